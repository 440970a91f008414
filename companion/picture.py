"""A flight as one picture: the map, and what was known and commanded over time.

Matplotlib is imported when a picture is drawn (it comes with `companion[design]`), never in the flying loop.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from companion.summary import FlightReport, PhaseSpan, Pose, Problem, TrailPoint, shortest_from_m
from companion.types import Phase

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH_IN, HEIGHT_IN, DPI = 12.4, 7.0, 110
ARC_STEP_RAD = 0.05

PHASE_COLOURS = {
    Phase.AWAIT: "#aab4be",
    Phase.STANDBY: "#6c8ebf",
    Phase.INHIBITED: "#c08a2b",
    Phase.ACQUIRE: "#7fb2e5",
    Phase.APPROACH: "#1d5fa8",
    Phase.HOLD: "#2f8f5b",
    Phase.KEEP: "#2f8f5b",
    Phase.COAST: "#e0a100",
    Phase.STALL: "#d9622b",
    Phase.HAND_OVER: "#b3261e",
    Phase.RELEASED: "#8f7aa8",
    Phase.ENDED: "#5b6875",
}
"""Blue: flying; green: there; yellow to red: trouble. The pages use the same."""
_ACCENT = "#1d5fa8"
_SECOND = "#b36b00"
_INK = "#1f2933"
_FAINT = "#7a8794"


class PictureError(Exception):
    """A picture cannot be drawn: Matplotlib is missing, or there is no position to draw."""


class Truth(NamedTuple):
    """What a simulation knows besides, in the local frame, metres: the true path, the true target or station,
    and the beacons that a station is given by."""

    path: Sequence[tuple[float, float]]
    target: tuple[float, float]
    beacons: Sequence[tuple[float, float]] = ()


def draw_flight(
    path: Path, flight: FlightReport, truth: Truth | None = None, title: str | None = None
) -> None:
    """Write the picture of a flight as PNG. With a truth, the shortest path is the one to the true target.

    Raises `PictureError` where Matplotlib is not installed or no position is known, `OSError` where the file
    cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise PictureError(f"Matplotlib is missing ({error}): pip install 'companion[design]'") from error
    trail = _engaged_trail(flight)
    if not any(p.x_m is not None for p in trail):
        raise PictureError("no position of the vehicle is known")
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DPI, layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1.0), wspace=0.05)
    s = flight.summary
    title = title or headline(s.captured, s.time_s, s.path_m, s.path_ratio, flight.problem.kind)
    figure.suptitle(title, fontsize=14, fontweight="bold", color=_INK, x=0.012, ha="left")
    _map(figure.add_subplot(grid[:, 0]), flight, trail, truth)
    first = figure.add_subplot(grid[0, 1])
    others = [figure.add_subplot(grid[row, 1], sharex=first) for row in (1, 2)]
    _distances(first, flight, trail)
    _bearing(others[0], trail)
    _commands(others[1], trail)
    for axes in (first, *others):
        _bands(axes, flight.phases, trail[0].t_s, trail[-1].t_s)
        axes.tick_params(labelbottom=axes is others[1])
    others[1].set_xlabel("seconds since OFFBOARD was selected", color=_INK, fontsize=9)
    figure.savefig(path, format="png", facecolor="white")


def headline(
    captured: bool,
    time_s: float | None,
    path_m: float | None,
    path_ratio: float | None,
    kind: str = "capture",
) -> str:
    """A flight in one line."""
    done = (
        ("Station reached", "Station not reached")
        if kind == "station"
        else ("Target captured", "Target not captured")
    )
    parts = [done[0] if captured else done[1]]
    if time_s is not None and path_m is not None:
        parts.append(f"{time_s:.1f} s, {path_m:.2f} m flown")
    if path_ratio is not None:
        parts.append(f"{path_ratio:.2f} × the shortest path")
    return "  ·  ".join(parts)


def shortest_path(start: Pose, target: tuple[float, float], problem: Problem) -> list[tuple[float, float]]:
    """Points of the shortest path from a pose into the disc around the target, if it is of these kinds:
    an arc and a straight line towards the centre, or one arc alone. Empty where it takes two arcs.
    """
    rho = problem.speed_m_s / problem.yaw_rate_rad_s
    found = [_arc_and_line(start, target, problem.radius_m, rho, side) for side in (1.0, -1.0)]
    return min((points for points in found if points), key=_length, default=[])


def _length(points: Sequence[tuple[float, float]]) -> float:
    return sum(math.dist(a, b) for a, b in itertools.pairwise(points))


