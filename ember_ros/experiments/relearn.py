"""Relearn: what walkers that do not learn did is recorded, and a table is learnt from the bags.

For each seed a walker with a random knee and one with a knee written by hand are recorded; from
each bag a table is learnt without one new tick; then legs that only use it, and learn nothing more,
carry the body.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ember_ros.bag.storage import BagOptions
from ember_ros.experiments.lab import each_seed, go_on
from ember_ros.experiments.study import OTHER_SEED, age, numbers, write_page
from ember_ros.experiments.trial import LOW_M, TILT_RAD, code_sha256
from ember_ros.experiments.words import Found
from ember_ros.offline.relearn import relearn
from ember_ros.params import replace
from ember_ros.run import run
from ember_ros.run_config import RunConfig
from ember_ros.versions import versions
from leg_node.table_file import save_table

NAME = "relearn"
CYCLES = 1000
RECORDED = ("random", "scripted")
SMOOTH = {"walk.smooth": 0.3, "walk.prior": 5.0}
"""Neighbours have a say, and what was never tried is no better than what was."""


def one_seed(seed: int, *, cycles: int, walk_cycles: int, out: Path) -> dict[str, Any]:
    """Record, relearn and walk with one seed, and return plain numbers."""
    folder, params = out / f"seed{seed}", numbers("plain")
    shutil.rmtree(folder, ignore_errors=True)  # a bag is never written over

    def go(config: RunConfig, name: str, bag: Path | None = None) -> dict[str, Any]:
        into = BagOptions(bag) if bag else None
        record, summary = run(
            config, "loop", folder / name, lambda cycles, falls: go_on(), "relearn", into
        )
        keys = ("falls", "distance_per_cycle_m", "roll_sd_rad", "pitch_sd_rad")
        rows = record.body_rows()
        bad = sum((r.tilt_max_rad or 0) > TILT_RAD or (r.height_min_m or 0) < LOW_M for r in rows)
        return {key: summary[key] for key in keys} | {"outside": bad / len(rows)}

    def walk(name: str, table: Path | None, changes: dict[str, float]) -> dict[str, Any]:
        config = RunConfig(
            "walker",
            walk_cycles,
            seed=seed + OTHER_SEED,
            params=replace(params, changes),
            learning=False,
            table=table,
        )
        return go(config, name)

    found: dict[str, Any] = {"seed": seed}
    for policy in RECORDED:
        bag, table = folder / f"{policy}_bag", folder / f"{policy}_relearnt.npz"
        config = RunConfig(
            "walker", cycles, seed=seed, params=params, policy=policy, learning=False
        )
        found[f"{policy} knee, recorded"] = go(config, policy, bag)
        learnt = relearn([bag])
        save_table(table, learnt.table, params, seed)
        found[f"{policy}_updates"] = learnt.updates
        found[f"{policy}_cells"] = int((learnt.table.visits > 0).sum())
        name = f"relearnt from the {policy} knee"
        found[name] = walk(f"from_{policy}", table, {})
        found[f"{name}, read smoothed"] = walk(f"from_{policy}_smoothed", table, SMOOTH)
    found["empty table"] = walk("empty", None, {})
    return found


def relearn_experiment(
    seeds: int,
    cycles: int,
    walk_cycles: int,
    out: Path,
    say: Callable[[int, int], bool],
    command: str,
) -> Found:
    """Run all seeds and return what came of it: ``about``, and ``seeds`` in their order.

    Args:
        seeds: how many, from 0.
        cycles: that are recorded.
        walk_cycles: that are walked with what was learnt from them.
        out: folder for the runs and bags.
        say: told how many seeds are done of how many; returns whether to go on.
        command: what was typed.
    """
    job = functools.partial(one_seed, cycles=cycles, walk_cycles=walk_cycles, out=out)
    return {
        "about": {
            "command": command,
            "versions": versions(),
            "code_sha256": code_sha256(),
            "cycles": cycles,
            "walk_cycles": walk_cycles,
        },
        "seeds": each_seed(job, seeds, say),
    }


def page(result: Found) -> str:
    """Return the results as a Markdown page."""
    about, found = result["about"], result["seeds"]
    cycles, walk_cycles = about["cycles"], about["walk_cycles"]
    known = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    smooth = " and ".join(f"`{name}: {value}`" for name, value in SMOOTH.items())
    lines = [
        "# Learnt again from bags",
        "",
        *age(result, NAME),
        f"Made by `{about['command']}`; every number below is written by it "
        f"(`relearn.json` holds them all). Versions: {known}.",
        "",
        f"Walkers that learn nothing are recorded for {cycles} cycles: one with a random knee, "
        "one with the knee written by hand. `ember relearn` works out the table that one-step "
        "Q-learning gets from each bag, in one pass and without one new tick (`--params plain`). "
        f"Legs with that table, frozen, then walk {walk_cycles} cycles with another seed. Read "
        f"smoothed: {smooth} in the parameter file. The empty "
        "table is frozen too: all its actions are ties, and its legs act at random.",
        "",
        "```",
        f"ember walk --params plain --policy random --cycles {cycles} --seed S --on loop \\",
        "  --bag out/bag --out out/random",
        "ember relearn out/bag --out out/relearn",
        f"ember walk --freeze --cycles {walk_cycles} --seed {OTHER_SEED}+S --on loop \\",
        "  --table out/relearn/table.npz --params out/relearn/params.yaml --out out/walked",
        "```",
        "",
        "| walker | seed | falls | distance a cycle, m | SD of roll, rad | SD of pitch, rad | "
        "outside |",
        "|---|---|---|---|---|---|---|",
    ]
    walkers = [name for name, value in found[0].items() if isinstance(value, dict)]
    for name in walkers:
        for each in found:
            w = each[name]
            lines.append(
                f"| {name} | {each['seed']} | {w['falls']} | {w['distance_per_cycle_m']:.3f} | "
                f"{w['roll_sd_rad']:.3f} | {w['pitch_sd_rad']:.3f} | {w['outside']:.1%} |"
            )
    lines += [
        "",
        f"Outside: share of cycles with roll or pitch over {TILT_RAD} rad or hips under {LOW_M} m. "
        f"Falls of recorded walkers are in {cycles} cycles, of the others in {walk_cycles}.",
        "",
        "| recorded | seed | updates | cells of the table that were visited |",
        "|---|---|---|---|",
    ]
    for policy in RECORDED:
        for each in found:
            lines.append(
                f"| {policy} knee | {each['seed']} | {each[f'{policy}_updates']} | "
                f"{each[f'{policy}_cells']} |"
            )
    lines += [
        "",
        "A random knee tries every action everywhere. The knee written by hand tries one action a "
        "state, and of the others the table knows nothing: under costs their 0 looks good. Read "
        "smoothed, an untried action counts a little less than its state as a whole.",
    ]
    return "\n".join(lines) + "\n"


def write(found: Found, folder: Path) -> list[str]:
    """Write the page and the numbers, and return the names of the files."""
    write_page(NAME, found, page(found), folder)
    return [f"{NAME}.md", f"{NAME}.json"]
