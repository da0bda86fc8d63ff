"""The direct approach: legs with an empty table learn to walk on the body."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ember_ros.experiments import plots, reporting, stats
from ember_ros.experiments.reporting import Claim, Results
from ember_ros.experiments.study import (
    BODIES,
    LEARNERS,
    Arm,
    Size,
    Study,
    baseline_arms,
    trained_arm,
)
from ember_ros.experiments.trial import Outcome

QUARTERS = 4
MAX_RELATIVE_FALLS, MIN_RELATIVE_DISTANCE = 0.1, 0.5
"""Criteria for successful walking: falls relative to the random knee, and distance relative to the
scripted knee."""
MIN_RANDOM_FALL_RATE = 20.0
"""Falls per 1000 cycles of the random knee; in a body with fewer the experiment is inconclusive."""
STARTS = ("trained table", "empty table")


def arms(size: Size) -> list[Arm]:
    """Return trained walkers of both learners in every body, and the baselines."""
    all_arms = []
    for body in BODIES:
        all_arms += [trained_arm(body, learner, size) for learner in LEARNERS]
        all_arms += baseline_arms(body, size)
    return all_arms


def curves(outcomes_by_arm: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return the falls and the mean distance, m per cycle, in each quarter of each walk."""
    by_name: dict[str, Any] = {}
    for arm, outcomes in outcomes_by_arm:
        name = "/".join(arm.labels.values())
        falls = [np.array_split(each.cycles["falls"], QUARTERS) for each in outcomes]
        distances = [np.array_split(each.cycles["distance_m"], QUARTERS) for each in outcomes]
        by_name[f"{name}/falls"] = [[int(q.sum()) for q in quarters] for quarters in falls]
        by_name[f"{name}/way"] = [
            [round(float(q.mean()), 5) for q in quarters if len(q)] for quarters in distances
        ]
    return by_name


class RelativePerformance(NamedTuple):
    """Falls and distance in the last quarter of the walks, relative to two baselines."""

    falls: stats.Interval
    """Falls divided by those of the random knee."""
    distance: stats.Interval
    """Distance divided by that of the scripted knee."""

    @property
    def succeeds(self) -> bool:
        """Whether both intervals meet their criteria completely."""
        return (
            self.falls.n > 1
            and self.falls.high <= MAX_RELATIVE_FALLS
            and self.distance.low >= MIN_RELATIVE_DISTANCE
        )

    @property
    def fails(self) -> bool:
        """Whether one of the intervals misses its criterion completely."""
        return self.falls.n > 1 and (
            self.falls.low > MAX_RELATIVE_FALLS or self.distance.high < MIN_RELATIVE_DISTANCE
        )

    def as_text(self) -> str:
        """Return both values with their intervals."""
        return (
            f"{reporting.with_interval(self.falls, '.0%', '')} of the falls of the random knee, "
            f"{reporting.with_interval(self.distance, '.0%', '')} of the distance of the scripted "
            "knee"
        )


def last_quarter(
    results: Results, body: str, walker: str, learner: str
) -> RelativePerformance | None:
    """Return the performance in the last quarter; None if the random knee falls too rarely."""
    curves = results["curves"]
    random = [falls[-1] for falls in curves[f"{body}/random knee/-/falls"]]
    mean = sum(random) / len(random)
    cycles = results["arms"][0]["runs"][0]["cycles"] / QUARTERS
    if 1000.0 * mean / cycles < MIN_RANDOM_FALL_RATE:
        return None
    scripted = curves[f"{body}/scripted knee/-/way"][0][-1]
    name = f"{body}/{walker}/{learner}"
    return RelativePerformance(
        stats.interval([falls[-1] / mean for falls in curves[f"{name}/falls"]]),
        stats.interval([distance[-1] / scripted for distance in curves[f"{name}/way"]]),
    )


def claims(results: Results) -> list[Claim]:
    """Test whether training before the walk is necessary, and whether it helps."""
    all_claims = []
    for body in BODIES:
        for learner in LEARNERS:
            trained, empty = (
                reporting.runs_of(results, body=body, walker=start, learner=learner)
                for start in STARTS
            )
            scope = f"`{learner}`, {body}"
            trained_walk, direct_walk = (
                last_quarter(results, body, start, learner) for start in STARTS
            )
            verdict, evidence = "unclear", "the random knee falls too rarely in this body"
            if direct_walk is not None and trained_walk is not None:
                evidence = f"{direct_walk.as_text()}; trained legs: {trained_walk.as_text()}"
                if direct_walk.succeeds:
                    verdict = "fails"
                elif direct_walk.fails and trained_walk.succeeds:
                    verdict = "holds"
            all_claims.append(
                Claim(
                    "the direct approach does not work, but training first does",
                    scope,
                    evidence,
                    verdict,
                )
            )
            for statement, name, form, unit, higher, lower in (
                (
                    "legs without training fall more often",
                    reporting.FALL_RATE,
                    ".1f",
                    "falls per 1000 (untrained - trained)",
                    empty,
                    trained,
                ),
                (
                    "legs without training get less reward",
                    "reward",
                    ".3f",
                    "reward per tick (trained - untrained)",
                    trained,
                    empty,
                ),
            ):
                difference = reporting.paired_difference(higher, lower, name)
                all_claims.append(
                    Claim(
                        statement,
                        scope,
                        f"{reporting.with_interval(difference, form)} {unit}",
                        stats.verdict(difference, claimed=1),
                    )
                )
    return all_claims


def text(results: Results) -> list[str]:
    """Return the tables and their explanation."""
    rows = []
    for body in BODIES:
        for learner in LEARNERS:
            cells = [body, learner]
            for start in reversed(STARTS):
                falls = np.sum(results["curves"][f"{body}/{start}/{learner}/falls"], axis=0)
                cells.append(", ".join(map(str, falls.tolist())))
            rows.append(cells)
    return [
        "Criteria: the direct approach works if, in the last quarter of the walk, untrained legs "
        f"fall at most {MAX_RELATIVE_FALLS:.0%} as often as the random knee and walk at least "
        f"{MIN_RELATIVE_DISTANCE:.0%} of the distance of the scripted knee. The claim that it does "
        "not work holds only if trained legs meet these criteria. In a body in which the random "
        f"knee falls less than {MIN_RANDOM_FALL_RATE:.0f} times per 1000 cycles the result is "
        "*unclear*. (The criteria were chosen after the results were known.) Falls in each quarter "
        "of the walk, summed over all seeds:",
        "",
        *reporting.markdown_table(("body", "learner", "empty table", "trained table"), rows),
        "",
        *reporting.walker_table(results["arms"]),
        "",
        reporting.WALKER_TABLE_NOTE,
    ]


def draw(results: Results, file: Path) -> None:
    """Draw falls and distance of every walker in every body."""
    kinds = {
        f"{start}, {learner}": {"walker": start, "learner": learner}
        for start in STARTS
        for learner in LEARNERS
    } | {"random knee": {"walker": "random knee"}, "scripted knee": {"walker": "scripted knee"}}
    groups = {body: {"body": body} for body in BODIES}
    plots.draw_groups(file, plots.fall_rates_and_distances(results, kinds, groups))


STUDY = Study(
    "direct",
    "The direct approach: an empty table on the body",
    'a robot must first be stable enough for a few steps; "the direct approach does not work", '
    "so the legs are first trained alone.",
    arms,
    text,
    draw,
    curves,
    claims,
)