def _arc_and_line(
    start: Pose, target: tuple[float, float], radius_m: float, rho: float, side: float
) -> list[tuple[float, float]]:
    """Turn to a side (1 left, −1 right) until the centre is ahead or the disc is reached; then straight."""
    cx = start.x_m - side * rho * math.sin(start.heading_rad)
    cy = start.y_m + side * rho * math.cos(start.heading_rad)
    points = [(start.x_m, start.y_m)]
    turned = 0.0
    while math.dist(points[-1], target) > radius_m:
        heading = start.heading_rad + side * turned
        x, y = points[-1]
        off = math.remainder(math.atan2(target[1] - y, target[0] - x) - heading, math.tau) * side
        if 0.0 <= off <= ARC_STEP_RAD:
            away = math.dist((x, y), target)
            share = (away - radius_m) / away
            return [*points, (x + share * (target[0] - x), y + share * (target[1] - y))]
        turned += ARC_STEP_RAD
        if turned > math.tau:
            return []
        heading = start.heading_rad + side * turned
        points.append((cx + side * rho * math.sin(heading), cy - side * rho * math.cos(heading)))
    return points


# ------------------------------------------------------------------------------------------------ the map


def _map(axes: Axes, flight: FlightReport, trail: Sequence[TrailPoint], truth: Truth | None) -> None:
    s = flight.summary
    what = "station" if flight.problem.kind == "station" else "target"
    start = s.start or _first_pose(trail)
    target = None if s.target_x_m is None or s.target_y_m is None else (s.target_x_m, s.target_y_m)
    if truth is not None:
        axes.plot(*zip(*truth.path, strict=True), color=_FAINT, lw=1.0, zorder=2, label="true path")
        _target(axes, truth.target, flight.problem.radius_m, "*", "#f2b705", f"true {what}")
        if truth.beacons:
            axes.plot(
                *zip(*truth.beacons, strict=True), "^", ms=8, color=_FAINT, mec=_INK, ls="", label="beacons"
            )
    if target is not None:
        _target(axes, target, flight.problem.radius_m, "x", _INK, f"{what}, estimated last")
    aim = truth.target if truth is not None else target
    if start is not None and aim is not None:
        _shortest(axes, start, aim, flight.problem)
    for phase, xs, ys in _runs(trail):
        axes.plot(xs, ys, color=PHASE_COLOURS[phase], lw=2.8, solid_capstyle="round", zorder=5)
    if start is not None:
        _start(axes, start)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set_xlabel("East, m", color=_INK, fontsize=9)
    axes.set_ylabel("North, m", color=_INK, fontsize=9)
    _dress(axes)
    for phase in dict.fromkeys(p.phase for p in trail if p.phase.is_engaged):
        axes.plot([], [], color=PHASE_COLOURS[phase], lw=2.8, label=phase.value)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8.5, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.085),
                    columnspacing=1.4, handlelength=1.8)  # fmt: skip


def _target(
    axes: Axes, at: tuple[float, float], radius_m: float, marker: str, colour: str, label: str
) -> None:
    """A target and its capture disc: filled for the true one, a rim for the estimated one."""
    from matplotlib.patches import Circle

    true = marker == "*"
    size, edge = (15, 0.8) if true else (8, 1.8)
    axes.plot(*at, marker=marker, ms=size, color=colour, mec=_INK, mew=edge, ls="", zorder=6, label=label)
    disc = {"fc": colour, "alpha": 0.16, "ec": "none"} if true else {"fill": False, "ec": colour, "lw": 1.1}
    axes.add_patch(Circle(at, radius_m, zorder=3, **disc))


def _shortest(axes: Axes, start: Pose, target: tuple[float, float], problem: Problem) -> None:
    points = shortest_path(start, target, problem)
    if points:
        label = f"shortest path, {shortest_from_m(start, *target, problem):.2f} m"
        axes.plot(*zip(*points, strict=True), color=_INK, ls=(0, (4, 3)), lw=1.2, zorder=4, label=label)


def _start(axes: Axes, start: Pose) -> None:
    at = (start.x_m, start.y_m)
    nose = (start.x_m + 0.9 * math.cos(start.heading_rad), start.y_m + 0.9 * math.sin(start.heading_rad))
    arrow = {"arrowstyle": "-|>", "lw": 1.6, "color": _INK, "mutation_scale": 16}
    axes.annotate("", xy=nose, xytext=at, zorder=8, arrowprops=arrow)
    axes.plot(*at, "o", ms=6, color="white", mec=_INK, mew=1.5, zorder=9)
    axes.annotate(
        "start", at, textcoords="offset points", xytext=(-8, -14), fontsize=9, color=_INK, ha="right"
    )


def _runs(trail: Sequence[TrailPoint]) -> list[tuple[Phase, list[float], list[float]]]:
    """The path cut where the phase changes, each piece beginning where the one before ended."""
    runs: list[tuple[Phase, list[float], list[float]]] = []
    for p in trail:
        if p.x_m is None or p.y_m is None:
            continue
        if not runs or runs[-1][0] is not p.phase:
            before = [(runs[-1][1][-1], runs[-1][2][-1])] if runs else []
            runs.append((p.phase, [x for x, _ in before], [y for _, y in before]))
        runs[-1][1].append(p.x_m)
        runs[-1][2].append(p.y_m)
    return runs


