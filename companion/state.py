"""What the pilot remembers: the plan of the flight, and the state that `pilot.step` carries along."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from companion import gate
from companion.beacons import Beacon
from companion.echo import Echo
from companion.guidance.scheme import PROBE, Command, Scheme
from companion.health import Health
from companion.limits import LimitState
from companion.settings import Settings
from companion.types import Phase, Setpoint, Verdict
from companion.vehicle import BodyMotion, Vehicle

STANDSTILL = Command(0.0, 0.0, PROBE)


class Plan(msgspec.Struct, frozen=True, gc=False):
    """What stays the same for a whole flight: the settings and what follows from them."""

    settings: Settings
    scheme: Scheme
    beacons: dict[str, Beacon]
    """Beacon id → its number in the scheme and what the configuration says of it."""
    to_find: int = 1
    to_keep: int = 1
    """So many beacons must be heard until the target or station is located, and after that."""


class Ranging(msgspec.Struct, frozen=True, gc=False):
    """What has become of the ranges."""

    beacons: dict[str, Beacon]
    """As in the plan, with what the beacons have told of themselves."""
    tracks: dict[str, gate.Track] = {}  # never changed in place, as the three below
    rejected: dict[Verdict, int] = {}
    malformed: dict[str, int] = {}
    accepted: int = 0
    accepted_before_loss: int | None = None
    """So many when the ranges were lost last in this flight; None: they never were."""
    t_lost_ns: int | None = None
    """Until when enough beacons were heard before that loss."""
    t_ns: int | None = None
    """When a range was believed last."""
    heard: dict[str, int] = {}
    """When a range of each beacon was believed last."""
    t_enough_ns: int | None = None
    """Until when enough beacons were heard: losses are judged by that."""
    range_m: float | None = None
    verdict: Verdict = Verdict.ACCEPTED
    """What became of the last range."""


class Observing(msgspec.Struct, frozen=True, gc=False):
    """The scheme's own state, the time that it stands at, and the motion that brought it there."""

    guidance: Any
    t_ns: int = 0
    motion: BodyMotion = BodyMotion()
    heading_rad: float = 0.0
    """The heading that the observer's turning so far amounts to; each ATTITUDE corrects it."""
    path_m: float = 0.0
    place: tuple[float, float] | None = None
    """Where the observer's moves lead to, in the autopilot's local frame; None: it tells no position."""
    lag_x_m: float = 0.0
    lag_y_m: float = 0.0
    """What the next prediction moves on top, to be where the autopilot's position says."""


class Steering(msgspec.Struct, frozen=True, gc=False):
    """The last command, and what left of it."""

    command: Command = STANDSTILL
    t_command_ns: int = 0
    hold_height_m: float | None = None
    limits: LimitState = LimitState()
    setpoint: Setpoint | None = None
    t_allowed_ns: int = 0
    echo: Echo = Echo()
    """What was sent lately, held against what the autopilot says that it flies."""


class Flight(msgspec.Struct, frozen=True, gc=False):
    """What has happened so far."""

    stop_asked: bool = False
    was_ready: bool = False
    was_engaged: bool = False
    captured: bool = False
    t_engaged_ns: int = 0
    engaged_s: float = 0.0
    """How long the last engagement lasted, once it is over."""
    t_heartbeat_ns: int | None = None
    t_status_ns: int | None = None
    t_request_ns: int | None = None
    hand_over_to: str = ""
    """What the hand-over under way asks for, as in `loss.hand_over_to`."""


class State(msgspec.Struct, frozen=True, gc=False):
    """All that the pilot remembers, in groups that change at the same pace."""

    phase: Phase
    reason: str
    t_phase_ns: int | None
    vehicle: Vehicle
    ranging: Ranging
    observing: Observing
    steering: Steering
    flight: Flight
    health: Health


def age_s(then_ns: int | None, now_ns: int) -> float:
    """Seconds since then; infinite where it never was."""
    return math.inf if then_ns is None else (now_ns - then_ns) * 1e-9


def height_m(p: Plan, s: State, t_ns: int) -> float | None:
    """The height, while it is told: by an old one a vehicle would climb or sink without end."""
    late_s = p.settings.loss.telemetry_after_s
    return s.vehicle.height_m if age_s(s.vehicle.t_motion_ns, t_ns) <= late_s else None
