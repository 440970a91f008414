"""Entry point of the `companion` command."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import NoReturn

from companion.cli import main


def run() -> NoReturn:
    """The command, and the end of the process without the interpreter's own.

    A thread of Zenoh's that lets go of a Python object while the interpreter goes down aborts the process
    ("FATAL: exception not rethrown"): a flight that ended in order would look like a crash to systemd.
    """
    status = main()
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads any more
        pass
    except OSError as error:  # the status stays that of the command: a flight was what it was
        print(f"companion: its output could not be written: {error.strerror}", file=sys.stderr)
    with suppress(OSError):
        sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    run()
