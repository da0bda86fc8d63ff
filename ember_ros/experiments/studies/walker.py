"""Figures 6 and 7, and the steps to failure: four trained legs go on learning in situ."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ember_ros.experiments import stats, words
from ember_ros.experiments.study import Arm, Size, Study, company, trained, walks
from ember_ros.experiments.trial import SETTLING_CYCLES, WINDOW, Outcome
from ember_ros.experiments.words import Claim, Found
from ember_ros.report.figures import AMBER, BLUE, GREY, INK, canvas, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HELD_OUT = 100
"""The first of the seeds that nothing was tuned on."""
GROUPS = (("ember", "tuned on"), ("ember", "held out"), ("plain", "tuned on"))
POINTS = 70
"""Points of a curve of standard deviations."""
DEGREE = 4
"""Of the trend, as in the paper."""
ANGLES = ("roll", "pitch")
STAND, SLACK, ENOUGH, LOWER = 0.9, 0.01, 0.75, 0.8
"""Our targets: shares of walkers that never fall, of steps outside, of the scripted way, and
of walkers that are steadier at the end."""


def arms(size: Size) -> list[Arm]:
    """Return long walks, and who walks beside them."""
    found = []
    for learner, seeds in GROUPS:
        first = HELD_OUT if seeds == "held out" else 0
        some = range(first, first + size.seeds)
        starts = [trained(learner, size, seed) for seed in some]
        found.append(
            Arm(
                {
                    "body": "reference",
                    "walker": "trained table, long",
                    "learner": learner,
                    "seeds": seeds,
                },
                walks(learner, "reference", size.walk, some, starts),
            )
        )
    return found + company("reference", size)


def curves(known: list[tuple[Arm, list[Outcome]]]) -> dict[str, Any]:
    """Return SD of roll and pitch against steps, traces of one walk, and survival."""
    found: dict[str, Any] = {}
    for arm, outcomes in known:
        if "seeds" not in arm.labels:
            continue
        name = f"{arm.labels['learner']}, {arm.labels['seeds']}"
        for angle in ANGLES:
            each = np.array([outcome.cycles[f"{angle}_sd_rad"] for outcome in outcomes])
            parts = np.array_split(each, min(POINTS, each.shape[1]), axis=1)
            # Within a cycle: the amplitude of a step; the mean of its square over the steps.
            sd = np.stack([np.sqrt((part**2).mean(axis=1)) for part in parts], axis=1)
            steps = np.cumsum([part.shape[1] for part in parts])
            low, middle, high = np.percentile(sd, (25, 50, 75), axis=0)
            degree = min(DEGREE, len(steps) - 1)
            unit = steps / steps[-1]
            trend = np.polynomial.Polynomial.fit(unit, middle, degree)(unit)
            found[f"{name}/{angle}"] = {
                "steps": steps.tolist(),
                "low": low.round(5).tolist(),
                "median": middle.round(5).tolist(),
                "high": high.round(5).tolist(),
                "trend": trend.round(5).tolist(),
            }
        found[f"{name}/traces"] = outcomes[0].traces.round(4).tolist()
        found[f"{name}/survival"] = stats.survival(
            [outcome.measures["first_fall"] for outcome in outcomes],
            [outcome.measures["cycles"] for outcome in outcomes],
        )._asdict()
    return found


def claims(found: Found) -> list[Claim]:
    """Say whether learning in situ steadies the body, and whether what was asked for came out."""
    lines: list[Claim] = []
    steadier: list[Claim] = []
    for learner, seeds in GROUPS:
        runs = words.runs_of(found, learner=learner, seeds=seeds)
        for angle in ANGLES:
            first, last = (words.column(runs, f"{angle}_sd_{end}_rad") for end in ("first", "last"))
            change = stats.difference(last, first)
            lower = sum(b < a for a, b in zip(first, last, strict=True))
            steadier.append(
                Claim(
                    f"our target: the SD of {angle} is lower at the end in at least {LOWER:.0%}",
                    f"`{learner}`, {seeds}",
                    f"{lower} of {len(runs)}",
                    words.bar(lower >= LOWER * len(runs), runs),
                )
            )
            lines.append(
                Claim(
                    f"the SD of {angle} falls while learning in situ",
                    f"`{learner}`, {seeds}",
                    f"{words.told(change, '.4f')} rad from the first {WINDOW} steps to the last",
                    stats.verdict(change, claimed=-1),
                )
            )
    scripted = words.runs_of(found, walker="scripted knee")[0]["distance_m"]
    for learner, seeds in GROUPS:
        runs = words.runs_of(found, learner=learner, seeds=seeds)
        where = f"`{learner}`, {seeds}"
        never = sum(run["falls"] == 0 for run in runs)
        lines.append(
            Claim(
                f"our target: at least {STAND:.0%} of the walkers never fall",
                where,
                f"{never} of {len(runs)}",
                words.bar(never >= STAND * len(runs), runs),
            )
        )
        settled = [run["outside_settled"] for run in runs]
        if None not in settled:
            middle = stats.quartiles(settled)[1]
            lines.append(
                Claim(
                    f"our target: outside in under {SLACK:.0%} of steps after the first "
                    f"{SETTLING_CYCLES}",
                    where,
                    f"{middle:.2%}, median over seeds",
                    words.bar(middle < SLACK, runs),
                )
            )
        way = sum(words.column(runs, "distance_m")) / len(runs) / scripted
        lines.append(
            Claim(
                f"our target: at least {ENOUGH:.0%} of the scripted knee's way",
                where,
                f"{way:.0%}, mean over seeds",
                words.bar(way >= ENOUGH, runs),
            )
        )
    return lines + steadier


def failures(found: Found) -> list[str]:
    """Return the table of steps to failure."""
    lines = []
    for learner, seeds in GROUPS:
        runs = words.runs_of(found, learner=learner, seeds=seeds)
        firsts = [str(run["first_fall"] + 1) for run in runs if run["first_fall"] is not None]
        settled = [run["outside_settled"] for run in runs]
        low, high = stats.share_interval(sum(run["falls"] == 0 for run in runs), len(runs))
        lines.append(
            (
                learner,
                seeds,
                f"{runs[0]['seed']} to {runs[-1]['seed']}",
                f"{words.never_fell(runs)} [{low:.0%}, {high:.0%}]",
                ", ".join(firsts) or "-",
                str(sum(run["falls"] for run in runs)),
                f"{words.falls_per_1000(runs):.2f}",
                "-" if None in settled else f"{stats.quartiles(settled)[1]:.2%}",
            )
        )
    heads = ("learner", "seeds", "walking seeds", "never fell", "first fell at step", "falls")
    outside = f"outside after {SETTLING_CYCLES} steps, median"
    return words.grid((*heads, "falls per 1000", outside), lines)


def gaits(found: Found) -> list[str]:
    """Return the table of how they walk."""
    scripted = words.runs_of(found, walker="scripted knee")[0]["distance_m"]
    lines = []
    for learner, seeds in GROUPS:
        runs = words.runs_of(found, learner=learner, seeds=seeds)
        mean = sum(words.column(runs, "distance_m")) / len(runs)
        forward = all(run["distance_m"] > 0.0 for run in runs)
        cells = [learner, seeds, f"{mean:.3f} ({mean / scripted:.0%})"]
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
            known = forward or name != "cost_of_transport"
            cells.append(words.spread(words.column(runs, name), form) if known else "-")
        lines.append(cells)
    heads = ("learner", "seeds", "distance a step, m", "slip a step, m", "peak force, N")
    rest = ("stance contact", "duty factor", "cost of transport", "turn, rad")
    drifts = (f"drift, rad, first {WINDOW}", "drift, rad, all", "heading change, rad, all")
    return words.grid((*heads, *rest, *drifts), lines)


def compared(found: Found) -> list[str]:
    """Return how steadily the one starts, beside how the other ends."""
    ember, plain = (words.runs_of(found, learner=lr, seeds="tuned on") for lr in ("ember", "plain"))
    told = []
    for angle in ANGLES:
        first = stats.quartiles(words.column(ember, f"{angle}_sd_first_rad"))[1]
        last = stats.quartiles(words.column(plain, f"{angle}_sd_last_rad"))[1]
        told.append(f"{first:.4f} rad of {angle} against {last:.4f}")
    return [
        f"`ember` starts with {' and '.join(told)} that `plain` ends with (medians). It explores "
        "nothing on the body, so there is little there for it to learn from.",
        "",
    ]


def text(found: Found) -> list[str]:
    """Say what came of it."""
    steady = []
    for learner, seeds in GROUPS:
        runs = words.runs_of(found, learner=learner, seeds=seeds)
        cells = [learner, seeds]
        for angle in ANGLES:
            for end in ("first", "last"):
                cells.append(words.spread(words.column(runs, f"{angle}_sd_{end}_rad"), ".4f"))
        steady.append(cells)
    ends = (f"first {WINDOW}", f"last {WINDOW}")
    return [
        "Steps to failure. The paper's one walker fell at step 62 and again at step 5473 of about "
        "6900:",
        "",
        *failures(found),
        "",
        "Held out: seeds that no number was chosen on. Body and ground are without noise, and "
        "`ember` explores nothing on the body: there a walking seed breaks ties and does no more, "
        "and walkers are as many as their trainings. Outside: share "
        f"of steps with {words.OUTSIDE}. Never fell: with its exact "
        "95 % interval (Clopper-Pearson).",
        "",
        f"Figure 6. Standard deviation over all ticks of {WINDOW} steps, rad; the figure's curve "
        "is that within each step, which leaves out what beats from step to step; its trend is of "
        "the median over seeds:",
        "",
        *words.grid(
            ("learner", "seeds", *(f"{angle}, {end}" for angle in ANGLES for end in ends)), steady
        ),
        "",
        *compared(found),
        "How they walk; distance: mean over all steps and seeds, and its share of the scripted "
        f"knee's; the others: medians over seeds of the last {WINDOW} steps:",
        "",
        *gaits(found),
        "",
        "Cost of transport, over the whole walk: positive work of the legs' motors by weight and "
        "way; the work is read once a tick, at its end, and misses part of what speeds a joint up. "
        "Turn: mean size of the change of heading in a step; drift: size of the mean change, in "
        f"the first {WINDOW} steps and in all; heading change: from the start to the end, to the "
        "left positive, whole turns counted.",
        "",
        "Beside them, in the same body:",
        "",
        *words.walkers([arm for arm in found["arms"] if "seeds" not in arm["labels"]]),
        "",
        words.WALKERS_NOTE,
    ]


def draw(found: Found, file: Path) -> None:
    """Draw figure 6, figure 7, the Kaplan-Meier curve and the distances."""
    figure, axes = canvas(5, 2, width=11.0, height=2.7)
    for across, (learner, colour) in enumerate((("ember", BLUE), ("plain", AMBER))):
        _figure_6(axes[:2, across], found, learner, colour)
        _figure_7(axes[2:4, across], found, learner)
    for axis, other in ((axes[0, 0], axes[0, 1]), (axes[1, 0], axes[1, 1])):
        axis.sharey(other)  # what is steadier looks it
    for axis in (axes[2, 0], axes[3, 0], axes[3, 1]):
        axis.sharey(axes[2, 1])
    axes[0, 0].legend(frameon=False)
    axes[2, 0].legend(frameon=False, ncols=2, loc="upper right")
    _survival(axes[4, 0], found)
    _distances(axes[4, 1], found)
    save(figure, file)


def _figure_6(axes: Sequence[Axes], found: Found, learner: str, colour: str) -> None:
    for axis, angle in zip(axes, ANGLES, strict=True):
        curve = found["curves"][f"{learner}, tuned on/{angle}"]
        steps = curve["steps"]
        axis.fill_between(steps, curve["low"], curve["high"], color=colour, alpha=0.25, lw=0)
        axis.plot(steps, curve["median"], color=colour, lw=1.2, label="median, quartiles")
        axis.plot(steps, curve["trend"], color=INK, lw=1.4, ls="--", label="4th order trend")
        axis.set_ylim(bottom=0.0)
        axis.set_ylabel(f"SD of {angle}, rad")
        axis.set_xlabel("steps")
    axes[0].set_title(f"Figure 6: {learner}", loc="left", color=INK)


def _figure_7(axes: Sequence[Axes], found: Found, learner: str) -> None:
    about = found["about"]
    for axis, end, each in zip(
        axes, ("first", "last"), found["curves"][f"{learner}, tuned on/traces"], strict=True
    ):
        shown = np.array(each)
        time = np.arange(len(shown)) / about["ticks"]
        if end == "last":
            time += about["walk"] - len(shown) / about["ticks"]
        axis.plot(time, shown[:, 0], color=BLUE, lw=1.2, label="roll")
        axis.plot(time, shown[:, 1], color=AMBER, lw=1.2, label="pitch")
        axis.set_ylabel("rad")
        axis.set_xlabel("steps")
        axis.set_title(f"Figure 7: {learner}, seed 0, its {end} steps", loc="left", color=INK)


def _survival(axis: Axes, found: Found) -> None:
    end = found["about"]["walk"]
    for (learner, seeds), colour, style in zip(
        GROUPS, (BLUE, GREY, AMBER), ("-", "--", "-"), strict=True
    ):
        curve = found["curves"][f"{learner}, {seeds}/survival"]
        steps = [*curve["steps"], end]
        share, low, high = ([*curve[key], curve[key][-1]] for key in ("share", "low", "high"))
        label = f"{learner}, {seeds}"
        axis.step(steps, share, style, where="post", color=colour, lw=1.8, label=label)
        axis.fill_between(steps, low, high, step="post", color=colour, alpha=0.15, lw=0)
    axis.set_ylim(-0.02, 1.05)
    axis.set_xlabel("steps")
    axis.set_ylabel("share that never fell")
    axis.set_title("Steps to the first fall (Kaplan-Meier, 95 %)", loc="left", color=INK)
    axis.legend(frameon=False, loc="center right")


def _distances(axis: Axes, found: Found) -> None:
    for n, ((learner, seeds), colour) in enumerate(zip(GROUPS, (BLUE, GREY, AMBER), strict=True)):
        values = words.column(words.runs_of(found, learner=learner, seeds=seeds), "distance_m")
        axis.plot([n] * len(values), values, "o", color=colour, alpha=0.6)
    scripted = words.runs_of(found, walker="scripted knee")[0]["distance_m"]
    axis.axhline(scripted, color=INK, lw=1.0, ls="--")
    axis.set_xticks(range(len(GROUPS)), [f"{learner},\n{seeds}" for learner, seeds in GROUPS])
    axis.set_xlim(-0.5, len(GROUPS) - 0.5)
    axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
    axis.set_ylabel("distance a step, m")
    axis.set_title("Each walker's distance; dashed: the scripted knee", loc="left", color=INK)


STUDY = Study(
    "walker",
    "Figures 6 and 7: the walker learns in situ",
    "the walker fell at step 62 and again at step 5473; standard deviation of roll and pitch falls "
    "for several thousand steps after integration, and beats between the structure's frequency "
    "and the step's can be seen (shown in figure 7, not tested here).",
    arms,
    text,
    draw,
    curves,
    claims,
)
