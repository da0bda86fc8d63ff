"""The direct approach: do legs that know nothing learn to walk on the body?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.study import BODIES, LEARNERS, Arm, Size, Study, company, trained_arm
from ember_ros.experiments.trial import Outcome
from ember_ros.experiments.words import Found

QUARTERS = 4
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


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines, claims = [], []
    for body in BODIES:
        for learner in LEARNERS:
            first, empty = (
                words.runs_of(found, body=body, walker=start, learner=learner) for start in STARTS
            )
            random = words.runs_of(found, body=body, walker="random knee")
            falls = words.more(empty, first, words.FALL_RATE)
            reward = words.more(first, empty, "reward")
            quarter = [
                np.sum(found["curves"][f"{body}/{name}"], axis=0).tolist()
                for name in (f"empty table/{learner}", f"trained table/{learner}")
            ]
            last = [
                [part[-1] for part in found["curves"][f"{body}/{name}"]]
                for name in (f"empty table/{learner}", "random knee/-")
            ]
            lines.append(
                (
                    body,
                    learner,
                    words.told(falls, ".1f"),
                    stats.verdict(falls, claimed=1),
                    words.told(reward),
                    stats.verdict(reward, claimed=1),
                    ", ".join(map(str, quarter[0])),
                    ", ".join(map(str, quarter[1])),
                )
            )
            better = stats.difference(last[1], last[0])
            way = words.more(empty, random, "distance_m")
            share = sum(last[0]) / max(1, sum(last[1]))
            learns = stats.verdict(better, claimed=1) == stats.verdict(way, claimed=1) == "holds"
            claims.append(
                f"- {body}, `{learner}`: that legs which know nothing cannot learn to walk here "
                f"**{'fails' if learns else 'holds' if better.high < 0 else 'unclear'}**: in the "
                f"last quarter they fall {share:.0%} as often as a random knee, and they go "
                f"{words.told(way)} m further a cycle than it does."
            )
    return [
        *words.walkers(found["arms"]),
        "",
        words.WALKERS_NOTE,
        "",
        "Empty against trained table, the same rule, seeds and budget; falls per quarter of the "
        "budget are sums over seeds:",
        "",
        *words.grid(
            (
                "body",
                "learner",
                "falls per 1000 more without training",
                "training helps",
                "reward a tick more with training",
                "training helps",
                "falls by quarter, empty",
                "falls by quarter, trained",
            ),
            lines,
        ),
        "",
        *claims,
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
)
