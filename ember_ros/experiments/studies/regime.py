"""Tables from the trainer with a fixed and with a modulated stop: which walks better?"""

from __future__ import annotations

from pathlib import Path

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.studies.fig5 import HEIGHTS, height_arm
from ember_ros.experiments.study import BODIES, LEARNERS, Arm, Size, Study, company, walks
from ember_ros.experiments.words import Found


def arms(size: Size) -> list[Arm]:
    """Return walkers with tables of both trainings in every body, and who walks beside them."""
    found = []
    seeds = range(size.seeds)
    for body in BODIES:
        for learner in LEARNERS:
            for height in HEIGHTS:
                starts = height_arm(learner, height, seeds, size.train).trials
                found.append(
                    Arm(
                        {"body": body, "walker": f"trained, {height} stop", "learner": learner},
                        walks(learner, body, size.brief, seeds, starts),
                    )
                )
        found += company(body, size)
    return found


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            fixed, modulated = (
                words.runs_of(found, body=body, walker=f"trained, {height} stop", learner=learner)
                for height in HEIGHTS
            )
            falls = words.more(modulated, fixed, words.FALL_RATE)
            roll = words.more(modulated, fixed, "roll_sd_rad")
            way = words.more(fixed, modulated, "distance_m")
            lines.append(
                (
                    body,
                    learner,
                    words.told(falls, ".2f"),
                    stats.verdict(falls, claimed=1),
                    words.told(roll, ".4f"),
                    stats.verdict(roll, claimed=1),
                    words.told(way),
                    stats.verdict(way, claimed=1),
                )
            )
    return [
        "The claim is that the simpler training walks better. Seed by seed:",
        "",
        *words.grid(
            (
                "body",
                "learner",
                "falls per 1000 more if modulated",
                "fixed falls less",
                "SD of roll more if modulated, rad",
                "fixed is steadier",
                "distance more if fixed, m",
                "fixed goes further",
            ),
            lines,
        ),
        "",
        *words.walkers(found["arms"]),
        "",
        words.WALKERS_NOTE,
    ]


def draw(found: Found, file: Path) -> None:
    """Draw falls and distance of every walker in every body."""
    kinds = {
        f"{height}, {learner}": {"walker": f"trained, {height} stop", "learner": learner}
        for height in HEIGHTS
        for learner in LEARNERS
    }
    groups = {body: {"body": body} for body in BODIES}
    plots.bodies(file, plots.fall_rates_and(found, kinds, groups), log=[plots.FALLS])


STUDY = Study(
    "regime",
    "Fixed or modulated training: which walks better?",
    "section VIII: it is better to train for the behaviour you want; the simpler training gave "
    "more stable walkers, and later learning was faster and more effective.",
    arms,
    text,
    draw,
)
