"""The law that holds whatever fails: judged by what the app was told and by the truth, not by its state."""

from __future__ import annotations

from collections import deque
from math import hypot, isfinite
from typing import NamedTuple

from companion.settings import Settings
from companion.types import (
    Attitude,
    Event,
    FlightMode,
    ModeReport,
    ModeRequest,
    Output,
    Phase,
    RangeSample,
    Setpoint,
    VehicleHeartbeat,
)
from sitl_mock.modes import Mode
from sitl_mock.world import World

_SPEED_MARGIN_M_S = 0.15
_YAW_RATE_MARGIN_RAD_S = 0.3
_HEIGHT_MARGIN_M = 0.3
_COAST_M = 2.0
"""What the true motion may exceed the commanded by: overshoot, the estimate's error, the way to a stop."""
_HAND_OVER_TO = (FlightMode.AUTO_LOITER, FlightMode.AUTO_LAND)
_MODE_FRESH_NS = 1_500_000_000
_SLACK = 1e-9


class Limits(NamedTuple):
    """The most of everything that the vehicle did, in OFFBOARD, since the strike; the truth."""

    speed_m_s: float = 0.0
    yaw_rate_rad_s: float = 0.0
    height_min_m: float = 99.0
    height_max_m: float = 0.0
    distance_m: float = 0.0
    """From where it stood when the fault struck."""

    def and_also(self, other: Limits) -> Limits:
        """The worse of two."""
        return Limits(
            max(self.speed_m_s, other.speed_m_s),
            max(self.yaw_rate_rad_s, other.yaw_rate_rad_s),
            min(self.height_min_m, other.height_min_m),
            max(self.height_max_m, other.height_max_m),
            max(self.distance_m, other.distance_m),
        )

    def exceeded(self, settings: Settings) -> list[str]:
        """Which limits of the configuration the true motion left by more than physics explains."""
        cfg = settings.limits
        if not self.height_max_m:
            return []
        bounds = (
            ("speed, m/s", self.speed_m_s, 0.0, cfg.speed_m_s + _SPEED_MARGIN_M_S),
            ("yaw rate, rad/s", self.yaw_rate_rad_s, 0.0, cfg.yaw_rate_rad_s + _YAW_RATE_MARGIN_RAD_S),
            ("least height, m", self.height_min_m, cfg.height_min_m - _HEIGHT_MARGIN_M, 1e9),
            ("greatest height, m", self.height_max_m, 0.0, cfg.height_max_m + _HEIGHT_MARGIN_M),
            ("distance, m", self.distance_m, 0.0, cfg.from_start_m + _COAST_M),
        )
        return [
            f"beyond the limits: {what}: {value:.2f}"
            for what, value, low, high in bounds
            if not low <= value <= high
        ]


