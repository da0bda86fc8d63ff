"""Another learner in the same leg: SARSA(lambda) compared with Q-learning on the trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ember_ros.experiments import plots, reporting, stats
from ember_ros.experiments.reporting import Claim, Results
from ember_ros.experiments.study import Arm, Size, Study, learner_params, training_trial
from ember_ros.experiments.trial import WINDOW, Outcome
from ember_ros.report.figures import INK, canvas, save
from leg_node import sarsa

LEARNERS = {
    "Q-learning": "leg_node.learner.QLearning",
    "SARSA(lambda)": "leg_node.sarsa.SarsaLambda",
}
"""Name of a learner, and its ``parts.learner``."""
PARAMETER_SETS = ("plain", "ember")
"""The learning parameters that both learners are tested with."""
QUANTITIES = {"reward": "mean reward", "distance_m": "distance per step, m"}
BINS = 60
"""Points of a curve."""


def arms(size: Size) -> list[Arm]:
    """Return trainings of both learners, each with the parameters of ``plain`` and ``ember``."""
    return [
        Arm(
            {"learner": name, "numbers": parameters},
            [
                training_trial(parameters, size, seed, parts__learner=path)
                for seed in range(size.seeds)
            ],
        )
        for parameters in PARAMETER_SETS
        for name, path in LEARNERS.items()
    ]


def curves(outcomes_by_arm: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return the quartiles of each quantity over seeds, in bins of cycles."""
    by_name: dict[str, Any] = {}
    for arm, outcomes in outcomes_by_arm:
        for name in QUANTITIES:
            values = np.array([outcome.cycles[name] for outcome in outcomes])
            by_name["/".join((*arm.labels.values(), name))] = stats.quartile_curve(values, BINS)
    return by_name


def claims(results: Results) -> list[Claim]:
    """Test which learner gets more reward and longer steps at the end of the training."""
    all_claims = []
    for parameters in PARAMETER_SETS:
        q_learning, sarsa_lambda = (
            reporting.runs_of(results, learner=name, numbers=parameters) for name in LEARNERS
        )
        for statement, name, unit in (
            ("gets more reward", "reward_last", "reward per tick"),
            ("makes longer steps", "distance_last_m", "m per step"),
        ):
            difference = reporting.paired_difference(sarsa_lambda, q_learning, name)
            all_claims.append(
                Claim(
                    f"SARSA(lambda) {statement} than Q-learning in the last {WINDOW} steps",
                    f"parameters of `{parameters}`",
                    f"{reporting.with_interval(difference)} {unit} (SARSA - Q-learning)",
                    stats.verdict(difference, claimed=1),
                )
            )
    return all_claims


def text(results: Results) -> list[str]:
    """Return the table and its explanation."""
    rows = []
    for arm in results["arms"]:
        runs, labels = arm["runs"], arm["labels"]
        rows.append(
            (
                labels["numbers"],
                labels["learner"],
                str(len(runs)),
                reporting.with_quartiles(reporting.column(runs, "reward")),
                reporting.with_quartiles(reporting.column(runs, "reward_last")),
                reporting.with_quartiles(reporting.column(runs, "distance_last_m")),
            )
        )
    gamma = learner_params().train.gamma
    return [
        "The learner is a part that a parameter names: `ember train --set "
        "parts.learner=leg_node.sarsa.SarsaLambda`. It receives transitions and returns targets; "
        "table, sharing, recording and replay are the same for every learner. The example is "
        f"`leg_node/sarsa.py`: the forward view with lambda = {sarsa.LAMBDA}, truncated after "
        f"{sarsa.HORIZON} ticks. Its parameters were not tuned: discount ({gamma}), learning rates "
        "and exploration are those of Q-learning.",
        "",
        *reporting.markdown_table(
            (
                "learning parameters",
                "learner",
                "trainings",
                "reward per tick, all steps",
                f"reward per tick, last {WINDOW} steps",
                f"distance per step, last {WINDOW} steps, m",
            ),
            rows,
        ),
        "",
        "Medians over seeds, quartiles in brackets.",
    ]


def draw(results: Results, file: Path) -> None:
    """Draw the learning curves: a row per quantity, a column per set of learning parameters."""
    figure, axes = canvas(len(QUANTITIES), len(PARAMETER_SETS), width=12.0, height=2.9)
    for row, (name, label) in enumerate(QUANTITIES.items()):
        for column, parameters in enumerate(PARAMETER_SETS):
            axis = axes[row, column]
            for n, learner in enumerate(LEARNERS):
                curve = results["curves"]["/".join((learner, parameters, name))]
                colour = plots.COLOURS[n]
                axis.fill_between(
                    curve["steps"], curve["low"], curve["high"], color=colour, alpha=0.2, lw=0
                )
                axis.plot(curve["steps"], curve["median"], color=colour, label=learner)
            axis.set_ylabel(label)
            if row == 0:
                axis.set_title(f"parameters of {parameters}", loc="left", color=INK)
            else:
                axis.set_xlabel("step")
    axes[0, 0].legend(frameon=False)
    save(figure, file)


STUDY = Study(
    "seam",
    "Another learner in the same leg",
    "uses Q-learning; any learner of action values could replace it.",
    arms,
    text,
    draw,
    curves=curves,
    claims=claims,
)
