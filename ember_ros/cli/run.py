"""``ember train``, ``walk`` and ``demo``: one leg learns alone, four legs carry a body."""

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
from ember_ros.report.summary import comparison_rows
from ember_ros.resume import resume_point, start_messages
from ember_ros.run import (
    BACKENDS,
    PICTURE,
    SUMMARY,
    TABLE,
    learns_by_default,
    need_ros,
    recover,
    refuse_to_replace,
    run,
)
from ember_ros.run_config import RunConfig
from ember_ros.spinning import Stop, prepare_environment, stop_signals
from ember_ros.terminal import command_line, console, grid, progress


def _run_options(*, cycles: int, out: str, backend: str) -> options.Decorator:
    """Return a decorator that adds the options which ``train`` and ``walk`` share."""
    return options.combined(
        options.cycles(cycles, "Cycles of the pattern generator, each one step of every leg."),
        options.SEED,
        options.out(out, "table.npz, cycles.csv, summary.json and run.png"),
        options.PARAMS,
        click.option(
            "--resume",
            type=options.FOLDER,
            metavar="RUN",
            help="Continue the run in this folder, with its table, parameters, exploration and "
            "cycle count. The world starts again at tick 0, so the result differs from a run "
            "without an interruption.",
        ),
        options.TABLE,
        click.option(
            "--learn/--freeze",
            "learning",
            default=None,
            help="Whether the table changes. Default: --freeze with --policy scripted or random, "
            "otherwise --learn.",
        ),
        options.shared_with_nodes("--policy", also="; scripted and random are baselines"),
        options.NAMESPACE,
        options.backend(
            BACKENDS,
            backend,
            "loop: without ROS, fastest. graph: all nodes in this process. processes: one process "
            "per node. All three give the same bits.",
        ),
        options.RECORD,
        options.force(),
    )


@click.command("train")
@_run_options(cycles=6000, out="out/train", backend="loop")
def train_command(**arguments: Any) -> None:
    """Train one leg on the cantilever trainer.

    \b
    ember train                              6000 steps, about half a minute
    ember train --seed 3 --out out/seed3     with another seed
    ember walk --table out/train/table.npz   walk with four legs that have this table
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    _train_or_walk("trainer", **arguments)


@click.command("walk")
@_run_options(cycles=300, out="out/walk", backend="graph")
def walk_command(**arguments: Any) -> None:
    """Walk with four legs that carry a body and continue to learn.

    \b
    ember walk --table out/train/table.npz   legs with the table of a training
    ember walk --table trained               with the table that comes with the package
    ember walk                               legs that start with an empty table
    ember walk --policy scripted             the scripted baseline
    ember walk --on processes --table ...    one process per node
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    _train_or_walk("walker", **arguments)


def config_from_options(
    world: str,
    *,
    cycles: int,
    seed: int,
    params_files: tuple[Path, ...],
    settings: tuple[str, ...],
    table: Path | None,
    resume: Path | None,
    learning: bool | None,
    policy: str,
) -> RunConfig:
    """Return what the options of ``train`` and ``walk`` ask to run.

    ``--resume`` keeps the run's own parameters unless ``--params`` is given; ``--set`` is laid on
    either.

    Raises:
        ParameterError: an option or a parameter is wrong, or the run cannot be resumed.
        TableError: the table of the run to resume cannot be read.
    """
    start_cycle = 0
    if resume is None:
        params = load_params(*params_files, settings=settings)
    else:
        if table is not None:
            raise ParameterError("--resume uses the table of its run; leave --table out")
        table = resume / TABLE
        recover(resume)
        start_cycle, own_params = resume_point(resume, world)
        params = (
            load_params(*params_files, settings=settings)
            if params_files
            else changed(own_params, settings)
        )
    return RunConfig(
        world,
        cycles,
        seed=seed,
        params=params,
        policy=policy,
        learning=learns_by_default(policy) if learning is None else learning,
        table=table,
        start_cycle=start_cycle,
    )


