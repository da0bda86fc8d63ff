"""``ember train``, ``walk`` and ``demo``: a leg learns, four of them carry a body."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from ember_ros.bag.storage import BagOptions
from ember_ros.cli import options
from ember_ros.cli.codes import INTERRUPTED
from ember_ros.errors import ParameterError, need
from ember_ros.params_file import changed, load_params
from ember_ros.report import figures
from ember_ros.report.summary import beside
from ember_ros.resume import resume_point, start_messages
from ember_ros.run import (
    BACKENDS,
    PICTURE,
    SUMMARY,
    TABLE,
    need_ros,
    recover,
    refuse_to_replace,
    run,
)
from ember_ros.run_config import RunConfig
from ember_ros.spinning import Stop, prepare_environment, stop_signals
from ember_ros.terminal import command_line, console, grid, progress


def _of_a_run(*, cycles: int, out: str, way: str) -> options.Adds:
    """Return what adds the options that `train` and `walk` share."""
    return options.together(
        options.cycles(cycles, "Cycles of the pattern generator: steps of each leg."),
        options.SEED,
        options.out(out, "table.npz, cycles.csv, summary.json and run.png"),
        options.PARAMS,
        click.option(
            "--resume",
            type=options.FOLDER,
            metavar="RUN",
            help="Go on from the run in this folder: with its table and parameters, exploration "
            "and cycle count where they were. The world begins anew, so it is not the run that "
            "would have come without the stop.",
        ),
        options.TABLE,
        click.option(
            "--learn/--freeze",
            "learning",
            default=None,
            help="Whether the table changes. Default: it does with --policy learned.",
        ),
        options.of_node("--policy", also="; scripted and random are baselines"),
        options.NAMESPACE,
        options.on(
            BACKENDS,
            way,
            "loop: no ROS, fastest. graph: all nodes in this process. processes: one process a "
            "node. All three end with the same bits.",
        ),
        options.RECORD,
        options.force(),
    )


@click.command("train")
@_of_a_run(cycles=6000, out="out/train", way="loop")
def train_command(**given: Any) -> None:
    """Train one leg on the cantilever trainer.

    \b
    ember train                              6000 steps, about half a minute
    ember train --seed 3 --out out/seed3     another one
    ember walk --table out/train/table.npz   let four such legs walk
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    _run("trainer", **given)


