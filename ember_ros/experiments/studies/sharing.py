"""One shared table for all legs, compared with one private table for each leg."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    walking_trials,
)
from ember_ros.experiments.trial import MIN_VISITS, Outcome

NO_SYNC = 1_000_000
"""Ticks between syncs: more than a walk has, so that each leg learns only on its own copy."""
TABLES = ("empty table", "private tables")
PAPER_SPEEDUP = 4.0
"""Ratio of the learning times that the paper states."""
MEAN_WINDOW = 25
"""Cycles in the moving mean that has to reach the reward level."""


def arms(size: Size) -> list[Arm]:
    """Return the baselines (with a shared empty table), trained walkers, and private tables."""
    all_arms = []
    for body in BODIES:
        all_arms += baseline_arms(body, size)
        for learner in LEARNERS:
            all_arms.append(trained_arm(body, learner, size))
            private = walking_trials(
                learner, body, size.short_walk, range(size.seeds), walk__sync_every=NO_SYNC
            )
            all_arms.append(
                Arm({"body": body, "walker": "private tables", "learner": learner}, private)
            )
    return all_arms


def curves(outcomes_by_arm: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return the reward level of each body and learner, and the cycle in which walkers reach it."""
    reward = {
        tuple(arm.labels.values()): np.array([outcome.cycles["reward"] for outcome in outcomes])
        for arm, outcomes in outcomes_by_arm
    }
    by_name: dict[str, Any] = {}
    for body in BODIES:
        for learner in LEARNERS:
            low = float(reward[body, "random knee", "-"].mean())
            high = float(reward[body, "trained table", learner].mean())
            level = (low + high) / 2
            by_name[f"{body}/{learner}/level"] = level
            for tables in TABLES:
                by_name[f"{body}/{learner}/{tables}"] = [
                    cycle_reached(values, level) for values in reward[body, tables, learner]
                ]
    return by_name


def cycle_reached(values: NDArray[np.float64], level: float) -> int | None:
    """Return the cycle in which a moving mean first reaches a level.

    Args:
        values: one value per cycle, ``(cycles,)``.
        level: the level.

    Returns:
        The cycle in the middle of the window, from 1; None if the level is never reached.
    """
    window = min(MEAN_WINDOW, len(values))
    reached = np.convolve(values, np.ones(window) / window, mode="valid") >= level
    return int(np.argmax(reached)) + window - window // 2 if reached.any() else None


def learning_times(
    results: Results, body: str, learner: str
) -> tuple[list[float], list[float], tuple[int, int]]:
    """Return the cycles until the reward level is reached.

    Returns:
        Cycles with the shared table and with private tables, one per seed, and how many seeds of
        each never reached the level. For these the length of the walk is used, which is a lower
        limit.
    """
    length = results["arms"][0]["runs"][0]["cycles"]
    times = [results["curves"][f"{body}/{learner}/{tables}"] for tables in TABLES]
    shared, private = ([float(length if t is None else t) for t in each] for each in times)
    return shared, private, (times[0].count(None), times[1].count(None))


def claims(results: Results) -> list[Claim]:
    """Test whether a shared table learns four times as fast, faster, and with fewer falls."""
    all_claims = []
    for body in BODIES:
        for learner in LEARNERS:
            shared, private, (never_shared, never_private) = learning_times(results, body, learner)
            scope = f"`{learner}`, {body}"
            ratio = stats.interval([b / a for a, b in zip(shared, private, strict=True)])
            never = [
                f"{n} {kind}"
                for n, kind in ((never_shared, "shared"), (never_private, "private"))
                if n
            ]
            note = f"; {' and '.join(never)} never reached it" if never else ""
            verdict = "unclear"
            # With such seeds the ratio is only a limit: a lower one if private tables never
            # reached the level, an upper one if shared tables did not.
            if ratio.n > 1 and ratio.low >= PAPER_SPEEDUP and not never_shared:
                verdict = "holds"
            elif ratio.n > 1 and ratio.high < PAPER_SPEEDUP and not never_private:
                verdict = "fails"
            all_claims.append(
                Claim(
                    "a shared table learns at least four times as fast",
                    scope,
                    f"{reporting.with_interval(ratio, '.1f', '')} times as fast{note}",
                    verdict,
                )
            )
            saved = stats.difference(private, shared)
            verdict = stats.verdict(saved, claimed=1)
            if never_shared and verdict == "holds":
                verdict = "unclear"
            all_claims.append(
                Claim(
                    "a shared table learns faster",
                    scope,
                    f"{reporting.with_interval(saved, '.0f')} cycles until the level is reached "
                    f"(private - shared){note}",
                    verdict,
                )
            )
            shared_runs, private_runs = (
                reporting.runs_of(results, body=body, walker=tables, learner=learner)
                for tables in TABLES
            )
            falls = reporting.paired_difference(private_runs, shared_runs, reporting.FALL_RATE)
            all_claims.append(
                Claim(
                    "a shared table reduces falls",
                    scope,
                    f"{reporting.with_interval(falls, '.1f')} falls per 1000 (private - shared)",
                    stats.verdict(falls, claimed=1),
                )
            )
    return all_claims


