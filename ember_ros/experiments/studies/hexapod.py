"""Six legs: tables of one leg from the trainer, used on a body with six legs."""

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
    learner_params,
    trained_arm,
)

BODY = "hexapod"
MAX_SEEDS = 5


def arms(size: Size) -> list[Arm]:
    """Return walkers with a trained table of each learner, and the baselines."""
    limited = size._replace(seeds=min(MAX_SEEDS, size.seeds))
    trained = [trained_arm(BODY, learner, limited) for learner in LEARNERS]
    return [*trained, *baseline_arms(BODY, limited)]


def claims(results: Results) -> list[Claim]:
    """Test whether walkers with a trained table walk further and fall less than the baselines."""
    all_claims = []
    for learner in LEARNERS:
        trained = reporting.runs_of(results, walker="trained table", learner=learner)
        for baseline, labels in (
            ("an empty table", {"walker": "empty table", "learner": learner}),
            ("a random knee", {"walker": "random knee"}),
        ):
            runs = reporting.runs_of(results, **labels)
            for statement, name, form, unit, sign in (
                ("fewer falls", reporting.FALL_RATE, ".1f", "falls per 1000", -1),
                ("longer distances", "distance_m", ".3f", "m per step", 1),
            ):
                difference = reporting.paired_difference(trained, runs, name)
                all_claims.append(
                    Claim(
                        f"six legs: {statement} with a trained table than with {baseline}",
                        f"`{learner}`",
                        f"{reporting.with_interval(difference, form)} {unit} (trained - baseline)",
                        stats.verdict(difference, claimed=sign),
                    )
                )
    return all_claims


def text(results: Results) -> list[str]:
    """Return the table of walkers and the description of the body."""
    six, four = learner_params(body=BODY), learner_params()
    tripods = [
        ", ".join(
            leg
            for leg, leg_offset in zip(six.robot.legs, six.robot.offset, strict=True)
            if leg_offset == offset
        )
        for offset in sorted(set(six.robot.offset))
    ]
    trained = reporting.runs_of(results, walker="trained table", learner="ember")
    scripted = reporting.runs_of(results, walker="scripted knee")[0]["distance_m"]
    share = sum(reporting.column(trained, "distance_m")) / len(trained) / scripted
    return [
        f"The body has {len(six.robot.segments)} segments with a total length of "
        f"{six.walker.length} m and a mass of {six.walker.mass} kg (body with four legs: "
        f"{four.walker.length} m, {four.walker.mass} kg). It has {len(six.robot.legs)} legs of the "
        f"same kind, in an alternating tripod gait: {' against '.join(tripods)}. It is a parameter "
        "file: `ember walk --params hexapod --table trained`. The training does not depend on the "
        "body: the tables are from the same trainings as those of the walkers with four legs.",
        "",
        f"With the table of `ember`, the distance is {share:.0%} of that of the scripted knee.",
        "",
        *reporting.walker_table(results["arms"]),
        "",
        reporting.WALKER_TABLE_NOTE,
    ]


def draw(results: Results, file: Path) -> None:
    """Draw falls and distance of every walker."""
    kinds = {
        **{
            f"trained, {learner}": {"walker": "trained table", "learner": learner}
            for learner in LEARNERS
        },
        **{
            f"empty, {learner}": {"walker": "empty table", "learner": learner}
            for learner in LEARNERS
        },
        "random knee": {"walker": "random knee"},
        "scripted knee": {"walker": "scripted knee"},
    }
    groups = {BODY: {"body": BODY}}
    plots.draw_groups(file, plots.fall_rates_and_distances(results, kinds, groups))


STUDY = Study(
    BODY,
    "Six legs: the same leg on a body of another kind",
    "trains one leg and uses four copies of it on a body; it motivates modules by the fact that "
    "they can be combined in other ways (section I).",
    arms,
    text,
    draw,
    claims=claims,
)
