"""The latencies as curves: the share of ranges that were answered within a time."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from companion.bench.system.figures import Report

_COLOURS = ("#4d4d4d", "#2f6db5", "#d9822b")


def plot(report: Report, directory: Path) -> Path | None:
    """Draw `directory`/latency.png and return its path; None where no latency was measured."""
    if not report.latencies_s:
        return None
    directory.mkdir(parents=True, exist_ok=True)
    rates = list(dict.fromkeys(name.rpartition(", ")[2] for name in report.latencies_s))
    figure, axes = plt.subplots(1, len(rates), figsize=(5.2 * len(rates), 4.2), sharey=True, squeeze=False)
    for axis, rate in zip(axes[0], rates, strict=True):
        curves = {n.rpartition(", ")[0]: v for n, v in report.latencies_s.items() if n.endswith(f", {rate}")}
        for (name, values), colour in zip(curves.items(), _COLOURS, strict=False):
            share = [100.0 * i / (len(values) - 1) for i in range(len(values))]
            median_us = 1e6 * values[len(values) // 2]
            label = f"{name}: {median_us:.0f} µs"
            axis.step(
                [1e3 * s for s in values],
                share,
                where="post",
                color=colour,
                label=label,
            )
        axis.set_xscale("log")
        axis.set_title(f"ranges at {rate}")
        axis.set_xlabel("range put → setpoint received, ms")
        axis.grid(True, which="both", alpha=0.25)
        axis.legend(loc="lower right", title="median of all turns")
    axes[0][0].set_ylabel("answered within that, %")
    figure.tight_layout()
    path = directory / "latency.png"
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
