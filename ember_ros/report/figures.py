"""Figures of a run, drawn from its record."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ember_ros.report.run_statistics import Row, RunRecord

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, AMBER, BLUE, GREY = "#20242c", "#d9730d", "#2f6f9f", "#9aa0a6"
TRACE_CYCLES = 12
"""Cycles of roll and pitch that are drawn tick by tick."""
SMOOTH = 50
"""Cycles in the moving mean of the training curves."""


def canvas(rows: int, columns: int = 1, width: float = 9.0, height: float = 3.0) -> Any:
    """Return a figure ``width`` inches wide and its axes, ``(rows, columns)``."""
    from ember_ros.report.picture import Picture

    # Not by pyplot, which would keep the figure and choose how a notebook draws its own.
    figure = Picture(figsize=(width, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color="#e6e8ea", linewidth=0.8)
        axis.set_axisbelow(True)
    return figure, axes


def save(figure: Figure, file: Path) -> None:
    """Write a figure, PNG or SVG."""
    file.parent.mkdir(parents=True, exist_ok=True)
    # Without the version of matplotlib in it, equal figures are equal files.
    figure.savefig(file, dpi=130, metadata={"Software": None} if file.suffix == ".png" else None)


def _moving_mean(values: Sequence[float], window: int) -> tuple[Any, Any]:
    window = max(1, min(window, len(values)))
    mean = np.convolve(values, np.ones(window) / window, mode="valid")
    return np.arange(len(mean)) + window, mean


def _curve(axis: Axes, values: Sequence[float], colour: str, label: str) -> None:
    axis.plot(np.arange(1, len(values) + 1), values, ".", color=GREY, markersize=1.5, alpha=0.5)
    axis.plot(*_moving_mean(values, SMOOTH), color=colour, linewidth=1.8)
    axis.set_ylabel(label)


def training(axes: Sequence[Axes], rows: Sequence[Row]) -> None:
    """Draw distance and peak force a step while a leg learns (paper, figure 5)."""
    _curve(axes[0], [row.distance_m or 0.0 for row in rows], BLUE, "distance a step, m")
    _curve(axes[1], [row.peak_force_n for row in rows], AMBER, "peak force a step, N")
    axes[0].set_title("On the trainer: one leg learns to step", loc="left", color=INK)
    axes[0].axhline(0.0, color=INK, linewidth=0.8)
    axes[1].set_xlabel(f"steps (line: mean of {SMOOTH})")


def walking(axes: Sequence[Axes], record: RunRecord, ticks: int) -> None:
    """Draw the body's path, and its roll and pitch while it walks (paper, figure 7)."""
    traces = record.traces
    falls = record.measured["falls"]
    cycles = len(traces) // ticks
    axes[0].plot(traces[:, 0], traces[:, 1], color=BLUE, linewidth=1.6)
    axes[0].plot(traces[:1, 0], traces[:1, 1], "o", color=INK, label="start")
    axes[0].plot(traces[-1:, 0], traces[-1:, 1], "s", color=AMBER, label="end")
    axes[0].legend(loc="best", frameon=False)
    axes[0].set_aspect("equal", adjustable="box", anchor="W")
    axes[0].set_xlabel("x, m")
    axes[0].set_ylabel("y, m")
    axes[0].set_title(
        f"On the body: the path of four legs in {cycles} cycles, {falls} falls",
        loc="left",
        color=INK,
    )
    shown = traces[-TRACE_CYCLES * ticks :]
    time = (np.arange(len(shown)) + len(traces) - len(shown)) / ticks
    axes[1].plot(time, shown[:, 2], color=BLUE, linewidth=1.4, label="roll")
    axes[1].plot(time, shown[:, 3], color=AMBER, linewidth=1.4, label="pitch")
    axes[1].set_xlabel("cycle")
    axes[1].set_ylabel("rad")
    axes[1].set_title(f"Its last {len(shown) // ticks} cycles", loc="left", color=INK)
    axes[1].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, ncols=2)


def picture(
    *, trained: RunRecord | None = None, walked: RunRecord | None = None, ticks: int = 32
) -> Figure | None:
    """Return a picture of what was trained, of what was walked, or of both; None of nothing.

    Args:
        trained: record of a leg on the trainer.
        walked: record of a walker.
        ticks: of a cycle.
    """
    parts = [part for part in (trained, walked) if part is not None and part.rows]
    if not parts:
        return None
    figure, grid = canvas(2 * len(parts))
    axes = grid[:, 0]
    for n, part in enumerate(parts):
        update = axes[2 * n : 2 * n + 2]
        if part is trained:
            training(update, part.body_rows())
        else:
            walking(update, part, ticks)
    made: Figure = figure
    return made


def draw(
    file: Path,
    *,
    trained: RunRecord | None = None,
    walked: RunRecord | None = None,
    ticks: int = 32,
) -> bool:
    """Write what ``picture`` returns into a file, PNG or SVG; return whether there was anything."""
    figure = picture(trained=trained, walked=walked, ticks=ticks)
    if figure is not None:
        save(figure, file)
    return figure is not None
