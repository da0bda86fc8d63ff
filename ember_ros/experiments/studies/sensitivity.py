"""Sensitivity of the walker to its mechanics: one parameter is changed at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from ember_ros.experiments import reporting, stats
from ember_ros.experiments.reporting import Results
from ember_ros.experiments.study import (
    Arm,
    Size,
    Study,
    learner_params,
    training_trial,
    walking_trials,
)
from ember_ros.report.figures import AMBER, BLUE, GREY, INK, canvas, save


class Sweep(NamedTuple):
    """A parameter and its values."""

    name: str
    """The parameter, with ``__`` for the dot."""
    label: str
    """Label of its axis, with the unit."""
    values: tuple[float, ...]
    in_training: bool = False
    """Whether the training uses the value, too; parameters of the body have no effect there."""


TICKS = learner_params().gait.ticks
THREE_TO_ONE, THREE_TO_TWO = 3 / 4, round(3 / 5 * TICKS) / TICKS
"""Shares of stance in a cycle for these support ratios; the second is rounded to whole ticks."""
SWEEPS = (
    Sweep("walker__twist_amplitude", "twist, rad", (0.0, 0.05, 0.10, 0.15)),
    Sweep("walker__twist_phase", "phase of the twist, cycles", (0.125, 0.375, 0.625, 0.875)),
    Sweep("leg__operating_height", "operating height, m", (0.43, 0.45, 0.46), True),
    Sweep(
        "trainer__stop_height", "height of the trainer's stop, m", (0.40, 0.41, 0.42, 0.43), True
    ),
    Sweep("gait__stance_share", "share of stance", (THREE_TO_TWO, 22 / TICKS, THREE_TO_ONE), True),
    Sweep("physics__friction", "friction coefficient", (0.4, 0.7, 1.0), True),
    Sweep("walker__hip_half_width", "half width of the hips, m", (0.10, 0.14, 0.22, 0.35)),
    Sweep("walker__length", "length of the body, m", (0.6, 0.8, 1.2, 1.5)),
)
WALKERS = ("trained", "empty table", "scripted", "random")
MAX_SEEDS = 3


def arms(size: Size) -> list[Arm]:
    """Return trained walkers and one walk of each baseline, for every value of every sweep."""
    all_arms = []
    seeds = range(min(MAX_SEEDS, size.seeds))
    for sweep in SWEEPS:
        for value in sweep.values:
            changes: dict[str, Any] = {sweep.name: value}
            training_changes = changes if sweep.in_training else {}
            starts = [training_trial("ember", size, seed, **training_changes) for seed in seeds]
            labels = {"sweep": sweep.name.replace("__", "."), "value": repr(value)}
            trained = walking_trials(
                "ember", "reference", size.short_walk, seeds, starts, **changes
            )
            all_arms.append(Arm({**labels, "walker": "trained"}, trained))
            for walker in WALKERS[1:]:
                learns = walker == "empty table"
                baseline = walking_trials(
                    "ember",
                    "reference",
                    size.short_walk,
                    range(1),
                    policy="learned" if learns else walker,
                    learning=learns,
                    **changes,
                )
                all_arms.append(Arm({**labels, "walker": walker}, baseline))
    return all_arms


def text(results: Results) -> list[str]:
    """Return the table and its explanation."""
    rows = []
    for sweep in SWEEPS:
        name = sweep.name.replace("__", ".")
        for value in sweep.values:
            runs = {
                walker: reporting.runs_of(results, sweep=name, value=repr(value), walker=walker)
                for walker in WALKERS
            }
            trained = runs["trained"]
            outside = stats.quartiles(reporting.column(trained, "outside"))[1]
            cells = [
                f"`{name}`",
                f"{value:g}",
                reporting.never_fell(trained),
                f"{reporting.falls_per_1000(trained):.1f}",
                f"{100 * outside:.1f} %",
                reporting.with_quartiles(reporting.column(trained, "distance_m")),
                reporting.with_quartiles(reporting.column(trained, "roll_sd_rad")),
            ]
            for walker in WALKERS[1:]:
                (run,) = runs[walker]
                cells.append(f"{reporting.falls_per_1000([run]):.0f}; {run['distance_m']:.3f}")
            rows.append(cells)
    heads = ["parameter", "value", "never fell", "falls per 1000 cycles", "outside"]
    heads += ["distance per cycle, m", "SD of roll, rad"]
    heads += [f"{walker}: falls; distance" for walker in WALKERS[1:]]
    return [
        "`ember` in the reference body, with one parameter changed at a time. Parameters of the "
        "leg, the gait, the trainer or the ground are changed in the training, too; for parameters "
        "of the body, the trained tables are the same for all values. The last three columns are "
        "single walks of baselines, in falls per 1000 cycles and distance per cycle in m: legs "
        "with an empty table that learn, the scripted knee, and a random knee.",
        "",
        *reporting.markdown_table(heads, rows),
        "",
        "Medians over seeds, quartiles in brackets. Falls are counted over all runs together. "
        f"Outside: share of cycles with {reporting.OUTSIDE}. A support ratio of 3:1 is a stance "
        f"share of {THREE_TO_ONE:g}. The stance share nearest to 3:2 is {THREE_TO_TWO:.3f}, "
        f"{round(THREE_TO_TWO * TICKS)} of {TICKS} ticks.",
    ]


def draw(results: Results, file: Path) -> None:
    """Draw falls and distance of all walkers, one pair of panels per parameter."""
    figure, axes = canvas(4, 4, width=14.0, height=2.4)
    for n, sweep in enumerate(SWEEPS):
        name = sweep.name.replace("__", ".")
        above, below = axes[2 * (n // 4), n % 4], axes[2 * (n // 4) + 1, n % 4]
        for walker, colour in zip(WALKERS, (BLUE, AMBER, INK, GREY), strict=True):
            runs = [
                reporting.runs_of(results, sweep=name, value=repr(value), walker=walker)
                for value in sweep.values
            ]
            style = "-" if walker == "trained" else "--"
            for axis, values_by_value in (
                (above, [reporting.column(r, reporting.FALL_RATE) for r in runs]),
                (below, [reporting.column(r, "distance_m") for r in runs]),
            ):
                medians = [stats.quartiles(values)[1] for values in values_by_value]
                axis.plot(sweep.values, medians, style, color=colour, lw=1.5, label=walker)
                for x, values in zip(sweep.values, values_by_value, strict=True):
                    axis.plot([x] * len(values), values, "o", color=colour, ms=3, alpha=0.5)
        above.set_yscale("symlog", linthresh=1.0)
        above.set_ylim(bottom=-0.2)
        below.axhline(0.0, color=INK, lw=0.6)
        below.set_xlabel(sweep.label)
        above.set_ylabel("falls per 1000")
        below.set_ylabel("distance, m")
    handles_and_labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles_and_labels, frameon=False, ncols=4, loc="outside upper left")
    save(figure, file)


STUDY = Study(
    "sensitivity",
    "Sensitivity to the mechanics",
    "the system is quite sensitive to some parameters and dimensions (section IV); the twist can "
    "be adjusted in phase and amplitude; a support ratio of 3:2 would be more dynamic than 3:1.",
    arms,
    text,
    draw,
)
