"""Plots that several experiments use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ember_ros.experiments import reporting, stats
from ember_ros.experiments.reporting import Results
from ember_ros.report.figures import AMBER, BLUE, GREY, INK, canvas, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = (BLUE, AMBER, "#4d8f5b", "#8c5a9e", GREY, INK, "#c2476a")

FALLS, DISTANCE = "falls per 1000 cycles", "distance per cycle, m"
MEASURES = {FALLS: reporting.FALL_RATE, DISTANCE: "distance_m"}
"""The measures that are plotted to compare walkers: label of the axis, and name."""


def strips(axis: Axes, groups: Mapping[str, Mapping[str, Sequence[float]]], label: str) -> None:
    """Draw a dot for every seed and a bar for the median, for each kind within each group.

    Args:
        axis: to draw on; the groups are on its x axis.
        groups: name of a group, name of a kind (same colour in all groups), values of its seeds.
        label: label of the y axis.
    """
    kinds = list(dict.fromkeys(kind for group in groups.values() for kind in group))
    width = 0.8 / len(kinds)
    for position, group in enumerate(groups.values()):
        for kind, values in group.items():
            n = kinds.index(kind)
            x = position - 0.4 + (n + 0.5) * width
            colour = COLOURS[n % len(COLOURS)]
            xs = [x + width * 0.5 * ((k + 0.5) / len(values) - 0.5) for k in range(len(values))]
            axis.plot(xs, values, "o", color=colour, alpha=0.55, ms=3.5, mew=0)
            median = stats.quartiles(values)[1]
            axis.plot([x - width * 0.36, x + width * 0.36], [median] * 2, color=colour, lw=2.2)
    for n, kind in enumerate(kinds):
        axis.plot([], [], "o-", color=COLOURS[n % len(COLOURS)], label=kind)
    axis.set_xticks(range(len(groups)), list(groups))
    axis.set_ylabel(label)


def draw_groups(
    file: Path,
    quantities: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]],
) -> None:
    """Draw one row of ``strips`` per quantity into a file; falls are logarithmic beyond 1.

    Args:
        file: PNG or SVG.
        quantities: label of the y axis, name of a group, name of a kind, values of its seeds.
    """
    figure, axes = canvas(len(quantities), 1, height=2.7)
    for axis, (label, groups) in zip(axes[:, 0], quantities.items(), strict=True):
        strips(axis, groups, label)
        if label == FALLS:
            axis.set_yscale("symlog", linthresh=1.0)
            axis.set_ylim(bottom=-0.2)
    axes[0, 0].legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    save(figure, file)


def fall_rates_and_distances(
    results: Results,
    kinds: Mapping[str, Mapping[str, str]],
    groups: Mapping[str, Mapping[str, str]],
) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return falls per 1000 cycles and distance per cycle, for ``draw_groups``.

    Args:
        results: the results of an experiment.
        kinds: name of a kind, labels of its arms.
        groups: name of a group, labels of its arms. The labels of a kind and of a group together
            select one arm.
    """
    return {
        label: {
            group: {
                kind: reporting.column(
                    reporting.runs_of(results, **group_labels, **kind_labels), name
                )
                for kind, kind_labels in kinds.items()
            }
            for group, group_labels in groups.items()
        }
        for label, name in MEASURES.items()
    }
