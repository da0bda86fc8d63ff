"""Figure 5: one leg learns on the trainer, with a fixed or a modulated stop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ember_ros.experiments import reporting, stats
from ember_ros.experiments.reporting import Claim, Results
from ember_ros.experiments.study import LEARNERS, Arm, Size, Study, learner_params
from ember_ros.experiments.trial import WINDOW, Outcome, Trial
from ember_ros.params import Params
from ember_ros.report.figures import AMBER, BLUE, INK, canvas, save

STOPS = ("fixed", "modulated")
ENDS = ("first", "last")
BINS = 120
"""Points of a curve."""
MEAN_WINDOW = 200
"""Steps in the moving mean from which the settling step is computed."""
SETTLED = 0.9
"""Share of the total change of the moving mean at which a curve counts as settled."""
MAX_VARIATION, MIN_SHARE = 0.15, 0.8
"""Our target for even steps: the coefficient of variation of their distance is at most the first,
in at least the second share of the trainings."""
VARIATIONS: dict[str, dict[str, Any]] = {
    "stop at 0.42 m": {"trainer__stop_height": 0.42},
    "1 % random in the end": {"train__epsilon_end": 0.01},
    "gamma 0.9": {"train__gamma": 0.9},
    "lead 0": {"reward__lead": 0},
}
"""Training parameters of `ember` set back to an earlier value, or to the paper's: one at a time,
and the first three together."""
COMBINED = "stop, randomness and gamma as before"
VARIATIONS[COMBINED] = {k: v for name in list(VARIATIONS)[:3] for k, v in VARIATIONS[name].items()}
QUANTITIES = {"distance_m": "distance per step, m", "peak_force_n": "peak force per step, N"}


def stop_arm(learner: str, stop: str, seeds: range, train: int) -> Arm:
    """Return trainings of ``train`` cycles with a ``fixed`` or ``modulated`` stop."""
    return Arm(
        {"learner": learner, "height": stop},
        [Trial("trainer", train, seed, stop_params(learner, stop)) for seed in seeds],
    )


def stop_params(learner: str, stop: str) -> Params:
    """Return the parameters of a trainer whose stop is ``fixed`` or ``modulated``."""
    return learner_params(learner, "modulated" if stop == "modulated" else "reference")


def arms(size: Size) -> list[Arm]:
    """Return trainings of both learners with both stops, and of the variations of ``ember``."""
    seeds = range(size.seeds)
    by_stop = [stop_arm(lr, stop, seeds, size.train) for lr in LEARNERS for stop in STOPS]
    return by_stop + [
        Arm(
            {"learner": variation_label(name), "height": "fixed"},
            [
                Trial("trainer", size.train, seed, learner_params("ember", **changes))
                for seed in seeds
            ],
        )
        for name, changes in VARIATIONS.items()
    ]


def variation_label(name: str) -> str:
    """Return the learner's label in the arm of one of the ``VARIATIONS``."""
    return f"ember, {name}"


def stop_note() -> str:
    """Return a note for pages on how the two stops differ."""
    fixed, modulated = (stop_params("ember", stop).trainer.stop_height for stop in STOPS)
    return (
        f"The modulated stop is also higher on average ({modulated} m instead of {fixed} m, "
        "`config/modulated.yaml`), because the range that the paper gives for it requires this. "
        "So two ways of training are compared, not modulation alone. The effect of the height of "
        "the stop alone is shown in the section on sensitivity."
    )


