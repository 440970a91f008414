"""Entry point of the `companion` command."""

from __future__ import annotations

import errno
import os
import sys
from contextlib import suppress
from typing import NoReturn

from companion.cli import main
from companion.exits import Exit

_UNWRITTEN = (errno.ENOSPC, errno.EIO)
"""The disk is full, or the terminal has gone."""


def run() -> NoReturn:
    """The command, and the end of the process without the interpreter's own.

    A thread of Zenoh's that lets go of a Python object while the interpreter goes down aborts the process
    ("FATAL: exception not rethrown"): a flight that ended in order would look like a crash to systemd.
    """
    status = 0
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads any more
        pass
    except OSError as error:
        if error.errno not in _UNWRITTEN:
            raise
        print(
            f"companion: {error.filename or 'its output'} could not be written: {error.strerror}",
            file=sys.stderr,
        )
        status = Exit.USAGE  # not of a flight, which writes its summary itself and ends as it was
    with suppress(OSError):
        sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    run()