def _train_or_walk(
    world: str,
    *,
    out: Path,
    backend: str,
    namespace: str,
    force: bool,
    bag: Path | None,
    split_mb: float,
    split_s: float,
    **config_options: Any,
) -> None:
    """Run, draw the figure, and print the results.

    Args:
        world: in which the legs are mounted.
        out: folder of the run.
        backend: one of ``BACKENDS``.
        namespace: of all nodes.
        force: whether an earlier run in ``out`` may be replaced.
        bag: folder of the bag to record; None for none.
        split_mb: megabytes after which the bag starts a new file; 0: never.
        split_s: simulated seconds after which the bag starts a new file; 0: never.
        **config_options: the options that ``config_from_options`` takes.
    """
    config = config_from_options(world, **config_options)
    if bag is None and (split_mb or split_s):
        raise ParameterError("--split-mb and --split-s need --bag")
    if not force:
        refuse_to_replace(out)
    for line in start_messages(config):
        console.print(line)
    with stop_signals() as stop:
        bag_options = BagOptions(bag, split_mb, split_s) if bag else None
        record, summary = _run_with_progress(
            config, backend, out, stop, bag_options, namespace, replace=force
        )
        label = "trained" if world == "trainer" else "walked"
        drawn = figures.draw(out / PICTURE, ticks=config.params.gait.ticks, **{label: record})
    _print({label: summary})
    picture = f", {PICTURE}" if drawn else "; no whole cycle to draw"
    console.print(f"In {out}: {TABLE}, cycles.csv, {SUMMARY}{picture}")
    if bag and summary["cycles"]:
        part = "the whole run" if summary["complete"] else "the run until it stopped"
        console.print(f"In {bag}: {part}; `ember replay {bag}` repeats it")
    if not summary["complete"]:
        _end_early(summary, out)


@click.command("demo")
@options.cycles(6000, "On the trainer.")
@options.cycles(300, "On the body.", flag="--walk-cycles")
@options.shared_with_nodes("--seed", type=int, help="Seed of both runs.")
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
    """Train one leg, walk with four on the ROS graph, and plot both.

    The leg learns alone in the direct loop, without ROS. Then four leg nodes with its table carry a
    body on a ROS graph and continue to learn.
    """
    if not force:
        refuse_to_replace(out / "train")
        refuse_to_replace(out / "walk")
    need_ros()  # fail before the training, not after it
    prepare_environment()
    params = load_params(*params_files, settings=settings)
    training = RunConfig("trainer", cycles, seed=seed, params=params)
    walking = RunConfig(
        "walker", walk_cycles, seed=seed, params=params, table=out / "train" / TABLE
    )
    with stop_signals() as stop:
        trained, first = _run_with_progress(training, "loop", out / "train", stop, replace=force)
        (out / "demo.png").unlink(missing_ok=True)  # it shows an earlier training
        summaries, records = {"one leg, trainer": first}, {"trained": trained}
        if not stop.requested:
            walked, second = _run_with_progress(
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


def _run_with_progress(
    config: RunConfig,
    backend: str,
    out: Path,
    stop: Stop,
    bag: BagOptions | None = None,
    namespace: str = "",
    *,
    replace: bool,
) -> tuple[Any, dict[str, Any]]:
    """Run a configuration and show its progress."""
    need("matplotlib", why="to draw the figure")
    label = "walking" if config.world == "walker" else "training"
    with progress(f"{label} ({backend})", config.cycles) as update:

        def show(done: int, falls: int) -> None:
            update(done, f"{done}/{config.cycles} cycles, {falls} falls")

        def go_on(done: int, falls: int) -> bool:
            show(done, falls)
            return not stop.requested

        record, summary = run(config, backend, out, go_on, command_line(), bag, namespace, replace)
        show(summary["cycles"], summary["falls"])
    return record, summary


def _print(summaries: Mapping[str, Mapping[str, Any]]) -> None:
    """Print summaries side by side, with headers if there are several."""
    heads = ("", *summaries) if len(summaries) > 1 else ()
    console.print(grid(comparison_rows(summaries), "l" + "r" * len(summaries), heads))


def _end_early(summary: dict[str, Any], out: Path) -> None:
    console.print(f"Stopped after {summary['cycles']} cycles; the table is in {out / TABLE}.")
    sys.exit(INTERRUPTED)
