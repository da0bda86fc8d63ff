"""Figures 6 and 7, and steps to failure: four trained legs continue to learn on the body.

The command and the result files of this experiment are called ``walker``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ember_ros.experiments import reporting, stats
from ember_ros.experiments.reporting import Claim, Results
from ember_ros.experiments.study import (
    Arm,
    Size,
    Study,
    baseline_arms,
    training_trial,
    walking_trials,
)
from ember_ros.experiments.trial import SETTLING_CYCLES, WINDOW, Outcome
from ember_ros.report.figures import AMBER, BLUE, GREY, INK, canvas, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HELD_OUT = 100
"""The first held-out seed: from it on, no seed was used for tuning."""
GROUPS = (("ember", "tuned on"), ("ember", "held out"), ("plain", "tuned on"))
"""Learner and set of seeds, as in the labels of the arms."""
SEED_SETS = {"tuned on": "seeds used for tuning", "held out": "held-out seeds"}
"""How pages and figures call a set of seeds."""
CURVE_POINTS = 70
"""Points of a curve of standard deviations."""
TREND_DEGREE = 4
"""Degree of the polynomial trend, as in the paper."""
ANGLES = ("roll", "pitch")
MIN_NEVER_FELL, MAX_OUTSIDE, MIN_RELATIVE_DISTANCE, MIN_STEADIER = 0.9, 0.01, 0.75, 0.8
"""Our targets: share of walkers that never fall; share of steps outside the safe range; distance
relative to the scripted knee; share of walkers whose SD of an angle is lower at the end."""


def arms(size: Size) -> list[Arm]:
    """Return long walks with trained tables, and the baselines."""
    all_arms = []
    for learner, seed_set in GROUPS:
        first = HELD_OUT if seed_set == "held out" else 0
        seeds = range(first, first + size.seeds)
        starts = [training_trial(learner, size, seed) for seed in seeds]
        labels = {
            "body": "reference",
            "walker": "trained table, long",
            "learner": learner,
            "seeds": seed_set,
        }
        trials = walking_trials(learner, "reference", size.walk, seeds, starts)
        all_arms.append(Arm(labels, trials))
    return all_arms + baseline_arms("reference", size)


def curves(outcomes_by_arm: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return, for each long walk, SD curves, traces of the first seed, and survival curves."""
    by_name: dict[str, Any] = {}
    for arm, outcomes in outcomes_by_arm:
        if "seeds" not in arm.labels:
            continue
        name = f"{arm.labels['learner']}, {arm.labels['seeds']}"
        for angle in ANGLES:
            values = np.array([outcome.cycles[f"{angle}_sd_rad"] for outcome in outcomes])
            parts = np.array_split(values, min(CURVE_POINTS, values.shape[1]), axis=1)
            # The root mean square over the steps of the SD within each step.
            sd = np.stack([np.sqrt((part**2).mean(axis=1)) for part in parts], axis=1)
            steps = np.cumsum([part.shape[1] for part in parts])
            low, median, high = np.percentile(sd, (25, 50, 75), axis=0)
            degree = min(TREND_DEGREE, len(steps) - 1)
            x = steps / steps[-1]
            trend = np.polynomial.Polynomial.fit(x, median, degree)(x)
            by_name[f"{name}/{angle}"] = {
                "steps": steps.tolist(),
                "low": low.round(5).tolist(),
                "median": median.round(5).tolist(),
                "high": high.round(5).tolist(),
                "trend": trend.round(5).tolist(),
            }
        by_name[f"{name}/traces"] = outcomes[0].traces.round(4).tolist()
        by_name[f"{name}/survival"] = stats.survival(
            [outcome.measures["first_fall"] for outcome in outcomes],
            [outcome.measures["cycles"] for outcome in outcomes],
        )._asdict()
    return by_name


