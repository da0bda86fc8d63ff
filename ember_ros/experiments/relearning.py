"""The experiment ``relearn``: tables learnt offline from bags of walkers that did not learn.

For each seed, a walker with a random knee and one with a scripted knee are recorded. A table is
learnt from each bag, without new simulation. Then legs walk with that table, without learning. The
learning itself is in ``ember_ros.offline.relearn``.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ember_ros.bag.storage import BagOptions
from ember_ros.experiments.reporting import Results
from ember_ros.experiments.runner import go_on, run_seeds
from ember_ros.experiments.study import WALK_SEED_OFFSET, learner_params, outdated_note, write_page
from ember_ros.experiments.trial import LOW_M, TILT_RAD, code_sha256
from ember_ros.offline.relearn import relearn
from ember_ros.params import replace
from ember_ros.run import run
from ember_ros.run_config import RunConfig
from ember_ros.versions import versions
from leg_node.table_file import save_table

NAME = "relearn"
CYCLES = 1000
"""Recorded cycles of each walker, by default."""
RECORDED = ("random", "scripted")
"""Policies of the recorded walkers."""
SMOOTH = {"walk.smooth": 0.3, "walk.prior": 5.0}
"""Parameters for smoothed values: neighbouring cells count, and an action that was never tried is
estimated a little worse than its state."""


def one_seed(seed: int, *, cycles: int, walk_cycles: int, out: Path) -> dict[str, Any]:
    """Record, relearn and walk with one seed.

    Args:
        seed: of the recorded walks; the other walks have it plus ``WALK_SEED_OFFSET``.
        cycles: recorded cycles of each walker.
        walk_cycles: cycles of each walk with a learnt table.
        out: folder for the runs and bags.

    Returns:
        ``seed``; the measures of each walk, by its name; and for each recorded policy the number of
        updates and of visited cells.
    """
    folder, params = out / f"seed{seed}", learner_params("plain")
    shutil.rmtree(folder, ignore_errors=True)  # an existing bag is never overwritten

    def measured_run(config: RunConfig, name: str, bag: Path | None = None) -> dict[str, Any]:
        bag_options = BagOptions(bag) if bag else None
        record, summary = run(
            config, "loop", folder / name, lambda cycles, falls: go_on(), "relearn", bag_options
        )
        keys = ("falls", "distance_per_cycle_m", "roll_sd_rad", "pitch_sd_rad")
        rows = record.body_rows()
        outside = sum(
            (r.tilt_max_rad or 0) > TILT_RAD or (r.height_min_m or 0) < LOW_M for r in rows
        )
        return {key: summary[key] for key in keys} | {"outside": outside / len(rows)}

    def walk(name: str, table: Path | None, changes: dict[str, float]) -> dict[str, Any]:
        config = RunConfig(
            "walker",
            walk_cycles,
            seed=seed + WALK_SEED_OFFSET,
            params=replace(params, changes),
            learning=False,
            table=table,
        )
        return measured_run(config, name)

    results: dict[str, Any] = {"seed": seed}
    for policy in RECORDED:
        bag, table = folder / f"{policy}_bag", folder / f"{policy}_relearnt.npz"
        config = RunConfig(
            "walker", cycles, seed=seed, params=params, policy=policy, learning=False
        )
        results[f"{policy} knee, recorded"] = measured_run(config, policy, bag)
        learnt = relearn([bag])
        save_table(table, learnt.table, params, seed)
        results[f"{policy}_updates"] = learnt.updates
        results[f"{policy}_cells"] = int((learnt.table.visits > 0).sum())
        name = f"relearnt from the {policy} knee"
        results[name] = walk(f"from_{policy}", table, {})
        results[f"{name}, read smoothed"] = walk(f"from_{policy}_smoothed", table, SMOOTH)
    results["empty table"] = walk("empty", None, {})
    return results


def relearn_experiment(
    seeds: int,
    cycles: int,
    walk_cycles: int,
    out: Path,
    report_progress: Callable[[int, int], bool],
    command: str,
) -> Results:
    """Run all seeds and return the results.

    Args:
        seeds: number of seeds, from 0 on.
        cycles: recorded cycles of each walker.
        walk_cycles: cycles of each walk with a learnt table.
        out: folder for the runs and bags.
        report_progress: is called regularly with the number of completed seeds and of all seeds;
            the run stops if it returns False.
        command: the command line, for the page.

    Returns:
        ``about``, and ``seeds``: the results of the completed seeds, in order.
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
        "seeds": run_seeds(job, seeds, report_progress),
    }


