"""Tables from the trainer with a fixed and with a modulated stop: which walks better?"""

from __future__ import annotations

from pathlib import Path

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.studies.fig5 import HEIGHTS, about_stops, height_arm
from ember_ros.experiments.study import BODIES, LEARNERS, Arm, Size, Study, company, walks
from ember_ros.experiments.words import Claim, Found


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


MEASURES = (
    (
        "the simpler training (fixed, lower stop) falls less",
        words.FALL_RATE,
        ".1f",
        "falls per 1000",
        1,
    ),
    (
        "the simpler training (fixed, lower stop) is steadier",
        "roll_sd_rad",
        ".3f",
        "rad of roll, SD,",
        1,
    ),
    ("the simpler training (fixed, lower stop) goes further", "distance_m", ".3f", "m a cycle", -1),
)
"""What is claimed, of which measure, its form and unit, and the sign of it if modulated."""


def claims(found: Found) -> list[Claim]:
    """Say which training walks better."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            fixed, modulated = (
                words.runs_of(found, body=body, walker=f"trained, {height} stop", learner=learner)
                for height in HEIGHTS
            )
            for says, name, form, unit, sign in MEASURES:
                more = words.more(modulated, fixed, name)
                told = f"{words.told(more, form)} {unit} if modulated"
                word = stats.verdict(more, claimed=sign)
                lines.append(Claim(says, f"`{learner}`, {body}", told, word))
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    return [
        about_stops(),
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
    plots.bodies(file, plots.fall_rates_and(found, kinds, groups))


STUDY = Study(
    "regime",
    "Fixed or modulated training: which walks better?",
    "section VIII: it is better to train for the behaviour you want; the simpler training gave "
    "more stable walkers.",
    arms,
    text,
    draw,
    claims=claims,
)
