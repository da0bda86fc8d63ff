"""Figure 5: one leg learns on the trainer, the stop fixed or modulated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ember_ros.experiments import stats, words
from ember_ros.experiments.study import LEARNERS, Arm, Size, Study, numbers
from ember_ros.experiments.trial import WINDOW, Outcome, Trial
from ember_ros.experiments.words import Claim, Found
from ember_ros.report.figures import AMBER, BLUE, INK, canvas, save

HEIGHTS = ("fixed", "modulated")
ENDS = ("first", "last")
BINS = 120
"""Points of a curve."""
MEAN = 200
"""Steps that are averaged where it is asked when a curve settles."""
SETTLED = 0.9
"""A curve has settled where it has gone this share of its way, from its first mean to its last."""
EVEN, MOSTLY = 0.15, 0.8
"""Steps are even where their standard deviation is at most this share of their mean; asked of this
share of the seeds."""
BACK: dict[str, dict[str, Any]] = {
    "stop at 0.42 m": {"trainer__stop_height": 0.42},
    "1 % random in the end": {"train__epsilon_end": 0.01},
    "gamma 0.9": {"train__gamma": 0.9},
    "lead 0": {"reward__lead": 0},
}
"""Numbers of `ember`'s training as they were before it was made even, or as the paper has them:
each alone, and all that were changed together."""
BEFORE = "stop, randomness and gamma as before"
BACK[BEFORE] = {k: v for name in list(BACK)[:3] for k, v in BACK[name].items()}
QUANTITIES = {"distance_m": "distance a step, m", "peak_force_n": "peak force a step, N"}


def height_arm(learner: str, height: str, seeds: range, train: int) -> Arm:
    """Return legs that are trained in one way."""
    return Arm(
        {"learner": learner, "height": height},
        [Trial("trainer", train, seed, with_height(learner, height)) for seed in seeds],
    )


def with_height(learner: str, height: str) -> Any:
    """Return the parameters of a trainer whose stop is ``fixed`` or ``modulated``."""
    return numbers(learner, "modulated" if height == "modulated" else "reference")


def arms(size: Size) -> list[Arm]:
    """Return all ways of training."""
    seeds = range(size.seeds)
    ways = [height_arm(lr, height, seeds, size.train) for lr in LEARNERS for height in HEIGHTS]
    return ways + [
        Arm(
            {"learner": back(name), "height": "fixed"},
            [Trial("trainer", size.train, seed, numbers("ember", **other)) for seed in seeds],
        )
        for name, other in BACK.items()
    ]


def back(name: str) -> str:
    """Return the learner of an arm whose training has numbers of ``BACK``."""
    return f"ember, {name}"


def about_stops() -> str:
    """Return what is to be known of the two stops."""
    fixed, modulated = (with_height("ember", height).trainer.stop_height for height in HEIGHTS)
    return (
        f"The modulated stop is also higher on average ({modulated} m instead of {fixed} m, "
        "`config/modulated.yaml`), as the paper's range for it asks: what is compared are two ways "
        "of training, not the modulation alone. What the stop's height alone does is told under "
        "sensitivity."
    )


def settles(values: NDArray[np.float64]) -> int:
    """Return the step at which the moving mean has first gone ``SETTLED`` of its way."""
    window = max(1, min(MEAN, len(values) // 5))
    mean = np.convolve(values, np.ones(window) / window, mode="valid")
    way = mean[-1] - mean[0]
    if way == 0.0:
        return window
    return int(np.argmax((mean - mean[0]) / way >= SETTLED)) + window


def evenness(way: NDArray[np.float64]) -> dict[str, float]:
    """Return how even steps are.

    Args:
        way: the distance of each step, m.

    Returns:
        Their standard deviation, that by their mean, and the correlation of a step with the next
        one, which is negative where short and long ones alternate.
    """
    spread, mean = float(way.std()), float(way.mean())
    lag = float(np.corrcoef(way[:-1], way[1:])[0, 1]) if len(way) > 2 and spread > 0.0 else 0.0
    return {"sd": spread, "share": spread / mean if mean > 0.0 else float("inf"), "lag": lag}


def curves(known: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return, for each arm, median and quartiles of each quantity, and when each seed settles."""
    found: dict[str, Any] = {}
    for arm, outcomes in known:
        for name in QUANTITIES:
            each = np.array([outcome.cycles[name] for outcome in outcomes])
            found["/".join((*arm.labels.values(), name))] = {
                **stats.quartile_curve(each, BINS),
                "settles": [settles(values) for values in each],
                "first": each[:, :MEAN].mean(axis=1).round(5).tolist(),
                "last": each[:, -MEAN:].mean(axis=1).round(5).tolist(),
            }
        ways = [outcome.cycles["distance_m"] for outcome in outcomes]
        for end, window in (("first", slice(None, WINDOW)), ("last", slice(-WINDOW, None))):
            even = [evenness(way[window]) for way in ways]
            found["/".join((*arm.labels.values(), f"even_{end}"))] = {
                name: [round(one[name], 4) if np.isfinite(one[name]) else None for one in even]
                for name in even[0]
            }
        early = [float(outcome.footfall[-1]) for outcome in outcomes]
        found["/".join((*arm.labels.values(), "down_early"))] = [round(each, 4) for each in early]
    return found