def claims(results: Results) -> list[Claim]:
    """Test whether learning in situ steadies the body, and whether our targets are reached."""
    all_claims: list[Claim] = []
    steadier_claims: list[Claim] = []
    for learner, seed_set in GROUPS:
        runs = reporting.runs_of(results, learner=learner, seeds=seed_set)
        scope = f"`{learner}`, {SEED_SETS[seed_set]}"
        for angle in ANGLES:
            first = reporting.column(runs, f"{angle}_sd_first_rad")
            last = reporting.column(runs, f"{angle}_sd_last_rad")
            change = stats.difference(last, first)
            lower = sum(b < a for a, b in zip(first, last, strict=True))
            steadier_claims.append(
                Claim(
                    f"our target: the SD of {angle} is lower at the end in at least "
                    f"{MIN_STEADIER:.0%} of the walks",
                    scope,
                    f"{lower} of {len(runs)}",
                    reporting.target_verdict(lower >= MIN_STEADIER * len(runs), runs),
                )
            )
            all_claims.append(
                Claim(
                    f"the SD of {angle} decreases during learning in situ",
                    scope,
                    f"{reporting.with_interval(change, '.4f')} rad "
                    f"(last {WINDOW} steps - first {WINDOW})",
                    stats.verdict(change, claimed=-1),
                )
            )
    scripted = reporting.runs_of(results, walker="scripted knee")[0]["distance_m"]
    for learner, seed_set in GROUPS:
        runs = reporting.runs_of(results, learner=learner, seeds=seed_set)
        scope = f"`{learner}`, {SEED_SETS[seed_set]}"
        never = sum(run["falls"] == 0 for run in runs)
        all_claims.append(
            Claim(
                f"our target: at least {MIN_NEVER_FELL:.0%} of the walkers never fall",
                scope,
                f"{never} of {len(runs)}",
                reporting.target_verdict(never >= MIN_NEVER_FELL * len(runs), runs),
            )
        )
        outside = [run["outside_settled"] for run in runs]
        if None not in outside:
            median = stats.quartiles(outside)[1]
            all_claims.append(
                Claim(
                    f"our target: less than {MAX_OUTSIDE:.0%} of the steps are outside, not "
                    f"counting the first {SETTLING_CYCLES}",
                    scope,
                    f"{median:.2%} (median over seeds)",
                    reporting.target_verdict(median < MAX_OUTSIDE, runs),
                )
            )
        relative = sum(reporting.column(runs, "distance_m")) / len(runs) / scripted
        all_claims.append(
            Claim(
                f"our target: at least {MIN_RELATIVE_DISTANCE:.0%} of the distance of the "
                "scripted knee",
                scope,
                f"{relative:.0%} (mean over seeds)",
                reporting.target_verdict(relative >= MIN_RELATIVE_DISTANCE, runs),
            )
        )
    return all_claims + steadier_claims


def failure_table(results: Results) -> list[str]:
    """Return the table of steps to failure."""
    rows = []
    for learner, seed_set in GROUPS:
        runs = reporting.runs_of(results, learner=learner, seeds=seed_set)
        first_falls = [str(run["first_fall"] + 1) for run in runs if run["first_fall"] is not None]
        outside = [run["outside_settled"] for run in runs]
        low, high = stats.share_interval(sum(run["falls"] == 0 for run in runs), len(runs))
        rows.append(
            (
                learner,
                SEED_SETS[seed_set],
                f"{runs[0]['seed']} to {runs[-1]['seed']}",
                f"{reporting.never_fell(runs)} [{low:.0%}, {high:.0%}]",
                ", ".join(first_falls) or "-",
                str(sum(run["falls"] for run in runs)),
                f"{reporting.falls_per_1000(runs):.2f}",
                "-" if None in outside else f"{stats.quartiles(outside)[1]:.2%}",
            )
        )
    heads = (
        "learner",
        "training seeds",
        "seeds of the walks",
        "never fell",
        "steps of first falls",
        "falls",
        "falls per 1000 steps",
        f"outside after the first {SETTLING_CYCLES} steps, median",
    )
    return reporting.markdown_table(heads, rows)


def gait_table(results: Results) -> list[str]:
    """Return the table of gait measures."""
    scripted = reporting.runs_of(results, walker="scripted knee")[0]["distance_m"]
    rows = []
    for learner, seed_set in GROUPS:
        runs = reporting.runs_of(results, learner=learner, seeds=seed_set)
        mean = sum(reporting.column(runs, "distance_m")) / len(runs)
        all_forward = all(run["distance_m"] > 0.0 for run in runs)
        cells = [learner, SEED_SETS[seed_set], f"{mean:.3f} ({mean / scripted:.0%})"]
        for name, form in (
            ("slip_m", ".3f"),
            ("peak_force_n", ".0f"),
            ("contact_share", ".2f"),
            ("duty_factor", ".2f"),
            ("cost_of_transport", ".2f"),
            ("turn_rad", ".4f"),
            ("drift_first_rad", ".4f"),
            ("drift_rad", ".4f"),
            ("heading_change_rad", "+.2f"),
        ):
            if name == "cost_of_transport" and not all_forward:
                cells.append("-")
            else:
                cells.append(reporting.with_quartiles(reporting.column(runs, name), form))
        rows.append(cells)
    heads = (
        "learner",
        "seeds",
        "distance per step, m",
        "slip per step, m",
        "peak force, N",
        "stance contact",
        "duty factor",
        "cost of transport",
        "turn per step, rad",
        f"drift per step, first {WINDOW}, rad",
        "drift per step, whole walk, rad",
        "heading change, whole walk, rad",
    )
    return reporting.markdown_table(heads, rows)