@click.command("walk")
@_of_a_run(cycles=300, out="out/walk", way="graph")
def walk_command(**given: Any) -> None:
    """Let four legs carry a body, still learning.

    \b
    ember walk --table out/train/table.npz   legs that a trainer has taught
    ember walk --table trained               the same, with the table that comes with the package
    ember walk                               legs that know nothing yet
    ember walk --policy scripted             a knee written by hand
    ember walk --on processes --table ...    seven processes
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    _run("walker", **given)


def _run(
    world: str,
    *,
    cycles: int,
    seed: int,
    out: Path,
    params_files: tuple[Path, ...],
    settings: tuple[str, ...],
    table: Path | None,
    resume: Path | None,
    learning: bool | None,
    policy: str,
    way: str,
    namespace: str,
    force: bool,
    bag: Path | None,
    split_mb: float,
    split_s: float,
) -> None:
    start_cycle, params = 0, load_params(*params_files, settings=settings)
    if resume is not None:
        if table is not None:
            raise ParameterError("--resume brings its own table: leave --table out")
        table = resume / TABLE
        recover(resume)
        start_cycle, was = resume_point(resume, world)
        params = params if params_files else changed(was, settings)
    config = RunConfig(
        world,
        cycles,
        seed=seed,
        params=params,
        policy=policy,
        learning=policy == "learned" if learning is None else learning,
        table=table,
        start_cycle=start_cycle,
    )
    if bag is None and (split_mb or split_s):
        raise ParameterError("--split-mb and --split-s are of a bag: give --bag too")
    if not force:
        refuse_to_replace(out)
    for line in start_messages(config):
        console.print(line)
    with stop_signals() as stop:
        into = BagOptions(bag, split_mb, split_s) if bag else None
        record, summary = _show(config, way, out, stop, into, namespace, replace=force)
        what = "trained" if world == "trainer" else "walked"
        drawn = figures.draw(out / PICTURE, ticks=params.gait.ticks, **{what: record})
    _print({what: summary})
    picture = f", {PICTURE}" if drawn else "; no whole cycle to draw"
    console.print(f"In {out}: {TABLE}, cycles.csv, {SUMMARY}{picture}")
    if bag and summary["cycles"]:
        what = "the whole run" if summary["complete"] else "the run until then"
        console.print(f"In {bag}: {what}; `ember replay {bag}` runs it again")
    if not summary["complete"]:
        _end_early(summary, out)


@click.command("demo")
@options.cycles(6000, "On the trainer.")
@options.cycles(300, "On the body.", flag="--walk-cycles")
@options.of_node("--seed", type=int, help="Of both runs.")
@options.NAMESPACE
@options.PARAMS
@options.out("out/demo", "both runs and demo.png")
@options.force()
def demo_command(
    cycles: int,
    walk_cycles: int,
    seed: int,
    namespace: str,
    params_files: tuple[Path, ...],
    settings: tuple[str, ...],
    out: Path,
    force: bool,
) -> None:
    """Train a leg, walk on four on the graph, draw it all.

    The leg learns alone with the direct loop; then four nodes with its table carry the body on a
    live graph, and go on learning.
    """
    if not force:
        refuse_to_replace(out / "train")
        refuse_to_replace(out / "walk")
    need_ros()  # say it now, and not when the leg is trained
    prepare_environment()
    params = load_params(*params_files, settings=settings)
    training = RunConfig("trainer", cycles, seed=seed, params=params)
    walking = RunConfig(
        "walker", walk_cycles, seed=seed, params=params, table=out / "train" / TABLE
    )
    with stop_signals() as stop:
        trained, first = _show(training, "loop", out / "train", stop, replace=force)
        (out / "demo.png").unlink(missing_ok=True)  # it shows another training
        summaries, records = {"one leg, trainer": first}, {"trained": trained}
        if not stop.requested:
            walked, second = _show(
                walking, "graph", out / "walk", stop, namespace=namespace, replace=force
            )
            summaries["four legs, body"], records["walked"] = second, walked
        drawn = figures.draw(out / "demo.png", ticks=params.gait.ticks, **records)
    _print(summaries)
    picture = "demo.png" if drawn else "no whole cycle to draw"
    runs = " and ".join(["train", "walk"][: len(summaries)])
    console.print(f"In {out}: {picture}, and the runs in {runs}")
    last = list(summaries.values())[-1]
    if stop.requested:
        _end_early(last, out / ("walk" if len(summaries) > 1 else "train"))


def _show(
    config: RunConfig,
    way: str,
    out: Path,
    stop: Stop,
    bag: BagOptions | None = None,
    namespace: str = "",
    *,
    replace: bool,
) -> tuple[Any, dict[str, Any]]:
    """Run a plan behind a progress bar."""
    need("matplotlib", why="to draw what comes of it")
    label = "walking" if config.world == "walker" else "training"
    with progress(f"{label} ({way})", config.cycles) as update:

        def go_on(done: int, falls: int) -> bool:
            update(done, f"{done}/{config.cycles} cycles, {falls} falls")
            return not stop.requested

        record, summary = run(config, way, out, go_on, command_line(), bag, namespace, replace)
        go_on(summary["cycles"], summary["falls"])
    return record, summary


def _print(summaries: Mapping[str, Mapping[str, Any]]) -> None:
    """Print summaries side by side, with a head each where there are several."""
    heads = ("", *summaries) if len(summaries) > 1 else ()
    console.print(grid(beside(summaries), "l" + "r" * len(summaries), heads))


def _end_early(summary: dict[str, Any], out: Path) -> None:
    console.print(f"Stopped after {summary['cycles']} cycles; what was learnt is in {out / TABLE}.")
    sys.exit(INTERRUPTED)
