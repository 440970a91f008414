"""A calibration as one picture: errors over time, their spread, and the fit."""

from __future__ import annotations

import math
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from companion.calibrate import Calibration, Fit

_COLOURS = ("#0b5fa5", "#d1495b", "#3a8f5c", "#c7873a", "#8a6fb0", "#56a3d9")
_INK = "#22262b"


def draw(path: Path, c: Calibration) -> None:
    """Write it as PNG. Raises OSError where the file cannot be written."""
    figure = Figure(figsize=(12.4, 4.4), dpi=110, layout="constrained")
    title = f"Beacon {c.beacon}  ·  bias {c.bias_m:+.3f} m"
    if c.fit is Fit.DISTANCE:
        title += f" and {1000.0 * c.bias_per_m:+.1f} mm/m"
    if c.fit is Fit.POWER:
        title += f" at {c.power_dbm:.0f} dBm and {1000.0 * c.bias_per_db:+.1f} mm/dB"
    figure.suptitle(
        f"{title}  ·  sigma {c.sigma_m:.3f} m", fontsize=13, fontweight="bold", color=_INK, x=0.012, ha="left"
    )
    over_time, spread, fit = figure.subplots(1, 3, width_ratios=(1.3, 1.0, 1.0))
    _over_time(over_time, c)
    _spread(spread, c)
    _fit(fit, c)
    figure.savefig(path, format="png", facecolor="white")


def _colour(i: int) -> str:
    return _COLOURS[i % len(_COLOURS)]


def _over_time(axes: Axes, c: Calibration) -> None:
    for i, g in enumerate(c.groups):
        label = f"{g.distance_m:g} m: {len(g.kept)}, {len(g.left_out)} outliers"
        axes.plot(
            [p.t_s for p in g.kept],
            [g.error_m(p) for p in g.kept],
            ".",
            ms=2.5,
            color=_colour(i),
            label=label,
        )
        axes.axhline(g.mean_m, color=_colour(i), lw=1.0)
    _named(axes, "Error of each range", "seconds from the recording's first", "measured − true, m")
    axes.legend(fontsize=8, markerscale=3, edgecolor="none")


def _spread(axes: Axes, c: Calibration) -> None:
    for i, g in enumerate(c.groups):
        errors = [g.error_m(p) for p in g.kept]
        axes.hist(errors, bins=40, density=True, color=_colour(i), alpha=0.35)
        xs = [g.mean_m + g.sigma_m * k / 10.0 for k in range(-40, 41)]
        sigma = max(g.sigma_m, 1e-4)
        ys = [math.exp(-0.5 * ((x - g.mean_m) / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi)) for x in xs]
        axes.plot(xs, ys, color=_colour(i), lw=1.2)
    _named(axes, "Spread, and the normal one", "measured − true, m", "density, 1/m")


def _fit(axes: Axes, c: Calibration) -> None:
    by_power = c.fit is Fit.POWER
    for i, g in enumerate(c.groups):
        x = g.power_dbm if by_power and g.power_dbm is not None else g.distance_m
        axes.errorbar(x, g.mean_m, yerr=g.sigma_m, fmt="o", ms=5, capsize=3, color=_colour(i))
    low, high = axes.get_xlim()
    ends = [low, high]
    if by_power:
        line = [c.bias_m + c.bias_per_db * (x - c.power_dbm) for x in ends]
    else:
        line = [c.bias_m + c.bias_per_m * x for x in ends]
    axes.plot(ends, line, color=_INK, lw=1.2, label=f"subtracted: {c.fit.value}")
    axes.set_xlim(low, high)
    where = "received power, dBm" if by_power else "true distance, m"
    _named(axes, "Mean error ± sigma, and the fit", where, "measured − true, m")
    axes.legend(fontsize=8, frameon=False)


def _named(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=10, color=_INK, loc="left")
    axes.set_xlabel(x, fontsize=9, color=_INK)
    axes.set_ylabel(y, fontsize=9, color=_INK)
    axes.tick_params(labelsize=8)
    axes.grid(color="#e6e8eb", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
