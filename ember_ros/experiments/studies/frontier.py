"""The frontier: how narrow a body can legs of each kind carry?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.plots import COLOURS
from ember_ros.experiments.studies.learners import changes
from ember_ros.experiments.study import (
    Arm,
    Size,
    Study,
    company,
    numbers,
    trained,
    trained_arm,
    walks,
)
from ember_ros.experiments.trial import Outcome
from ember_ros.experiments.words import Claim, Found
from ember_ros.report.figures import GREY, canvas, save
from leg_node.assembly import make_discretizer

BODIES = ("short", "narrow")
AIM = 1.0
"""Falls per 1000 steps that are aimed at."""
BEFORE = "ember without lead and explore"
TWICE = "ember, trained twice as long"
WIDTHS = (0.22, 0.14, 0.12, 0.10, 0.08)
"""Half widths of the hips in a body of the reference's length, m."""
KINDS = (
    "random knee",
    "empty table",
    "scripted knee",
    "trained, ember",
    f"trained, {BEFORE}",
    "trained, plain",
)


FEET = ("scripted knee", "ember", BEFORE, "plain")
MOMENTS = (
    ("last 2 ticks of swing", (30, 31)),
    ("first tick of stance", (0,)),
    ("ticks 2 to 5 of stance", (1, 2, 3, 4)),
    ("middle of stance", (10, 11, 12, 13)),
)
"""Ticks of a leg's own cycle of 32, 24 of them stance."""


def arms(size: Size) -> list[Arm]:
    """Return walkers before and after in the frontier bodies, and in ever narrower ones."""
    found = []
    before = changes("plain", ("lead", "explore"))
    longer: dict[str, Any] = {"train__epsilon_cycles": 2 * numbers().train.epsilon_cycles}
    twice = size._replace(train=2 * size.train)
    for body in BODIES:
        found += [
            trained_arm(body, "plain", size),
            trained_arm(body, "ember", size, name=BEFORE, **before),
            trained_arm(body, "ember", size),
            trained_arm(body, "ember", twice, name=TWICE, **longer),
        ]
        found += company(body, size)
    some = range(size.few)
    for width in WIDTHS:
        for kind in KINDS:
            learner = "plain" if kind.endswith("plain") else "ember"
            other = before if kind.endswith(BEFORE) else {}
            if not kind.startswith("trained"):
                trials = walks(
                    learner,
                    "reference",
                    size.brief,
                    range(1),
                    policy="learned" if kind == "empty table" else kind.split()[0],
                    learning=kind == "empty table",
                    walker__hip_half_width=width,
                )
            else:
                starts = [trained(learner, size, seed, **other) for seed in some]
                trials = walks(
                    learner,
                    "reference",
                    size.brief,
                    some,
                    starts,
                    walker__hip_half_width=width,
                    **other,
                )
            found.append(Arm({"width": f"{width:g}", "kind": kind}, trials))
    return found


