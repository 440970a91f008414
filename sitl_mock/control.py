"""Faults switched by a person or a script while the mock runs: lines `NAME on` and `NAME off`."""

from __future__ import annotations

import os
from collections.abc import Callable

from sitl_mock.faults import Faults, parse_fault

_CHUNK_BYTES = 4096


class Control:
    """Reads lines from a descriptor, never waiting; says what it did, and what it did not understand."""

    def __init__(self, descriptor: int, say: Callable[[str], None]) -> None:
        self._descriptor = descriptor
        self._say = say
        self._rest = b""

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._descriptor

    def read(self, faults: Faults) -> bool:
        """Obey what has come; to be called once there is something. False at the end of the input."""
        data = os.read(self._descriptor, _CHUNK_BYTES)
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._obey(line.decode(errors="replace").split(), faults)
        return bool(data)

    def _obey(self, words: list[str], faults: Faults) -> None:
        if not words:
            return
        if len(words) != 2 or words[1] not in ("on", "off") or "@" in words[0]:
            self._say(f"control: {' '.join(words)!r}: must be NAME on, or NAME off")
            return
        try:
            fault = parse_fault(words[0]).fault
        except ValueError as error:
            self._say(f"control: {error}")
            return
        faults.switch(fault, words[1] == "on")
        self._say(f"control: {fault.value} {words[1]}")
