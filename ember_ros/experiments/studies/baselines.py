"""Baselines: scripted knee, random knee, frozen table, learning table, central learner."""

from __future__ import annotations

from pathlib import Path

from ember_ros.experiments import plots, reporting, stats
from ember_ros.experiments.reporting import Claim, Results
from ember_ros.experiments.study import (
    LEARNERS,
    Arm,
    Size,
    Study,
    baseline_arms,
    trained_arm,
    training_trial,
    walking_trials,
)
from ember_ros.experiments.trial import CENTRAL
from ember_ros.params import Params
from leg_node.assembly import empty_table

BODIES = ("reference", "narrow")
CENTRAL_LABELS = {"body": "reference", "walker": "central learner", "learner": "plain"}


def arms(size: Size) -> list[Arm]:
    """Return walkers with trained tables, learning and frozen, and all baselines."""
    seeds, all_arms = range(size.seeds), []
    for body in BODIES:
        for learner in LEARNERS:
            all_arms.append(trained_arm(body, learner, size))
            starts = [training_trial(learner, size, seed) for seed in seeds]
            frozen = walking_trials(learner, body, size.short_walk, seeds, starts, learning=False)
            all_arms.append(
                Arm({"body": body, "walker": "trained, frozen", "learner": learner}, frozen)
            )
        all_arms += baseline_arms(body, size)
    central = walking_trials("plain", "reference", size.short_walk, seeds, policy=CENTRAL)
    return [*all_arms, Arm(CENTRAL_LABELS, central)]


def claims(results: Results) -> list[Claim]:
    """Test whether learning in situ helps, and compare the central learner with two baselines."""
    all_claims = []
    for body in BODIES:
        for learner in LEARNERS:
            learning, frozen = (
                reporting.runs_of(results, body=body, walker=walker, learner=learner)
                for walker in ("trained table", "trained, frozen")
            )
            for statement, name, form, unit in (
                ("learning in situ reduces falls", reporting.FALL_RATE, ".2f", "falls per 1000"),
                ("learning in situ reduces the SD of roll", "roll_sd_rad", ".4f", "rad"),
            ):
                difference = reporting.paired_difference(frozen, learning, name)
                all_claims.append(
                    Claim(
                        statement,
                        f"`{learner}`, {body}",
                        f"{reporting.with_interval(difference, form)} {unit} (frozen - learning)",
                        stats.verdict(difference, claimed=1),
                    )
                )
    central = reporting.runs_of(results, **CENTRAL_LABELS)
    for name, runs in (
        ("a random knee", reporting.runs_of(results, body="reference", walker="random knee")),
        (
            "four legs that share an empty table",
            reporting.runs_of(results, body="reference", walker="empty table", learner="plain"),
        ),
    ):
        difference = reporting.paired_difference(runs, central, reporting.FALL_RATE)
        all_claims.append(
            Claim(
                f"a central learner falls less often than {name}",
                "`plain`, reference",
                f"{reporting.with_interval(difference, '.1f')} falls per 1000 (baseline - central)",
                stats.verdict(difference, claimed=1),
            )
        )
    return all_claims


def text(results: Results) -> list[str]:
    """Return the tables and their explanation."""
    central = reporting.runs_of(results, **CENTRAL_LABELS)
    ticks = Params().gait.ticks
    coarse_states = ticks * 2 ** len(Params().robot.legs)
    states = empty_table(Params()).states
    actions = len(Params().leg.knee_speeds)
    return [
        *reporting.walker_table(results["arms"]),
        "",
        reporting.WALKER_TABLE_NOTE,
        "",
        "*Frozen*: the table does not change during the walk. *Central learner*: one learner that "
        "chooses the actions of all four legs. With the full states and actions of four legs its "
        f"table would have {states}^4 x {actions}^4 = {states**4 * actions**4:.1e} cells, too many "
        f"for any memory. The table used has all {actions**4} joint actions, but only "
        f"{coarse_states} coarse states (tick of the cycle, and which feet touch the ground), "
        f"together {coarse_states * actions**4:.1e} cells. It learns with the rule and parameters "
        "of `plain` from the mean reward of the legs. It makes at most one update per tick, "
        f"{ticks * central[0]['cycles']} in the whole walk, so most of its cells are never "
        "updated.",
    ]


def draw(results: Results, file: Path) -> None:
    """Draw falls and distance of every walker in every body."""
    kinds = {
        f"{name}, {learner}": {"walker": walker, "learner": learner}
        for learner in LEARNERS
        for name, walker in (("learning", "trained table"), ("frozen", "trained, frozen"))
    } | {"random knee": {"walker": "random knee"}, "scripted knee": {"walker": "scripted knee"}}
    groups = {body: {"body": body} for body in BODIES}
    quantities = plots.fall_rates_and_distances(results, kinds, groups)
    central = reporting.runs_of(results, **CENTRAL_LABELS)
    for label, name in plots.MEASURES.items():
        quantities[label]["reference"]["central learner"] = reporting.column(central, name)
    plots.draw_groups(file, quantities)


STUDY = Study(
    "baselines",
    "Baselines",
    "has no baselines; it states that a robot of this kind is intractable for a single learner "
    "(section I).",
    arms,
    text,
    draw,
    claims=claims,
)
