"""Draw figures of a run from its record."""

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
"""Last cycles whose roll and pitch are drawn at every tick."""
MEAN_WINDOW = 50
"""Cycles in the moving mean of the training curves."""


def canvas(rows: int, columns: int = 1, width: float = 9.0, height: float = 3.0) -> Any:
    """Return an empty figure and its axes.

    Args:
        rows: rows of axes.
        columns: columns of axes.
        width: of the figure, inches.
        height: of each row, inches.

    Returns:
        The figure, and an array of axes, ``(rows, columns)``.
    """
    from ember_ros.report.picture import Picture

    # Without pyplot, which would keep a reference to the figure and choose a notebook's backend.
    figure = Picture(figsize=(width, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color="#e6e8ea", linewidth=0.8)
        axis.set_axisbelow(True)
    return figure, axes


def save(figure: Figure, file: Path) -> None:
    """Write a figure into a file, PNG or SVG by its ending."""
    file.parent.mkdir(parents=True, exist_ok=True)
    # The version of matplotlib is left out, so that equal figures give equal files.
    figure.savefig(file, dpi=130, metadata={"Software": None} if file.suffix == ".png" else None)


def _moving_mean(values: Sequence[float], window: int) -> tuple[Any, Any]:
    """Return the last cycle of each window, from 1, and the mean over the window."""
    window = max(1, min(window, len(values)))
    mean = np.convolve(values, np.ones(window) / window, mode="valid")
    return np.arange(len(mean)) + window, mean


def _draw_curve(axis: Axes, values: Sequence[float], colour: str, label: str) -> None:
    """Draw one dot per cycle and the moving mean."""
    axis.plot(np.arange(1, len(values) + 1), values, ".", color=GREY, markersize=1.5, alpha=0.5)
    axis.plot(*_moving_mean(values, MEAN_WINDOW), color=colour, linewidth=1.8)
    axis.set_ylabel(label)


def training(axes: Sequence[Axes], rows: Sequence[Row]) -> None:
    """Draw distance and peak force per step of a leg that learns (figure 5 of the paper)."""
    _draw_curve(axes[0], [row.distance_m or 0.0 for row in rows], BLUE, "distance per step, m")
    _draw_curve(axes[1], [row.peak_force_n for row in rows], AMBER, "peak force per step, N")
    axes[0].set_title("Trainer: one leg learns", loc="left", color=INK)
    axes[0].axhline(0.0, color=INK, linewidth=0.8)
    axes[1].set_xlabel(f"steps (line: moving mean over {MEAN_WINDOW})")


def walking(axes: Sequence[Axes], record: RunRecord, ticks: int) -> None:
    """Draw the path of the body, and its roll and pitch (figure 7 of the paper)."""
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
        f"Walker: path of the body in {cycles} cycles, {falls} falls",
        loc="left",
        color=INK,
    )
    last = traces[-TRACE_CYCLES * ticks :]
    time = (np.arange(len(last)) + len(traces) - len(last)) / ticks
    axes[1].plot(time, last[:, 2], color=BLUE, linewidth=1.4, label="roll")
    axes[1].plot(time, last[:, 3], color=AMBER, linewidth=1.4, label="pitch")
    axes[1].set_xlabel("cycle")
    axes[1].set_ylabel("rad")
    axes[1].set_title(f"Last {len(last) // ticks} cycles", loc="left", color=INK)
    axes[1].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, ncols=2)


def picture(
    *, trained: RunRecord | None = None, walked: RunRecord | None = None, ticks: int = 32
) -> Figure | None:
    """Return a figure of a training, of a walk, or of both.

    Args:
        trained: record of a leg on the trainer.
        walked: record of a walker.
        ticks: ticks per cycle.

    Returns:
        The figure; None if there is no record, or if the records are empty.
    """
    records = [record for record in (trained, walked) if record is not None and record.rows]
    if not records:
        return None
    result: Figure
    result, grid = canvas(2 * len(records))
    axes = grid[:, 0]
    for n, record in enumerate(records):
        pair = axes[2 * n : 2 * n + 2]
        if record is trained:
            training(pair, record.body_rows())
        else:
            walking(pair, record, ticks)
    return result


def draw(
    file: Path,
    *,
    trained: RunRecord | None = None,
    walked: RunRecord | None = None,
    ticks: int = 32,
) -> bool:
    """Write the figure that ``picture`` returns into a file; return False if there is none."""
    figure = picture(trained=trained, walked=walked, ticks=ticks)
    if figure is not None:
        save(figure, file)
    return figure is not None
