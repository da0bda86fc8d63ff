"""First light: one leg learns alone, then four of them walk, beside their baselines.

For each seed one leg is trained by the plain rule; then four walkers use the same body: legs with
the trained table, a knee written by hand, a random knee, and legs that start from nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ember_ros.experiments.seeds import LOW_M, TILT_RAD, each_seed, outside
from ember_ros.params import Params, replace
from ember_ros.plan import Plan
from ember_ros.report.recorder import Record
from ember_ros.run import TABLE, run
from ember_ros.versions import versions

CYCLES = 6000
SMOOTH = {"walk.smooth": 0.3, "walk.epsilon_start": 0.0, "walk.epsilon_end": 0.0}
"""Neighbours have a say (``leg_node/reading.py``), and nothing is tried at random."""
WALKERS = ("trained", "trained, smoothed", "scripted", "random", "empty table")


def one_seed(seed: int, *, train_cycles: int, walk_cycles: int, out: Path) -> dict[str, Any]:
    """Train and walk with one seed, and return plain numbers."""
    params, folder = Params(), out / f"seed{seed}"

    def go(plan: Plan, name: str) -> tuple[Record, dict[str, Any]]:
        return run(plan, "loop", folder / name, lambda cycles, falls: True, "first-light")

    training = Plan("trainer", train_cycles, seed=seed, params=params)
    _, summary = go(training, "train")
    found: dict[str, Any] = {"seed": seed, "first": summary["first"], "last": summary["last"]}
    table = folder / "train" / TABLE
    for name in WALKERS:
        plan = Plan(
            "walker",
            walk_cycles,
            seed=seed,
            params=replace(params, SMOOTH) if "smoothed" in name else params,
            policy=name if name in ("scripted", "random") else "learned",
            learning=name not in ("scripted", "random"),
            table=table if name.startswith("trained") else None,
        )
        record, summary = go(plan, name.replace(",", "").replace(" ", "_"))
        keys = ("falls", "first_fall", "distance_per_cycle_m", "roll_sd_rad", "pitch_sd_rad")
        found[name] = {key: summary[key] for key in keys} | {"outside": outside(record)}
    return found


def first_light(
    seeds: int, train_cycles: int, walk_cycles: int, out: Path, say: Callable[[int, int], bool]
) -> list[dict[str, Any]]:
    """Run all seeds, two processes at once, and return their numbers in order of seed.

    Args:
        seeds: how many, from 0.
        train_cycles: cycles on the trainer.
        walk_cycles: cycles on the body.
        out: folder for the runs.
        say: told how many seeds are done; returns whether to go on.
    """
    job = functools.partial(one_seed, train_cycles=train_cycles, walk_cycles=walk_cycles, out=out)
    return each_seed(job, seeds, say)


def page(found: list[dict[str, Any]], train_cycles: int, walk_cycles: int, command: str) -> str:
    """Return the results as a Markdown page."""
    first, last = found[0]["first"]["cycles"], found[0]["last"]["cycles"]
    lines = [
        "# First light",
        "",
        f"Made by `{command}`; every number below is written by it (`first-light.json` holds them "
        f"all). Versions: {', '.join(f'{k} {v}' for k, v in versions().items())}.",
        "",
        f"## One leg on the trainer, {train_cycles} cycles, the plain rule",
        "",
        f"Means over the first {first} and the last {last} cycles. "
        f"`ember train --cycles {train_cycles} --seed S` shows one line of it.",
        "",
        "| seed | distance a cycle, first, m | last, m | stance contact, last | "
        "peak force, first, N | last, N |",
        "|---|---|---|---|---|---|",
    ]
    for each in found:
        a, b = each["first"], each["last"]
        lines.append(
            f"| {each['seed']} | {a['distance_per_cycle_m']:.3f} | "
            f"{b['distance_per_cycle_m']:.3f} | {b['contact_share']:.2f} | "
            f"{a['peak_force_n']:.0f} | {b['peak_force_n']:.0f} |"
        )
    lines += [
        "",
        f"## Four legs on the body, {walk_cycles} cycles",
        "",
        "The same body and the same seeds; trained legs and legs with an empty table go on "
        "learning, by the plain rule; smoothed: `walk.smooth` 0.3 and no random actions. "
        f"Outside: share of cycles with roll or pitch over {TILT_RAD} rad or hips under {LOW_M} m. "
        f"`ember walk --cycles {walk_cycles} --seed S --table out/train/table.npz` (or `--policy "
        "scripted`, `--policy random`, or no table) shows one line of it.",
        "",
        "| walker | seed | falls | first fall, cycle | distance a cycle, m | SD of roll, rad | "
        "SD of pitch, rad | outside |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in WALKERS:
        for each in found:
            w = each[name]
            fall = "-" if w["first_fall"] is None else w["first_fall"]
            lines.append(
                f"| {name} | {each['seed']} | {w['falls']} | {fall} | "
                f"{w['distance_per_cycle_m']:.3f} | {w['roll_sd_rad']:.3f} | "
                f"{w['pitch_sd_rad']:.3f} | {w['outside']:.1%} |"
            )
    return "\n".join(lines) + "\n"
