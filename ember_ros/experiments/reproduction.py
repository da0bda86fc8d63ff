"""All experiments, and the document that puts the paper's figures beside what came out."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from ember_ros.errors import ParameterError
from ember_ros.experiments import lab, words
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
    walker,
)
from ember_ros.experiments.study import (
    BODIES,
    OLDER,
    OTHER_SEED,
    Size,
    Study,
    belongs,
    collect,
    cpu_seconds,
    numbers,
    section,
    write,
)
from ember_ros.experiments.words import Found

ALL = "all"
DOCUMENT = "REPRODUCTION.md"
RESULTS = "results"
STUDIES: dict[str, Study] = {
    module.STUDY.name: module.STUDY
    for module in (
        fig5,
        walker,
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


def read(name: str, folder: Path) -> Found:
    """Read what came of an experiment.

    Raises:
        ParameterError: it was not run into this folder.
    """
    file = folder / f"{name}.json"
    try:
        found: Found = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ParameterError(
            f"there is no result {file}; `ember experiment {name}` makes it"
        ) from error
    return found


def run(
    studies: Sequence[Study],
    size: Size,
    trials: Path,
    say: Callable[[int, int], bool],
    command: str,
) -> list[Found] | None:
    """Run what was not run before, and return what came of each experiment.

    Args:
        studies: the experiments.
        size: of all of them.
        trials: folder of all trials.
        say: told how much is done of how much; returns whether to go on.
        command: what was typed.

    Returns:
        None where it was stopped.
    """
    needed = [trial for study in studies for arm in study.arms(size) for trial in arm.trials]
    if not lab.run_all(needed, trials, say):
        return None
    return [collect(study, size, command, trials) for study in studies]


def write_all(studies: Sequence[Study], found: Sequence[Found], out: Path) -> list[str]:
    """Write the files of experiments into ``RESULTS``, and of all of them the document too.

    Returns:
        The names of the pages, seen from ``RESULTS``.
    """
    for study, each in zip(studies, found, strict=True):
        write(study, each, out / RESULTS)
    made = [f"{study.name}.md" for study in studies]
    if len(studies) == len(STUDIES):
        (out / DOCUMENT).write_text(document(out / RESULTS), encoding="utf-8")
        made.append(f"../{DOCUMENT}")
    return made


def document(folder: Path) -> str:
    """Return the document, made from the result files in a folder and from nothing else."""
    found = {name: read(name, folder) for name in STUDIES}
    known = found["walker"]["about"]["versions"]
    body = numbers().walker
    bodies = [
        f"`{name}` {numbers(body=name).walker.length} m, "
        f"{numbers(body=name).walker.hip_half_width} m"
        for name in BODIES
    ]
    hours = sum(cpu_seconds(found.values()).values()) / 2 / 3600
    old = [name for name, study in STUDIES.items() if belongs(study, found[name]) is not None]
    again = f"{OLDER} The results of {', '.join(old)} were made by code that decided otherwise."
    lines = [
        "# Reproduction",
        "",
        *([again, ""] if old else []),
        'Jacob, Polani and Nehaniv, "Legs that can walk" (2005), show single runs. Here each of '
        "their experiments is run over many seeds, with what the paper says beside what came out. "
        "Every number below is written by one command from the result files beside this page; a "
        "test makes the page again from them and compares.",
        "",
        "```",
        f"{found['walker']['about']['command']}",
        "```",
        "",
        f"Versions: {', '.join(f'{name} {version}' for name, version in known.items())}. "
        f"All runs together take {hours:.1f} hours on two cores. What was run before is not run "
        "again: stop it and start it as you like.",
        "",
        "**Words.** A step is a cycle of the pattern generator. A walker *falls* when roll or "
        f"pitch pass {body.fall_angle} rad, its body touches the ground, or its hips are under "
        f"{body.fall_height} m for a whole cycle. A claim *holds* or *fails* where the 95 % "
        "interval (Student's t) of the difference, seed by seed, lies on one side of 0, and is "
        "*unclear* otherwise; where a claim is about a bar and no difference, it says so. There "
        "are many claims and no correction for that. Trainings have the seeds 0, 1, ..., the walks "
        f"with their tables {OTHER_SEED}, {OTHER_SEED + 1}, ....",
        "",
        "**Seeds.** The numbers of `ember` were found on training seeds 0 to 19, mostly in the "
        f"narrow body; no number was chosen on seeds from {walker.HELD_OUT} on, which walk in "
        "the reference body. The frontier has no held-out seeds.",
        "",
        "**Learners.** `plain` is the paper's: one-step Q-learning at a constant rate, "
        "epsilon-greedy. `ember`, the default, is still one-step, local, tabular and shared, and "
        f"adds {len(learners.PARTS)} parts that are parameters: [what each is worth](#"
        f"{_anchor(STUDIES['learners'].title)}).",
        "",
        f"**Bodies.** Length and half width of the hips: {'; '.join(bodies)}. All are parameter "
        "files: `ember walk --params narrow`. Body and knees collide, not the feet alone.",
        "",
        *_summary(found),
        "",
        "**Every claim**, and where it holds:",
        "",
        *_claims(found),
        "",
    ]
    for name, study in STUDIES.items():
        lines += section(study, found[name], "##", f"{RESULTS}/")
    return "\n".join(lines).rstrip("\n") + "\n"


def _anchor(title: str) -> str:
    kept = [c for c in title.lower() if c.isalnum() or c in " -"]
    return "".join(kept).replace(" ", "-")


def _summary(found: dict[str, Found]) -> list[str]:
    """Return the lines that answer the question: does it walk, and go on walking?"""
    walks = found["walker"]
    scripted = words.runs_of(walks, walker="scripted knee")[0]["distance_m"]
    lines = ["**In short.**", ""]
    for learner, seeds in walker.GROUPS:
        runs = words.runs_of(walks, learner=learner, seeds=seeds)
        mean = sum(words.column(runs, "distance_m")) / len(runs)
        lines.append(
            f"- `{learner}`, seeds {seeds}: {words.never_fell(runs)} walkers never fell in "
            f"{runs[0]['cycles']} steps of learning in situ, {sum(r['falls'] for r in runs)} falls "
            f"in all; {mean:.3f} m a step, {mean / scripted:.0%} of the scripted knee's "
            f"(our target: {walker.ENOUGH:.0%}). The paper's walker fell at steps 62 and 5473 of "
            "about 6900."
        )
    for body in frontier.BODIES:
        rates = {
            learner: words.falls_per_1000(
                words.runs_of(found["frontier"], body=body, walker="trained table", learner=learner)
            )
            for learner in ("plain", frontier.BEFORE, "ember", frontier.TWICE)
        }
        told = ", ".join(f"{learner} {rate:.2f}" for learner, rate in rates.items())
        lines.append(
            f"- Frontier, {body} body, falls per 1000 steps (our target: at most {frontier.AIM:.0f}"
            f"): {told}."
        )
    return lines


def _claims(found: dict[str, Found]) -> list[str]:
    """Return every claim with where it holds, fails, or is unclear."""
    lines = []
    for name, study in STUDIES.items():
        by_claim: dict[str, dict[str, list[str]]] = {}
        for claim in study.claims(found[name]):
            by_claim.setdefault(claim.says, {}).setdefault(claim.word, []).append(claim.where)
        for says, by_word in by_claim.items():
            verdicts = [f"**{word}**: {'; '.join(where)}" for word, where in by_word.items()]
            link = f"[{name}](#{_anchor(study.title)})"
            lines.append((says, "<br>".join(verdicts), link, f"`ember experiment {name}`"))
    return words.grid(("claim", "verdict", "section", "command"), lines)
