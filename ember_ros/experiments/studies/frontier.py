"""The frontier: how narrow a body the legs of each kind can carry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ember_ros.experiments import plots, reporting, stats
from ember_ros.experiments.plots import COLOURS
from ember_ros.experiments.reporting import Claim, Results
from ember_ros.experiments.studies.learners import changes
from ember_ros.experiments.study import (
    Arm,
    Size,
    Study,
    baseline_arms,
    learner_params,
    trained_arm,
    training_trial,
    walking_trials,
)
from ember_ros.experiments.trial import Outcome
from ember_ros.report.figures import GREY, canvas, save
from leg_node.assembly import make_discretizer

BODIES = ("short", "narrow")
TARGET_FALL_RATE = 1.0
"""Our target: at most so many falls per 1000 steps."""
WITHOUT_LEAD = "ember without lead and explore"
LONGER_TRAINING = "ember, trained twice as long"
HALF_WIDTHS = (0.22, 0.14, 0.12, 0.10, 0.08)
"""Half widths of the hips of further bodies, with the length of the reference body, m."""
KINDS = (
    "random knee",
    "empty table",
    "scripted knee",
    "trained, ember",
    f"trained, {WITHOUT_LEAD}",
    "trained, plain",
)
"""The walkers in these further bodies."""
FOOTFALL_WALKERS = ("scripted knee", "ember", WITHOUT_LEAD, "plain")
"""The walkers whose ground contact is compared."""
TICK_RANGES = (
    ("last 2 ticks of swing", (30, 31)),
    ("first tick of stance", (0,)),
    ("ticks 2 to 5 of stance", (1, 2, 3, 4)),
    ("ticks 11 to 14 of stance", (10, 11, 12, 13)),
)
"""Ticks of a leg's own cycle, from 0; the cycle has 24 ticks of stance and then 8 of swing."""


def arms(size: Size) -> list[Arm]:
    """Return walkers in the two narrow bodies, and in a series of bodies of decreasing width."""
    all_arms = []
    without_lead = changes("plain", ("lead", "explore"))
    slower_decay: dict[str, Any] = {
        "train__epsilon_cycles": 2 * learner_params().train.epsilon_cycles
    }
    longer = size._replace(train=2 * size.train)
    for body in BODIES:
        all_arms += [
            trained_arm(body, "plain", size),
            trained_arm(body, "ember", size, name=WITHOUT_LEAD, **without_lead),
            trained_arm(body, "ember", size),
            trained_arm(body, "ember", longer, name=LONGER_TRAINING, **slower_decay),
        ]
        all_arms += baseline_arms(body, size)
    seeds = range(size.reduced_seeds)
    for half_width in HALF_WIDTHS:
        for kind in KINDS:
            learner = "plain" if kind.endswith("plain") else "ember"
            changed = without_lead if kind.endswith(WITHOUT_LEAD) else {}
            if not kind.startswith("trained"):
                trials = walking_trials(
                    learner,
                    "reference",
                    size.short_walk,
                    range(1),
                    policy="learned" if kind == "empty table" else kind.split()[0],
                    learning=kind == "empty table",
                    walker__hip_half_width=half_width,
                )
            else:
                trials = walking_trials(
                    learner,
                    "reference",
                    size.short_walk,
                    seeds,
                    [training_trial(learner, size, seed, **changed) for seed in seeds],
                    walker__hip_half_width=half_width,
                    **changed,
                )
            all_arms.append(Arm({"width": f"{half_width:g}", "kind": kind}, trials))
    return all_arms