def text(results: Results) -> list[str]:
    """Return the tables and their explanation."""
    rows = []
    for body in BODIES:
        for learner in LEARNERS:
            shared, private, never = learning_times(results, body, learner)
            runs = reporting.runs_of(results, body=body, walker=TABLES[1], learner=learner)
            differ = [run["legs_differ"] for run in runs if run["legs_differ"] is not None]
            rows.append(
                (
                    body,
                    learner,
                    f"{results['curves'][f'{body}/{learner}/level']:.2f}",
                    *(
                        reporting.with_quartiles(times, ".0f") + (f"; {n} never" if n else "")
                        for times, n in zip((shared, private), never, strict=True)
                    ),
                    reporting.with_quartiles(differ, ".0%") if differ else "-",
                )
            )
    return [
        "Legs learn on the body from an empty table: with one shared table, or with a private "
        "table for each leg. Cycles until they reach a reward level:",
        "",
        *reporting.markdown_table(
            (
                "body",
                "learner",
                "level, reward per tick",
                "shared table: cycles",
                "private tables: cycles",
                "private legs differ",
            ),
            rows,
        ),
        "",
        "*Level*: half way between the mean reward of the random knee (with the reward of `ember`) "
        "and that of a walker with a trained table. It is reached when a moving mean over "
        f"{MEAN_WINDOW} cycles reaches it; the middle of that window is reported. Learning times "
        "shorter than about half a window therefore cannot be distinguished. *Never*: number of "
        "walkers that did not reach the level; the length of the walk is used for them. The claim "
        "of four times as fast is tested with the ratio of the learning times (private / shared): "
        f"it holds if the 95 % interval is at or above {PAPER_SPEEDUP:.0f}, and fails if it is "
        "below. *Private legs differ*: of the states that two legs both "
        f"visited at least {MIN_VISITS} times, the share in which the best actions of their "
        "tables differ. Both chance and specialisation contribute to it.",
        "",
        *reporting.walker_table(results["arms"]),
        "",
        reporting.WALKER_TABLE_NOTE,
    ]


def draw(results: Results, file: Path) -> None:
    """Draw learning times and falls."""
    length = results["arms"][0]["runs"][0]["cycles"]
    names = {"empty table": "shared", "private tables": "private"}
    times: dict[str, dict[str, list[float]]] = {}
    falls: dict[str, dict[str, list[float]]] = {}
    for body in BODIES:
        for tables, name in names.items():
            for learner in LEARNERS:
                kind = f"{name}, {learner}"
                reached = results["curves"][f"{body}/{learner}/{tables}"]
                times.setdefault(body, {})[kind] = [length if t is None else t for t in reached]
                runs = reporting.runs_of(results, body=body, walker=tables, learner=learner)
                falls.setdefault(body, {})[kind] = reporting.column(runs, reporting.FALL_RATE)
    plots.draw_groups(file, {"cycles to the reward level": times, plots.FALLS: falls})


STUDY = Study(
    "sharing",
    "One shared table against four private ones",
    "all legs use the same table, so that learning after integration is four times as fast; legs "
    "may need to specialise.",
    arms,
    text,
    draw,
    curves,
    claims,
)
