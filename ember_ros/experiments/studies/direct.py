"""The direct approach: do legs that know nothing learn to walk on the body?"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.study import BODIES, LEARNERS, Arm, Size, Study, company, trained_arm
from ember_ros.experiments.trial import Outcome
from ember_ros.experiments.words import Claim, Found

QUARTERS = 4
FALLS_LEFT, WAY_GONE = 0.1, 0.5
"""Shares of a random knee's falls and of the scripted knee's way that are called walking."""
PROVES = 20.0
"""Falls per 1000 cycles of a random knee under which a body proves nothing."""
STARTS = ("trained table", "empty table")


def arms(size: Size) -> list[Arm]:
    """Return trained walkers of both learners in every body, and who walks beside them."""
    found = []
    for body in BODIES:
        found += [trained_arm(body, learner, size) for learner in LEARNERS]
        found += company(body, size)
    return found


def curves(known: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return falls and mean distance of each quarter of each walk."""
    found: dict[str, Any] = {}
    for arm, outcomes in known:
        name = "/".join(arm.labels.values())
        falls = [np.array_split(each.cycles["falls"], QUARTERS) for each in outcomes]
        ways = [np.array_split(each.cycles["distance_m"], QUARTERS) for each in outcomes]
        found[f"{name}/falls"] = [[int(p.sum()) for p in parts] for parts in falls]
        found[f"{name}/way"] = [
            [round(float(p.mean()), 5) for p in parts if len(p)] for parts in ways
        ]
    return found


class Walk(NamedTuple):
    """How walkers do in the last quarter, beside a random and a scripted knee in the same body."""

    falls: stats.Interval
    """Share of the random knee's falls."""
    way: stats.Interval
    """Share of the scripted knee's way."""

    @property
    def walks(self) -> bool:
        """Whether the intervals are beyond both bars."""
        return self.falls.n > 1 and self.falls.high <= FALLS_LEFT and self.way.low >= WAY_GONE

    @property
    def fails(self) -> bool:
        """Whether one of the intervals is short of its bar."""
        return self.falls.n > 1 and (self.falls.low > FALLS_LEFT or self.way.high < WAY_GONE)

    def told(self) -> str:
        """Return both shares."""
        return (
            f"{words.told(self.falls, '.0%', '')} of a random knee's falls, "
            f"{words.told(self.way, '.0%', '')} of the scripted knee's way"
        )


def in_the_end(found: Found, body: str, walker: str, learner: str) -> Walk | None:
    """Return how walkers do in the last quarter; None where a random knee hardly falls."""
    curves = found["curves"]
    random = [falls[-1] for falls in curves[f"{body}/random knee/-/falls"]]
    each = sum(random) / len(random)
    cycles = found["arms"][0]["runs"][0]["cycles"] / QUARTERS
    if 1000.0 * each / cycles < PROVES:
        return None
    scripted = curves[f"{body}/scripted knee/-/way"][0][-1]
    name = f"{body}/{walker}/{learner}"
    return Walk(
        stats.interval([falls[-1] / each for falls in curves[f"{name}/falls"]]),
        stats.interval([way[-1] / scripted for way in curves[f"{name}/way"]]),
    )


def claims(found: Found) -> list[Claim]:
    """Say whether training first is needed, and whether it helps."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            first, empty = (
                words.runs_of(found, body=body, walker=start, learner=learner) for start in STARTS
            )
            where = f"`{learner}`, {body}"
            walk, other = (in_the_end(found, body, start, learner) for start in reversed(STARTS))
            word, told = "unclear", "a random knee hardly falls here: it proves nothing"
            if walk is not None and other is not None:
                told = f"{walk.told()}; with trained legs {other.told()}"
                if walk.walks:
                    word = "fails"
                elif walk.fails and other.walks:
                    word = "holds"
            lines.append(
                Claim("the direct approach does not work, training first does", where, told, word)
            )
            for says, name, form, more in (
                ("without training they fall more", words.FALL_RATE, ".1f", (empty, first)),
                ("without training they earn less", "reward", ".3f", (first, empty)),
            ):
                much = words.more(*more, name)
                lines.append(
                    Claim(
                        says,
                        where,
                        f"{words.told(much, form)} "
                        f"{'falls per 1000' if name == words.FALL_RATE else 'reward a tick'}",
                        stats.verdict(much, claimed=1),
                    )
                )
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            cells = [body, learner]
            for start in reversed(STARTS):
                falls = np.sum(found["curves"][f"{body}/{start}/{learner}/falls"], axis=0)
                cells.append(", ".join(map(str, falls.tolist())))
            lines.append(cells)
    return [
        "The direct approach is said to work where legs that know nothing, in the last quarter of "
        f"the budget, fall at most {FALLS_LEFT:.0%} as often as a random knee and go at least "
        f"{WAY_GONE:.0%} of the scripted knee's way; that it does not is said only where trained "
        "legs pass these bars. (They were set when the runs were known.) Falls by quarter, all "
        "seeds together:",
        "",
        *words.grid(("body", "learner", "empty table", "trained table"), lines),
        "",
        *words.walkers(found["arms"]),
        "",
        words.WALKERS_NOTE,
    ]


def draw(found: Found, file: Path) -> None:
    """Draw falls and distance of every walker in every body."""
    kinds = {
        f"{start}, {learner}": {"walker": start, "learner": learner}
        for start in STARTS
        for learner in LEARNERS
    } | {"random knee": {"walker": "random knee"}, "scripted knee": {"walker": "scripted knee"}}
    groups = {body: {"body": body} for body in BODIES}
    plots.bodies(file, plots.fall_rates_and(found, kinds, groups))


STUDY = Study(
    "direct",
    "The direct approach: an empty table on the body",
    'a robot must first be stable enough for a few steps; "the direct approach does not work", '
    "so legs are trained alone first.",
    arms,
    text,
    draw,
    curves,
    claims,
)
