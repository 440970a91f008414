"""What is published from: a recording played, and the far end of a module's serial port."""

from __future__ import annotations

import fcntl
import os
import struct
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from companion.uwb.families import Family, open_parser
from companion.uwb.measured import Measured
from companion.uwb.sources import Recording, batches


def play(path: Path, family: Family, **options: float) -> list[Measured]:
    source = Recording(path, **options)
    read = batches(source, family, open_parser(family), threading.Event(), print)
    return [m for batch in read for m in batch]


class Module:
    """The far end of a pseudo-terminal: what a UWB module would be."""

    def __init__(self, link: Path) -> None:
        self._far, near = os.openpty()
        tty.setraw(near)
        self._near = near
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(near))
        os.set_blocking(self._far, False)
        self.heard = b""

    def write(self, data: bytes) -> None:
        """What finds the buffer full of what nobody has read is lost, and lost as a whole."""
        (unread,) = struct.unpack("i", fcntl.ioctl(self._near, termios.FIONREAD, b"\0" * 4))
        if unread < 2048:
            os.write(self._far, data)

    def listen(self) -> bytes:
        with suppress(BlockingIOError):
            self.heard += os.read(self._far, 4096)
        return self.heard

    def close(self) -> None:
        os.close(self._far)
        os.close(self._near)


@contextmanager
def attached(tmp_path: Path) -> Iterator[tuple[Module, str]]:
    link = tmp_path / "uwb"
    unit = Module(link)
    try:
        yield unit, str(link)
    finally:
        unit.close()