class Watch:
    """Notes what the app was told and what it sent, and every breach of the law."""

    def __init__(self, settings: Settings, world: World) -> None:
        self.limits = Limits()
        self.broken: list[str] = []
        self._settings = settings
        self._world = world
        self._begun = False
        self._from = (0.0, 0.0)
        self._t_event_ns = 0
        self._t_vehicle_ns = self._t_mode_ns = self._t_attitude_ns = self._t_range_ns = -(10**12)
        self._actual: FlightMode | None = None
        self._intended: FlightMode | None = None
        self._armed = False
        self._was_steering = False
        self._seqs: dict[str, tuple[int, int]] = {}
        """Session → its last number, and when it came."""
        self._last: Setpoint | None = None
        self._recent: deque[int] = deque(maxlen=int(settings.stream.max_rate_hz) + 2)

    def begin(self) -> None:
        """The fault strikes."""
        self._begun = True
        self._from = (self._world.vehicle.x_m, self._world.vehicle.y_m)

    def look(self) -> None:
        """Look at the truth."""
        px4, v = self._world.px4, self._world.vehicle
        if self._begun and px4.mode is Mode.OFFBOARD and px4.armed:
            now = Limits(
                hypot(v.vx_m_s, v.vy_m_s),
                abs(v.yaw_rate_rad_s),
                v.height_m,
                v.height_m,
                hypot(v.x_m - self._from[0], v.y_m - self._from[1]),
            )
            self.limits = self.limits.and_also(now)

    def record(self, _: object) -> None:
        """The run's record is not needed."""

    # ---------------------------------------------------------------------------------------------- told

    def told(self, event: Event) -> None:
        """The app is told this now."""
        t_ns = self._t_event_ns = event.t_ns
        if isinstance(event, VehicleHeartbeat):
            self._t_vehicle_ns, self._armed = t_ns, event.armed
            if t_ns - self._t_mode_ns >= _MODE_FRESH_NS:
                self._actual, self._intended = event.mode, None
        elif isinstance(event, ModeReport):
            self._t_vehicle_ns = self._t_mode_ns = t_ns
            self._actual, self._intended = event.actual, event.intended
        elif isinstance(event, Attitude) and isfinite(event.heading_rad):
            self._t_attitude_ns = t_ns
        elif isinstance(event, RangeSample) and self._may_be_believed(event):
            self._t_range_ns = t_ns

    def _may_be_believed(self, e: RangeSample) -> bool:
        """New, of the target, and a length: what nobody may steer by is left out, not every outlier."""
        last, t_last_ns = self._seqs.get(e.session, (-1, 0))
        silent = e.t_ns - t_last_ns > self._settings.ranges.restart_after_s * 1e9  # then it may begin anew
        fresh = e.seq > last or silent
        mission = self._settings.mission
        known = self._settings.beacons if mission.kind == "station" else (mission.target,)
        if e.beacon not in known or not 0.0 < e.range_m < 1e6 or not fresh:
            return False
        self._seqs[e.session] = e.seq, e.t_ns
        return True

    # ---------------------------------------------------------------------------------------------- sent

    def sent(self, output: Output, phase: Phase) -> None:
        """The app sends this now, in this phase."""
        if isinstance(output, ModeRequest):
            if phase is not Phase.HAND_OVER or output.mode not in _HAND_OVER_TO:
                self._breach(f"asked for {output.mode.value} in {phase.value}")
            if (
                self._actual is not FlightMode.OFFBOARD
                or self._t_event_ns - self._t_vehicle_ns > _MODE_FRESH_NS
            ):
                self._breach("asked for a mode though a pilot may have taken over unheard")
        elif isinstance(output, Setpoint):
            self._bounds(output)
            self._grounds(output)
            self._last = output

    def _bounds(self, s: Setpoint) -> None:
        cfg = self._settings.limits
        if not all(
            map(isfinite, (s.speed_m_s, s.yaw_rate_rad_s, s.heading_rad, s.climb_m_s, s.height_m or 0.0))
        ):
            self._breach("a setpoint that is not finite")
        if not 0.0 <= s.speed_m_s <= cfg.speed_m_s or abs(s.yaw_rate_rad_s) > cfg.yaw_rate_rad_s:
            self._breach(f"a setpoint beyond the limits: {s}")
        if (
            s.speed_m_s > 0.0
            and s.height_m is not None
            and not cfg.height_min_m <= s.height_m <= cfg.height_max_m
        ):
            self._breach(f"a height out of its band: {s.height_m:g} m")
        before = self._last.speed_m_s if self._last is not None else 0.0
        if s.speed_m_s > before + 0.1 * cfg.acceleration_m_s2 + _SLACK:
            self._breach("a speed that jumps")
        if len(self._recent) == self._recent.maxlen and s.t_ns - self._recent[0] < 1_000_000_000:
            self._breach("more setpoints than the greatest rate allows")
        self._recent.append(s.t_ns)

    def _grounds(self, s: Setpoint) -> None:
        """Whether what the app was told entitles it to this setpoint."""
        cfg, t_ns = self._settings.loss, s.t_ns
        if t_ns != self._t_event_ns:
            self._breach("a setpoint that no event caused")
        insists = self._settings.vehicle.kind == "ardupilot"  # to which silence would mean nothing
        if t_ns - self._t_vehicle_ns > cfg.vehicle_after_s * 1e9 and not (insists and s.speed_m_s == 0.0):
            self._breach("a setpoint to a vehicle that is gone")
        offboard = self._actual is FlightMode.OFFBOARD
        if self._was_steering and not offboard and self._intended in (FlightMode.OFFBOARD, None):
            self._breach("a setpoint after OFFBOARD was left")
        if s.speed_m_s <= 0.0:
            return
        self._was_steering = True
        if not offboard or not self._armed:
            self._breach(f"a speed while {self._actual}, armed: {self._armed}")
        if t_ns - self._t_attitude_ns > cfg.telemetry_after_s * 1e9:
            self._breach("a speed without a heading")
        if t_ns - self._t_range_ns > cfg.stall_after_s * 1e9:
            self._breach("a speed without ranges")

    def _breach(self, what: str) -> None:
        if self._begun and what not in self.broken:
            self.broken.append(what)
