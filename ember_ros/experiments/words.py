"""From a result to words: measures of runs, tables of walkers, medians and intervals as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ember_ros.experiments import stats
from ember_ros.experiments.trial import LOW_M, TILT_RAD

Found = dict[str, Any]
"""An experiment's JSON value: ``name``, ``about``, ``arms`` (``labels``, ``runs``), ``curves``."""
Run = dict[str, Any]
"""One trial's line: ``seed``, ``trial`` and its measures."""


class Claim(NamedTuple):
    """Something that is claimed, and what came out."""

    says: str
    """What is claimed."""
    where: str
    """Learner and body."""
    here: str
    """The figures."""
    word: str
    """``holds``, ``fails`` or ``unclear``."""


def runs_of(found: Found, **labels: str) -> list[Run]:
    """Return the runs of the one arm with these labels.

    Raises:
        KeyError: there is none, or more than one.
    """
    fits = [arm for arm in found["arms"] if labels.items() <= arm["labels"].items()]
    if len(fits) != 1:
        raise KeyError(f"{len(fits)} arms of {found['name']} have {labels}; one would be right")
    runs: list[Run] = fits[0]["runs"]
    return runs


FALL_RATE = "fall_rate"
"""Falls per 1000 cycles, a measure that is worked out."""


def column(runs: Sequence[Run], name: str) -> list[float]:
    """Return one measure of all runs, in order of seed.

    Raises:
        ValueError: a run has no such number; to leave it out would be a mean of something else.
    """
    if name == FALL_RATE:
        return [1000.0 * run["falls"] / run["cycles"] for run in runs]
    values = [run[name] for run in runs]
    if None in values:
        raise ValueError(f"{name} is not known of every run")
    return [float(value) for value in values]


def more(one: Sequence[Run], other: Sequence[Run], name: str) -> stats.Interval:
    """Return how much more of a measure some runs have than others, seed by seed."""
    return stats.difference(column(one, name), column(other, name))


def falls_per_1000(runs: Sequence[Run]) -> float:
    """Return falls per 1000 cycles, all runs together."""
    return 1000.0 * sum(column(runs, "falls")) / sum(column(runs, "cycles"))


def never_fell(runs: Sequence[Run]) -> str:
    """Return how many of the runs never fell."""
    return f"{sum(run['falls'] == 0 for run in runs)} of {len(runs)}"


def spread(values: Sequence[float], form: str = ".3f") -> str:
    """Return the median, and the quartiles in brackets."""
    low, middle, high = stats.quartiles(values)
    if len(values) == 1:
        return f"{middle:{form}}"
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


def told(found: stats.Interval, form: str = ".3f", sign: str = "+") -> str:
    """Return a mean with its interval, which one seed alone has not."""
    if found.n < 2:
        return f"{found.mean:{sign}{form}}"
    return f"{found.mean:{sign}{form}} [{found.low:{sign}{form}}, {found.high:{sign}{form}}]"


def bar(passed: bool, runs: Sequence[Any]) -> str:
    """Return the verdict on a bar; one seed proves nothing."""
    return "unclear" if len(runs) < 2 else "holds" if passed else "fails"


def grid(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    """Return a Markdown table."""
    return [
        f"| {' | '.join(heads)} |",
        f"|{'---|' * len(heads)}",
        *(f"| {' | '.join(line)} |" for line in lines),
    ]


def walkers(arms: Sequence[dict[str, Any]]) -> list[str]:
    """Return the table of walkers: a line an arm, in the same columns everywhere."""
    heads = (
        "body", "walker", "learner", "runs", "never fell", "falls per 1000", "outside",
        "distance a cycle, m", "SD of roll, rad", "SD of pitch, rad",
    )  # fmt: skip
    lines = []
    for arm in arms:
        runs, labels = arm["runs"], arm["labels"]
        lines.append(
            (
                labels["body"],
                labels["walker"],
                labels["learner"],
                str(len(runs)),
                never_fell(runs),
                f"{falls_per_1000(runs):.2f}",
                f"{100 * stats.quartiles(column(runs, 'outside'))[1]:.1f} %",
                spread(column(runs, "distance_m")),
                spread(column(runs, "roll_sd_rad")),
                spread(column(runs, "pitch_sd_rad")),
            )
        )
    return grid(heads, lines)


OUTSIDE = f"roll or pitch over {TILT_RAD} rad or hips under {LOW_M} m"
"""When a cycle is counted as outside."""
WALKERS_NOTE = (
    "Medians over seeds with quartiles; falls of all runs together; outside: share of cycles with "
    f"{OUTSIDE}."
)
"""Stands below every table of walkers."""
