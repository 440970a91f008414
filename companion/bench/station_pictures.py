"""Station keeping in pictures: how far and how well, and the paper's Fig. 6 from our own runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from companion.bench.drawing import save, tidy
from companion.bench.station import STATION_CASES, STATION_SCHEMES, StationReport, make, told
from companion.bench.station_plant import Air, Field, Moment, fly, random_beacons, untold

COLOURS = {"station": "#0b5fa5", "station-paper": "#d1495b", "station-perfect": "#111111"}
PAPER_START = (-4.0, -1.0, math.pi / 3.0)
"""The pose at the start of the paper's example of station keeping; its station is the origin."""
PAPER_AIR = Air(dropout=0.0, reflected=0.0, yaw_rate_lag_s=1e-3, speed_lag_s=1e-3, limit_s=60.0, hold_s=10.0)
"""The paper's plant: no lag, no lost or reflected range."""


def station_plots(report: StationReport, directory: Path) -> list[Path]:
    """Draw everything into `directory`, which is made if it is not there; return the files."""
    return save({"station.png": station(report), "figure6.png": figure6(report)}, directory)


def station(report: StationReport) -> Figure:
    """Shares of all flights: below a path ratio, and below a greatest distance at the station."""
    cases = list(dict.fromkeys(row.case for row in report.rows))
    figure = Figure(figsize=(9.5, 3.2 * len(cases) + 0.6), layout="constrained")
    axes: Any = figure.subplots(len(cases), 2, sharey=True, squeeze=False)
    for row, outcomes in zip(report.rows, report.outcomes, strict=True):
        path, hold = axes[cases.index(row.case)]
        _draw(path, row.scheme, [o.path_m / max(o.bound_m, 1e-9) for o in outcomes])
        _draw(hold, row.scheme, [o.worst_m for o in outcomes])
    for name, (path, hold) in zip(cases, axes, strict=True):
        path.set_title(f"{name}: {STATION_CASES[name][0]}", loc="left", fontsize=9, fontweight="bold")
        path.set_xlim(0.95, 2.5)
        hold.set_xlim(0.0, 3.0 * report.keeping.radius_m)
        hold.axvline(report.keeping.radius_m, color="#e8b400", lw=1.4)
        for axis in (path, hold):
            axis.set_ylim(0.0, 1.02)
            tidy(axis)
    axes[-1][0].set_xlabel("path until the station is entered ÷ shortest path")
    axes[-1][1].set_xlabel("greatest distance in the minute after the arrival (m); ε in yellow")
    figure.supylabel("share of all flights", fontsize=10)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure


def _draw(axis: Axes, scheme: str, values: Sequence[float]) -> None:
    ordered = sorted(v for v in values if math.isfinite(v))
    shares = np.arange(len(ordered) + 1) / len(values)
    limit = scheme == "station-perfect"
    axis.step(
        [0.0, *ordered, 1e9],
        [*shares, shares[-1]],
        where="post",
        color=COLOURS[scheme],
        lw=1.2 if limit else 2.0,
        ls="--" if limit else "-",
        label=scheme,
    )


def example_field(seed: int) -> tuple[Field, Callable[[float, float], tuple[float, float]]]:
    """The paper's example as seen from its start, beacons at random; and the way back into its frame."""
    x0, y0, heading = PAPER_START
    c, sn = math.cos(heading), math.sin(heading)
    at = (-x0 * c - y0 * sn, x0 * sn - y0 * c)
    return Field(at, random_beacons(at, seed)), lambda x, y: (x0 + c * x - sn * y, y0 + sn * x + c * y)


def figure6(report: StationReport) -> Figure:
    """The paper's Fig. 6: the paths of its example, three beacons at random near the station."""
    field, place = example_field(report.seed)
    air = PAPER_AIR._replace(radius_m=report.keeping.radius_m)
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    axis: Any = figure.subplots()

    for scheme in dict.fromkeys(row.scheme for row in report.rows):
        limit = scheme == "station-perfect"
        moments: list[Moment] = []
        flight = fly(
            make(scheme, field, air, report.guidance, report.keeping), field, report.seed, air,
            watch=moments.append, tell=told if limit else untold,
        )  # fmt: skip
        path = [place(m.x_m, m.y_m) for m in moments]
        ends = f"after {flight.time_s:.0f} s" if math.isfinite(flight.time_s) else "never stays"
        ends += f", {moments[-1].d_m:.2f} m off at the end"
        axis.plot(
            *zip(*path, strict=True),
            color=COLOURS[scheme],
            lw=1.2 if limit else 2.0,
            ls=(0, (2, 2)) if limit else "-",
            zorder=4 if limit else 3,
            label=f"{scheme}, {STATION_SCHEMES[scheme]}:\n{ends}",
        )
    axis.plot(*zip(*(place(*b) for b in field.beacons), strict=True), "^", ms=9, color="#8c8c8c", mec="k")
    axis.add_patch(Circle((0.0, 0.0), report.keeping.radius_m, color="#e8b400", alpha=0.45, lw=0))
    axis.annotate("station, ε", (0.0, 0.0), (10, -18), textcoords="offset points", fontsize=9)
    axis.plot(*PAPER_START[:2], marker="o", color="k", ms=6, ls="none")
    axis.annotate("start", PAPER_START[:2], (-12, -14), textcoords="offset points", fontsize=9)
    axis.set_aspect("equal")
    axis.margins(0.08)
    axis.set_xlabel("x (m)")
    axis.set_ylabel("y (m)")
    axis.set_title("Station keeping, the example of Section VII (Fig. 6)", loc="left", fontsize=11)
    axis.legend(frameon=False, fontsize=8, loc="upper left")
    tidy(axis)
    return figure