def comparison(results: Results) -> list[str]:
    """Return how steady ``ember`` is at the start, compared with ``plain`` at the end."""
    ember, plain = (
        reporting.runs_of(results, learner=learner, seeds="tuned on")
        for learner in ("ember", "plain")
    )
    sentences = []
    for angle in ANGLES:
        first = stats.quartiles(reporting.column(ember, f"{angle}_sd_first_rad"))[1]
        last = stats.quartiles(reporting.column(plain, f"{angle}_sd_last_rad"))[1]
        sentences.append(
            f"The median SD of {angle} of `ember` in the first {WINDOW} steps is {first:.4f} rad; "
            f"that of `plain` in the last {WINDOW} steps is {last:.4f} rad."
        )
    return [
        f"{' '.join(sentences)} `ember` does not explore on the body, so it gains little new "
        "experience there.",
        "",
    ]


def text(results: Results) -> list[str]:
    """Return the tables and their explanation."""
    sd_rows = []
    for learner, seed_set in GROUPS:
        runs = reporting.runs_of(results, learner=learner, seeds=seed_set)
        cells = [learner, SEED_SETS[seed_set]]
        for angle in ANGLES:
            for end in ("first", "last"):
                values = reporting.column(runs, f"{angle}_sd_{end}_rad")
                cells.append(reporting.with_quartiles(values, ".4f"))
        sd_rows.append(cells)
    ends = (f"first {WINDOW}", f"last {WINDOW}")
    return [
        "**Steps to failure.** The one walker of the paper fell at step 62 and again at step 5473 "
        "of about 6900:",
        "",
        *failure_table(results),
        "",
        "*Held-out seeds* were not used for tuning any parameter. Body and ground have no noise, "
        "and `ember` does not explore on the body. The seed of a walk of `ember` therefore only "
        "breaks ties between equal values, and walks differ because their trainings differ. *Never "
        "fell*: with its exact 95 % confidence interval (Clopper-Pearson). *Outside*: share of "
        f"steps with {reporting.OUTSIDE}.",
        "",
        f"**Figure 6.** Standard deviation over all ticks of {WINDOW} steps, rad. The curves in "
        "the figure show the standard deviation within each step instead, which does not include "
        "slow oscillations over several steps (beats). Their trend is fitted to the median over "
        "seeds.",
        "",
        *reporting.markdown_table(
            ("learner", "seeds", *(f"{angle}, {end}" for angle in ANGLES for end in ends)), sd_rows
        ),
        "",
        *comparison(results),
        "**Gait.** Distance: mean over all steps and seeds, and its ratio to that of the scripted "
        "knee. Other columns without a range of steps in their heading: medians over seeds of the "
        f"last {WINDOW} steps, except for the cost of transport:",
        "",
        *gait_table(results),
        "",
        "*Stance contact*: share of stance ticks with the foot on the ground; *duty factor*: the "
        "same share of all ticks. *Cost of transport*, over the whole walk: positive work of the "
        "motors, divided by weight and distance. The work is measured once per tick, at its end, "
        "so part of the work that accelerates a joint is missing. *Turn*: mean absolute change of "
        "heading. *Drift*: absolute value of the mean change of heading. *Heading change*: from "
        "start to end of the walk, positive to the left, including whole turns.",
        "",
        "**Baselines** in the same body, over short walks:",
        "",
        *reporting.walker_table([arm for arm in results["arms"] if "seeds" not in arm["labels"]]),
        "",
        reporting.WALKER_TABLE_NOTE,
    ]


def draw(results: Results, file: Path) -> None:
    """Draw figures 6 and 7, the Kaplan-Meier curves and the distances."""
    figure, axes = canvas(5, 2, width=11.0, height=2.7)
    for column, (learner, colour) in enumerate((("ember", BLUE), ("plain", AMBER))):
        _draw_figure_6(axes[:2, column], results, learner, colour)
        _draw_figure_7(axes[2:4, column], results, learner)
    for axis, other in ((axes[0, 0], axes[0, 1]), (axes[1, 0], axes[1, 1])):
        axis.sharey(other)  # equal scales, to compare the learners
    for axis in (axes[2, 0], axes[3, 0], axes[3, 1]):
        axis.sharey(axes[2, 1])
    axes[0, 0].legend(frameon=False)
    axes[2, 0].legend(frameon=False, ncols=2, loc="upper right")
    _draw_survival(axes[4, 0], results)
    _draw_distances(axes[4, 1], results)
    save(figure, file)


