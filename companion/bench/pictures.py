"""The benchmark in pictures: path ratios, where they come from, and the paper's figures from our own runs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from companion.bench import batch
from companion.bench.batch import Floats, Flyer
from companion.bench.cases import CASES, SECTION_VII
from companion.bench.drawing import save, tidy
from companion.bench.guidance import CONTENDERS, SHORTEST, Report, Result, paper_with_bearing
from companion.bench.plant import Flight, Plant, Sample, Start

COLOURS = {
    "companion": "#0b5fa5",
    "kalman-lq-paper": "#56a3d9",
    "paper": "#d1495b",
    "matveev": "#8a6fb0",
    "cao": "#3a8f5c",
    "cochran-krstic": "#c7873a",
    "turn-on-increase": "#8c8c8c",
    "lq-perfect": "#111111",
}
RATIOS = (1.003, 1.01, 1.03, 1.1, 1.3, 2.0, 4.0, 10.0)
"""Marks on axes of the path ratio, which are logarithmic in what is above 1."""
PER_CELL = 12
"""About so many flights are behind a cell of the heat maps."""
PAPER_START = (-2.0, 0.5, math.pi / 2.0)
"""The pose of Section VII."""
PAPER_TARGET = (3.5, 5.0)
AFTER_S = 2.0
"""The figures of the paper's example go on for so long after the capture."""


def plots(report: Report, directory: Path) -> list[Path]:
    """Draw everything into `directory`, which is made if it is not there; return the files."""
    figures = {
        "path_ratio.png": path_ratio(report),
        "where.png": where(report),
        "figure3.png": figure3(report),
        "figure4.png": figure4(report),
        "figure5.png": figure5(report),
    }
    return save(figures, directory)


# ------------------------------------------------------------------------------------------- statistics


def path_ratio(report: Report) -> Figure:
    """The share of flights below each path ratio: one panel a case, one line a scheme."""
    names = list(dict.fromkeys(row.case for row in report.rows))
    columns = math.ceil(math.sqrt(len(names)))
    rows = math.ceil(len(names) / columns)
    size = (8.5, 5.5) if len(names) == 1 else (3.3 * columns, 2.6 * rows + 0.8)
    figure = Figure(figsize=size, layout="constrained")
    axes: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    for axis, name in zip(axes.flat, names, strict=False):
        for result in report.results:
            if result.row.case == name and result.row.scheme != SHORTEST:
                _draw_ratios(axis, result)
        axis.set_title(name, loc="left", fontsize=10, fontweight="bold")
        axis.set_xscale("log")
        axis.set_xlim(RATIOS[0] - 1.0, RATIOS[-1] - 1.0)
        axis.set_ylim(0.0, 1.02)
        axis.set_xticks([ratio - 1.0 for ratio in RATIOS[1:]], [f"{ratio:g}" for ratio in RATIOS[1:]])
        axis.minorticks_off()
        axis.tick_params(labelsize=8)
        tidy(axis)
    figure.supxlabel("path ÷ shortest path", fontsize=10)
    figure.supylabel("share of flights captured within it", fontsize=10)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    return figure


def _draw_ratios(axis: Axes, result: Result) -> None:
    f = Flight(*result.flights.T)
    ratio = np.sort(f.path_m / np.maximum(f.bound_m, 1e-9))
    name = result.row.scheme
    axis.step(
        [0.0, *np.clip(ratio - 1.0, RATIOS[0] - 1.0, 1e3)],
        np.arange(len(ratio) + 1) / len(ratio),
        where="post",
        color=COLOURS.get(name),
        lw=2.4 if name == "companion" else 1.3,
        ls="--" if name == "lq-perfect" else "-",
        zorder=3 if name == "companion" else 2,
        label=name,
    )


