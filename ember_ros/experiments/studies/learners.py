"""What `ember` adds to `plain`, each part alone and each part left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ember_ros.experiments import plots, words
from ember_ros.experiments.study import Arm, Size, Study, company, numbers, trained_arm
from ember_ros.experiments.words import Found
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
"""Names of a stage's numbers, or of one number, that belong to each part."""
MEANING = {
    "counts": "rates of 1/visits down to a floor, from true visit counts",
    "prior": "an untried action is a little worse than its state, not 0",
    "smooth": "neighbouring states and actions have a say",
    "explore": "on the trainer random actions at first, on the body none",
    "lead": "the last ticks of swing are rewarded as stance is",
}


def changes(learner: str, parts: tuple[str, ...]) -> dict[str, Any]:
    """Return a learner's numbers of some parts, by full name."""
    every = as_dict(numbers(learner))
    found: dict[str, Any] = {}
    for part in parts:
        for name in PARTS[part]:
            if "." in name:
                group, each = name.split(".")
                found[f"{group}__{each}"] = every[group][each]
            else:
                found |= {f"{stage}__{name}": every[stage][name] for stage in ("train", "walk")}
    return found


def variants() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return name, learner to start from, and what is changed."""
    found: dict[str, tuple[str, dict[str, Any]]] = {"plain": ("plain", {})}
    found |= {f"plain + {part}": ("plain", changes("ember", (part,))) for part in PARTS}
    found |= {f"ember - {part}": ("ember", changes("plain", (part,))) for part in PARTS}
    return found | {"ember": ("ember", {})}


def arms(size: Size) -> list[Arm]:
    """Return walkers of every variant, and who walks beside them."""
    found = []
    few = size._replace(seeds=size.few)
    for body in BODIES:
        for name, (learner, other) in variants().items():
            found.append(trained_arm(body, learner, few, name=name, **other))
        for arm in company(body, few):
            labels = dict(arm.labels)
            if labels["walker"] == "empty table":  # not a variant, though its learner is called so
                labels["learner"] += ", empty"
            found.append(Arm(labels, arm.trials))
    return found


def text(found: Found) -> list[str]:
    """Say what came of it."""
    both = {learner: as_dict(numbers(learner)) for learner in ("plain", "ember")}
    switches, lines = [], []
    for part, names in PARTS.items():
        for name in names:
            for full in [name] if "." in name else [f"{s}.{name}" for s in ("train", "walk")]:
                group, each = full.split(".")
                values = [str(both[learner][group][each]) for learner in ("plain", "ember")]
                if values[0] != values[1]:
                    switches.append((part, f"`{full}`", *values, MEANING[part]))
    for body in BODIES:
        whole, none = (
            words.runs_of(found, body=body, learner=learner) for learner in ("ember", "plain")
        )
        for part in PARTS:
            alone = words.runs_of(found, body=body, learner=f"plain + {part}")
            left = words.runs_of(found, body=body, learner=f"ember - {part}")
            lines.append(
                (
                    body,
                    part,
                    words.told(words.more(alone, none, words.FALL_RATE), ".1f"),
                    words.told(words.more(alone, none, "distance_m")),
                    words.told(words.more(left, whole, words.FALL_RATE), ".1f"),
                    words.told(words.more(left, whole, "distance_m")),
                )
            )
    return [
        "`plain` is the paper's learner (`--params plain`); `ember` the default. They differ in:",
        "",
        *words.grid(("part", "parameter", "plain", "ember", "meaning"), switches),
        "",
        "What a part does, seed by seed: added to `plain` alone, and left out of `ember`:",
        "",
        *words.grid(
            (
                "body",
                "part",
                "alone: falls per 1000",
                "alone: distance, m",
                "left out: falls per 1000",
                "left out: distance, m",
            ),
            lines,
        ),
        "",
        *words.walkers(found["arms"]),
        "",
        words.WALKERS_NOTE,
    ]


def draw(found: Found, file: Path) -> None:
    """Draw falls and distance of every variant."""
    names = list(variants())
    figure, axes = canvas(2, 2, width=12.0, height=3.2)
    for across, body in enumerate(BODIES):
        for down, (label, measure) in enumerate(plots.MEASURES.items()):
            groups = {}
            for name in names:
                values = words.column(words.runs_of(found, body=body, learner=name), measure)
                short = name.replace("plain + ", "+\n").replace("ember - ", "-\n")
                groups[short] = {"": values}
            axis = axes[down, across]
            plots.strips(axis, groups, label)
            axis.tick_params(axis="x", labelsize=7)
            if down == 0:
                axis.set_yscale("symlog", linthresh=1.0)
                axis.set_ylim(bottom=-0.2)
                axis.set_title(f"{body} body", loc="left", color=INK)
    save(figure, file)


STUDY = Study(
    "learners",
    "The learners: what each part is worth",
    "has one-step Q-learning alone; that similar local states want similar local actions is its "
    "principle (section V), used only in that legs share a table.",
    arms,
    text,
    draw,
)
