"""What a steering law's gains are worth, before a flight: gains, poles and margins over the range.

The loop is broken where the yaw rate is commanded: steering law × first-order lag of the yaw rate × bearing
kinematics Eq. (5), linearised at each distance (and bearing). The vehicle's dead time is not in the loop: it
is what the delay margin is held against. Gains are those that fly, from `guidance.lq`.

python-control and matplotlib are slow to import, so nothing of a flight imports this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import control
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from companion.guidance import lq, model
from companion.guidance.lq import Gains
from companion.guidance.settings import GuidanceSettings

DISTANCES = 40
FARTHEST_M = 60.0
TABLE_STRIDE = 4
"""Every so manieth distance is in the text; a divisor of DISTANCES, so that all bearings show the same."""
TICKS_M = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
SHORTEST_SHOWN_S = 0.01
"""The plot of delay margins ends here; those of unstable loops, which are 0, lie on its edge."""
ENDLESS = 1e6
"""Gain margins above this are rounding."""
BEARINGS_RAD: dict[str, tuple[float, ...]] = {"lq": (0.0,), "lq-paper": (0.05, 0.5, 1.5, 2.5)}
"""Where the loop is linearised. The gains of `lq` do not depend on the bearing, and at 0 the plant is at its
least stable; those of `lq-paper` do."""


@dataclass(frozen=True, slots=True)
class DesignPoint:
    """The loop at one distance and bearing.

    `poles_rad_s` are those of the closed loop without dead time. The loop stays stable while its gain is
    multiplied by anything between the two gain margins, and while the dead time is below the delay margin
    (0 where the loop is unstable to begin with). Infinite margins have no limit.
    """

    distance_m: float
    bearing_rad: float
    gains: Gains
    poles_rad_s: tuple[complex, ...]
    gain_margin_low: float
    gain_margin_high: float
    phase_margin_rad: float
    crossover_rad_s: float
    delay_margin_s: float

    @property
    def is_stable(self) -> bool:
        """True if every closed-loop pole is in the left half plane."""
        return all(pole.real < 0.0 for pole in self.poles_rad_s)


@dataclass(frozen=True, slots=True)
class DesignReport:
    """The analysis of one steering law on one vehicle; `warnings` are sentences for a person."""

    controller: Literal["lq", "lq-paper"]
    vehicle_lag_s: float
    vehicle_delay_s: float
    points: tuple[DesignPoint, ...]
    warnings: tuple[str, ...]


def design(settings: GuidanceSettings, vehicle_lag_s: float, vehicle_delay_s: float) -> DesignReport:
    """Analyse the steering law that the settings select.

    `vehicle_lag_s` is the first-order lag of the vehicle's yaw rate (which `lq` is designed for, and
    `lq-paper` ignores), `vehicle_delay_s` its dead time, telemetry and computation included.
    """
    nearest_m = settings.capture_radius_m - settings.stop_margin_m
    points = tuple(
        _point(settings, vehicle_lag_s, float(d), theta)
        for theta in BEARINGS_RAD[settings.controller]
        for d in np.geomspace(nearest_m, max(FARTHEST_M, 2.0 * nearest_m), DISTANCES)
    )
    return DesignReport(
        settings.controller,
        vehicle_lag_s,
        vehicle_delay_s,
        points,
        _warnings(settings, points, vehicle_delay_s),
    )


def _point(settings: GuidanceSettings, lag_s: float, d_m: float, theta_rad: float) -> DesignPoint:
    v = settings.speed_m_s
    if settings.controller == "lq":
        gains = lq.bearing_gains(d_m, v, lag_s, *settings.lq_q, settings.lq_r)
    else:
        gains = lq.paper_gains(d_m, theta_rad, v, *settings.lq_paper_q, settings.lq_paper_r)
    loop = _loop(settings.controller, gains, model.jacobian(d_m, theta_rad, v), lag_s)
    poles = tuple(complex(p) for p in control.feedback(loop, 1).poles())
    stable = all(p.real < 0.0 for p in poles)
    low, high, phase, crossover, delay = _margins(loop)
    return DesignPoint(d_m, theta_rad, gains, poles, low, high, phase, crossover, delay if stable else 0.0)


def _loop(controller: str, k: Gains, m: model.Jacobian, lag_s: float) -> Any:
    """The open loop from commanded yaw rate to −(what the law commands), as a state space.

    States: `lq` θ, `lq-paper` d and θ, then the actual yaw rate if it lags.
    """
    if controller == "lq":
        a, on_state, on_rate = np.array([[m.c]]), np.array([[k.k1]]), k.k2
    else:
        a, on_state, on_rate = np.array([[0.0, m.a], [-m.b, m.c]]), np.array([[k.k1, k.k2]]), 0.0
    n = len(a)
    drive = np.zeros((n, 1))
    drive[-1, 0] = 1.0
    if lag_s == 0.0:
        return control.ss(a, drive, on_state, on_rate)
    lagged = np.block([[a, drive], [np.zeros((1, n)), np.array([[-1.0 / lag_s]])]])
    command = np.zeros((n + 1, 1))
    command[-1, 0] = 1.0 / lag_s
    return control.ss(lagged, command, np.hstack([on_state, [[on_rate]]]), 0.0)


def _margins(loop: Any) -> tuple[float, float, float, float, float]:
    """Gain margins (low, high), least phase margin, its crossover frequency, least delay margin."""
    gain, phase_deg, _, _, crossover, _ = control.stability_margins(loop, returnall=True)
    gains = [float(g) for g in gain if g < ENDLESS]
    at_rest = float(np.real(loop(0.0)))
    if at_rest < 0.0 and math.isfinite(at_rest):  # a phase of −180° at frequency 0 counts as well
        gains.append(-1.0 / at_rest)
    low = max((g for g in gains if g < 1.0), default=0.0)
    high = min((g for g in gains if g > 1.0), default=math.inf)
    crossings = [
        (math.radians(float(p)), float(w)) for p, w in zip(phase_deg, crossover, strict=True) if w > 0.0
    ]
    if not crossings:
        return low, high, math.inf, math.nan, math.inf
    phase, at = min(crossings, key=lambda c: abs(c[0]))
    delay = min((p % model.TWO_PI) / w for p, w in crossings)
    return low, high, phase, at, delay


def _warnings(settings: GuidanceSettings, points: tuple[DesignPoint, ...], delay_s: float) -> tuple[str, ...]:
    found = []
    for theta in BEARINGS_RAD[settings.controller]:
        line = [p for p in points if p.bearing_rad == theta]
        at = f" at a bearing of {theta:g} rad" if len(points) > len(line) else ""
        unstable = [p.distance_m for p in line if not p.is_stable]
        if unstable:
            found.append(f"unstable{at} on this vehicle, even without dead time: {_span(unstable)}")
        late = [p for p in line if p.is_stable and p.delay_margin_s < delay_s]
        if late:
            least = min(p.delay_margin_s for p in late)
            found.append(
                f"the delay margin{at} is down to {least:.3f} s, below the vehicle's dead time of "
                f"{delay_s:.3f} s: {_span([p.distance_m for p in late])}"
            )
    if settings.controller == "lq-paper":
        q1, r = settings.lq_paper_q[0], settings.lq_paper_r
        found.append(
            f"near bearing 0 the law is a relay of ±{math.sqrt(q1 / r):.3f} rad/s per metre of distance, "
            "which no margin of a linear loop describes"
        )
    return tuple(found)


def _span(distances_m: list[float]) -> str:
    return f"distances {min(distances_m):.2f} to {max(distances_m):.2f} m"


def table(report: DesignReport) -> str:
    """The report as text: one line per distance and bearing, then the warnings."""
    lines = [
        f"{report.controller}: yaw-rate lag {report.vehicle_lag_s:g} s, "
        f"dead time {report.vehicle_delay_s:g} s",
        "distance  bearing      k1      k2  gain margins  phase  crossover   delay  closed-loop poles",
        "       m      rad                         low  high    deg      rad/s  margin  rad/s",
    ]
    for p in report.points[::TABLE_STRIDE]:
        poles = "  ".join(_pole(pole) for pole in p.poles_rad_s if pole.imag >= 0.0)
        lines.append(
            f"{p.distance_m:8.2f} {p.bearing_rad:8.2f} {p.gains.k1:7.3f} {p.gains.k2:7.3f} "
            f"{p.gain_margin_low:8.2f} {p.gain_margin_high:5.2f} {math.degrees(p.phase_margin_rad):6.1f} "
            f"{p.crossover_rad_s:10.2f} {p.delay_margin_s:7.3f}  {poles}"
        )
    return "\n".join([*lines, *(f"warning: {w}" for w in report.warnings)])


def _pole(pole: complex) -> str:
    return f"{pole.real:.2f}" if pole.imag == 0.0 else f"{pole.real:.2f} ± {pole.imag:.2f}j"


def plot(report: DesignReport, directory: Path) -> Path:
    """Draw gains, poles and margins over the distance into `directory`/design.png; return that path."""
    directory.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(11.0, 8.0), layout="constrained")
    axes: Any = figure.subplots(2, 2)
    _draw_over_distance(axes, report)
    _draw_poles(axes[0, 1], figure, report)
    figure.suptitle(
        f"Steering law {report.controller}: yaw-rate lag {report.vehicle_lag_s:g} s, "
        f"dead time {report.vehicle_delay_s:g} s"
    )
    path = directory / "design.png"
    figure.savefig(path, dpi=110)
    return path


def _draw_over_distance(axes: Any, report: DesignReport) -> None:
    gains, phase, delay = axes[0, 0], axes[1, 0], axes[1, 1]
    for n, theta in enumerate(BEARINGS_RAD[report.controller]):
        line = [p for p in report.points if p.bearing_rad == theta]
        d = [p.distance_m for p in line]
        name = "" if report.controller == "lq" else f"θ = {theta:g}"
        color = f"C{n}"
        gains.plot(d, [p.gains.k1 for p in line], color=color, label=f"k1 {name}")
        gains.plot(d, [p.gains.k2 for p in line], color=color, ls="--", label=f"k2 {name}")
        phase.plot(d, [math.degrees(p.phase_margin_rad) for p in line], color=color, label=name)
        delay.plot(
            d,
            [max(p.delay_margin_s, SHORTEST_SHOWN_S) for p in line],
            color=color,
            label=name or "delay margin",
        )
    delay.axhline(report.vehicle_delay_s, color="k", ls=":", label="the vehicle's dead time")
    delay.set_yscale("log")
    delay.set_ylim(SHORTEST_SHOWN_S, 30.0)
    gains.set_title("Gains")
    phase.set_title("Least phase margin (degrees)")
    delay.set_title("Delay margin (s)")
    for axis in (gains, phase, delay):
        axis.set_xscale("log")
        axis.set_xticks(TICKS_M, [f"{tick:g}" for tick in TICKS_M])
        axis.minorticks_off()
        axis.set_xlabel("distance (m)")
        axis.grid(alpha=0.3)
    gains.legend(fontsize="small", ncols=2 if report.controller == "lq-paper" else 1)
    delay.legend(fontsize="small")
    if report.controller != "lq":
        phase.legend(fontsize="small")


def _draw_poles(axis: Axes, figure: Figure, report: DesignReport) -> None:
    poles = [(p.distance_m, pole) for p in report.points for pole in p.poles_rad_s]
    dots = axis.scatter(
        [pole.real for _, pole in poles],
        [pole.imag for _, pole in poles],
        c=[d for d, _ in poles],
        norm=LogNorm(),
        s=12.0,
    )
    axis.axvline(0.0, color="k", lw=0.8)
    axis.set_title("Closed-loop poles, without dead time (rad/s)")
    axis.set_xlabel("real")
    axis.set_ylabel("imaginary")
    axis.grid(alpha=0.3)
    bar = figure.colorbar(dots, ax=axis, label="distance (m)")
    bar.set_ticks(list(TICKS_M), labels=[f"{tick:g}" for tick in TICKS_M])
    bar.ax.minorticks_off()