def page(results: Results) -> str:
    """Return the results as a Markdown page."""
    about, seeds = results["about"], results["seeds"]
    cycles, walk_cycles = about["cycles"], about["walk_cycles"]
    installed = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    smooth = " and ".join(f"`{name}: {value}`" for name, value in SMOOTH.items())
    lines = [
        "# Relearning: tables learnt offline from bags",
        "",
        *outdated_note(results, NAME),
        f"Written by `{about['command']}`, including every number below "
        f"(all of them are in `relearn.json`). Versions: {installed}.",
        "",
        f"Walkers that do not learn are recorded for {cycles} cycles: one with a random knee, one "
        "with the scripted knee. `ember relearn` computes the table that one-step Q-learning "
        "(`--params plain`) learns from each bag, in one pass and without new simulation. Then "
        f"legs walk with that table for {walk_cycles} cycles with another seed, without learning. "
        f'"Read smoothed" means that the parameters of this walk are {smooth}. The baseline with '
        "an empty table does not learn either: all its actions have equal values, so the legs "
        "act at random.",
        "",
        "```",
        f"ember walk --params plain --policy random --cycles {cycles} --seed S --on loop \\",
        "  --bag out/bag --out out/random",
        "ember relearn out/bag --out out/relearn",
        f"ember walk --freeze --cycles {walk_cycles} --seed {WALK_SEED_OFFSET}+S --on loop \\",
        "  --table out/relearn/table.npz --params out/relearn/params.yaml --out out/walked",
        "```",
        "",
        "| walker | seed | falls | distance per cycle, m | SD of roll, rad | SD of pitch, rad | "
        "outside |",
        "|---|---|---|---|---|---|---|",
    ]
    walkers = [name for name, value in seeds[0].items() if isinstance(value, dict)]
    for name in walkers:
        for each in seeds:
            walk = each[name]
            lines.append(
                f"| {name} | {each['seed']} | {walk['falls']} | "
                f"{walk['distance_per_cycle_m']:.3f} | "
                f"{walk['roll_sd_rad']:.3f} | {walk['pitch_sd_rad']:.3f} | {walk['outside']:.1%} |"
            )
    lines += [
        "",
        f"Outside: share of cycles with roll or pitch over {TILT_RAD} rad or hips under {LOW_M} m. "
        f"The falls of recorded walkers are counted over {cycles} cycles, those of the others over "
        f"{walk_cycles}.",
        "",
        "| recorded walker | seed | updates | visited cells of the table |",
        "|---|---|---|---|",
    ]
    for policy in RECORDED:
        for each in seeds:
            lines.append(
                f"| {policy} knee | {each['seed']} | {each[f'{policy}_updates']} | "
                f"{each[f'{policy}_cells']} |"
            )
    lines += [
        "",
        "A random knee tries every action in every state that it visits. The scripted knee tries "
        "only one action per state, so the table has no information about the other actions. Most "
        "rewards are negative, so their initial value 0 is too high and they are chosen. With "
        "smoothed values, an untried action is estimated a little worse than its state.",
    ]
    return "\n".join(lines) + "\n"


def write(results: Results, folder: Path) -> list[str]:
    """Write the page and the JSON file, and return the names of the files."""
    write_page(NAME, results, page(results), folder)
    return [f"{NAME}.md", f"{NAME}.json"]