def _shares(values: list[float | None]) -> str:
    """Return shares of the mean, seed by seed; of a mean that is no way forward there is none."""
    return ", ".join("-" if value is None else f"{value:.0%}" for value in values)


def claims(found: Found) -> list[Claim]:
    """Say whether the leg learns, and what modulation does to it."""
    lines = []
    for learner in LEARNERS:
        for height in HEIGHTS:
            for says, name, form, unit, sign in (
                ("the distance a step rises", "distance_m", ".3f", "m", 1),
                ("the peak force a step falls", "peak_force_n", ".0f", "N", -1),
            ):
                curve = found["curves"][f"{learner}/{height}/{name}"]
                change = stats.difference(curve["last"], curve["first"])
                told = f"{words.told(change, form)} {unit} from the first {MEAN} steps to the last"
                word = stats.verdict(change, claimed=sign)
                lines.append(Claim(says, f"`{learner}`, {height} stop", told, word))
            first, last = (found["curves"][f"{learner}/{height}/even_{e}"] for e in ENDS)
            change = stats.difference(last["sd"], first["sd"])
            even = sum(share is not None and share <= EVEN for share in last["share"])
            where, n = f"`{learner}`, {height} stop", len(last["sd"])
            lines += [
                Claim(
                    "steps even out: the SD of the distance falls",
                    where,
                    f"{words.told(change)} m from the first {WINDOW} steps to the last",
                    stats.verdict(change, claimed=-1),
                ),
                Claim(
                    f"our target: an SD of at most {EVEN:.0%} of the mean over the last {WINDOW} "
                    f"steps in at least {MOSTLY:.0%} of the trainings",
                    where,
                    f"{even} of {n}; {_shares(last['share'])} of the mean",
                    words.bar(even >= MOSTLY * n, last["sd"]),
                ),
            ]
        settled = [found["curves"][f"{learner}/{h}/distance_m"]["settles"] for h in HEIGHTS]
        slower = stats.difference(settled[1], settled[0])
        fixed, modulated = (words.runs_of(found, learner=learner, height=h) for h in HEIGHTS)
        shorter = words.more(modulated, fixed, "distance_last_m")
        lines += [
            Claim(
                "with the modulated (and higher) stop learning is slower",
                f"`{learner}`",
                f"the distance settles {words.told(slower, '.0f')} steps later",
                stats.verdict(slower, claimed=1),
            ),
            Claim(
                "with the modulated (and higher) stop steps end shorter",
                f"`{learner}`",
                f"{words.told(shorter)} m over the last {WINDOW} steps",
                stats.verdict(shorter, claimed=-1),
            ),
        ]
    return lines