def _draw_figure_6(axes: Sequence[Axes], results: Results, learner: str, colour: str) -> None:
    """Draw the SD of roll and pitch over the steps, with quartiles and trend."""
    for axis, angle in zip(axes, ANGLES, strict=True):
        curve = results["curves"][f"{learner}, tuned on/{angle}"]
        steps = curve["steps"]
        axis.fill_between(steps, curve["low"], curve["high"], color=colour, alpha=0.25, lw=0)
        axis.plot(steps, curve["median"], color=colour, lw=1.2, label="median, quartiles")
        axis.plot(steps, curve["trend"], color=INK, lw=1.4, ls="--", label="4th order trend")
        axis.set_ylim(bottom=0.0)
        axis.set_ylabel(f"SD of {angle}, rad")
        axis.set_xlabel("steps")
    axes[0].set_title(f"Figure 6: {learner}", loc="left", color=INK)


def _draw_figure_7(axes: Sequence[Axes], results: Results, learner: str) -> None:
    """Draw roll and pitch of one walk in its first and in its last steps."""
    about = results["about"]
    for axis, end, trace in zip(
        axes, ("first", "last"), results["curves"][f"{learner}, tuned on/traces"], strict=True
    ):
        angles = np.array(trace)
        time = np.arange(len(angles)) / about["ticks"]
        if end == "last":
            time += about["walk"] - len(angles) / about["ticks"]
        axis.plot(time, angles[:, 0], color=BLUE, lw=1.2, label="roll")
        axis.plot(time, angles[:, 1], color=AMBER, lw=1.2, label="pitch")
        axis.set_ylabel("rad")
        axis.set_xlabel("steps")
        axis.set_title(f"Figure 7: {learner}, seed 0, {end} steps", loc="left", color=INK)


def _draw_survival(axis: Axes, results: Results) -> None:
    """Draw the share of walkers that have not fallen yet, with its confidence interval."""
    end = results["about"]["walk"]
    for (learner, seed_set), colour, style in zip(
        GROUPS, (BLUE, GREY, AMBER), ("-", "--", "-"), strict=True
    ):
        curve = results["curves"][f"{learner}, {seed_set}/survival"]
        steps = [*curve["steps"], end]
        share, low, high = ([*curve[key], curve[key][-1]] for key in ("share", "low", "high"))
        label = f"{learner}, {SEED_SETS[seed_set]}"
        axis.step(steps, share, style, where="post", color=colour, lw=1.8, label=label)
        axis.fill_between(steps, low, high, step="post", color=colour, alpha=0.15, lw=0)
    axis.set_ylim(-0.02, 1.05)
    axis.set_xlabel("steps")
    axis.set_ylabel("share without a fall")
    axis.set_title("Steps to the first fall (Kaplan-Meier, 95 %)", loc="left", color=INK)
    axis.legend(frameon=False, loc="center right")


def _draw_distances(axis: Axes, results: Results) -> None:
    """Draw the distance of each walker, and that of the scripted knee as a dashed line."""
    for n, ((learner, seed_set), colour) in enumerate(
        zip(GROUPS, (BLUE, GREY, AMBER), strict=True)
    ):
        values = reporting.column(
            reporting.runs_of(results, learner=learner, seeds=seed_set), "distance_m"
        )
        axis.plot([n] * len(values), values, "o", color=colour, alpha=0.6)
    scripted = reporting.runs_of(results, walker="scripted knee")[0]["distance_m"]
    axis.axhline(scripted, color=INK, lw=1.0, ls="--")
    labels = [f"{learner},\n{SEED_SETS[seed_set]}" for learner, seed_set in GROUPS]
    axis.set_xticks(range(len(GROUPS)), labels)
    axis.set_xlim(-0.5, len(GROUPS) - 0.5)
    axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
    axis.set_ylabel("distance per step, m")
    axis.set_title("Distance of each walker (dashed: scripted knee)", loc="left", color=INK)


STUDY = Study(
    "walker",
    "Figures 6 and 7: the walker learns in situ",
    "the walker fell at step 62 and again at step 5473; the standard deviation of roll and pitch "
    "decreases for several thousand steps after integration; beats between the natural frequency "
    "of the structure and the step frequency are visible (shown in figure 7, not tested here).",
    arms,
    text,
    draw,
    curves,
    claims,
)
