"""Tables from trainings with a fixed and with a modulated stop: which ones walk better."""

from __future__ import annotations

from pathlib import Path

from ember_ros.experiments import plots, reporting, stats
from ember_ros.experiments.reporting import Claim, Results
from ember_ros.experiments.studies.fig5 import STOPS, stop_arm, stop_note
from ember_ros.experiments.study import (
    BODIES,
    LEARNERS,
    Arm,
    Size,
    Study,
    baseline_arms,
    walking_trials,
)


def arms(size: Size) -> list[Arm]:
    """Return walkers with tables of both trainings in every body, and the baselines."""
    all_arms = []
    seeds = range(size.seeds)
    for body in BODIES:
        for learner in LEARNERS:
            for stop in STOPS:
                starts = stop_arm(learner, stop, seeds, size.train).trials
                all_arms.append(
                    Arm(
                        {"body": body, "walker": f"trained, {stop} stop", "learner": learner},
                        walking_trials(learner, body, size.short_walk, seeds, starts),
                    )
                )
        all_arms += baseline_arms(body, size)
    return all_arms


MEASURES = (
    ("leads to fewer falls", reporting.FALL_RATE, ".1f", "falls per 1000", 1),
    ("leads to a lower SD of roll", "roll_sd_rad", ".3f", "rad", 1),
    ("leads to longer distances", "distance_m", ".3f", "m per cycle", -1),
)
"""Claim, measure, format, unit, and claimed sign of the difference (modulated - fixed)."""


def claims(results: Results) -> list[Claim]:
    """Test which training leads to better walking."""
    all_claims = []
    for body in BODIES:
        for learner in LEARNERS:
            fixed, modulated = (
                reporting.runs_of(
                    results, body=body, walker=f"trained, {stop} stop", learner=learner
                )
                for stop in STOPS
            )
            for statement, name, form, unit, sign in MEASURES:
                difference = reporting.paired_difference(modulated, fixed, name)
                all_claims.append(
                    Claim(
                        f"the simpler training (fixed, lower stop) {statement}",
                        f"`{learner}`, {body}",
                        f"{reporting.with_interval(difference, form)} {unit} (modulated - fixed)",
                        stats.verdict(difference, claimed=sign),
                    )
                )
    return all_claims


def text(results: Results) -> list[str]:
    """Return the table of walkers and its explanation."""
    return [
        stop_note(),
        "",
        *reporting.walker_table(results["arms"]),
        "",
        reporting.WALKER_TABLE_NOTE,
    ]


def draw(results: Results, file: Path) -> None:
    """Draw falls and distance of every walker in every body."""
    kinds = {
        f"{stop}, {learner}": {"walker": f"trained, {stop} stop", "learner": learner}
        for stop in STOPS
        for learner in LEARNERS
    }
    groups = {body: {"body": body} for body in BODIES}
    plots.draw_groups(file, plots.fall_rates_and_distances(results, kinds, groups))


STUDY = Study(
    "regime",
    "Fixed or modulated training: which walks better?",
    "it is better to train for the behaviour that is wanted; the simpler training led to more "
    "stable walkers (section VIII).",
    arms,
    text,
    draw,
    claims=claims,
)
