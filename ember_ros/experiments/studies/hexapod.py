"""Six legs: what one leg was taught on the trainer carries a body that the paper never had."""

from __future__ import annotations

from pathlib import Path

from ember_ros.experiments import plots, stats, words
from ember_ros.experiments.study import (
    LEARNERS,
    Arm,
    Size,
    Study,
    company,
    numbers,
    trained_arm,
)
from ember_ros.experiments.words import Claim, Found

BODY = "hexapod"
SEEDS = 5


def arms(size: Size) -> list[Arm]:
    """Return walkers with a table of each learner, and who walks beside them."""
    own = size._replace(seeds=min(SEEDS, size.seeds))
    return [*(trained_arm(BODY, learner, own) for learner in LEARNERS), *company(BODY, own)]


def claims(found: Found) -> list[Claim]:
    """Say whether a trained table walks further and falls less than others."""
    lines = []
    for learner in LEARNERS:
        trained = words.runs_of(found, walker="trained table", learner=learner)
        for than, labels in (
            ("an empty one", {"walker": "empty table", "learner": learner}),
            ("a random knee", {"walker": "random knee"}),
        ):
            other = words.runs_of(found, **labels)
            for says, name, form, unit, sign in (
                ("falls less", words.FALL_RATE, ".1f", "falls per 1000", -1),
                ("walks further", "distance_m", ".3f", "m a step", 1),
            ):
                more = words.more(trained, other, name)
                told = f"{words.told(more, form)} {unit} if trained"
                word = stats.verdict(more, claimed=sign)
                lines.append(
                    Claim(f"six legs: a trained table {says} than {than}", learner, told, word)
                )
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    own, four = numbers(body=BODY), numbers()
    tripods = [
        ", ".join(
            leg
            for leg, each in zip(own.robot.legs, own.robot.offset, strict=True)
            if each == offset
        )
        for offset in sorted(set(own.robot.offset))
    ]
    trained = words.runs_of(found, walker="trained table", learner="ember")
    scripted = words.runs_of(found, walker="scripted knee")[0]["distance_m"]
    share = sum(words.column(trained, "distance_m")) / len(trained) / scripted
    return [
        f"The body has {len(own.robot.segments)} segments of {own.walker.length} m together and "
        f"{own.walker.mass} kg (four legs: {four.walker.length} m, {four.walker.mass} kg), and "
        f"{len(own.robot.legs)} of the same legs in an alternating tripod: "
        f"{' against '.join(tripods)}. "
        "It is a parameter file, `ember walk --params hexapod --table trained`; the legs' training "
        "knows nothing of it: a trial of the training is the same one that walks on four legs.",
        "",
        f"With the table of `ember` it goes {share:.0%} of the scripted knee's distance.",
        "",
        *words.walkers(found["arms"]),
        "",
        words.WALKERS_NOTE,
    ]


def draw(found: Found, file: Path) -> None:
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
    plots.bodies(file, plots.fall_rates_and(found, kinds, {BODY: {"body": BODY}}))


STUDY = Study(
    BODY,
    "Six legs: the same leg on a body of another kind",
    "trains one leg and puts four of it on a body; that modules can be put together in other ways "
    "is its reason to have them (section I).",
    arms,
    text,
    draw,
    claims=claims,
)