def curves(outcomes_by_arm: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return the share of feet on the ground in each tick, for some walkers in each body."""
    by_name: dict[str, Any] = {}
    for arm, outcomes in outcomes_by_arm:
        walker = arm.labels.get("walker", "")
        if walker in ("trained table", "scripted knee"):
            name = arm.labels["learner"] if walker == "trained table" else walker
            mean = np.mean([outcome.footfall for outcome in outcomes], axis=0)
            by_name[f"{arm.labels['body']}/{name}"] = mean.round(4).tolist()
    return by_name


def claims(results: Results) -> list[Claim]:
    """Test which learners fall less often in narrow bodies, and which reach our target."""
    all_claims = []
    for body in BODIES:
        plain, without_lead, ember, longer = (
            reporting.runs_of(results, body=body, walker="trained table", learner=learner)
            for learner in ("plain", WITHOUT_LEAD, "ember", LONGER_TRAINING)
        )
        for name, runs in (("ember without lead and explore", without_lead), ("plain", plain)):
            difference = reporting.paired_difference(runs, ember, reporting.FALL_RATE)
            all_claims.append(
                Claim(
                    f"ember falls less often than {name}",
                    f"{body} body",
                    f"{reporting.with_interval(difference, '.1f')} falls per 1000 ({name} - ember)",
                    stats.verdict(difference, claimed=1),
                )
            )
        for name, runs in (("ember", ember), (LONGER_TRAINING, longer)):
            rate = reporting.falls_per_1000(runs)
            all_claims.append(
                Claim(
                    f"our target: {name}: at most {TARGET_FALL_RATE:.0f} fall per 1000 steps",
                    f"{body} body",
                    f"{rate:.2f} falls per 1000; {reporting.never_fell(runs)} never fell "
                    f"({WITHOUT_LEAD}: {reporting.falls_per_1000(without_lead):.2f})",
                    reporting.target_verdict(rate <= TARGET_FALL_RATE, runs),
                )
            )
    return all_claims


def text(results: Results) -> list[str]:
    """Return the tables and their explanation."""
    width_rows = []
    for half_width in HALF_WIDTHS:
        cells = [f"{half_width:g}"]
        for kind in KINDS:
            runs = reporting.runs_of(results, width=f"{half_width:g}", kind=kind)
            cells.append(f"{reporting.falls_per_1000(runs):.1f}")
            cells.append(f"{sum(reporting.column(runs, 'distance_m')) / len(runs):.3f}")
        width_rows.append(cells)
    contact_rows = []
    for body in BODIES:
        for walker in FOOTFALL_WALKERS:
            share = np.array(results["curves"][f"{body}/{walker}"])
            means = [share[list(ticks)].mean() for _, ticks in TICK_RANGES]
            contact_rows.append((body, walker, *(f"{mean:.0%}" for mean in means)))
    shape = " x ".join(map(str, make_discretizer(learner_params()).shape))
    return [
        "A possible reason for falls in narrow bodies is a late touchdown. In swing, a leg is "
        "rewarded for having no ground contact, and punished for contact until the last tick. So "
        "a trained knee may still be bent when stance begins. Until this foot touches the ground, "
        "only the other diagonal pair of legs supports the body. The scripted knee puts its foot "
        "down before stance begins. Share of feet on the ground, over all legs and cycles:",
        "",
        *reporting.markdown_table(
            ("body", "walker", *(name for name, _ in TICK_RANGES)), contact_rows
        ),
        "",
        "A leg can sense its own height and its contact at the end of swing, and it knows the "
        "phase. With `reward.lead` the last ticks before stance are rewarded as in stance. The "
        f"states stay the same ({shape}). `ember` combines this with more exploration on the "
        "trainer (`train.epsilon_start`); the section on the learners shows the effect of each of "
        "the two alone.",
        "",
        f"*{WITHOUT_LEAD}*: both of these parts as in `plain`. *{LONGER_TRAINING}*: twice as many "
        "cycles on the trainer, and the share of random actions decreases half as fast.",
        "",
        *reporting.walker_table([arm for arm in results["arms"] if "body" in arm["labels"]]),
        "",
        reporting.WALKER_TABLE_NOTE,
        "",
        f"Bodies with a length of {learner_params().walker.length} m and hips of decreasing half "
        "width; falls per 1000 cycles, and distance per cycle in m:",
        "",
        *reporting.markdown_table(
            (
                "half width, m",
                *(f"{measure}, {kind}" for kind in KINDS for measure in ("falls", "distance")),
            ),
            width_rows,
        ),
    ]


def draw(results: Results, file: Path) -> None:
    """Draw falls and distance by the width of the hips, and the ground contact by tick."""
    figure, axes = canvas(1, 3, width=14.0, height=3.6)
    for n, kind in enumerate(KINDS):
        for axis, (label, name) in zip(axes[0], plots.MEASURES.items(), strict=False):
            by_width = [
                reporting.column(reporting.runs_of(results, width=f"{each:g}", kind=kind), name)
                for each in HALF_WIDTHS
            ]
            means = [sum(values) / len(values) for values in by_width]
            axis.plot(HALF_WIDTHS, means, "-", color=COLOURS[n], lw=1.6, label=kind)
            for half_width, values in zip(HALF_WIDTHS, by_width, strict=True):
                x = [half_width] * len(values)
                axis.plot(x, values, "o", color=COLOURS[n], ms=3.5, alpha=0.5)
            axis.set_ylabel(label)
            axis.set_xlabel("half width of the hips, m")
    axes[0, 0].set_yscale("symlog", linthresh=1.0)
    axes[0, 0].set_ylim(bottom=-0.2)
    handles_and_labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles_and_labels, frameon=False, ncols=6, loc="outside upper left")
    axis = axes[0, 2]
    for name in FOOTFALL_WALKERS:
        kind = name if name.endswith("knee") else f"trained, {name}"
        colour = COLOURS[KINDS.index(kind)]
        share = results["curves"][f"narrow/{name}"]
        half = len(share) // 2
        axis.plot(range(-half, half), [*share[half:], *share[:half]], color=colour, lw=1.6)
    axis.axvspan(-8, 0, color=GREY, alpha=0.15, lw=0)
    axis.set_xlabel("tick of the leg's cycle; grey: swing")
    axis.set_ylabel("share of feet on the ground, narrow body")
    save(figure, file)


STUDY = Study(
    "frontier",
    "The frontier: narrow bodies",
    "often the instability is too great to be overcome by further learning (section VIII); it "
    "expects a benefit from a stance that begins when the foot touches the ground.",
    arms,
    text,
    draw,
    curves,
    claims,
)
