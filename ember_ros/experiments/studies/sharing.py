"""One table for all legs against one for each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.study import (
    BODIES,
    LEARNERS,
    Arm,
    Size,
    Study,
    company,
    trained_arm,
    walks,
)
from ember_ros.experiments.trial import MIN_VISITS, Outcome
from ember_ros.experiments.words import Claim, Found

NEVER = 1_000_000
"""Ticks between syncs that never come: every leg learns on its own copy."""
TABLES = ("empty table", "private tables")
PAPER = 4.0
"""Times as quickly, says the paper."""
MEAN = 25
"""Cycles that are averaged where it is asked when a reward is reached."""


def arms(size: Size) -> list[Arm]:
    """Return legs that know nothing, with one table and with four, and who walks beside them."""
    found = []
    for body in BODIES:
        found += company(body, size)
        for learner in LEARNERS:
            found.append(trained_arm(body, learner, size))
            found.append(
                Arm(
                    {"body": body, "walker": "private tables", "learner": learner},
                    walks(learner, body, size.brief, range(size.seeds), walk__sync_every=NEVER),
                )
            )
    return found


def curves(known: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return the reward that is to be reached, and when each walker reaches it."""
    reward = {
        tuple(arm.labels.values()): np.array([outcome.cycles["reward"] for outcome in outcomes])
        for arm, outcomes in known
    }
    found: dict[str, Any] = {}
    for body in BODIES:
        for learner in LEARNERS:
            low = float(reward[body, "random knee", "-"].mean())
            high = float(reward[body, "trained table", learner].mean())
            level = (low + high) / 2
            found[f"{body}/{learner}/level"] = level
            for tables in TABLES:
                found[f"{body}/{learner}/{tables}"] = [
                    reached(values, level) for values in reward[body, tables, learner]
                ]
    return found


def reached(values: Any, level: float) -> int | None:
    """Return the cycle in whose surroundings the mean has reached a level, or None."""
    window = min(MEAN, len(values))
    over = np.convolve(values, np.ones(window) / window, mode="valid") >= level
    return int(np.argmax(over)) + window - window // 2 if over.any() else None


def cycles_to(
    found: Found, body: str, learner: str
) -> tuple[list[float], list[float], tuple[int, int]]:
    """Return the cycles that shared and private tables took, and how many of each never did.

    Who never reached the reward counts as the whole budget: it took longer still.
    """
    budget = found["arms"][0]["runs"][0]["cycles"]
    times = [found["curves"][f"{body}/{learner}/{tables}"] for tables in TABLES]
    shared, private = ([float(budget if t is None else t) for t in each] for each in times)
    return shared, private, (times[0].count(None), times[1].count(None))


def claims(found: Found) -> list[Claim]:
    """Say whether sharing is four times as quick, quicker at all, and safer."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            shared, private, never = cycles_to(found, body, learner)
            where = f"`{learner}`, {body}"
            ratio = stats.interval([b / a for a, b in zip(shared, private, strict=True)])
            late = [
                f"{n} {kind}" for n, kind in zip(never, ("shared", "private"), strict=True) if n
            ]
            at_least = f"; {' and '.join(late)} never got there" if late else ""
            word = "unclear"
            # A private table that never got there makes its ratio a least one, a shared a most.
            if ratio.n > 1 and ratio.low >= PAPER and not never[0]:
                word = "holds"
            elif ratio.n > 1 and ratio.high < PAPER and not never[1]:
                word = "fails"
            lines.append(
                Claim(
                    "one table learns at least four times as quickly",
                    where,
                    f"{words.told(ratio, '.1f', '')} times{at_least}",
                    word,
                )
            )
            sooner = stats.difference(private, shared)
            word = stats.verdict(sooner, claimed=1)
            if never[0] and word == "holds":
                word = "unclear"
            lines.append(
                Claim(
                    "one table learns more quickly",
                    where,
                    f"{words.told(sooner, '.0f')} cycles with private tables{at_least}",
                    word,
                )
            )
            one, four = (
                words.runs_of(found, body=body, walker=tables, learner=learner) for tables in TABLES
            )
            falls = words.more(four, one, words.FALL_RATE)
            lines.append(
                Claim(
                    "one table saves falls",
                    where,
                    f"{words.told(falls, '.1f')} falls per 1000 with private tables",
                    stats.verdict(falls, claimed=1),
                )
            )
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            shared, private, never = cycles_to(found, body, learner)
            four = words.runs_of(found, body=body, walker=TABLES[1], learner=learner)
            differ = [run["legs_differ"] for run in four if run["legs_differ"] is not None]
            lines.append(
                (
                    body,
                    learner,
                    f"{found['curves'][f'{body}/{learner}/level']:.2f}",
                    *(
                        words.spread(each, ".0f") + (f"; {n} never" if n else "")
                        for each, n in zip((shared, private), never, strict=True)
                    ),
                    words.spread(differ, ".0%") if differ else "-",
                )
            )
    return [
        "Legs that know nothing, on the body, with one table and with one each; cycles until they "
        "earn what is to be reached:",
        "",
        *words.grid(
            ("body", "learner", "reward a tick", "one table", "one each", "private legs differ"),
            lines,
        ),
        "",
        "The reward to reach lies half way between the random knee's (by `ember`'s reward) and "
        f"that of a walker with trained legs; it is reached by a mean over {MEAN} cycles, and told "
        "is its middle, so that shorter times are not told apart; who never reached it counts as "
        "the whole budget. Legs differ: share of the states that two legs both visited "
        f"{MIN_VISITS} times in which the largest values of their tables are of different actions. "
        "That is chance as well as specialisation.",
        "",
        *words.walkers(found["arms"]),
        "",
        words.WALKERS_NOTE,
    ]


def draw(found: Found, file: Path) -> None:
    """Draw how long it takes, and the falls."""
    budget = found["arms"][0]["runs"][0]["cycles"]
    names = {"empty table": "shared", "private tables": "private"}
    times: dict[str, dict[str, list[float]]] = {}
    falls: dict[str, dict[str, list[float]]] = {}
    for body in BODIES:
        for tables, name in names.items():
            for learner in LEARNERS:
                kind = f"{name}, {learner}"
                each = found["curves"][f"{body}/{learner}/{tables}"]
                times.setdefault(body, {})[kind] = [budget if t is None else t for t in each]
                runs = words.runs_of(found, body=body, walker=tables, learner=learner)
                falls.setdefault(body, {})[kind] = words.column(runs, words.FALL_RATE)
    label = "cycles to the reward"
    plots.bodies(file, {label: times, plots.FALLS: falls})


STUDY = Study(
    "sharing",
    "One shared table against four private ones",
    "all legs reference one table, so that learning after integration is four times as quick; "
    "legs may need to specialise.",
    arms,
    text,
    draw,
    curves,
    claims,
)
