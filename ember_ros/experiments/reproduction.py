"""Run all experiments, and write the document that compares the paper with the results."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from ember_ros.errors import ParameterError
from ember_ros.experiments import reporting, runner
from ember_ros.experiments.reporting import Results
from ember_ros.experiments.studies import (
    baselines,
    direct,
    fig5,
    frontier,
    hexapod,
    learners,
    regime,
    seam,
    senses,
    sensitivity,
    sharing,
    walking,
)
from ember_ros.experiments.study import (
    BODIES,
    OUTDATED,
    WALK_SEED_OFFSET,
    Size,
    Study,
    collect,
    cpu_seconds,
    learner_params,
    outdated_reason,
    section,
    write_results,
)

ALL = "all"
DOCUMENT = "REPRODUCTION.md"
RESULTS = "results"
STUDIES: dict[str, Study] = {
    module.STUDY.name: module.STUDY
    for module in (
        fig5,
        walking,
        direct,
        sharing,
        regime,
        baselines,
        learners,
        frontier,
        senses,
        sensitivity,
        hexapod,
        seam,
    )
}


def read(name: str, folder: Path) -> Results:
    """Read the results of an experiment from a folder.

    Raises:
        ParameterError: the folder does not contain them.
    """
    file = folder / f"{name}.json"
    try:
        results: Results = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ParameterError(
            f"there is no result {file}; `ember experiment {name}` writes it"
        ) from error
    return results


def run(
    studies: Sequence[Study],
    size: Size,
    trials: Path,
    report_progress: Callable[[int, int], bool],
    command: str,
) -> list[Results] | None:
    """Run the trials that were not run yet, and return the results of each experiment.

    Args:
        studies: the experiments.
        size: the size of each experiment.
        trials: folder of all trials.
        report_progress: is called regularly with the completed and the total cost of the trials;
            the run stops if it returns False.
        command: the command line, for the pages.

    Returns:
        The results in the order of the experiments; None if the run was stopped.
    """
    needed = [trial for study in studies for arm in study.arms(size) for trial in arm.trials]
    if not runner.run_all(needed, trials, report_progress):
        return None
    return [collect(study, size, command, trials) for study in studies]


def write_all(studies: Sequence[Study], all_results: Sequence[Results], out: Path) -> list[str]:
    """Write the files of the experiments into ``RESULTS``; if these are all, also the document.

    Returns:
        The paths of the pages, relative to ``RESULTS``.
    """
    for study, results in zip(studies, all_results, strict=True):
        write_results(study, results, out / RESULTS)
    pages = [f"{study.name}.md" for study in studies]
    if len(studies) == len(STUDIES):
        (out / DOCUMENT).write_text(document(out / RESULTS), encoding="utf-8")
        pages.append(f"../{DOCUMENT}")
    return pages


def document(folder: Path) -> str:
    """Return the document as Markdown, computed from nothing but the result files in a folder."""
    all_results = {name: read(name, folder) for name in STUDIES}
    about = all_results["walker"]["about"]
    installed = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    reference = learner_params().walker
    walkers = {name: learner_params(body=name).walker for name in BODIES}
    bodies = [f"`{n}` {each.length} m, {each.hip_half_width} m" for n, each in walkers.items()]
    hours = sum(cpu_seconds(all_results.values()).values()) / 2 / 3600
    outdated = [n for n, study in STUDIES.items() if outdated_reason(study, all_results[n])]
    note = (
        f"{OUTDATED} The results of {', '.join(outdated)} were computed by another version of "
        "the code."
    )
    lines = [
        "# Reproduction",
        "",
        *([note, ""] if outdated else []),
        'Jacob, Polani and Nehaniv, "Legs that can walk" (2005), report single runs. This document '
        "repeats each of their experiments over many seeds and compares the results with the "
        "paper. One command computes every number below from the result files in the folder "
        f"`{RESULTS}`. A test computes this document again and compares.",
        "",
        "```",
        f"{about['command']}",
        "```",
        "",
        f"Versions: {installed}. All runs together take {hours:.1f} hours on two cores. You can "
        "stop the command at any time: when you start it again, completed runs are not repeated.",
        "",
        "**Terms.** A *step* is one cycle of the central pattern generator. A walker *falls* if "
        f"its roll or pitch exceeds {reference.fall_angle} rad, if its body touches the ground, or "
        f"if its hips are below {reference.fall_height} m for a whole cycle. *Outside* is a cycle "
        "in which the body leaves a narrower safe range (see below each table). *SD* is standard "
        "deviation.",
        "",
        "**Verdicts.** Two arms of an experiment are compared by the difference of a measure, "
        "paired by seed. A claim *holds* or *fails* if the 95 % confidence interval of the mean "
        "difference (Student's t) lies on one side of 0; otherwise it is *unclear*. A claim that "
        'begins with "our target" compares a measure with a fixed limit instead; a few other '
        "claims have criteria of their own, which are given in their sections. There are many "
        "claims, and the intervals are not corrected for multiple testing.",
        "",
        "**Seeds.** Trainings have the seeds 0, 1, ...; the walks with their tables have the "
        f"seeds {WALK_SEED_OFFSET}, {WALK_SEED_OFFSET + 1}, .... The parameters of `ember` were "
        "tuned on the training seeds 0 to 19, mostly in the narrow body. Seeds from "
        f"{walking.HELD_OUT} on are held out: they were not used for tuning. They are used in the "
        "reference body; the frontier experiment has no held-out seeds.",
        "",
        "**Learners.** `plain` is the learner of the paper: one-step Q-learning with a constant "
        "learning rate and epsilon-greedy exploration. `ember` is the default. It is also "
        "one-step, local, tabular and shared by all legs, and it adds "
        f"{len(learners.PARTS)} parts that can be set by parameters: [the effect of each part](#"
        f"{_anchor(STUDIES['learners'].title)}).",
        "",
        f"**Bodies.** Length, and half of the distance between left and right hips: "
        f"{'; '.join(bodies)}. Each body is a parameter file: `ember walk --params narrow`. Not "
        "only the feet but also body and knees have collision shapes.",
        "",
        *_summary(all_results),
        "",
        "**All claims** and their verdicts:",
        "",
        *_claims(all_results),
        "",
    ]
    for name, study in STUDIES.items():
        lines += section(study, all_results[name], "##", f"{RESULTS}/")
    return "\n".join(lines).rstrip("\n") + "\n"


def _anchor(title: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    allowed = [c for c in title.lower() if c.isalnum() or c in " -"]
    return "".join(allowed).replace(" ", "-")


def _summary(all_results: dict[str, Results]) -> list[str]:
    """Return the main results: whether walkers fall, and how far they walk."""
    walks = all_results["walker"]
    scripted = reporting.runs_of(walks, walker="scripted knee")[0]["distance_m"]
    lines = ["**Summary.**", ""]
    for learner, seeds in walking.GROUPS:
        runs = reporting.runs_of(walks, learner=learner, seeds=seeds)
        mean = sum(reporting.column(runs, "distance_m")) / len(runs)
        lines.append(
            f"- `{learner}`, {walking.SEED_SETS[seeds]}: {reporting.never_fell(runs)} walkers "
            f"never fell in {runs[0]['cycles']} steps of learning in situ; "
            f"{sum(run['falls'] for run in runs)} falls in total. Mean distance per step: "
            f"{mean:.3f} m, {mean / scripted:.0%} of the scripted knee's (our target: at least "
            f"{walking.MIN_RELATIVE_DISTANCE:.0%}). The walker of the paper fell at steps 62 and "
            "5473 of about 6900."
        )
    for body in frontier.BODIES:
        rates = {
            learner: reporting.falls_per_1000(
                reporting.runs_of(
                    all_results["frontier"], body=body, walker="trained table", learner=learner
                )
            )
            for learner in ("plain", frontier.WITHOUT_LEAD, "ember", frontier.LONGER_TRAINING)
        }
        lines.append(
            f"- {body.capitalize()} body, falls per 1000 steps (our target: at most "
            f"{frontier.TARGET_FALL_RATE:.0f}): "
            f"{'; '.join(f'{learner}: {rate:.2f}' for learner, rate in rates.items())}."
        )
    return lines


def _claims(all_results: dict[str, Results]) -> list[str]:
    """Return a Markdown table of all claims with their verdicts."""
    rows = []
    for name, study in STUDIES.items():
        scopes: dict[str, dict[str, list[str]]] = {}
        for claim in study.claims(all_results[name]):
            by_verdict = scopes.setdefault(claim.statement, {})
            by_verdict.setdefault(claim.verdict, []).append(claim.scope)
        for statement, by_verdict in scopes.items():
            verdicts = [f"**{word}**: {'; '.join(scope)}" for word, scope in by_verdict.items()]
            link = f"[{name}](#{_anchor(study.title)})"
            rows.append((statement, "<br>".join(verdicts), link, f"`ember experiment {name}`"))
    return reporting.markdown_table(("claim", "verdict", "section", "command"), rows)