def text(found: Found) -> list[str]:
    """Say what came of it."""
    lines, even = [], []
    for learner in LEARNERS:
        for height in HEIGHTS:
            first, last = (found["curves"][f"{learner}/{height}/even_{e}"] for e in ENDS)
            even.append(
                (
                    learner,
                    height,
                    words.spread(first["sd"]),
                    words.spread(last["sd"]),
                    _shares(last["share"]),
                    words.spread(first["lag"], ".2f"),
                    words.spread(last["lag"], ".2f"),
                )
            )
            runs = words.runs_of(found, learner=learner, height=height)
            curve = {n: found["curves"][f"{learner}/{height}/{n}"] for n in QUANTITIES}
            lines.append(
                (
                    learner,
                    height,
                    words.spread(words.column(runs, "distance_last_m")),
                    words.spread(curve["distance_m"]["settles"], ".0f"),
                    words.spread(words.column(runs, "peak_force_n"), ".0f"),
                    words.spread(curve["peak_force_n"]["settles"], ".0f"),
                )
            )
    heads = ["learner", "stop"]
    for what in ("distance a step at the end, m", "peak force at the end, N"):
        heads += [what, "settles at step"]
    return [
        *words.grid(heads, lines),
        "",
        "How even the steps are: the standard deviation of the distance, m, and the correlation of "
        f"a step with the next, over the first {WINDOW} steps and the last:",
        "",
        *words.grid(
            (
                "learner",
                "stop",
                "SD, first",
                "SD, last",
                "SD by mean, last, seed by seed",
                "next step, first",
                "next step, last",
            ),
            even,
        ),
        "",
        f"Medians over seeds with quartiles; at the end: the last {WINDOW} steps. A curve "
        f"settles where its mean over {MEAN} steps has first gone {SETTLED:.0%} of its way. "
        f"`ember` begins with {numbers().train.epsilon_start:.0%} random actions, and their share "
        f"falls over the first {numbers().train.epsilon_cycles} steps: where its curves settle is "
        "a matter of that.",
        "",
        about_stops(),
        "",
        *_causes(found),
    ]


def _causes(found: Found) -> list[str]:
    """Say how even steps are by `ember`, and with numbers of its training taken back."""
    lines = []
    for learner in ("ember", *map(back, BACK)):
        last = found["curves"][f"{learner}/fixed/even_last"]
        runs = words.runs_of(found, learner=learner, height="fixed")
        even = sum(share is not None and share <= EVEN for share in last["share"])
        lines.append(
            (
                learner,
                f"{even} of {len(runs)}",
                _shares(last["share"]),
                words.spread(words.column(runs, "distance_last_m")),
                words.spread(
                    [100.0 * x for x in found["curves"][f"{learner}/fixed/down_early"]], ".1f"
                ),
            )
        )
    most = f"at most {EVEN:.0%} of the mean"
    return [
        "What the numbers do: `ember` as it is, and with numbers of its training as they were "
        "before, or as the paper has them. The last column tells how often the foot is down while "
        "the hip still swings forward, as `reward.lead` allows it, which brakes the bar:",
        "",
        *words.grid(
            (
                "learner, fixed stop",
                f"even: SD {most}",
                "SD by mean, last, seed by seed",
                "distance a step at the end, m",
                "foot down in the last tick of swing, % of all steps, first ones included",
            ),
            lines,
        ),
    ]


def draw(found: Found, file: Path) -> None:
    """Draw both quantities against steps, a column a way of training the stop."""
    figure, axes = canvas(2, 2, height=3.2)
    for across, height in enumerate(HEIGHTS):
        for down, (name, label) in enumerate(QUANTITIES.items()):
            axis = axes[down, across]
            for learner, colour in zip(LEARNERS, (AMBER, BLUE), strict=True):
                curve = found["curves"][f"{learner}/{height}/{name}"]
                axis.fill_between(
                    curve["steps"], curve["low"], curve["high"], color=colour, alpha=0.25, lw=0
                )
                axis.plot(curve["steps"], curve["median"], color=colour, lw=1.6, label=learner)
            axis.sharey(axes[down, 0])
            axis.set_ylabel(label)
        axes[0, across].set_title(f"The stop is {height}", loc="left", color=INK)
        axes[1, across].set_xlabel("steps")
    axes[0, 0].legend(frameon=False)
    save(figure, file)


STUDY = Study(
    "fig5",
    "Figure 5: one leg on the trainer",
    "in 6000 steps the distance a step rises and evens out and the peak force falls; with the "
    "support height modulated (by up to 10 %) learning is a little slower and the average step "
    "after learning not so long.",
    arms,
    text,
    draw,
    curves,
    claims,
)
