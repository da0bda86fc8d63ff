"""How sensitive the walker is to its mechanics: one number at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from ember_ros.experiments import stats, words
from ember_ros.experiments.study import Arm, Size, Study, numbers, trained, walks
from ember_ros.experiments.words import Found
from ember_ros.report.figures import AMBER, BLUE, GREY, INK, canvas, save


class Sweep(NamedTuple):
    """One number and the values it takes."""

    name: str
    """The parameter, with ``__`` for the dot."""
    label: str
    values: tuple[float, ...]
    trains: bool = False
    """Whether legs are trained with it too; the body's numbers are none of the trainer's."""


TICKS = numbers().gait.ticks
THREE_TO_ONE, THREE_TO_TWO = 3 / 4, round(3 / 5 * TICKS) / TICKS
"""Shares of the cycle in stance; the second to the next whole tick."""
SWEEPS = (
    Sweep("walker__twist_amplitude", "twist, rad", (0.0, 0.05, 0.10, 0.15)),
    Sweep("walker__twist_phase", "phase of the twist, cycles", (0.125, 0.375, 0.625, 0.875)),
    Sweep("leg__operating_height", "operating height, m", (0.43, 0.45, 0.46), True),
    Sweep("trainer__stop_height", "trainer's stop, m", (0.40, 0.41, 0.42, 0.43), True),
    Sweep("gait__stance_share", "share of stance", (THREE_TO_TWO, 22 / TICKS, THREE_TO_ONE), True),
    Sweep("physics__friction", "friction", (0.4, 0.7, 1.0), True),
    Sweep("walker__hip_half_width", "half width of the hips, m", (0.10, 0.14, 0.22, 0.35)),
    Sweep("walker__length", "length of the body, m", (0.6, 0.8, 1.2, 1.5)),
)
POLICIES = ("trained", "empty table", "scripted", "random")


def arms(size: Size) -> list[Arm]:
    """Return walkers of every value, and the scripted knee in the same mechanics."""
    found = []
    seeds = range(min(3, size.seeds))
    for sweep in SWEEPS:
        for value in sweep.values:
            changes: dict[str, Any] = {sweep.name: value}
            on_trainer = changes if sweep.trains else {}
            starts = [trained("ember", size, seed, **on_trainer) for seed in seeds]
            labels = {"sweep": sweep.name.replace("__", "."), "value": repr(value)}
            walked = walks("ember", "reference", size.brief, seeds, starts, **changes)
            found.append(Arm({**labels, "walker": "trained"}, walked))
            for walker in POLICIES[1:]:
                learns = walker == "empty table"
                beside = walks(
                    "ember",
                    "reference",
                    size.brief,
                    range(1),
                    policy="learned" if learns else walker,
                    learning=learns,
                    **changes,
                )
                found.append(Arm({**labels, "walker": walker}, beside))
    return found


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines = []
    for sweep in SWEEPS:
        name = sweep.name.replace("__", ".")
        for value in sweep.values:
            cells = [f"`{name}`", f"{value:g}"]
            runs = {
                walker: words.runs_of(found, sweep=name, value=repr(value), walker=walker)
                for walker in POLICIES
            }
            own = runs["trained"]
            cells += [
                words.never_fell(own),
                f"{words.falls_per_1000(own):.1f}",
                f"{100 * stats.quartiles(words.column(own, 'outside'))[1]:.1f} %",
                words.spread(words.column(own, "distance_m")),
                words.spread(words.column(own, "roll_sd_rad")),
            ]
            for walker in POLICIES[1:]:
                (run,) = runs[walker]
                cells.append(f"{words.falls_per_1000([run]):.0f}; {run['distance_m']:.3f}")
            lines.append(cells)
    heads = ["parameter", "value", "never fell", "falls per 1000", "outside", "distance, m"]
    heads += ["SD of roll, rad", *(f"{walker}: falls; distance" for walker in POLICIES[1:])]
    return [
        "`ember`, the reference body, one number changed at a time. Where it is the leg's or the "
        "ground's, legs are trained with it; where it is the body's, they are the same legs. "
        "Trained legs, and beside them one walk each of legs with an empty table, of the scripted "
        "and of a random knee, falls per 1000 cycles and distance a cycle:",
        "",
        *words.grid(heads, lines),
        "",
        f"3 to 1 is {THREE_TO_ONE:g} of stance; {THREE_TO_TWO:.3f}, that is "
        f"{round(THREE_TO_TWO * TICKS)} of {TICKS} ticks, is the nearest to 3 to 2.",
    ]


def draw(found: Found, file: Path) -> None:
    """Draw a panel a number: falls and distance, trained legs and who walks beside them."""
    figure, axes = canvas(4, 4, width=14.0, height=2.4)
    for n, sweep in enumerate(SWEEPS):
        name = sweep.name.replace("__", ".")
        above, below = axes[2 * (n // 4), n % 4], axes[2 * (n // 4) + 1, n % 4]
        for walker, colour in zip(POLICIES, (BLUE, AMBER, INK, GREY), strict=True):
            runs = [
                words.runs_of(found, sweep=name, value=repr(value), walker=walker)
                for value in sweep.values
            ]
            style = "-" if walker == "trained" else "--"
            for axis, each in (
                (above, [words.column(r, words.FALL_RATE) for r in runs]),
                (below, [words.column(r, "distance_m") for r in runs]),
            ):
                middle = [stats.quartiles(values)[1] for values in each]
                axis.plot(sweep.values, middle, style, color=colour, lw=1.5, label=walker)
                for value, values in zip(sweep.values, each, strict=True):
                    axis.plot([value] * len(values), values, "o", color=colour, ms=3, alpha=0.5)
        above.set_yscale("symlog", linthresh=1.0)
        above.set_ylim(bottom=-0.2)
        below.axhline(0.0, color=INK, lw=0.6)
        below.set_xlabel(sweep.label)
        above.set_ylabel("falls per 1000")
        below.set_ylabel("distance, m")
    known = axes[0, 0].get_legend_handles_labels()
    figure.legend(*known, frameon=False, ncols=4, loc="outside upper left")
    save(figure, file)


STUDY = Study(
    "sensitivity",
    "Sensitivity to the mechanics",
    "the system is quite sensitive to some parameters and dimensions (section IV); twist can be "
    "adjusted in phase and amplitude; a support ratio of 3:2 would be more dynamic than 3:1.",
    arms,
    text,
    draw,
)
