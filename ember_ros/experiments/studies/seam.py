"""Another learner in the same leg: SARSA(lambda) beside Q-learning on the trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.study import Arm, Size, Study, numbers, trained
from ember_ros.experiments.trial import Outcome
from ember_ros.experiments.words import Claim, Found
from ember_ros.report.figures import INK, canvas, save
from leg_node import sarsa

LEARNERS = {
    "Q-learning": "leg_node.learner.QLearning",
    "SARSA(lambda)": "leg_node.sarsa.SarsaLambda",
}
"""Name, and ``parts.learner``."""
NUMBERS = ("plain", "ember")
"""Whose learning numbers hold."""
QUANTITIES = {"reward": "mean reward", "distance_m": "distance a step, m"}
BINS = 60


def arms(size: Size) -> list[Arm]:
    """Return trainings by both learners, with the numbers of the paper's and with ours."""
    return [
        Arm(
            {"learner": name, "numbers": own},
            [trained(own, size, seed, parts__learner=path) for seed in range(size.seeds)],
        )
        for own in NUMBERS
        for name, path in LEARNERS.items()
    ]


def curves(known: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return the quartiles of each quantity over seeds, in bins of cycles."""
    found: dict[str, Any] = {}
    for arm, outcomes in known:
        for name in QUANTITIES:
            each = np.array([outcome.cycles[name] for outcome in outcomes])
            found["/".join((*arm.labels.values(), name))] = stats.quartile_curve(each, BINS)
    return found


def claims(found: Found) -> list[Claim]:
    """Say which of the two earns more and goes further in the end."""
    lines = []
    for own in NUMBERS:
        one, other = (words.runs_of(found, learner=name, numbers=own) for name in LEARNERS)
        for says, name, unit in (
            ("earns more than Q-learning in the last 500 steps", "reward_last", "reward a tick"),
            ("goes further than Q-learning in the last 500 steps", "distance_last_m", "m a step"),
        ):
            more = words.more(other, one, name)
            told = f"{words.told(more)} {unit} with SARSA(lambda)"
            lines.append(
                Claim(f"SARSA(lambda) {says}", f"`{own}`", told, stats.verdict(more, claimed=1))
            )
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines = []
    for arm in found["arms"]:
        runs, labels = arm["runs"], arm["labels"]
        lines.append(
            (
                labels["numbers"],
                labels["learner"],
                str(len(runs)),
                words.spread(words.column(runs, "reward")),
                words.spread(words.column(runs, "reward_last")),
                words.spread(words.column(runs, "distance_last_m")),
            )
        )
    gamma = numbers().train.gamma
    return [
        "A learner is a part that is named in the parameters: `ember train --set "
        "parts.learner=leg_node.sarsa.SarsaLambda`. It is given transitions and returns targets; "
        "table, sharing, recording and replay are as ever. `leg_node/sarsa.py` is the example: the "
        f"forward view with lambda = {sarsa.LAMBDA}, cut off after {sarsa.HORIZON} ticks. Nothing "
        f"was tuned for it; discount ({gamma}), rates and exploration are those of Q-learning.",
        "",
        *words.grid(
            (
                "numbers",
                "learner",
                "trainings",
                "reward a tick, all steps",
                "reward a tick, last 500",
                "distance a step, last 500, m",
            ),
            lines,
        ),
        "",
        "Medians over seeds with quartiles.",
    ]


def draw(found: Found, file: Path) -> None:
    """Draw both quantities over the steps, a curve a learner, a column a set of numbers."""
    figure, axes = canvas(len(QUANTITIES), len(NUMBERS), width=12.0, height=2.9)
    for down, (name, label) in enumerate(QUANTITIES.items()):
        for across, own in enumerate(NUMBERS):
            axis = axes[down, across]
            for n, learner in enumerate(LEARNERS):
                curve = found["curves"]["/".join((learner, own, name))]
                colour = plots.COLOURS[n]
                axis.fill_between(
                    curve["steps"], curve["low"], curve["high"], color=colour, alpha=0.2, lw=0
                )
                axis.plot(curve["steps"], curve["median"], color=colour, label=learner)
            axis.set_ylabel(label)
            if down == 0:
                axis.set_title(f"numbers of {own}", loc="left", color=INK)
            else:
                axis.set_xlabel("step")
    axes[0, 0].legend(frameon=False)
    save(figure, file)


STUDY = Study(
    "seam",
    "Another learner in the same leg",
    "has Q-learning; any learner of action values could stand in its place.",
    arms,
    text,
    draw,
    curves=curves,
    claims=claims,
)
