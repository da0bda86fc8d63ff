"""``ember experiment`` and ``bench``: tests of the paper's claims, and the time of a tick."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import click

from ember_ros.cli import options
from ember_ros.cli.codes import INTERRUPTED
from ember_ros.errors import ParameterError, need
from ember_ros.experiments import isotropy, relearning, reproduction
from ember_ros.experiments.reporting import Results
from ember_ros.experiments.reproduction import ALL, RESULTS, STUDIES, read
from ember_ros.experiments.study import Size, Study, outdated_reason
from ember_ros.params_file import load_params
from ember_ros.spinning import stop_signals
from ember_ros.terminal import command_line, console, grid, progress, stages


@click.command("experiment")
@click.argument("name", type=click.Choice([*STUDIES, relearning.NAME, isotropy.NAME, ALL]))
@click.option(
    "--seeds",
    type=click.IntRange(1, 100),  # seeds from 100 on are held out
    help="Number of seeds; learners uses at most 4, sensitivity 3. Default: 10 (relearn: 5; "
    "isotropy: 1).",
)
@options.cycles(
    None, "Cycles on the trainer. Default: 6000 (relearn: 1000 recorded ones).", minimum=1
)
@options.cycles(
    None,
    "Cycles of a long walk; short walks have 1/14 of it. "
    "Default: 7000 (relearn: 300, isotropy: 500).",
    minimum=1,
    flag="--walk-cycles",
)
@options.out("out/experiments", "REPRODUCTION.md, and for results/NAME.md, .json, .csv and .png")
@click.option(
    "--trials",
    type=options.FOLDER,
    default="out/trials",
    show_default=True,
    help="Folder of all single runs; runs that are in it are not repeated.",
)
@click.option(
    "--redraw",
    is_flag=True,
    help="Run nothing; write pages, tables and figures again from the results in --out.",
)
def experiment_command(
    name: str,
    seeds: int | None,
    cycles: int | None,
    walk_cycles: int | None,
    out: Path,
    trials: Path,
    redraw: bool,
) -> None:
    """Run an experiment over many seeds and write its report.

    Two runs take place at a time. After Ctrl-C, the same command continues with the runs that are
    missing; isotropy and relearn repeat their walks.

    \b
    fig5         one leg on the trainer, with a fixed or a modulated stop
    walker       learning on the body: figures 6 and 7, and steps to failure
    direct       learning on the body from an empty table
    sharing      one shared table against one table per leg
    regime       which training gives better walking
    baselines    scripted, random, frozen and learning legs, and a central learner
    learners     the additions to plain Q-learning, each alone and each left out
    frontier     narrow bodies
    senses       each sense left out; states of the walker that the trainer does not have
    sensitivity  the mechanical parameters, one at a time
    relearn      tables learnt from bags of random and scripted walks
    isotropy     whether the world is the same in all directions
    all          all experiments of the paper, and the document REPRODUCTION.md
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    results = out / RESULTS
    if name == relearning.NAME:
        found = (
            read(name, results)
            if redraw
            else _relearn(seeds or 5, cycles or relearning.CYCLES, walk_cycles or 300, trials)
        )
        _print_files(results, relearning.write(found, results))
        return
    need("matplotlib", why="to draw the figures")
    if name == isotropy.NAME:
        if seeds not in (None, 1):
            raise click.UsageError("isotropy has one training only; leave --seeds out")
        found = (
            read(name, results) if redraw else _isotropy(cycles or 6000, walk_cycles or 500, trials)
        )
        _print_files(results, isotropy.write(found, results))
        return
    need("scipy", why="for the statistics of experiments")
    studies = list(STUDIES.values()) if name == ALL else [STUDIES[name]]
    if redraw:
        made = _redraw(studies, out)
    else:
        size = Size(seeds or 10, cycles or 6000, walk_cycles or 7000)
        made = reproduction.write_all(studies, _run(name, studies, size, trials), out)
    console.print(f"In {results}: {', '.join(made)}, with .json, .csv and .png of each")


def _run(name: str, studies: list[Study], size: Size, trials: Path) -> list[Results]:
    with _going_on(name) as go_on:
        found = reproduction.run(studies, size, trials, go_on, command_line())
    if found is None:
        _stop(f"Stopped; finished runs are in {trials} and will not be repeated.")
    return found


def _redraw(studies: list[Study], out: Path) -> list[str]:
    """Write pages, tables and figures again from existing results."""
    found = [read(study.name, out / RESULTS) for study in studies]
    for study, each in zip(studies, found, strict=True):
        why = outdated_reason(study, each)
        if why is not None:
            console.print(f"{study.name}: this version would give other results: {why}")
    try:
        return reproduction.write_all(studies, found, out)
    except KeyError as error:
        raise ParameterError(
            f"these results lack {error}, which this version draws; without --redraw they are "
            "computed again"
        ) from error


def _relearn(seeds: int, cycles: int, walk_cycles: int, trials: Path) -> Results:
    folder = trials / relearning.NAME
    with _going_on(relearning.NAME, "seeds") as go_on:
        found = relearning.relearn_experiment(
            seeds, cycles, walk_cycles, folder, go_on, command_line()
        )
    if len(found["seeds"]) < seeds:
        _stop(f"Stopped after {len(found['seeds'])} of {seeds} seeds; nothing was written.")
    return found


def _isotropy(cycles: int, walk_cycles: int, trials: Path) -> Results:
    need("pybullet", why="to build the worlds")
    with _going_on(isotropy.NAME) as go_on:
        found = isotropy.isotropy_experiment(cycles, walk_cycles, trials, go_on, command_line())
    if found is None:
        _stop("Stopped; nothing was written.")
    return found


@contextmanager
def _going_on(label: str, unit: str = "%") -> Iterator[Callable[[int, int], bool]]:
    """Yield a callback that shows the progress and returns whether to continue."""
    with stop_signals() as stop, progress(label, 100) as update:

        def go_on(done: int, of: int) -> bool:
            percent = 100 * done // of
            update(percent, f"{percent} %" if unit == "%" else f"{done}/{of} {unit}")
            return not stop.requested

        yield go_on


def _stop(why: str) -> NoReturn:
    console.print(why)
    sys.exit(INTERRUPTED)


def _print_files(folder: Path, names: list[str]) -> None:
    console.print(f"In {folder}: {', '.join(names)}")


@click.command("bench")
@options.cycles(100, "Cycles of a walk.", minimum=4)
@click.option(
    "--repeats", type=click.IntRange(1), default=5, show_default=True, help="Number of repeats."
)
@click.option("--train-cycles", type=click.IntRange(1), default=6000, show_default=True)
@click.option("--epochs", type=click.IntRange(10), default=10_000, show_default=True)
@options.PARAMS
@options.out("out/bench", "bench.json and bench.md")
def bench_command(
    params_files: tuple[Path, ...], settings: tuple[str, ...], out: Path, **sizes: int
) -> None:
    """Measure ticks per second and the time of each part of a tick.

    The same walk runs with physics only, in the loop, and on the graph in one process and in seven,
    in turn and repeatedly. Medians, and ratios within a repeat, are printed. The machine should be
    idle.
    """
    from ember_ros import bench

    params = load_params(*params_files, settings=settings)
    with stages("measuring") as show_stage:
        measured = bench.bench(params, report=show_stage, **sizes)
    made = bench.write(measured, out, command_line())
    console.print(grid(bench.lines(measured)))
    _print_files(out, made)
