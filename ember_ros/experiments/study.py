"""What an experiment is: arms of trials, what is worked out from them, a figure, and a text.

An experiment's result is one JSON value, made from trials; its CSV, its figure and its text are
made from that value alone, so no figure in them is typed by hand.
"""

from __future__ import annotations

import csv
import functools
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ember_ros.experiments.trial import Outcome, Trial, code_sha256, outcome
from ember_ros.experiments.words import Claim, Found, Run, grid
from ember_ros.params import Params, replace
from ember_ros.params_file import CONFIG, load_params
from ember_ros.versions import versions

BODIES = ("reference", "easy", "short", "narrow")
LEARNERS = ("plain", "ember")
OTHER_SEED = 1000
"""Added to a training seed for the walk with its table: the two share no random number."""


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
    claims: Callable[[Found], list[Claim]] = lambda found: []
    """What is claimed, and whether it holds."""


# -- what trials are made of ------------------------------------------------------------------


def numbers(learner: str = "ember", body: str = "reference", **changes: Any) -> Params:
    """Return the parameters of a learner in a body; ``__`` stands for the dot in names."""
    own = _of_package(learner, body)
    return replace(own, {k.replace("__", "."): v for k, v in changes.items()})


@functools.cache
def _of_package(learner: str, body: str) -> Params:
    """Return what the package's files say: read once, for thousands of trials."""
    # Not by name: a file of the user's that is called so would be taken.
    return load_params(*(CONFIG / f"{name}.yaml" for name in (learner, body) if name != "ember"))


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


def trained_arm(body: str, learner: str, size: Size, *, name: str = "", **changes: Any) -> Arm:
    """Return walkers with a trained table that go on learning.

    Args:
        body: of the walkers.
        learner: ``plain`` or ``ember``.
        size: its seeds, its training and its brief walk.
        name: of a learner that is changed; its own without.
        changes: to the learner, on the trainer and on the body.
    """
    seeds = range(size.seeds)
    starts = [trained(learner, size, seed, **changes) for seed in seeds]
    return Arm(
        {"body": body, "walker": "trained table", "learner": name or learner},
        walks(learner, body, size.brief, seeds, starts, **changes),
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
            "code_sha256": code_sha256(),
            "ticks": Params().gait.ticks,
            **size._asdict(),
            "brief": size.brief,
        },
        "arms": [
            {
                "labels": arm.labels,
                "runs": [
                    _run(trial, each, folder)
                    for trial, each in zip(arm.trials, outcomes, strict=True)
                ],
            }
            for arm, outcomes in arms
        ],
        "curves": study.curves(arms),
    }


NO_BODY = ("falls", "first_fall", "outside", "outside_settled", "cost_of_transport")
NO_ANGLE = ("roll", "pitch", "turn", "drift", "heading")
"""Measures that mean nothing on a trainer, and how the names of others begin."""


def _run(trial: Trial, found: Outcome, folder: Path) -> Run:
    """Return a trial's line."""
    line = {"seed": trial.seed, "trial": trial.key, **found.measures}
    if trial.start is not None:
        line["start"] = trial.start.key
        line["start_cpu_s"] = outcome(trial.start, folder).measures["cpu_s"]
    if trial.world == "trainer":
        for name in [name for name in line if name in NO_BODY or name.startswith(NO_ANGLE)]:
            line.pop(name)
    return line


OLDER = "> **Older than this version.**"
"""How a page begins whose results were made by code that decided otherwise."""


def age(found: Found, name: str) -> list[str]:
    """Return what a page says first where its results are not of the code that decides now."""
    if found["about"].get("code_sha256") == code_sha256():
        return []
    return [
        f"{OLDER} The code that decides is not the one that made these results; "
        f"`ember experiment {name}` makes them again.",
        "",
    ]


def belongs(study: Study, found: Found) -> str | None:
    """Return why a result is not what this code would come to; None where it is."""
    about = found["about"]
    if about.get("code_sha256") != code_sha256():
        return "the code that decides is not the one that ran it"
    size = Size(about["seeds"], about["train"], about["walk"])
    names = [
        {"trial": trial.key_with(about["versions"])}
        | ({"start": trial.start.key_with(about["versions"])} if trial.start else {})
        for arm in study.arms(size)
        for trial in arm.trials
    ]
    runs = [run for arm in found["arms"] for run in arm["runs"]]
    if [{key: run[key] for key in ("trial", "start") if key in run} for run in runs] != names:
        return "its trials are not those that this code asks for"
    return None


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
    file.with_suffix(".md").write_text(page_of(study, found), encoding="utf-8")


def write_page(name: str, found: Found, page: str, folder: Path) -> None:
    """Write ``NAME.json`` and ``NAME.md`` of an experiment that is not made of arms of trials."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(found, indent=1) + "\n"
    (folder / f"{name}.json").write_text(text, encoding="utf-8")
    (folder / f"{name}.md").write_text(page, encoding="utf-8")


def page_of(study: Study, found: Found) -> str:
    """Return an experiment's page of its own."""
    return "\n".join(section(study, found, "#")) + "\n"


def cpu_seconds(found: Iterable[Found]) -> dict[str, float]:
    """Return the CPU time of every trial of some experiments, trainings too, each once."""
    spent: dict[str, float] = {}
    for each in found:
        for arm in each["arms"]:
            for run in arm["runs"]:
                spent[run["trial"]] = run["cpu_s"]
                if "start" in run:
                    spent[run["start"]] = run["start_cpu_s"]
    return spent


def section(study: Study, found: Found, heading: str, figures: str = "") -> list[str]:
    """Return an experiment's part of a document.

    Args:
        study: the experiment.
        found: what came of it.
        heading: the hashes before its title.
        figures: what stands before the figure's name in its link.
    """
    about = found["about"]
    counts = [len(arm["runs"]) for arm in found["arms"]]
    few, many = min(counts), max(counts)
    seeds = f"{few} to {many}" if few < many else f"{few}"
    spent = cpu_seconds([found])
    claims = study.claims(found)
    why = belongs(study, found)
    stale = f"{OLDER} Of this section: {why}; `ember experiment {study.name}` makes it again."
    verdicts = [
        *grid(
            ("claim", "where", "seed by seed, mean [95 %]", "verdict"),
            [(each.says, each.where, each.here, f"**{each.word}**") for each in claims],
        ),
        "",
    ]
    return [
        f"{heading} {study.title}",
        "",
        f"**The paper:** {study.paper}",
        "",
        *([] if why is None else [stale, ""]),
        *(verdicts if claims else []),
        *study.text(found),
        "",
        f"![{study.title}]({figures}{study.name}.png)",
        "",
        f"`{about['command']}`: {about['train']} cycles on the trainer, {about['walk']} (long) or "
        f"{about['brief']} cycles on the body; {seeds} seeds an arm, {sum(counts)} runs, "
        f"{sum(spent.values()) / 60:.0f} CPU minutes with the trainings they start from; every run "
        f"is a line of `{study.name}.csv`.",
        "",
    ]
