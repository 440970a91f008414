"""ArduCopter's parameters, judged: what it does when this app falls silent."""

from __future__ import annotations

from collections.abc import Iterator

from companion.check.report import Part, Row, State, never_came
from companion.link.survey import VehicleFindings

_LAND = (4, 5, 7)
"""FS_GCS_ENABLE: SmartRTL or Land, Land, Brake or Land."""
_RETURN = (1, 2, 3, 6)
_LONG_TIMEOUT_S = 3.0
_NOBODY = "When this app is killed, it stops and stays in GUIDED until somebody acts."


def judge(found: VehicleFindings, watched_s: float) -> Iterator[Row]:
    """The failsafe that must stand in for this app, and how long a lost setpoint is flown."""
    values = found.parameters
    enabled, ours = values.get("FS_GCS_ENABLE"), values.get("SYSID_MYGCS")
    timeout_s = values.get("GUID_TIMEOUT")
    if enabled is None:
        yield never_came(Part.PARAMETERS, "FS_GCS_ENABLE", watched_s, _NOBODY)
    elif enabled in _LAND:
        yield Row(Part.PARAMETERS, "FS_GCS_ENABLE", State.OK, f"{enabled:g}: without HEARTBEAT it lands")
    else:
        returns = enabled in _RETURN
        yield Row(
            Part.PARAMETERS,
            "FS_GCS_ENABLE",
            State.WARN,
            f"{enabled:g}: without HEARTBEAT it {'returns' if returns else 'does nothing'}",
            "A return needs a global position." if returns else _NOBODY,
            "set FS_GCS_ENABLE = 5 (Land)",
        )
    if ours is None:
        yield never_came(Part.PARAMETERS, "SYSID_MYGCS", watched_s, "Whose HEARTBEAT counts is not known.")
    elif ours == found.system_id:
        yield Row(Part.PARAMETERS, "SYSID_MYGCS", State.OK, f"{ours:g}: our HEARTBEAT is the one that counts")
    else:
        yield Row(
            Part.PARAMETERS,
            "SYSID_MYGCS",
            State.WARN,
            f"{ours:g}: the HEARTBEAT of system {ours:g} counts, not ours",
            _NOBODY,
            f"set SYSID_MYGCS = {found.system_id} (MAV_GCS_SYSID from 4.7 on), which is the id that we use",
        )
    if timeout_s is None:
        yield never_came(Part.PARAMETERS, "GUID_TIMEOUT", watched_s, "How long it flies on is not known.")
    elif timeout_s <= _LONG_TIMEOUT_S:
        text = f"{timeout_s:g} s: our stream lost, it flies on for so long, then stands"
        yield Row(Part.PARAMETERS, "GUID_TIMEOUT", State.OK, text)
    else:
        yield Row(
            Part.PARAMETERS,
            "GUID_TIMEOUT",
            State.WARN,
            f"{timeout_s:g} s: our stream lost, it flies on for so long",
            "That long nobody steers.",
            "set GUID_TIMEOUT to 3 or less",
        )
