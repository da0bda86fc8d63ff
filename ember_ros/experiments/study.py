"""Define what an experiment consists of: arms of trials, curves, claims, a figure and a text.

The results of an experiment are one JSON value, computed from trials. Its CSV file, figure and text
are computed from that value alone, so no number in them is typed by hand.
"""

from __future__ import annotations

import csv
import functools
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ember_ros.experiments.reporting import Claim, Results, Run, markdown_table
from ember_ros.experiments.trial import Outcome, Trial, code_sha256, outcome
from ember_ros.params import Params, replace
from ember_ros.params_file import CONFIG, load_params
from ember_ros.versions import versions

BODIES = ("reference", "easy", "short", "narrow")
LEARNERS = ("plain", "ember")
WALK_SEED_OFFSET = 1000
"""Offset from the seed of a training to the seed of the walk with its table, so that the two share
no random numbers."""


class Size(NamedTuple):
    """The size of an experiment."""

    seeds: int
    """Number of seeds per arm."""
    train: int
    """Cycles on the trainer."""
    walk: int
    """Cycles of a long walk."""

    @property
    def short_walk(self) -> int:
        """Cycles of a short walk, for experiments with many arms: 1/14 of a long walk."""
        return max(1, self.walk // 14)

    @property
    def reduced_seeds(self) -> int:
        """Number of seeds for experiments with very many arms: at most 4."""
        return min(self.seeds, 4)


class Arm(NamedTuple):
    """Trials that differ only in their seed."""

    labels: dict[str, str]
    trials: list[Trial]


@dataclass(frozen=True)
class Study:
    """An experiment."""

    name: str
    """Name of the command and of the result files."""
    title: str
    """Heading of its page."""
    paper: str
    """What the paper reports."""
    arms: Callable[[Size], list[Arm]]
    """Returns the trials to run."""
    text: Callable[[Results], list[str]]
    """Returns the lines of its page, in Markdown."""
    draw: Callable[[Results, Path], None]
    """Writes its figure into a file."""
    curves: Callable[[list[tuple[Arm, list[Outcome]]]], dict[str, Any]] = lambda outcomes_by_arm: {}
    """Returns what is computed from the cycles of the trials, by name."""
    claims: Callable[[Results], list[Claim]] = lambda results: []
    """Returns the claims that it tests, with their verdicts."""


# -- parameters and trials --------------------------------------------------------------------


def learner_params(learner: str = "ember", body: str = "reference", **changes: Any) -> Params:
    """Return the parameters of a learner in a body.

    Args:
        learner: ``plain`` or ``ember``.
        body: name of a parameter file of the package.
        **changes: changed parameters; in their names ``__`` stands for the dot.
    """
    params = _package_params(learner, body)
    return replace(params, {k.replace("__", "."): v for k, v in changes.items()})


@functools.cache
def _package_params(learner: str, body: str) -> Params:
    """Read the package's parameter files for a learner and a body; cached for many trials."""
    # By path: a name could refer to a file in the user's working directory.
    return load_params(*(CONFIG / f"{name}.yaml" for name in (learner, body) if name != "ember"))


def training_trial(learner: str, size: Size, seed: int, **changes: Any) -> Trial:
    """Return the training of one leg on the trainer; it does not depend on any body."""
    return Trial("trainer", size.train, seed, learner_params(learner, **changes))


def walking_trials(
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
    """Return walks of one kind, one per seed.

    Args:
        learner: ``plain`` or ``ember``.
        body: name of a parameter file of the package.
        cycles: length of each walk.
        seeds: seeds of the trainings; the walks have these plus ``WALK_SEED_OFFSET``.
        starts: for each seed, the trial whose table the walk starts from; without them, all walks
            start from an empty table.
        policy: as in ``Trial``.
        learning: whether the legs learn while they walk.
        **changes: changed parameters; in their names ``__`` stands for the dot.
    """
    params = learner_params(learner, body, **changes)
    seeds = list(seeds)
    return [
        Trial("walker", cycles, seed + WALK_SEED_OFFSET, params, policy, learning, start)
        for seed, start in zip(seeds, list(starts) or [None] * len(seeds), strict=True)
    ]


def baseline_arms(body: str, size: Size) -> list[Arm]:
    """Return the baselines in a body: scripted knee, random knee, empty tables that learn."""
    seeds = range(size.seeds)
    arms = [
        Arm(
            {"body": body, "walker": f"{policy} knee", "learner": "-"},
            walking_trials(
                "ember", body, size.short_walk, policy_seeds, policy=policy, learning=False
            ),
        )
        for policy, policy_seeds in (("scripted", range(1)), ("random", seeds))
    ]
    return arms + [
        Arm(
            {"body": body, "walker": "empty table", "learner": learner},
            walking_trials(learner, body, size.short_walk, seeds),
        )
        for learner in LEARNERS
    ]


def trained_arm(body: str, learner: str, size: Size, *, name: str = "", **changes: Any) -> Arm:
    """Return short walks that start with a trained table and continue to learn.

    Args:
        body: name of a parameter file of the package.
        learner: ``plain`` or ``ember``.
        size: number of seeds, and cycles of trainings and walks.
        name: name of the learner in the labels, if it is changed.
        **changes: changed parameters, for the training and for the walk.
    """
    seeds = range(size.seeds)
    starts = [training_trial(learner, size, seed, **changes) for seed in seeds]
    return Arm(
        {"body": body, "walker": "trained table", "learner": name or learner},
        walking_trials(learner, body, size.short_walk, seeds, starts, **changes),
    )


# -- results ----------------------------------------------------------------------------------


def collect(study: Study, size: Size, command: str, folder: Path) -> Results:
    """Return the results of an experiment whose trials are in ``folder``."""
    outcomes_by_arm = [
        (arm, [outcome(trial, folder) for trial in arm.trials]) for arm in study.arms(size)
    ]
    return {
        "name": study.name,
        "about": {
            "command": command,
            "versions": versions(),
            "code_sha256": code_sha256(),
            "ticks": Params().gait.ticks,
            **size._asdict(),
            "brief": size.short_walk,
        },
        "arms": [
            {
                "labels": arm.labels,
                "runs": [
                    _run(trial, each, folder)
                    for trial, each in zip(arm.trials, outcomes, strict=True)
                ],
            }
            for arm, outcomes in outcomes_by_arm
        ],
        "curves": study.curves(outcomes_by_arm),
    }


WALKER_MEASURES = ("falls", "first_fall", "outside", "outside_settled", "cost_of_transport")
"""Measures that have no meaning on the trainer."""
WALKER_MEASURE_PREFIXES = ("roll", "pitch", "turn", "drift", "heading")
"""How the names of further measures begin that have no meaning on the trainer."""


def _run(trial: Trial, result: Outcome, folder: Path) -> Run:
    """Return the results of one trial as a flat mapping."""
    run = {"seed": trial.seed, "trial": trial.key, **result.measures}
    if trial.start is not None:
        run["start"] = trial.start.key
        run["start_cpu_s"] = outcome(trial.start, folder).measures["cpu_s"]
    if trial.world == "trainer":
        for name in list(run):
            if name in WALKER_MEASURES or name.startswith(WALKER_MEASURE_PREFIXES):
                run.pop(name)
    return run


OUTDATED = "> **Older than this version.**"
"""How a page begins if an earlier version of the code computed its results."""


def outdated_note(results: Results, name: str) -> list[str]:
    """Return the first lines of a page whose results another version of the code computed.

    Args:
        results: the results of the experiment.
        name: name of the experiment.

    Returns:
        No lines if the results are up to date.
    """
    if results["about"].get("code_sha256") == code_sha256():
        return []
    return [
        f"{OUTDATED} These results were computed by another version of the code; "
        f"`ember experiment {name}` computes them again.",
        "",
    ]


def outdated_reason(study: Study, results: Results) -> str | None:
    """Return why this version of the code would compute other results; None if it would not."""
    about = results["about"]
    if about.get("code_sha256") != code_sha256():
        return "another version of the code computed them"
    size = Size(about["seeds"], about["train"], about["walk"])
    expected = [
        {"trial": trial.key_with(about["versions"])}
        | ({"start": trial.start.key_with(about["versions"])} if trial.start else {})
        for arm in study.arms(size)
        for trial in arm.trials
    ]
    runs = [run for arm in results["arms"] for run in arm["runs"]]
    if [{key: run[key] for key in ("trial", "start") if key in run} for run in runs] != expected:
        return "this version of the experiment has other trials"
    return None


def write_results(study: Study, results: Results, folder: Path) -> None:
    """Write ``NAME.json``, ``NAME.csv``, ``NAME.png`` and ``NAME.md``."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / study.name
    text = json.dumps(results, indent=1, allow_nan=False)
    file.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    with file.with_suffix(".csv").open("w", newline="", encoding="utf-8") as out:
        labels = list(dict.fromkeys(key for arm in results["arms"] for key in arm["labels"]))
        columns = list(dict.fromkeys(k for arm in results["arms"] for r in arm["runs"] for k in r))
        table = csv.writer(out, lineterminator="\n")
        table.writerow([*labels, *columns])
        for arm in results["arms"]:
            for run in arm["runs"]:
                row = [
                    *(arm["labels"].get(k, "") for k in labels),
                    *(run.get(k) for k in columns),
                ]
                table.writerow(row)
    study.draw(results, file.with_suffix(".png"))
    file.with_suffix(".md").write_text(page_of(study, results), encoding="utf-8")


def write_page(name: str, results: Results, page: str, folder: Path) -> None:
    """Write ``NAME.json`` and ``NAME.md`` of an experiment that has no arms of trials."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(results, indent=1) + "\n"
    (folder / f"{name}.json").write_text(text, encoding="utf-8")
    (folder / f"{name}.md").write_text(page, encoding="utf-8")


def page_of(study: Study, results: Results) -> str:
    """Return the page of an experiment, in Markdown."""
    return "\n".join(section(study, results, "#")) + "\n"


def cpu_seconds(all_results: Iterable[Results]) -> dict[str, float]:
    """Return the CPU time of every trial of some experiments, s, by key, trainings included."""
    seconds: dict[str, float] = {}
    for results in all_results:
        for arm in results["arms"]:
            for run in arm["runs"]:
                seconds[run["trial"]] = run["cpu_s"]
                if "start" in run:
                    seconds[run["start"]] = run["start_cpu_s"]
    return seconds


def section(study: Study, results: Results, heading: str, figures: str = "") -> list[str]:
    """Return the section of a document about one experiment, as lines of Markdown.

    Args:
        study: the experiment.
        results: its results.
        heading: the number signs before its title.
        figures: the folder of the figure in its link, ending in a slash.
    """
    about = results["about"]
    counts = [len(arm["runs"]) for arm in results["arms"]]
    lowest, highest = min(counts), max(counts)
    seeds = f"{lowest} to {highest}" if lowest < highest else f"{lowest}"
    minutes = sum(cpu_seconds([results]).values()) / 60
    claims = study.claims(results)
    reason = outdated_reason(study, results)
    note = (
        f"{OUTDATED} The results of this section are outdated: {reason}; "
        f"`ember experiment {study.name}` computes them again."
    )
    verdicts = [
        *markdown_table(
            ("claim", "tested with", "result, mean over seeds [95 % interval]", "verdict"),
            [(each.statement, each.scope, each.evidence, f"**{each.verdict}**") for each in claims],
        ),
        "",
    ]
    return [
        f"{heading} {study.title}",
        "",
        f"**The paper:** {study.paper}",
        "",
        *([] if reason is None else [note, ""]),
        *(verdicts if claims else []),
        *study.text(results),
        "",
        f"![{study.title}]({figures}{study.name}.png)",
        "",
        f"Command: `{about['command']}`. A training has {about['train']} cycles, a walk "
        f"{about['walk']} (long) or {about['brief']} cycles (short). {seeds} seeds per arm, "
        f"{sum(counts)} runs, {minutes:.0f} CPU minutes including the trainings. Each run is one "
        f"row of `{study.name}.csv`.",
        "",
    ]
