"""Drawings that several experiments share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ember_ros.experiments import stats, words
from ember_ros.report.figures import AMBER, BLUE, GREY, INK, canvas, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = (BLUE, AMBER, "#4d8f5b", "#8c5a9e", GREY, INK, "#c2476a")

FALLS, WAY = "falls per 1000 cycles", "distance a cycle, m"
MEASURES = {FALLS: words.FALL_RATE, WAY: "distance_m"}
"""What is drawn of walkers wherever they are compared: label of the axis, and measure."""


def strips(axis: Axes, groups: Mapping[str, Mapping[str, Sequence[float]]], label: str) -> None:
    """Draw every seed as a dot and every median as a bar: a cluster a group, a strip a kind."""
    kinds = list(dict.fromkeys(kind for group in groups.values() for kind in group))
    wide = 0.8 / len(kinds)
    for place, group in enumerate(groups.values()):
        for kind, values in group.items():
            n = kinds.index(kind)
            x = place - 0.4 + (n + 0.5) * wide
            colour = COLOURS[n % len(COLOURS)]
            apart = [x + wide * 0.5 * ((k + 0.5) / len(values) - 0.5) for k in range(len(values))]
            axis.plot(apart, values, "o", color=colour, alpha=0.55, ms=3.5, mew=0)
            middle = stats.quartiles(values)[1]
            axis.plot([x - wide * 0.36, x + wide * 0.36], [middle] * 2, color=colour, lw=2.2)
    for n, kind in enumerate(kinds):
        axis.plot([], [], "o-", color=COLOURS[n % len(COLOURS)], label=kind)
    axis.set_xticks(range(len(groups)), list(groups))
    axis.set_ylabel(label)


def bodies(
    file: Path,
    quantities: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]],
) -> None:
    """Draw strips, a row a quantity; falls are logarithmic beyond 1.

    Args:
        file: PNG or SVG.
        quantities: label of an axis, group, kind, values.
    """
    figure, axes = canvas(len(quantities), 1, height=2.7)
    for axis, (label, groups) in zip(axes[:, 0], quantities.items(), strict=True):
        strips(axis, groups, label)
        if label == FALLS:
            axis.set_yscale("symlog", linthresh=1.0)
            axis.set_ylim(bottom=-0.2)
    axes[0, 0].legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    save(figure, file)


def fall_rates_and(
    found: Any, kinds: Mapping[str, Mapping[str, str]], groups: Mapping[str, Mapping[str, str]]
) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return falls per 1000 cycles and distance of arms, by group and kind, for ``bodies``.

    Args:
        found: what came of an experiment.
        kinds: name of a kind, labels of its arms.
        groups: name of a group, labels of its arms.
    """
    return {
        label: {
            group: {
                kind: words.column(words.runs_of(found, **one, **other), name)
                for kind, other in kinds.items()
            }
            for group, one in groups.items()
        }
        for label, name in MEASURES.items()
    }
