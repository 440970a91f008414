"""What a person at a ground station is told: STATUSTEXT and NAMED_VALUE_FLOAT, made from the loop's outputs.

Pure: output in, messages out, paced by the outputs' own time. The vehicle's link sends them as broadcasts of
our component; an autopilot that forwards (PX4: MAV_n_FORWARD of our port) hands them to the ground station.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from companion.settings import Settings
from companion.types import Output, Phase, PhaseChange, Severity, Status

TEXT_BYTES = 50
"""Of one STATUSTEXT; a longer text is sent in chunks of this length."""
TEXT_GAP_S = 1.0
"""Between two texts, unless the later one is a warning or worse, or the last of all."""
AWAITED_S = 2.0
"""What is still awaited after this long is told."""
FRESH_S = 1.0
"""An older range is not sent: the plot shows the gap."""


class GroundStation:
    """Decides what is told. Where phases change faster than texts may go, the last one is told."""

    def __init__(self, settings: Settings) -> None:
        self._texts = settings.ground_station.texts
        self._values_period_ns = (
            0.9e9 / settings.ground_station.values_rate_hz if settings.ground_station.values_rate_hz else None
        )  # nine tenths: statuses come a little early or late
        _, self._radius_m = settings.aim
        self._pending: PhaseChange | None = None
        self._told: tuple[Phase, str] | None = None
        self._t_text_ns: int | None = None
        self._t_values_ns: int | None = None
        self._awaited: tuple[tuple[str, ...], int] = ((), 0)
        self._awaited_told: tuple[str, ...] = ()
        self._text_id = 0

    def messages(self, output: Output) -> list[Any]:
        """The MAVLink messages that go with an output, in order; mostly none."""
        if isinstance(output, PhaseChange):
            self._pending = output
            return self._due_text(output.t_ns)
        if isinstance(output, Status):
            return self._due_text(output.t_ns) + self._due_awaited(output) + self._due_values(output)
        return []

    # ------------------------------------------------------------------------------------------- texts

    def _due_text(self, t_ns: int) -> list[Any]:
        change = self._pending
        if change is None or not self._texts:
            return []
        if (change.after, change.reason) == self._told:  # back where it was, before that could be told
            self._pending = None
            return []
        urgent = change.severity <= Severity.WARNING or change.after.is_final
        if not urgent and self._is_too_soon(t_ns):
            return []
        self._pending = None
        self._told = (change.after, change.reason)
        return self._text(change.severity, f"{change.after.value}: {change.reason}", t_ns)

    def _due_awaited(self, s: Status) -> list[Any]:
        """What the flight waits for, once it has been the same for a while."""
        if s.awaited != self._awaited[0]:
            self._awaited = (s.awaited, s.t_ns)
        waited_s = (s.t_ns - self._awaited[1]) * 1e-9
        if not self._texts or s.awaited == self._awaited_told or waited_s < AWAITED_S:
            return []
        if s.awaited and self._is_too_soon(s.t_ns):
            return []
        self._awaited_told = s.awaited
        return self._text(Severity.NOTICE, f"awaiting {'; '.join(s.awaited)}", s.t_ns) if s.awaited else []

    def _is_too_soon(self, t_ns: int) -> bool:
        return self._t_text_ns is not None and (t_ns - self._t_text_ns) * 1e-9 < TEXT_GAP_S

    def _text(self, severity: Severity, text: str, t_ns: int) -> list[Any]:
        self._t_text_ns = t_ns
        self._text_id = self._text_id % 0xFFFF + 1
        return text_messages(severity, f"companion: {text}", self._text_id)

    # ------------------------------------------------------------------------------------------ values

    def _due_values(self, s: Status) -> list[Any]:
        if self._values_period_ns is None:
            return []
        if self._t_values_ns is not None and s.t_ns - self._t_values_ns < self._values_period_ns:
            return []
        self._t_values_ns = s.t_ns
        t_boot_ms = (s.t_ns // 1_000_000) & 0xFFFFFFFF
        return [
            mavlink.MAVLink_named_value_float_message(t_boot_ms, name.encode(), value)
            for name, value in values(s, self._radius_m).items()
        ]


def values(s: Status, radius_m: float) -> dict[str, float]:
    """What is plotted, by name (at most 10 characters); what is not known is left out.

    `range_m` slant, where there is one beacon; `bear_deg` positive to the right, `sigma_deg` its standard
    deviation; `togo_m` the estimated horizontal distance to the radius around target or station, 0 inside it.
    """
    known = {}
    is_fresh = s.range_age_s is not None and s.range_age_s <= FRESH_S
    if s.range_m is not None and is_fresh and not s.beacons:
        known["range_m"] = s.range_m
    if (e := s.estimate) is not None:
        known["bear_deg"] = math.degrees(e.bearing_rad)
        known["sigma_deg"] = math.degrees(e.bearing_sigma_rad)
        known["togo_m"] = max(e.distance_m - radius_m, 0.0)
    return known


def text_messages(severity: Severity, text: str, text_id: int) -> list[Any]:
    """One STATUSTEXT, or the chunks of a longer text: same id, counted, the last one not full."""
    data = text.encode("ascii", "replace")
    if len(data) <= TEXT_BYTES:
        return [mavlink.MAVLink_statustext_message(int(severity), data, 0, 0)]
    return [
        mavlink.MAVLink_statustext_message(
            int(severity), data[n * TEXT_BYTES : (n + 1) * TEXT_BYTES], text_id, n
        )
        for n in range(len(data) // TEXT_BYTES + 1)
    ]
