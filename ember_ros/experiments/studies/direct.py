"""The direct approach: do legs that know nothing learn to walk on the body?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.study import BODIES, LEARNERS, Arm, Size, Study, company, trained_arm
from ember_ros.experiments.trial import Outcome
from ember_ros.experiments.words import Claim, Found

QUARTERS = 4
FALLS_LEFT, WAY_GONE = 0.1, 0.5
"""Shares of a random knee's falls and of the scripted knee's way that are called walking."""
STARTS = ("trained table", "empty table")


def arms(size: Size) -> list[Arm]:
    """Return trained walkers of both learners in every body, and who walks beside them."""
    found = []
    for body in BODIES:
        found += [trained_arm(body, learner, size) for learner in LEARNERS]
        found += company(body, size)
    return found


def curves(known: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return the falls of each quarter of each walk."""
    return {
        "/".join(arm.labels.values()): [
            [int(part.sum()) for part in np.array_split(outcome.cycles["falls"], QUARTERS)]
            for outcome in outcomes
        ]
        for arm, outcomes in known
    }


def claims(found: Found) -> list[Claim]:
    """Say whether training first is needed, and whether it helps."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            first, empty = (
                words.runs_of(found, body=body, walker=start, learner=learner) for start in STARTS
            )
            scripted = words.runs_of(found, body=body, walker="scripted knee")[0]
            where = f"`{learner}`, {body}"
            last = [
                [part[-1] for part in found["curves"][f"{body}/{name}"]]
                for name in (f"empty table/{learner}", "random knee/-")
            ]
            random = sum(last[1]) / len(last[1])
            share = stats.interval([falls / random if random else 0.0 for falls in last[0]])
            way = stats.interval([run["distance_m"] / scripted["distance_m"] for run in empty])
            word = "unclear"
            if share.n > 1 and (share.low > FALLS_LEFT or way.high < WAY_GONE):
                word = "holds"
            elif share.n > 1 and share.high <= FALLS_LEFT and way.low >= WAY_GONE:
                word = "fails"
            lines.append(
                Claim(
                    "legs that know nothing do not learn to walk on the body",
                    where,
                    f"{words.told(share, '.0%', '')} of a random knee's falls in the last quarter; "
                    f"{words.told(way, '.0%', '')} of the scripted knee's way",
                    word,
                )
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
                falls = np.sum(found["curves"][f"{body}/{start}/{learner}"], axis=0)
                cells.append(", ".join(map(str, falls.tolist())))
            lines.append(cells)
    return [
        "Legs that know nothing are said to have learnt to walk where they fall, in the last "
        f"quarter of the budget, at most {FALLS_LEFT:.0%} as often as a random knee, and have gone "
        f"at least {WAY_GONE:.0%} of the scripted knee's way. Falls by quarter, all seeds "
        "together:",
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
    plots.bodies(file, plots.fall_rates_and(found, kinds, groups), log=[plots.FALLS])


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
