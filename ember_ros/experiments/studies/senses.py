"""The effect of each sense, and the states of a walker that do not occur on the trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ember_ros.experiments import plots, reporting, stats
from ember_ros.experiments.reporting import Claim, Results
from ember_ros.experiments.studies.fig5 import STOPS, stop_arm
from ember_ros.experiments.study import (
    LEARNERS,
    Arm,
    Size,
    Study,
    baseline_arms,
    learner_params,
    training_trial,
    walking_trials,
)
from ember_ros.report.figures import canvas, save
from leg_node.assembly import empty_table

BODIES = ("reference",)
BEYOND_ALL_ANGLES = 3.2
"""An edge larger than every angle, rad, so that all angles are in one bin."""
WITHOUT: dict[str, dict[str, Any]] = {
    "all senses": {},
    "without hair": {"leg__hair_length": 1.0},  # so long that it always touches the ground
    "without force": {"state__force_edges": (1e6,)},  # larger than every force
    "without inclination": {"state__inclination_edges": (BEYOND_ALL_ANGLES,)},
}
"""The changed parameters with which a sense always has the same value."""


def arms(size: Size) -> list[Arm]:
    """Return walkers without one sense, the baselines, and trainings with walks for coverage."""
    all_arms = []
    seeds = range(size.seeds)
    for body in BODIES:
        for name, changes in WITHOUT.items():
            starts = [training_trial("ember", size, seed, **changes) for seed in seeds]
            all_arms.append(
                Arm(
                    {"body": body, "walker": f"trained, {name}", "learner": "ember"},
                    walking_trials("ember", body, size.short_walk, seeds, starts, **changes),
                )
            )
        all_arms += baseline_arms(body, size)
    for learner in LEARNERS:
        for stop in STOPS:
            trainings = stop_arm(learner, stop, seeds, size.train)
            all_arms.append(Arm({"coverage": "trainer", **trainings.labels}, trainings.trials))
            for body in BODIES:
                all_arms.append(
                    Arm(
                        {"coverage": body, **trainings.labels},
                        walking_trials(learner, body, size.short_walk, seeds, trainings.trials),
                    )
                )
    return all_arms


def claims(results: Results) -> list[Claim]:
    """Test which senses improve the reward or reduce falls."""
    all_claims = []
    for body in BODIES:
        complete = reporting.runs_of(results, body=body, walker="trained, all senses")
        for name in list(WITHOUT)[1:]:
            reduced = reporting.runs_of(results, body=body, walker=f"trained, {name}")
            for statement, measure, higher, lower, form, unit in (
                (
                    "increases the reward",
                    "reward",
                    complete,
                    reduced,
                    ".3f",
                    "reward per tick (with - without)",
                ),
                (
                    "reduces falls",
                    reporting.FALL_RATE,
                    reduced,
                    complete,
                    ".1f",
                    "falls per 1000 (without - with)",
                ),
            ):
                difference = reporting.paired_difference(higher, lower, measure)
                all_claims.append(
                    Claim(
                        f"the sense {statement}",
                        f"{name.removeprefix('without ')}, {body}",
                        f"{reporting.with_interval(difference, form)} {unit}",
                        stats.verdict(difference, claimed=1),
                    )
                )
    return all_claims


def text(results: Results) -> list[str]:
    """Return the tables and their explanation."""
    states = empty_table(learner_params()).states
    coverage_rows = []
    for learner in LEARNERS:
        for stop in STOPS:
            cells = [learner, stop]
            for place in ("trainer", *BODIES):
                runs = reporting.runs_of(results, coverage=place, learner=learner, height=stop)
                visited = reporting.column(runs, "states_visited")
                cells.append(reporting.with_quartiles(visited, ".0f"))
                if place != "trainer":
                    new = [100 * share for share in reporting.column(runs, "unvisited_share")]
                    cells.append(reporting.with_quartiles(new, ".2f"))
            coverage_rows.append(cells)
    return [
        "Legs are trained and walk with all senses, or without one of them: a sense is left out by "
        "parameters with which it always has the same value.",
        "",
        *reporting.walker_table([arm for arm in results["arms"] if "body" in arm["labels"]]),
        "",
        reporting.WALKER_TABLE_NOTE,
        "",
        f"Coverage: how many of the {states} states are visited during a training and during a "
        "walk with its table, and how many decisions of the walk are in states that were not "
        "visited during the training:",
        "",
        *reporting.markdown_table(
            (
                "learner",
                "stop",
                "states visited on the trainer",
                *(
                    head
                    for body in BODIES
                    for head in (
                        f"states visited on the {body} body",
                        f"decisions in new states on the {body} body, %",
                    )
                ),
            ),
            coverage_rows,
        ),
    ]


def draw(results: Results, file: Path) -> None:
    """Draw reward and falls without each sense, and the share of decisions in new states."""
    reward: dict[str, dict[str, list[float]]] = {}
    falls: dict[str, dict[str, list[float]]] = {}
    unvisited: dict[str, dict[str, list[float]]] = {}
    for body in BODIES:
        for name in WITHOUT:
            runs = reporting.runs_of(results, body=body, walker=f"trained, {name}")
            reward.setdefault(body, {})[name] = reporting.column(runs, "reward")
            falls.setdefault(body, {})[name] = reporting.column(runs, reporting.FALL_RATE)
    for learner in LEARNERS:
        for stop in STOPS:
            for body in BODIES:
                runs = reporting.runs_of(results, coverage=body, learner=learner, height=stop)
                shares = reporting.column(runs, "unvisited_share")
                group = unvisited.setdefault(f"{learner},\n{stop} stop", {})
                group[body] = [100 * share for share in shares]
    figure, axes = canvas(3, 1, height=2.7)
    for axis, groups, label in zip(
        axes[:, 0],
        (reward, falls, unvisited),
        ("reward per tick", plots.FALLS, "decisions in new states, %"),
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
    "the 17 x 8 x 8 partitions of hip angle, force and inclination, and the bits for stance and "
    "hair, were chosen by trial; the hair gives information that the other senses do not give.",
    arms,
    text,
    draw,
    claims=claims,
)
