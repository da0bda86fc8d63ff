"""Baselines: a knee by hand, a random one, a frozen table, a learning one, a central learner."""

from __future__ import annotations

from pathlib import Path

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.study import (
    LEARNERS,
    Arm,
    Size,
    Study,
    company,
    trained,
    trained_arm,
    walks,
)
from ember_ros.experiments.trial import CENTRAL
from ember_ros.experiments.words import Found
from ember_ros.params import Params
from leg_node.state import Partition

BODIES = ("reference", "narrow")
CENTRAL_LABELS = {"body": "reference", "walker": "central learner", "learner": "plain"}


def arms(size: Size) -> list[Arm]:
    """Return all baselines."""
    seeds, found = range(size.seeds), []
    for body in BODIES:
        for learner in LEARNERS:
            found.append(trained_arm(body, learner, size))
            starts = [trained(learner, size, seed) for seed in seeds]
            frozen = walks(learner, body, size.brief, seeds, starts, learning=False)
            found.append(
                Arm({"body": body, "walker": "trained, frozen", "learner": learner}, frozen)
            )
        found += company(body, size)
    central = walks("plain", "reference", size.brief, seeds, policy=CENTRAL)
    return [*found, Arm(CENTRAL_LABELS, central)]


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            learning, frozen = (
                words.runs_of(found, body=body, walker=walker, learner=learner)
                for walker in ("trained table", "trained, frozen")
            )
            falls = words.more(frozen, learning, words.FALL_RATE)
            reward = words.more(learning, frozen, "reward")
            roll = words.more(frozen, learning, "roll_sd_rad")
            lines.append(
                (
                    body,
                    learner,
                    words.told(falls, ".2f"),
                    stats.verdict(falls, claimed=1),
                    words.told(reward, ".4f"),
                    stats.verdict(reward, claimed=1),
                    words.told(roll, ".4f"),
                    stats.verdict(roll, claimed=1),
                )
            )
    central = words.runs_of(found, **CENTRAL_LABELS)
    random = words.runs_of(found, body="reference", walker="random knee")
    empty = words.runs_of(found, body="reference", walker="empty table", learner="plain")
    against = words.more(central, random, words.FALL_RATE)
    modular = words.more(central, empty, words.FALL_RATE)
    states = Partition(Params()).size
    actions = len(Params().leg.knee_speeds)
    return [
        *words.walkers(found["arms"]),
        "",
        words.WALKERS_NOTE,
        "",
        "Does learning in situ help? Seed by seed, a learning walker against a frozen one:",
        "",
        *words.grid(
            (
                "body",
                "learner",
                "falls per 1000 more if frozen",
                "learning helps",
                "reward a tick more if learning",
                "learning helps",
                "SD of roll more if frozen, rad",
                "learning helps",
            ),
            lines,
        ),
        "",
        f"A central learner over all that four legs sense and do has {states}^4 x {actions}^4 = "
        f"{states**4 * actions**4:.1e} cells: no machine has them. What fits has all "
        f"{actions**4} joint actions over 512 coarse states (the tick of the cycle and which feet "
        "touch the ground), 3.4 million cells, and learns by the plain rule from the mean of the "
        "legs' rewards. In the same budget it makes at most one update a tick, "
        f"{32 * central[0]['cycles']} in all, so that most of its cells are never tried: it falls "
        f"{words.told(against, '.1f')} times per 1000 cycles more than a random knee, and "
        f"{words.told(modular, '.1f')} more than four plain legs with one empty table.",
    ]


def draw(found: Found, file: Path) -> None:
    """Draw falls and distance of every walker in every body."""
    kinds = {
        f"{name}, {learner}": {"walker": walker, "learner": learner}
        for learner in LEARNERS
        for name, walker in (("learning", "trained table"), ("frozen", "trained, frozen"))
    } | {"random knee": {"walker": "random knee"}, "scripted knee": {"walker": "scripted knee"}}
    groups = {body: {"body": body} for body in BODIES}
    quantities = plots.fall_rates_and(found, kinds, groups)
    central = words.runs_of(found, **CENTRAL_LABELS)
    for label, name in ((plots.FALLS, words.FALL_RATE), (plots.WAY, "distance_m")):
        quantities[label]["reference"]["central learner"] = words.column(central, name)
    plots.bodies(file, quantities, log=[plots.FALLS])


STUDY = Study(
    "baselines",
    "Baselines",
    "has none; a robot of this kind is intractable for one learner (section I).",
    arms,
    text,
    draw,
)