def settling_step(values: NDArray[np.float64]) -> int:
    """Return the step at which a curve has settled.

    Args:
        values: one value per step, ``(steps,)``.

    Returns:
        The first step at which the moving mean has made ``SETTLED`` of its total change.
    """
    window = max(1, min(MEAN_WINDOW, len(values) // 5))
    mean = np.convolve(values, np.ones(window) / window, mode="valid")
    change = mean[-1] - mean[0]
    if change == 0.0:
        return window
    return int(np.argmax((mean - mean[0]) / change >= SETTLED)) + window


def evenness(distances: NDArray[np.float64]) -> dict[str, float]:
    """Return statistics of how even steps are.

    Args:
        distances: the distance of each step, m, ``(steps,)``.

    Returns:
        ``sd``: standard deviation, m; ``share``: coefficient of variation (SD divided by mean),
        infinite if the mean is not positive; ``lag``: correlation of a step with the next one,
        negative if short and long steps alternate.
    """
    sd, mean = float(distances.std()), float(distances.mean())
    lag = 0.0
    if len(distances) > 2 and sd > 0.0:
        lag = float(np.corrcoef(distances[:-1], distances[1:])[0, 1])
    return {"sd": sd, "share": sd / mean if mean > 0.0 else float("inf"), "lag": lag}


def curves(outcomes_by_arm: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return learning curves, settling steps and evenness of each arm, by name."""
    by_name: dict[str, Any] = {}
    for arm, outcomes in outcomes_by_arm:
        for name in QUANTITIES:
            values = np.array([outcome.cycles[name] for outcome in outcomes])
            by_name["/".join((*arm.labels.values(), name))] = {
                **stats.quartile_curve(values, BINS),
                "settles": [settling_step(each) for each in values],
                "first": values[:, :MEAN_WINDOW].mean(axis=1).round(5).tolist(),
                "last": values[:, -MEAN_WINDOW:].mean(axis=1).round(5).tolist(),
            }
        distances = [outcome.cycles["distance_m"] for outcome in outcomes]
        for end, window in (("first", slice(None, WINDOW)), ("last", slice(-WINDOW, None))):
            even = [evenness(each[window]) for each in distances]
            by_name["/".join((*arm.labels.values(), f"even_{end}"))] = {
                name: [round(one[name], 4) if np.isfinite(one[name]) else None for one in even]
                for name in even[0]
            }
        early = [float(outcome.footfall[-1]) for outcome in outcomes]
        by_name["/".join((*arm.labels.values(), "down_early"))] = [round(x, 4) for x in early]
    return by_name


def _percentages(values: list[float | None]) -> str:
    """Return shares as text, one per seed; ``-`` for None, where the mean is not positive."""
    return ", ".join("-" if value is None else f"{value:.0%}" for value in values)


def claims(results: Results) -> list[Claim]:
    """Test whether the leg learns, and what effect the modulation of the stop has."""
    all_claims = []
    for learner in LEARNERS:
        for stop in STOPS:
            scope = f"`{learner}`, {stop} stop"
            for statement, name, form, unit, sign in (
                ("the distance per step increases", "distance_m", ".3f", "m", 1),
                ("the peak force per step decreases", "peak_force_n", ".0f", "N", -1),
            ):
                curve = results["curves"][f"{learner}/{stop}/{name}"]
                change = stats.difference(curve["last"], curve["first"])
                all_claims.append(
                    Claim(
                        statement,
                        scope,
                        f"{reporting.with_interval(change, form)} {unit} "
                        f"(last {MEAN_WINDOW} steps - first {MEAN_WINDOW})",
                        stats.verdict(change, claimed=sign),
                    )
                )
            first, last = (results["curves"][f"{learner}/{stop}/even_{end}"] for end in ENDS)
            change = stats.difference(last["sd"], first["sd"])
            even = _count_even(last["share"])
            n = len(last["sd"])
            all_claims += [
                Claim(
                    "steps become more even: the SD of their distance decreases",
                    scope,
                    f"{reporting.with_interval(change)} m (last {WINDOW} steps - first {WINDOW})",
                    stats.verdict(change, claimed=-1),
                ),
                Claim(
                    f"our target: over the last {WINDOW} steps the SD is at most "
                    f"{MAX_VARIATION:.0%} of the mean, in at least {MIN_SHARE:.0%} of the "
                    "trainings",
                    scope,
                    f"{even} of {n}; SD / mean of each seed: {_percentages(last['share'])}",
                    reporting.target_verdict(even >= MIN_SHARE * n, last["sd"]),
                ),
            ]
        settled = [results["curves"][f"{learner}/{s}/distance_m"]["settles"] for s in STOPS]
        slower = stats.difference(settled[1], settled[0])
        fixed, modulated = (reporting.runs_of(results, learner=learner, height=s) for s in STOPS)
        shorter = reporting.paired_difference(modulated, fixed, "distance_last_m")
        all_claims += [
            Claim(
                "with the modulated (and higher) stop learning is slower",
                f"`{learner}`",
                f"{reporting.with_interval(slower, '.0f')} steps until the distance has settled "
                "(modulated - fixed)",
                stats.verdict(slower, claimed=1),
            ),
            Claim(
                "with the modulated (and higher) stop steps are shorter at the end",
                f"`{learner}`",
                f"{reporting.with_interval(shorter)} m in the last {WINDOW} steps "
                "(modulated - fixed)",
                stats.verdict(shorter, claimed=-1),
            ),
        ]
    return all_claims


def _count_even(variations: list[float | None]) -> int:
    """Return how many coefficients of variation are at most ``MAX_VARIATION``."""
    return sum(value is not None and value <= MAX_VARIATION for value in variations)


def text(results: Results) -> list[str]:
    """Return the tables and their explanation."""
    rows, even_rows = [], []
    for learner in LEARNERS:
        for stop in STOPS:
            first, last = (results["curves"][f"{learner}/{stop}/even_{end}"] for end in ENDS)
            even_rows.append(
                (
                    learner,
                    stop,
                    reporting.with_quartiles(first["sd"]),
                    reporting.with_quartiles(last["sd"]),
                    _percentages(last["share"]),
                    reporting.with_quartiles(first["lag"], ".2f"),
                    reporting.with_quartiles(last["lag"], ".2f"),
                )
            )
            runs = reporting.runs_of(results, learner=learner, height=stop)
            settled = {
                name: results["curves"][f"{learner}/{stop}/{name}"]["settles"]
                for name in QUANTITIES
            }
            rows.append(
                (
                    learner,
                    stop,
                    reporting.with_quartiles(reporting.column(runs, "distance_last_m")),
                    reporting.with_quartiles(settled["distance_m"], ".0f"),
                    reporting.with_quartiles(reporting.column(runs, "peak_force_n"), ".0f"),
                    reporting.with_quartiles(settled["peak_force_n"], ".0f"),
                )
            )
    train = learner_params().train
    return [
        *reporting.markdown_table(
            (
                "learner",
                "stop",
                "distance per step at the end, m",
                "distance settles at step",
                "peak force at the end, N",
                "peak force settles at step",
            ),
            rows,
        ),
        "",
        f"Medians over seeds, quartiles in brackets. *At the end*: mean over the last {WINDOW} "
        f"steps. *Settles*: the first step at which the moving mean over {MEAN_WINDOW} steps has "
        f"made {SETTLED:.0%} of its total change. `ember` starts with {train.epsilon_start:.0%} "
        f"random actions and reduces their share over the first {train.epsilon_cycles} steps, so "
        "this schedule mainly determines when its curves settle.",
        "",
        "How even the steps are: standard deviation of the distance per step, and correlation of "
        f"the distance of a step with that of the next one, over the first and the last {WINDOW} "
        "steps:",
        "",
        *reporting.markdown_table(
            (
                "learner",
                "stop",
                "SD, first, m",
                "SD, last, m",
                "SD / mean of each seed, last",
                "correlation, first",
                "correlation, last",
            ),
            even_rows,
        ),
        "",
        stop_note(),
        "",
        *_variations(results),
    ]


def _variations(results: Results) -> list[str]:
    """Return the table of how even the steps are with each of the ``VARIATIONS``."""
    rows = []
    for learner in ("ember", *map(variation_label, VARIATIONS)):
        last = results["curves"][f"{learner}/fixed/even_last"]
        runs = reporting.runs_of(results, learner=learner, height="fixed")
        early = [100.0 * x for x in results["curves"][f"{learner}/fixed/down_early"]]
        rows.append(
            (
                learner,
                f"{_count_even(last['share'])} of {len(runs)}",
                _percentages(last["share"]),
                reporting.with_quartiles(reporting.column(runs, "distance_last_m")),
                reporting.with_quartiles(early, ".1f"),
            )
        )
    return [
        "Effect of the training parameters: `ember` as it is, and with some of its training "
        "parameters set back to an earlier value or to the value of the paper. The last column is "
        "the share of steps in which the foot is on the ground in the last tick of swing. "
        "`reward.lead` permits this; it brakes the bar, because the hip still swings forward:",
        "",
        *reporting.markdown_table(
            (
                "learner, fixed stop",
                f"trainings with SD / mean of at most {MAX_VARIATION:.0%}",
                "SD / mean of each seed, last",
                "distance per step at the end, m",
                "foot on the ground in the last tick of swing, % of all steps",
            ),
            rows,
        ),
    ]


def draw(results: Results, file: Path) -> None:
    """Draw the learning curves: a row per quantity, a column per stop."""
    figure, axes = canvas(2, 2, height=3.2)
    for column, stop in enumerate(STOPS):
        for row, (name, label) in enumerate(QUANTITIES.items()):
            axis = axes[row, column]
            for learner, colour in zip(LEARNERS, (AMBER, BLUE), strict=True):
                curve = results["curves"][f"{learner}/{stop}/{name}"]
                axis.fill_between(
                    curve["steps"], curve["low"], curve["high"], color=colour, alpha=0.25, lw=0
                )
                axis.plot(curve["steps"], curve["median"], color=colour, lw=1.6, label=learner)
            axis.sharey(axes[row, 0])
            axis.set_ylabel(label)
        axes[0, column].set_title(f"{stop.capitalize()} stop", loc="left", color=INK)
        axes[1, column].set_xlabel("steps")
    axes[0, 0].legend(frameon=False)
    save(figure, file)


STUDY = Study(
    "fig5",
    "Figure 5: one leg on the trainer",
    "in 6000 steps the distance per step increases and becomes more even, and the peak force "
    "decreases; with a modulated support height (by up to 10 %) learning is a little slower and "
    "the average step after learning is shorter.",
    arms,
    text,
    draw,
    curves,
    claims,
)