def _first_pose(trail: Sequence[TrailPoint]) -> Pose | None:
    for p in trail:
        if p.x_m is not None and p.y_m is not None and p.heading_rad is not None:
            return Pose(p.x_m, p.y_m, p.heading_rad)
    return None


# ---------------------------------------------------------------------------------------------- over time


def _engaged_trail(flight: FlightReport) -> Sequence[TrailPoint]:
    """From the first to the last engaged point with a second around them; all of it if it never engaged."""
    engaged = [p.t_s for p in flight.trail if p.phase.is_engaged]
    if not engaged:
        return flight.trail
    first, last = max(engaged[0], 0.0) - 1.0, engaged[-1] + 1.0
    return [p for p in flight.trail if first <= p.t_s <= last]


def _distances(axes: Axes, flight: FlightReport, trail: Sequence[TrailPoint]) -> None:
    t = [p.t_s for p in trail]
    axes.plot(t, _values([p.range_m for p in trail]), ".", ms=3, color=_FAINT, label="range (slant)")
    d = _values([p.distance_m for p in trail])
    sigma = _values([p.distance_sigma_m for p in trail])
    axes.fill_between(
        t, [max(a - 2 * b, 0.0) for a, b in zip(d, sigma, strict=True)],
        [a + 2 * b for a, b in zip(d, sigma, strict=True)], color=_ACCENT, alpha=0.16, lw=0,
    )  # fmt: skip
    axes.plot(t, d, color=_ACCENT, lw=1.6, label="distance ± 2σ")
    axes.axhline(flight.problem.radius_m, color=_INK, lw=0.9, ls=(0, (4, 3)), label="capture radius")
    top = max((v for p in trail for v in (p.range_m, p.distance_m) if v is not None), default=1.0)
    axes.set_ylim(0.0, 1.08 * top)
    _title(axes, "distance, m")


def _bearing(axes: Axes, trail: Sequence[TrailPoint]) -> None:
    t = [p.t_s for p in trail]
    theta = [math.degrees(v) for v in _values([p.bearing_rad for p in trail])]
    sigma = [math.degrees(v) for v in _values([p.bearing_sigma_rad for p in trail])]
    low = [max(a - 2 * b, -180.0) for a, b in zip(theta, sigma, strict=True)]
    high = [min(a + 2 * b, 180.0) for a, b in zip(theta, sigma, strict=True)]
    axes.fill_between(t, low, high, color=_ACCENT, alpha=0.16, lw=0)
    for i in range(1, len(theta)):  # no line across the jump from 180° to −180°
        if abs(theta[i] - theta[i - 1]) > 180.0:
            theta[i - 1] = math.nan
    axes.plot(t, theta, color=_ACCENT, lw=1.6, label="bearing ± 2σ, right positive")
    axes.axhline(0.0, color=_INK, lw=0.6)
    axes.set_ylim(-180.0, 180.0)
    axes.set_yticks((-180, -90, 0, 90, 180))
    _title(axes, "bearing, °")


def _commands(axes: Axes, trail: Sequence[TrailPoint]) -> None:
    t = [p.t_s for p in trail]
    axes.step(
        t, _values([p.speed_m_s for p in trail]), where="post", color=_ACCENT, lw=1.6, label="speed, m/s"
    )
    axes.step(
        t, _values([p.yaw_rate_rad_s for p in trail]), where="post", color=_SECOND, lw=1.3,
        label="yaw rate, rad/s, left positive",
    )  # fmt: skip
    axes.axhline(0.0, color=_INK, lw=0.6)
    axes.margins(y=0.12)
    _title(axes, "commanded")


def _bands(axes: Axes, phases: Sequence[PhaseSpan], first_s: float, last_s: float) -> None:
    for span in phases:
        left, right = max(span.from_s, first_s), min(span.to_s, last_s)
        if left < right and span.phase.is_engaged:
            axes.axvspan(left, right, color=PHASE_COLOURS[span.phase], alpha=0.10, lw=0, zorder=0)
    axes.set_xlim(first_s, max(last_s, first_s + 1.0))


def _values(values: Sequence[float | None]) -> list[float]:
    return [math.nan if v is None else v for v in values]


def _title(axes: Axes, name: str) -> None:
    axes.set_ylabel(name, color=_INK, fontsize=9)
    _dress(axes)
    axes.legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3,
                borderaxespad=0.1, handlelength=1.6, columnspacing=1.2)  # fmt: skip


def _dress(axes: Axes) -> None:
    axes.grid(color="#e3e6ea", lw=0.7, zorder=0)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_FAINT)
    axes.tick_params(colors=_INK, labelsize=8.5, length=3)
