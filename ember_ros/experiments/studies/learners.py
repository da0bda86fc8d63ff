"""The parts that `ember` adds to `plain`: each one added alone, and each one left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ember_ros.experiments import plots, reporting
from ember_ros.experiments.reporting import Results
from ember_ros.experiments.study import (
    Arm,
    Size,
    Study,
    baseline_arms,
    learner_params,
    trained_arm,
)
from ember_ros.params import as_dict
from ember_ros.report.figures import INK, canvas, save

BODIES = ("reference", "narrow")
PARTS: dict[str, tuple[str, ...]] = {
    "counts": ("alpha_floor", "alpha_ceiling"),
    "prior": ("prior",),
    "smooth": ("smooth",),
    "explore": ("epsilon_start", "epsilon_end"),
    "lead": ("reward.lead",),
}
"""The parameters of each part: fields of both learning stages, or a full name with a dot."""
MEANING = {
    "counts": "learning rates of 1/visits with a lower limit, from exact visit counts",
    "prior": "an untried action is estimated a little worse than its state, instead of 0",
    "smooth": "the estimate of a cell includes neighbouring states and actions",
    "explore": "on the trainer, many random actions at first; on the body, none",
    "lead": "in the last ticks of swing, a leg is rewarded as in stance",
}


def changes(learner: str, parts: tuple[str, ...]) -> dict[str, Any]:
    """Return the values that a learner has for the parameters of some parts.

    Args:
        learner: ``plain`` or ``ember``.
        parts: names of ``PARTS``.

    Returns:
        Values by full name, with ``__`` for the dot.
    """
    params = as_dict(learner_params(learner))
    values: dict[str, Any] = {}
    for part in parts:
        for name in PARTS[part]:
            for full_name in _full_names(name):
                group, field = full_name.split(".")
                values[f"{group}__{field}"] = params[group][field]
    return values


def _full_names(name: str) -> list[str]:
    """Return the full names of a parameter of ``PARTS``."""
    return [name] if "." in name else [f"{stage}.{name}" for stage in ("train", "walk")]


def variants() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return all variants: name, learner to start from, and changed parameters."""
    by_name: dict[str, tuple[str, dict[str, Any]]] = {"plain": ("plain", {})}
    by_name |= {f"plain + {part}": ("plain", changes("ember", (part,))) for part in PARTS}
    by_name |= {f"ember - {part}": ("ember", changes("plain", (part,))) for part in PARTS}
    return by_name | {"ember": ("ember", {})}


def arms(size: Size) -> list[Arm]:
    """Return walkers of every variant, and the baselines."""
    all_arms = []
    reduced = size._replace(seeds=size.reduced_seeds)
    for body in BODIES:
        for name, (learner, changed) in variants().items():
            all_arms.append(trained_arm(body, learner, reduced, name=name, **changed))
        for arm in baseline_arms(body, reduced):
            labels = dict(arm.labels)
            if labels["walker"] == "empty table":  # otherwise its learner is also that of a variant
                labels["learner"] += ", empty"
            all_arms.append(Arm(labels, arm.trials))
    return all_arms


def text(results: Results) -> list[str]:
    """Return the tables and their explanation."""
    params = {learner: as_dict(learner_params(learner)) for learner in ("plain", "ember")}
    parameter_rows, effect_rows = [], []
    for part, names in PARTS.items():
        for full_name in [each for name in names for each in _full_names(name)]:
            group, field = full_name.split(".")
            values = [str(params[learner][group][field]) for learner in ("plain", "ember")]
            if values[0] != values[1]:
                parameter_rows.append((part, f"`{full_name}`", *values, MEANING[part]))
    for body in BODIES:
        ember, plain = (
            reporting.runs_of(results, body=body, learner=learner) for learner in ("ember", "plain")
        )
        for part in PARTS:
            added = reporting.runs_of(results, body=body, learner=f"plain + {part}")
            left_out = reporting.runs_of(results, body=body, learner=f"ember - {part}")
            cells = [body, part]
            for changed, unchanged in ((added, plain), (left_out, ember)):
                for measure, form in ((reporting.FALL_RATE, ".1f"), ("distance_m", ".3f")):
                    difference = reporting.paired_difference(changed, unchanged, measure)
                    cells.append(reporting.with_interval(difference, form))
            effect_rows.append(cells)
    return [
        "`plain` is the learner of the paper (`--params plain`), `ember` is the default. They "
        "differ in these parameters:",
        "",
        *reporting.markdown_table(
            ("part", "parameter", "plain", "ember", "meaning"), parameter_rows
        ),
        "",
        "Effect of each part, as a difference paired by seed: the part added to `plain` (compared "
        "with `plain`), and the part left out of `ember` (compared with `ember`):",
        "",
        *reporting.markdown_table(
            (
                "body",
                "part",
                "added: falls per 1000 cycles",
                "added: distance per cycle, m",
                "left out: falls per 1000 cycles",
                "left out: distance per cycle, m",
            ),
            effect_rows,
        ),
        "",
        *reporting.walker_table(results["arms"]),
        "",
        reporting.WALKER_TABLE_NOTE,
    ]


def draw(results: Results, file: Path) -> None:
    """Draw falls and distance of every variant."""
    figure, axes = canvas(2, 2, width=12.0, height=3.2)
    for column, body in enumerate(BODIES):
        for row, (label, measure) in enumerate(plots.MEASURES.items()):
            groups = {}
            for name in variants():
                runs = reporting.runs_of(results, body=body, learner=name)
                short_name = name.replace("plain + ", "+\n").replace("ember - ", "-\n")
                groups[short_name] = {"": reporting.column(runs, measure)}
            axis = axes[row, column]
            plots.strips(axis, groups, label)
            axis.tick_params(axis="x", labelsize=7)
            if row == 0:
                axis.set_yscale("symlog", linthresh=1.0)
                axis.set_ylim(bottom=-0.2)
                axis.set_title(f"{body.capitalize()} body", loc="left", color=INK)
    save(figure, file)


STUDY = Study(
    "learners",
    "The learners: the effect of each part",
    "uses one-step Q-learning only; its principle that similar local states require similar local "
    "actions (section V) is used only in that the legs share one table.",
    arms,
    text,
    draw,
)