def curves(known: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return when feet are on the ground, for each kind of walker in each body."""
    found: dict[str, Any] = {}
    for arm, outcomes in known:
        walker = arm.labels.get("walker", "")
        if walker in ("trained table", "scripted knee"):
            name = arm.labels["learner"] if walker == "trained table" else walker
            mean = np.mean([outcome.footfall for outcome in outcomes], axis=0)
            found[f"{arm.labels['body']}/{name}"] = mean.round(4).tolist()
    return found


def claims(found: Found) -> list[Claim]:
    """Say what was won at the frontier."""
    lines = []
    for body in BODIES:
        plain, before, after, twice = (
            words.runs_of(found, body=body, walker="trained table", learner=learner)
            for learner in ("plain", BEFORE, "ember", TWICE)
        )
        for than, runs in (("without lead and explore", before), ("plain", plain)):
            fewer = words.more(runs, after, words.FALL_RATE)
            lines.append(
                Claim(
                    f"ember falls less than {than}",
                    body,
                    f"{words.told(fewer, '.1f')} falls per 1000 there",
                    stats.verdict(fewer, claimed=1),
                )
            )
        for name, runs in (("ember", after), (TWICE, twice)):
            rate = words.falls_per_1000(runs)
            lines.append(
                Claim(
                    f"{name}: at most {AIM:.0f} fall per 1000 steps",
                    body,
                    f"{words.falls_per_1000(before):.2f} before, {rate:.2f} after; "
                    f"{words.never_fell(runs)} never fell",
                    words.bar(rate <= AIM, runs),
                )
            )
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines = []
    for width in WIDTHS:
        cells = [f"{width:g}"]
        for kind in KINDS:
            runs = words.runs_of(found, width=f"{width:g}", kind=kind)
            cells.append(f"{words.falls_per_1000(runs):.1f}")
            cells.append(f"{sum(words.column(runs, 'distance_m')) / len(runs):.3f}")
        lines.append(cells)
    return [
        "A reading of why narrow bodies fall: feet that come down late. The swing reward pays for "
        "being off the ground and punishes contact up to its last tick; so a learnt knee may still "
        "be bent when its stance begins, and until the foot is down the body rests on the other "
        "diagonal alone. The knee written by hand puts its foot down before stance. Share of feet "
        "on the ground, of all legs and cycles:",
        "",
        *words.grid(
            ("body", "walker", *(f"{head}" for head, _ in MOMENTS)),
            [
                (
                    body,
                    name,
                    *(
                        f"{np.mean([found['curves'][f'{body}/{name}'][n] for n in ticks]):.0%}"
                        for _, ticks in MOMENTS
                    ),
                )
                for body in BODIES
                for name in FEET
            ],
        ),
        "",
        "What a leg can sense of this by itself is its own height and its contact at the end of "
        "swing, and it knows the phase: with `reward.lead` the last ticks before stance are "
        "rewarded as stance is. The state is not changed: "
        f"{' x '.join(map(str, make_discretizer(numbers()).shape))}. It goes with "
        "more exploration on the trainer (`train.epsilon_start`): the table of the learners tells "
        "what each of the two does without the other.",
        "",
        f"Before: {BEFORE}; after: `ember`. Two more things were tried: twice the steps on the "
        "trainer, the share of random actions falling half as fast; and the nearer horizon of "
        "`plain`, which the table of the learners suggests (from the first of these same seeds).",
        "",
        *words.walkers([arm for arm in found["arms"] if "body" in arm["labels"]]),
        "",
        words.WALKERS_NOTE,
        "",
        f"Ever narrower hips in a body of {numbers().walker.length} m; falls per 1000 cycles, and "
        "distance a cycle, m:",
        "",
        *words.grid(
            (
                "half width, m",
                *(f"{head}, {kind}" for kind in KINDS for head in ("falls", "distance")),
            ),
            lines,
        ),
    ]


def draw(found: Found, file: Path) -> None:
    """Draw falls and distance against the width of the hips."""
    figure, axes = canvas(1, 3, width=14.0, height=3.6)
    for n, kind in enumerate(KINDS):
        for axis, (label, name) in zip(axes[0], plots.MEASURES.items(), strict=False):
            each = [
                words.column(words.runs_of(found, width=f"{width:g}", kind=kind), name)
                for width in WIDTHS
            ]
            means = [sum(values) / len(values) for values in each]
            axis.plot(WIDTHS, means, "-", color=COLOURS[n], lw=1.6, label=kind)
            for width, values in zip(WIDTHS, each, strict=True):
                at = [width] * len(values)
                axis.plot(at, values, "o", color=COLOURS[n], ms=3.5, alpha=0.5)
            axis.set_ylabel(label)
            axis.set_xlabel("half width of the hips, m")
    axes[0, 0].set_yscale("symlog", linthresh=1.0)
    axes[0, 0].set_ylim(bottom=-0.2)
    known = axes[0, 0].get_legend_handles_labels()
    figure.legend(*known, frameon=False, ncols=6, loc="outside upper left")
    axis = axes[0, 2]
    for name in FEET:
        kind = name if name.endswith("knee") else f"trained, {name}"
        colour = COLOURS[KINDS.index(kind)]
        share = found["curves"][f"narrow/{name}"]
        half = len(share) // 2
        axis.plot(range(-half, half), [*share[half:], *share[:half]], color=colour, lw=1.6)
    axis.axvspan(-8, 0, color=GREY, alpha=0.15, lw=0)
    axis.set_xlabel("tick of the leg's cycle; grey: swing")
    axis.set_ylabel("share of feet down, narrow body")
    save(figure, file)


STUDY = Study(
    "frontier",
    "The frontier: narrow bodies",
    "often this instability is too great to be overcome simply by further learning (section VIII); "
    "it expects much of a stance that begins when the foot feels the ground.",
    arms,
    text,
    draw,
    curves,
    claims,
)
