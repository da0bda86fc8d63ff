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
from ember_ros.experiments.words import Claim, Found
from ember_ros.params import Params
from leg_node.assembly import empty_table

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


def claims(found: Found) -> list[Claim]:
    """Say whether learning in situ helps, and what a central learner does."""
    lines = []
    for body in BODIES:
        for learner in LEARNERS:
            learning, frozen = (
                words.runs_of(found, body=body, walker=walker, learner=learner)
                for walker in ("trained table", "trained, frozen")
            )
            for says, name, form, unit in (
                ("learning in situ saves falls", words.FALL_RATE, ".2f", "falls per 1000"),
                ("learning in situ steadies", "roll_sd_rad", ".4f", "rad of roll, SD,"),
            ):
                more = words.more(frozen, learning, name)
                told = f"{words.told(more, form)} {unit} if frozen"
                word = stats.verdict(more, claimed=1)
                lines.append(Claim(says, f"`{learner}`, {body}", told, word))
    central = words.runs_of(found, **CENTRAL_LABELS)
    for than, runs in (
        ("than a random knee", words.runs_of(found, body="reference", walker="random knee")),
        (
            "than four legs with one empty table",
            words.runs_of(found, body="reference", walker="empty table", learner="plain"),
        ),
    ):
        more = words.more(runs, central, words.FALL_RATE)
        lines.append(
            Claim(
                f"a central learner falls less {than}",
                "`plain`, reference",
                f"{words.told(more, '.1f')} falls per 1000 there",
                stats.verdict(more, claimed=1),
            )
        )
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    central = words.runs_of(found, **CENTRAL_LABELS)
    ticks = Params().gait.ticks
    coarse = ticks * 2 ** len(Params().robot.legs)
    states = empty_table(Params()).states
    actions = len(Params().leg.knee_speeds)
    return [
        *words.walkers(found["arms"]),
        "",
        words.WALKERS_NOTE,
        "",
        f"A central learner over all that four legs sense and do has {states}^4 x {actions}^4 = "
        f"{states**4 * actions**4:.1e} cells: no machine has them. What fits has all "
        f"{actions**4} joint actions over {coarse} coarse states (the tick of the cycle and which "
        f"feet touch the ground), {coarse * actions**4:.1e} cells, and learns by the plain rule "
        "from the mean of the legs' rewards. In the same budget it makes at most one update a "
        f"tick, {ticks * central[0]['cycles']} in all, so that most of its cells are never tried.",
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
    for label, name in plots.MEASURES.items():
        quantities[label]["reference"]["central learner"] = words.column(central, name)
    plots.bodies(file, quantities)


STUDY = Study(
    "baselines",
    "Baselines",
    "has none; a robot of this kind is intractable for one learner (section I).",
    arms,
    text,
    draw,
    claims=claims,
)
