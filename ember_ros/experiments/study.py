"""What an experiment is: arms of trials, what is worked out from them, a figure, and a text.

An experiment's result is one JSON value, made from trials; its CSV, its figure and its text are
made from that value alone, so no figure in them is typed by hand.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ember_ros.experiments import stats
from ember_ros.experiments.trial import Outcome, Trial, outcome
from ember_ros.params import Params, replace
from ember_ros.params_file import load_params
from ember_ros.versions import versions

BODIES = ("reference", "easy", "short", "narrow")
LEARNERS = ("plain", "ember")
OTHER_SEED = 1000
"""Added to a training seed for the walk with its table: the two share no random number."""

Found = dict[str, Any]
"""The JSON value: ``name``, ``about``, ``arms`` (``labels`` and ``runs``) and ``curves``."""
Run = dict[str, Any]
"""One trial's line: ``seed``, ``trial`` and its measures."""


class Size(NamedTuple):
    """How large an experiment is."""

    seeds: int
    train: int
    """Cycles on the trainer."""
    walk: int
    """Cycles of a long walk."""

    @property
    def brief(self) -> int:
        """Cycles of a walk that is compared with many others: a fourteenth of a long one."""
        return max(1, self.walk // 14)

    @property
    def few(self) -> int:
        """Seeds where there are many arms."""
        return min(self.seeds, 4)


class Arm(NamedTuple):
    """Trials that differ in their seed alone."""

    labels: dict[str, str]
    trials: list[Trial]


@dataclass(frozen=True)
class Study:
    """An experiment."""

    name: str
    title: str
    paper: str
    """What the paper says."""
    arms: Callable[[Size], list[Arm]]
    text: Callable[[Found], list[str]]
    """Lines of Markdown."""
    draw: Callable[[Found, Path], None]
    curves: Callable[[list[tuple[Arm, list[Outcome]]]], dict[str, Any]] = lambda arms: {}


# -- what trials are made of ------------------------------------------------------------------


def numbers(learner: str = "ember", body: str = "reference", **changes: Any) -> Params:
    """Return the parameters of a learner in a body; ``__`` stands for the dot in names."""
    files = [name for name in (learner, body) if name != "ember"]  # ember's are the defaults
    return replace(load_params(*files), {k.replace("__", "."): v for k, v in changes.items()})


def trained(learner: str, size: Size, seed: int, **changes: Any) -> Trial:
    """Return the training of one leg; it knows of no body."""
    return Trial("trainer", size.train, seed, numbers(learner, **changes))


def walks(
    learner: str,
    body: str,
    cycles: int,
    seeds: Iterable[int],
    starts: Iterable[Trial | None] = (),
    *,
    policy: str = "learned",
    learning: bool = True,
    **changes: Any,
) -> list[Trial]:
    """Return walks of one kind, one a training seed; from nothing without ``starts``."""
    params = numbers(learner, body, **changes)
    seeds = list(seeds)
    return [
        Trial("walker", cycles, seed + OTHER_SEED, params, policy, learning, start)
        for seed, start in zip(seeds, list(starts) or [None] * len(seeds), strict=True)
    ]


def company(body: str, size: Size) -> list[Arm]:
    """Return who walks beside those that are tested: the knee by hand, a random one, no table."""
    seeds = range(size.seeds)
    arms = [
        Arm(
            {"body": body, "walker": f"{policy} knee", "learner": "-"},
            walks("ember", body, size.brief, some, policy=policy, learning=False),
        )
        for policy, some in (("scripted", range(1)), ("random", seeds))
    ]
    return arms + [
        Arm(
            {"body": body, "walker": "empty table", "learner": learner},
            walks(learner, body, size.brief, seeds),
        )
        for learner in LEARNERS
    ]


def trained_arm(body: str, learner: str, size: Size) -> Arm:
    """Return walkers with a trained table that go on learning."""
    seeds = range(size.seeds)
    starts = [trained(learner, size, seed) for seed in seeds]
    return Arm(
        {"body": body, "walker": "trained table", "learner": learner},
        walks(learner, body, size.brief, seeds, starts),
    )


# -- from trials to a value -------------------------------------------------------------------


def collect(study: Study, size: Size, command: str, folder: Path) -> Found:
    """Return what came of an experiment whose trials are in ``folder``."""
    arms = [(arm, [outcome(trial, folder) for trial in arm.trials]) for arm in study.arms(size)]
    return {
        "name": study.name,
        "about": {
            "command": command,
            "versions": versions(),
            "ticks": Params().gait.ticks,
            **size._asdict(),
            "brief": size.brief,
        },
        "arms": [
            {
                "labels": arm.labels,
                "runs": [
                    {"seed": trial.seed, "trial": trial.key, **each.measures}
                    for trial, each in zip(arm.trials, outcomes, strict=True)
                ],
            }
            for arm, outcomes in arms
        ],
        "curves": study.curves(arms),
    }


def write(study: Study, found: Found, folder: Path) -> None:
    """Write ``NAME.json``, ``NAME.csv``, ``NAME.png`` and ``NAME.md``."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / study.name
    text = json.dumps(found, indent=1, allow_nan=False)
    file.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    with file.with_suffix(".csv").open("w", newline="", encoding="utf-8") as out:
        labels = list(dict.fromkeys(key for arm in found["arms"] for key in arm["labels"]))
        columns = list(dict.fromkeys(k for arm in found["arms"] for r in arm["runs"] for k in r))
        table = csv.writer(out, lineterminator="\n")
        table.writerow([*labels, *columns])
        for arm in found["arms"]:
            for run in arm["runs"]:
                known = [
                    *(arm["labels"].get(k, "") for k in labels),
                    *(run.get(k) for k in columns),
                ]
                table.writerow(known)
    study.draw(found, file.with_suffix(".png"))
    page = "\n".join(section(study, found, "#")) + "\n"
    file.with_suffix(".md").write_text(page, encoding="utf-8")


def section(study: Study, found: Found, heading: str, figures: str = "") -> list[str]:
    """Return an experiment's part of a document.

    Args:
        study: the experiment.
        found: what came of it.
        heading: the hashes before its title.
        figures: what stands before the figure's name in its link.
    """
    about = found["about"]
    total = sum(run["cpu_s"] for arm in found["arms"] for run in arm["runs"])
    count = sum(len(arm["runs"]) for arm in found["arms"])
    return [
        f"{heading} {study.title}",
        "",
        f"**The paper:** {study.paper}",
        "",
        *study.text(found),
        "",
        f"![{study.title}]({figures}{study.name}.png)",
        "",
        f"`{about['command']}` with {about['seeds']} seeds, {about['train']} cycles on the "
        f"trainer, {about['walk']} (long) or {about['brief']} cycles on the body; "
        f"{count} runs, {total / 60:.0f} CPU minutes without their trainings; every run is a line "
        f"of `{study.name}.csv`.",
        "",
    ]


# -- from a value to words --------------------------------------------------------------------


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


def column(runs: Sequence[Run], name: str) -> list[float]:
    """Return one measure of all runs, ``None`` as not a number would be wrong: none is left out.

    Raises:
        ValueError: a run has no such number.
    """
    values = [run[name] for run in runs]
    if None in values:
        raise ValueError(f"{name} is not known of every run")
    return [float(value) for value in values]


def falls_per_1000(runs: Sequence[Run]) -> float:
    """Return falls per 1000 cycles, all runs together."""
    return 1000.0 * sum(column(runs, "falls")) / sum(column(runs, "cycles"))


def falls_rates(runs: Sequence[Run]) -> list[float]:
    """Return falls per 1000 cycles of each run."""
    return [1000.0 * run["falls"] / run["cycles"] for run in runs]


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
    """Return a mean difference with its interval."""
    return f"{found.mean:{sign}{form}} [{found.low:{sign}{form}}, {found.high:{sign}{form}}]"


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


WALKERS_NOTE = (
    "Medians over seeds with quartiles; falls of all runs together; outside: share of cycles with "
    "roll or pitch over 0.3 rad or hips under 0.36 m."
)
"""Stands below every table of walkers."""
