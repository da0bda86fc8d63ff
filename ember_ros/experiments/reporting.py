"""Read measures from results, and format them as text: intervals, quartiles and tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ember_ros.experiments import stats
from ember_ros.experiments.trial import LOW_M, TILT_RAD

Results = dict[str, Any]
"""The JSON value of an experiment: ``name``, ``about``, ``arms`` (``labels``, ``runs``) and
``curves``."""
Run = dict[str, Any]
"""The results of one trial: ``seed``, ``trial`` (its key) and its measures."""


class Claim(NamedTuple):
    """A claim and its test."""

    statement: str
    """The claim."""
    scope: str
    """The learner and the body that it was tested with."""
    evidence: str
    """The measured values."""
    verdict: str
    """``holds``, ``fails`` or ``unclear``."""


def runs_of(results: Results, **labels: str) -> list[Run]:
    """Return the runs of the one arm with these labels.

    Raises:
        KeyError: no arm has them, or more than one.
    """
    matches = [arm for arm in results["arms"] if labels.items() <= arm["labels"].items()]
    if len(matches) != 1:
        raise KeyError(
            f"{len(matches)} arms of {results['name']} have {labels}; expected exactly one"
        )
    runs: list[Run] = matches[0]["runs"]
    return runs


FALL_RATE = "fall_rate"
"""Falls per 1000 cycles: a measure that is not in a run but computed from it."""


def column(runs: Sequence[Run], name: str) -> list[float]:
    """Return one measure of all runs, in the order of the runs.

    Raises:
        ValueError: the measure is None in a run; a mean over the other runs would be wrong.
    """
    if name == FALL_RATE:
        return [1000.0 * run["falls"] / run["cycles"] for run in runs]
    values = [run[name] for run in runs]
    if None in values:
        raise ValueError(f"{name} is missing in at least one run")
    return [float(value) for value in values]


def paired_difference(
    minuend: Sequence[Run], subtrahend: Sequence[Run], name: str
) -> stats.Interval:
    """Return the mean difference of a measure between two arms, paired by seed."""
    return stats.difference(column(minuend, name), column(subtrahend, name))


def falls_per_1000(runs: Sequence[Run]) -> float:
    """Return the falls per 1000 cycles over all runs together."""
    return 1000.0 * sum(column(runs, "falls")) / sum(column(runs, "cycles"))


def never_fell(runs: Sequence[Run]) -> str:
    """Return the number of runs without a fall, as ``8 of 10``."""
    return f"{sum(run['falls'] == 0 for run in runs)} of {len(runs)}"


def with_quartiles(values: Sequence[float], form: str = ".3f") -> str:
    """Return the median, followed by the first and third quartile in brackets."""
    low, median, high = stats.quartiles(values)
    if len(values) == 1:
        return f"{median:{form}}"
    return f"{median:{form}} ({low:{form}} to {high:{form}})"


def with_interval(interval: stats.Interval, form: str = ".3f", sign: str = "+") -> str:
    """Return the mean, followed by its interval; of a single seed, the mean alone."""
    if interval.n < 2:
        return f"{interval.mean:{sign}{form}}"
    low, high = f"{interval.low:{sign}{form}}", f"{interval.high:{sign}{form}}"
    return f"{interval.mean:{sign}{form}} [{low}, {high}]"


def target_verdict(reached: bool, runs: Sequence[Any]) -> str:
    """Return ``holds`` or ``fails`` for a target; ``unclear`` if there is only one seed."""
    return "unclear" if len(runs) < 2 else "holds" if reached else "fails"


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [
        f"| {' | '.join(heads)} |",
        f"|{'---|' * len(heads)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def walker_table(arms: Sequence[dict[str, Any]]) -> list[str]:
    """Return a Markdown table of walkers, one row per arm; all pages use the same columns."""
    heads = (
        "body", "walker", "learner", "runs", "never fell", "falls per 1000 cycles", "outside",
        "distance per cycle, m", "SD of roll, rad", "SD of pitch, rad",
    )  # fmt: skip
    rows = []
    for arm in arms:
        runs, labels = arm["runs"], arm["labels"]
        rows.append(
            (
                labels["body"],
                labels["walker"],
                labels["learner"],
                str(len(runs)),
                never_fell(runs),
                f"{falls_per_1000(runs):.2f}",
                f"{100 * stats.quartiles(column(runs, 'outside'))[1]:.1f} %",
                with_quartiles(column(runs, "distance_m")),
                with_quartiles(column(runs, "roll_sd_rad")),
                with_quartiles(column(runs, "pitch_sd_rad")),
            )
        )
    return markdown_table(heads, rows)


OUTSIDE = f"roll or pitch over {TILT_RAD} rad or hips under {LOW_M} m"
"""The condition under which a cycle counts as outside the safe range."""
WALKER_TABLE_NOTE = (
    "Medians over seeds, quartiles in brackets. Falls are counted over all runs together. Outside: "
    f"share of cycles outside the safe range, that is with {OUTSIDE}."
)
"""The note below every table of walkers."""
