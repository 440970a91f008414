"""What else is known of the vehicle: battery, estimate, restarts, its words, and who else is on its link.

The wording of what is missing stands here once: `companion check` and the flight say the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import msgspec
from msgspec.structs import replace

from companion.settings import LossSettings, VehicleSettings
from companion.types import AutopilotWords, BatteryReport, Charge, EstimatorReport, PartyHeard

_RANK = {Charge.UNKNOWN: 0, Charge.OK: 1, Charge.LOW: 2, Charge.CRITICAL: 3}
_ESTIMATE_FRESH_NS = 5_000_000_000
"""ESTIMATOR_STATUS comes at 0.5 to 1 Hz; an older one says nothing of now."""


class Health(msgspec.Struct, frozen=True, gc=False):
    """The last word of each kind since the autopilot's start; None: nothing came."""

    t_found_ns: int | None = None
    """The first HEARTBEAT."""
    charge: Charge = Charge.UNKNOWN
    """The worst so far: a battery that was low once is low until the autopilot restarts."""
    share: float | None = None
    battery_low: bool = False
    """The battery is to end the flight (`loss.battery_hand_over`)."""
    estimator: EstimatorReport | None = None
    unfit_until_ns: int = 0
    """Until then the estimate is known not to carry the setpoints."""
    commander: PartyHeard | None = None
    other_vehicle: PartyHeard | None = None
    words: AutopilotWords | None = None
    clock_back: int = 0
    """Messages in a row whose time lies before that of earlier ones."""
    t_reboot_ns: int | None = None


def on_battery(h: Health, cfg: LossSettings, e: BatteryReport) -> Health:
    """BATTERY_STATUS or SYS_STATUS."""
    charge = max(h.charge, e.charge, key=_RANK.__getitem__)
    if e.share is not None and e.share < cfg.battery_share:
        charge = max(charge, Charge.LOW, key=_RANK.__getitem__)
    ends = charge is Charge.CRITICAL or (charge is Charge.LOW and cfg.battery_hand_over == "low")
    return replace(
        h,
        charge=charge,
        share=h.share if e.share is None else e.share,
        battery_low=ends and cfg.battery_hand_over != "never",
    )


def on_estimator(h: Health, cfg: VehicleSettings, e: EstimatorReport) -> Health:
    """ESTIMATOR_STATUS."""
    until_ns = 0 if can_fly(cfg, e) else e.t_ns + _ESTIMATE_FRESH_NS
    return replace(h, estimator=e, unfit_until_ns=until_ns)


def battery_words(h: Health) -> str:
    """The battery in words: `low, 9 % left`."""
    return h.charge.value + ("" if h.share is None else f", {h.share * 100:.0f} % left")


def fresh_estimator(h: Health, t_ns: int) -> EstimatorReport | None:
    """What is told of the estimate now; None where nothing is, or not lately."""
    e = h.estimator
    return e if e is not None and t_ns - e.t_ns <= _ESTIMATE_FRESH_NS else None


class Shortfall(NamedTuple):
    """Something that the autopilot's estimate lacks: what, why that matters, and what to do."""

    subject: str
    found: str
    why: str
    do: str
    vital: bool
    """Setpoints cannot be flown without it."""

    def text(self) -> str:
        """In one line."""
        return f"{self.subject} estimate {self.found}: {self.why} → {self.do}"


def shortfalls(
    cfg: VehicleSettings, hand_over_to: Literal["land", "hold", "release"], e: EstimatorReport
) -> Iterator[Shortfall]:
    """What the estimate lacks for this flight."""
    is_px4 = cfg.kind == "px4"
    if not e.velocity:
        yield Shortfall(
            "velocity",
            "not valid",
            'OFFBOARD cannot run. PX4 then says "no offboard signal", though setpoints arrive.'
            if is_px4
            else "GUIDED cannot run.",
            "wait for GPS, or give it optical flow or vision "
            + (
                "(EKF2_OF_CTRL; EKF2_EV_CTRL = 15, EKF2_HGT_REF = 3, EKF2_MAG_TYPE = 5 and ODOMETRY at 25 Hz "
                "or more)"
                if is_px4
                else "(EK3_SRC1_VELXY = 5 with FLOW_TYPE; EK3_SRC1_POSXY = 6 with VISO_TYPE)"
            ),
            vital=True,
        )
    if not (e.position and e.height) and cfg.setpoint_frame == "local_ned":
        yield Shortfall(
            "local position",
            "not valid" if not e.position else "has no valid height",
            "Setpoints with a height (vehicle.setpoint_frame = local_ned) need it.",
            'wait for it, or set vehicle.setpoint_frame = "body_ned"',
            vital=True,
        )
    if not e.global_position:
        asks = hand_over_to == "hold"
        yield Shortfall(
            "global position",
            "not there",
            "Hold and Return are not available without it"
            + (", and the hand-over asks for Hold (loss.hand_over_to)." if asks else "."),
            ("set COM_OBL_RC_ACT = 4 (Land)" if is_px4 else "set FS_GCS_ENABLE = 5 (Land)")
            + (' and loss.hand_over_to = "land"' if asks else ""),
            vital=False,
        )


def can_fly(cfg: VehicleSettings, e: EstimatorReport) -> bool:
    """True where nothing vital is missing: the same as no vital `shortfalls`, without the words."""
    return e.velocity and (cfg.setpoint_frame == "body_ned" or (e.position and e.height))


WITHOUT = {
    "HEARTBEAT": "Nothing is known of the vehicle.",
    "ATTITUDE": "Without a heading the app stands still.",
    "LOCAL_POSITION_NED": "Speed and height are not known.",
    "CURRENT_MODE": "The mode is then known by HEARTBEAT only, up to 1 s late, and the intended mode not "
    "at all: started in the air, or after a takeover, the app stays silent until a restart on the ground.",
    "EXTENDED_SYS_STATE": "Whether it stands on the ground is not known.",
    "ESTIMATOR_STATUS": "Whether OFFBOARD can run is not known.",
    "BATTERY_STATUS": "Nobody will notice an empty one.",
}
"""Telemetry, and what is not known without it."""
