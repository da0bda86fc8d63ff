"""``ember experiment`` and ``bench``: what the paper's claims come to, and what a tick costs."""

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
from ember_ros.experiments import isotropy, relearn, reproduction
from ember_ros.experiments.reproduction import ALL, RESULTS, STUDIES, read
from ember_ros.experiments.study import Size, Study, belongs
from ember_ros.experiments.words import Found
from ember_ros.params_file import load_params
from ember_ros.spinning import stop_signals
from ember_ros.terminal import command_line, console, grid, progress, stages


@click.command("experiment")
@click.argument("name", type=click.Choice([*STUDIES, relearn.NAME, isotropy.NAME, ALL]))
@click.option(
    "--seeds",
    type=click.IntRange(1, 100),  # from 100 on they are held out
    help="How many; of learners at most 4, of sensitivity 3. Default: 10 (relearn: 5; isotropy "
    "has one).",
)
@options.cycles(
    None, "On the trainer. Default: 6000 (relearn: that are recorded, 1000).", minimum=1
)
@options.cycles(
    None,
    "On the body, where a walk is long; others take 1/14. "
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
    help="Folder of all single runs; what is there is not run again.",
)
@click.option(
    "--redraw",
    is_flag=True,
    help="Run nothing: make pages, tables and figures again from the results in --out.",
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
    """Run an experiment over many seeds, two runs at once, and write what came of it.

    Stopped by Ctrl-C, it goes on where it was when it is started again; isotropy and relearn
    begin their walks anew.

    \b
    fig5         one leg on the trainer, the stop fixed or modulated
    walker       figures 6 and 7, and steps to failure: learning on the body
    direct       legs that know nothing, on the body
    sharing      one table for all legs against one each
    regime       which training walks better
    baselines    by hand, random, frozen, learning, a central learner
    learners     what ember adds to plain, each part alone and left out
    frontier     narrow bodies
    senses       each sense left out; what a walker meets that is new to it
    sensitivity  the mechanics, one number at a time
    relearn      tables learnt from bags of random and scripted walkers
    isotropy     whether the world is the same in every direction
    all          all of the paper's, and the document REPRODUCTION.md
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    results = out / RESULTS
    if name == relearn.NAME:
        found = (
            read(name, results)
            if redraw
            else _relearn(seeds or 5, cycles or relearn.CYCLES, walk_cycles or 300, trials)
        )
        _say_made(results, relearn.write(found, results))
        return
    need("matplotlib", why="to draw what comes of it")
    if name == isotropy.NAME:
        if seeds not in (None, 1):
            raise click.UsageError("isotropy has one training: --seeds is not for it")
        found = (
            read(name, results) if redraw else _isotropy(cycles or 6000, walk_cycles or 500, trials)
        )
        _say_made(results, isotropy.write(found, results))
        return
    need("scipy", why="for the statistics of experiments")
    studies = list(STUDIES.values()) if name == ALL else [STUDIES[name]]
    if redraw:
        made = _redraw(studies, out)
    else:
        size = Size(seeds or 10, cycles or 6000, walk_cycles or 7000)
        made = reproduction.write_all(studies, _run(name, studies, size, trials), out)
    console.print(f"In {results}: {', '.join(made)}, with .json, .csv and .png of each")


def _run(name: str, studies: list[Study], size: Size, trials: Path) -> list[Found]:
    with _going_on(name) as go_on:
        found = reproduction.run(studies, size, trials, go_on, command_line())
    if found is None:
        _stop(f"Stopped; what was run is in {trials}, and is not run again.")
    return found


def _redraw(studies: list[Study], out: Path) -> list[str]:
    """Write again what is made from results that are there."""
    found = [read(study.name, out / RESULTS) for study in studies]
    for study, each in zip(studies, found, strict=True):
        why = belongs(study, each)
        if why is not None:
            console.print(f"{study.name}: not what this version would come to: {why}")
    try:
        return reproduction.write_all(studies, found, out)
    except KeyError as error:
        raise ParameterError(
            f"what this version draws is not in these results: {error}; without --redraw they are "
            "made again"
        ) from error


def _relearn(seeds: int, cycles: int, walk_cycles: int, trials: Path) -> Found:
    folder = trials / relearn.NAME
    with _going_on(relearn.NAME, "seeds") as go_on:
        found = relearn.relearn_experiment(
            seeds, cycles, walk_cycles, folder, go_on, command_line()
        )
    if len(found["seeds"]) < seeds:
        _stop(f"Stopped after {len(found['seeds'])} of {seeds} seeds; nothing was written.")
    return found


def _isotropy(cycles: int, walk_cycles: int, trials: Path) -> Found:
    need("pybullet", why="to build the worlds")
    with _going_on(isotropy.NAME) as go_on:
        found = isotropy.isotropy_experiment(cycles, walk_cycles, trials, go_on, command_line())
    if found is None:
        _stop("Stopped; nothing was written.")
    return found


@contextmanager
def _going_on(label: str, unit: str = "%") -> Iterator[Callable[[int, int], bool]]:
    """Give what is told how much is done of how much, shows it, and says whether to go on."""
    with stop_signals() as stop, progress(label, 100) as update:

        def go_on(done: int, of: int) -> bool:
            percent = 100 * done // of
            update(percent, f"{percent} %" if unit == "%" else f"{done}/{of} {unit}")
            return not stop.requested

        yield go_on


def _stop(why: str) -> NoReturn:
    console.print(why)
    sys.exit(INTERRUPTED)


def _say_made(folder: Path, made: list[str]) -> None:
    console.print(f"In {folder}: {', '.join(made)}")


@click.command("bench")
@options.cycles(100, "A walk's.", minimum=4)
@click.option("--repeats", type=click.IntRange(1), default=5, show_default=True, help="Turns.")
@click.option("--train-cycles", type=click.IntRange(1), default=6000, show_default=True)
@click.option("--epochs", type=click.IntRange(10), default=10_000, show_default=True)
@options.PARAMS
@options.out("out/bench", "bench.json and bench.md")
def bench_command(
    params_files: tuple[Path, ...], settings: tuple[str, ...], out: Path, **sizes: int
) -> None:
    """Measure ticks a second and what a tick costs.

    One walk is run by physics alone, the loop, the graph in one process and in seven, in turn and
    over and over; medians and ratios within one turn are printed. The machine should be idle.
    """
    from ember_ros import bench

    params = load_params(*params_files, settings=settings)
    with stages("measuring") as say:
        found = bench.bench(params, say=say, **sizes)
    made = bench.write(found, out, command_line())
    console.print(grid(bench.lines(found)))
    _say_made(out, made)
