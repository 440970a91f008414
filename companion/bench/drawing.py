"""What all pictures of the benchmark share: how axes look, and how figures become files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure


def tidy(axis: Axes) -> None:
    """No frame, a faint grid."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25, lw=0.6)


def save(figures: Mapping[str, Figure | None], directory: Path) -> list[Path]:
    """Write each by its name into `directory`, which is made if it is not there; return the files."""
    directory.mkdir(parents=True, exist_ok=True)
    written = []
    for name, figure in figures.items():
        if figure is not None:
            figure.savefig(directory / name, dpi=130)
            written.append(directory / name)
    return written
