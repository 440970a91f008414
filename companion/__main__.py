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
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # nobody reads any more
            stream.flush()
    os._exit(status)


if __name__ == "__main__":
    run()