def where(report: Report) -> Figure | None:
    """The median path ratio over start distance and bearing, one panel a scheme; None without random
    starts."""
    name = next((row.case for row in report.rows if CASES[row.case].theta_rad is None), None)
    results = [r for r in report.results if r.row.case == name and r.row.scheme != SHORTEST]
    if name is None or not results:
        return None
    columns = min(4, len(results))
    rows = math.ceil(len(results) / columns)
    figure = Figure(figsize=(3.1 * columns + 1.2, 2.7 * rows + 0.7), layout="constrained")
    axes: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axis in axes.flat[len(results) :]:
        axis.set_visible(False)
    across = max(4, 2 * round(math.sqrt(0.5 * report.runs / PER_CELL)))
    mesh: Any = None
    for axis, result in zip(axes.flat, results, strict=False):
        starts, f = result.starts, Flight(*result.flights.T)
        case = CASES[name]
        bearings = np.linspace(-180.0, 180.0, across + 1)
        distances = np.linspace(case.d_min_m, case.d_max_m, across // 2 + 1)
        longer = np.clip(f.path_m / np.maximum(f.bound_m, 1e-9) - 1.0, 1e-4, 1e3)
        cells = _medians(np.degrees(starts[:, 1]), starts[:, 0], longer, bearings, distances)
        mesh = axis.pcolormesh(bearings, distances, cells, norm=LogNorm(0.01, 2.0), cmap="magma_r")
        axis.set_facecolor("0.85")
        axis.set_title(result.row.scheme, loc="left", fontsize=10, fontweight="bold")
        axis.set_xticks([-180, -90, 0, 90, 180], ["astern", "left", "ahead", "right", "astern"], fontsize=8)
        axis.tick_params(labelsize=8)
    figure.supxlabel("where the target is at the start", fontsize=10)
    figure.supylabel("distance at the start (m)", fontsize=10)
    figure.suptitle(f"Median path ÷ shortest path, case {name}", fontsize=11)
    bar = figure.colorbar(mesh, ax=axes, extend="both", shrink=0.9)
    ticks = (1.01, 1.03, 1.1, 1.3, 2.0, 3.0)
    bar.set_ticks([tick - 1.0 for tick in ticks], labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    return figure


def _medians(x: Floats, y: Floats, value: Floats, x_edges: Floats, y_edges: Floats) -> Floats:
    """Median of `value` in each cell; not a number where a cell is empty."""
    column = np.clip(np.digitize(x, x_edges) - 1, 0, len(x_edges) - 2)
    line = np.clip(np.digitize(y, y_edges) - 1, 0, len(y_edges) - 2)
    cells = np.full((len(y_edges) - 1, len(x_edges) - 1), np.nan)
    for i, j in np.ndindex(cells.shape):
        inside = value[(line == i) & (column == j)]
        if len(inside):
            cells[i, j] = np.median(inside)
    return cells


# -------------------------------------------------------------------------------- the paper's example


class Example(NamedTuple):
    """One flight of Section VII, in the paper's coordinates."""

    label: str
    colour: str
    flight: Flight
    trace: dict[str, Floats]
    """A column for each field of `Sample`."""


def _examples(report: Report) -> dict[str, Example]:
    """The paper's example on the paper's plant (no lag, no lost or reflected range), one flight a scheme."""
    plant = Plant(
        radius_m=report.settings.capture_radius_m,
        speed_m_s=report.settings.speed_m_s,
        yaw_rate_max_rad_s=report.settings.yaw_rate_max_rad_s,
        dropout=0.0,
        reflected=0.0,
        yaw_rate_lag_s=0.0,
        velocity_lag_s=0.0,
        limit_s=120.0,
    )
    flyers = {
        "companion": ("the default, bearing unknown", CONTENDERS["companion"].make(report.settings, plant)),
        "paper": ("the paper's scheme, told the bearing", paper_with_bearing(report.settings, plant)),
        "lq-perfect": (
            "limit: LQ with the true state",
            CONTENDERS["lq-perfect"].make(report.settings, plant),
        ),
    }
    return {
        name: _example(label, COLOURS[name], flyer, plant, report.seed)
        for name, (label, flyer) in flyers.items()
    }


def _example(label: str, colour: str, flyer: Flyer, plant: Plant, seed: int) -> Example:
    flight, lines = batch.fly_traced(flyer, plant, Start(*SECTION_VII, seed))
    until = lines[lines[:, 0] <= min(flight.time_s, plant.limit_s) + AFTER_S]
    trace = dict(zip(Sample._fields, until.T, strict=True))
    x0, y0, heading = PAPER_START
    c, sn = math.cos(heading), math.sin(heading)
    x, y = trace["x_m"], trace["y_m"]
    trace |= {"x_m": x0 + c * x - sn * y, "y_m": y0 + sn * x + c * y}
    return Example(label, colour, flight, trace)


def _ending(flight: Flight) -> str:
    return f"{flight.time_s:.1f} s" if math.isfinite(flight.time_s) else "not captured"


def figure3(report: Report) -> Figure:
    """The paper's Fig. 3: the paths of its example."""
    figure = Figure(figsize=(7.2, 6.2), layout="constrained")
    axis: Any = figure.subplots()
    for name, example in _examples(report).items():
        limit = name == "lq-perfect"
        axis.plot(
            example.trace["x_m"],
            example.trace["y_m"],
            color=example.colour,
            lw=1.2 if limit else 2.2,
            ls=(0, (2, 2)) if limit else "-",
            zorder=4 if limit else 3,
            label=f"{example.label}: {_ending(example.flight)}",
        )
    axis.add_patch(Circle(PAPER_TARGET, report.settings.capture_radius_m, color="#e8b400", alpha=0.35, lw=0))
    axis.plot(*PAPER_TARGET, marker="x", color="#8a6a00", ms=7, mew=2, ls="none")
    axis.annotate("target, ε", PAPER_TARGET, (10, -18), textcoords="offset points", fontsize=9)
    axis.plot(*PAPER_START[:2], marker="o", color="k", ms=6, ls="none")
    axis.annotate("start, heading north", PAPER_START[:2], (10, -4), textcoords="offset points", fontsize=9)
    axis.set_aspect("equal")
    axis.margins(0.08)
    axis.set_xlabel("x (m)")
    axis.set_ylabel("y (m)")
    axis.set_title("Target capture, the example of Section VII (Fig. 3)", loc="left", fontsize=11)
    axis.legend(frameon=False, fontsize=9, loc="upper left")
    tidy(axis)
    return figure


def figure4(report: Report) -> Figure:
    """The paper's Fig. 4: distance, its rate, speed and yaw rate over time, with the paper's scheme."""
    return _over_time(_examples(report)["paper"], report, "(Fig. 4)")


def figure5(report: Report) -> Figure:
    """In the place of the paper's Fig. 5, whose controller was not available: the same with the default."""
    return _over_time(_examples(report)["companion"], report, "(in the place of Fig. 5)")


def _over_time(example: Example, report: Report, which: str) -> Figure:
    figure = Figure(figsize=(7.6, 7.2), layout="constrained")
    axes: Any = figure.subplots(4, 1, sharex=True)
    s = example.trace
    for axis, values, label in zip(
        axes,
        (s["d_m"], s["rate_m_s"], s["v_m_s"], s["omega_rad_s"]),
        ("d (m)", "ḋ (m/s)", "v (m/s)", "ω (rad/s)"),
        strict=True,
    ):
        axis.plot(s["t_s"], values, color=example.colour, lw=1.6)
        axis.set_ylabel(label)
        if math.isfinite(example.flight.time_s):
            axis.axvline(example.flight.time_s, color="k", lw=0.8, ls=":")
        tidy(axis)
    axes[0].axhline(report.settings.capture_radius_m, color="#e8b400", lw=1.4)
    axes[0].set_ylim(bottom=0.0)
    axes[0].annotate(
        f"captured: {_ending(example.flight)}",
        (min(example.flight.time_s, float(s["t_s"][-1])), axes[0].get_ylim()[1]),
        (-6, -10),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=9,
    )
    limit = report.settings.yaw_rate_max_rad_s
    axes[3].set_ylim(-1.12 * limit, 1.12 * limit)
    axes[3].set_xlabel("t (s)")
    figure.suptitle(f"Section VII with {example.label} {which}", fontsize=11)
    return figure
