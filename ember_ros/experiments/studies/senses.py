"""What each sense is worth, and what a walker meets that a trainer never sees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.studies.fig5 import HEIGHTS, height_arm
from ember_ros.experiments.study import LEARNERS, Arm, Size, Study, company, numbers, trained, walks
from ember_ros.experiments.words import Claim, Found
from ember_ros.report.figures import canvas, save
from leg_node.assembly import empty_table

BODIES = ("reference",)
FAR = 3.2
"""An edge that no angle passes: all are in one bin."""
WITHOUT: dict[str, dict[str, Any]] = {
    "all senses": {},
    "without hair": {"leg__hair_length": 1.0},  # it always touches
    "without force": {"state__force_edges": (1e6,)},  # no load passes it
    "without inclination": {"state__inclination_edges": (FAR,)},
}
"""A sense is left out by letting it always read the same."""


def arms(size: Size) -> list[Arm]:
    """Return walkers that lack a sense, trainers, and who walks beside them."""
    found = []
    seeds = range(size.seeds)
    for body in BODIES:
        for name, changes in WITHOUT.items():
            starts = [trained("ember", size, seed, **changes) for seed in seeds]
            found.append(
                Arm(
                    {"body": body, "walker": f"trained, {name}", "learner": "ember"},
                    walks("ember", body, size.brief, seeds, starts, **changes),
                )
            )
        found += company(body, size)
    for learner in LEARNERS:
        for height in HEIGHTS:
            trainers = height_arm(learner, height, seeds, size.train)
            found.append(Arm({"coverage": "trainer", **trainers.labels}, trainers.trials))
            for body in BODIES:
                found.append(
                    Arm(
                        {"coverage": body, **trainers.labels},
                        walks(learner, body, size.brief, seeds, trainers.trials),
                    )
                )
    return found


def claims(found: Found) -> list[Claim]:
    """Say which sense is of use."""
    lines = []
    for body in BODIES:
        whole = words.runs_of(found, body=body, walker="trained, all senses")
        for name in list(WITHOUT)[1:]:
            less = words.runs_of(found, body=body, walker=f"trained, {name}")
            sense = name.removeprefix("without ")
            for says, more, form, unit in (
                ("reward", words.more(whole, less, "reward"), ".3f", "reward a tick lost"),
                ("falls", words.more(less, whole, words.FALL_RATE), ".1f", "falls per 1000 more"),
            ):
                lines.append(
                    Claim(
                        f"the sense is of use, by {says}",
                        f"{sense}, {body}",
                        f"{words.told(more, form)} {unit} without",
                        stats.verdict(more, claimed=1),
                    )
                )
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    states = empty_table(numbers()).states
    coverage = []
    for learner in LEARNERS:
        for height in HEIGHTS:
            trainer = words.runs_of(found, coverage="trainer", learner=learner, height=height)
            cells = [learner, height, words.spread(words.column(trainer, "states_visited"), ".0f")]
            for body in BODIES:
                runs = words.runs_of(found, coverage=body, learner=learner, height=height)
                cells.append(words.spread(words.column(runs, "states_visited"), ".0f"))
                cells.append(
                    words.spread([100 * v for v in words.column(runs, "unvisited_share")], ".2f")
                )
            coverage.append(cells)
    return [
        "Trained and walked with all senses, and without one (a sense is left out by letting it "
        "always read the same):",
        "",
        *words.walkers([arm for arm in found["arms"] if "body" in arm["labels"]]),
        "",
        words.WALKERS_NOTE,
        "",
        f"What a walker meets that its trainer never saw; of {states} states:",
        "",
        *words.grid(
            (
                "learner",
                "stop",
                "states the trainer was in",
                *(
                    head
                    for body in BODIES
                    for head in (
                        f"states a walker was in, {body}",
                        f"its decisions in states new to it, {body}, %",
                    )
                ),
            ),
            coverage,
        ),
    ]


def draw(found: Found, file: Path) -> None:
    """Draw reward and falls without each sense, and the share of what is new."""
    reward: dict[str, dict[str, list[float]]] = {}
    falls: dict[str, dict[str, list[float]]] = {}
    unvisited: dict[str, dict[str, list[float]]] = {}
    for body in BODIES:
        for name in WITHOUT:
            runs = words.runs_of(found, body=body, walker=f"trained, {name}")
            reward.setdefault(body, {})[name] = words.column(runs, "reward")
            falls.setdefault(body, {})[name] = words.column(runs, words.FALL_RATE)
    for learner in LEARNERS:
        for height in HEIGHTS:
            for body in BODIES:
                runs = words.runs_of(found, coverage=body, learner=learner, height=height)
                group = unvisited.setdefault(f"{learner},\n{height} stop", {})
                group[body] = [100 * value for value in words.column(runs, "unvisited_share")]
    figure, axes = canvas(3, 1, height=2.7)
    for axis, groups, label in zip(
        axes[:, 0],
        (reward, falls, unvisited),
        ("reward a tick", plots.FALLS, "new states, % of decisions"),
        strict=True,
    ):
        plots.strips(axis, groups, label)
        axis.legend(frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    axes[1, 0].set_yscale("symlog", linthresh=1.0)
    axes[1, 0].get_legend().remove()
    save(figure, file)


STUDY = Study(
    "senses",
    "The senses",
    "17 x 8 x 8 partitions of hip, force and inclination with bits for stance and hair were chosen "
    "by trial; the hair tells what the others do not.",
    arms,
    text,
    draw,
    claims=claims,
)
