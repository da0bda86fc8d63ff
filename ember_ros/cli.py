"""``ember``: train a leg, let four of them walk, see what came of it, measure the speed."""

from __future__ import annotations

import errno
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from rich.table import Table as Grid

import ember_ros
from ember_ros.bag.storage import BagOptions
from ember_ros.cli_bags import COMMANDS, FOLDER, INTERRUPTED, NAMESPACE, PARAMS, SET
from ember_ros.errors import EmberError, ParameterError, need
from ember_ros.experiments import isotropy, lab, relearn
from ember_ros.experiments.reproduction import ALL, DOCUMENT, RESULTS, STUDIES, document, read
from ember_ros.experiments.study import Size, Study, belongs, collect, write
from ember_ros.experiments.words import Found
from ember_ros.params import SPECS, Params
from ember_ros.params_file import changed, dump_params, load_params, range_of
from ember_ros.plan import Plan
from ember_ros.resume import beginning, resumed
from ember_ros.run import (
    PICTURE,
    SUMMARY,
    TABLE,
    WAYS,
    GoOn,
    need_ros,
    recover,
    refuse_to_replace,
    run,
)
from ember_ros.spinning import Stop, prepare_environment, stop_signals
from ember_ros.terminal import console, doing, progress, say_all_paths, typed

RELEARN, ISOTROPY = "relearn", "isotropy"
"""The experiments that are not made of trials."""


class _Group(click.Group):
    """Says errors of ours in one line, with exit code 2, as click does its own."""

    def invoke(self, ctx: click.Context) -> Any:
        say_all_paths()
        try:
            return super().invoke(ctx)
        except EmberError as error:
            click.echo(f"error: {error}", err=True)
            ctx.exit(error.code)
        except OSError as error:  # a full disk, a folder where a file should be
            if error.errno == errno.EPIPE:
                raise  # click's own
            where = f": {error.filename}" if error.filename else ""
            click.echo(f"error: {error.strerror or error}{where}", err=True)
            ctx.exit(2)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(ember_ros.__version__, prog_name="ember_ros")
def main() -> None:
    """Legs that learn to walk, each a module of its own, on a ROS 2 graph.

    A leg learns alone on the trainer (`ember train`); four legs with what it learnt carry a body
    and go on learning (`ember walk`). `ember demo` does both and draws a picture.

    After Jacob, Polani and Nehaniv, "Legs that can walk" (2005).
    """


FORCE = click.option(
    "--force", is_flag=True, help="Replace an earlier run in --out, once the new one has begun."
)


def _options(*, cycles: int, out: str, way: str) -> Callable[[Any], Any]:
    """Add the options that `train` and `walk` share."""

    def add(command: Any) -> Any:
        for option in (
            FORCE,
            click.option(
                "--split-s",
                type=click.FloatRange(0.0),
                default=0.0,
                help="Begin a new file of the bag after so many simulated seconds.",
            ),
            click.option(
                "--split-mb",
                type=click.FloatRange(0.0),
                default=0.0,
                help="Begin a new file of the bag after so many megabytes.",
            ),
            click.option(
                "--bag",
                type=click.Path(path_type=Path),
                help="Record the run into this new folder; see `ember replay --help`.",
            ),
            click.option(
                "--on",
                "way",
                type=click.Choice(WAYS),
                default=way,
                show_default=True,
                help="loop: no ROS, fastest. graph: all nodes in this process. processes: one "
                "process a node. All three end with the same bits.",
            ),
            NAMESPACE,
            click.option(
                "--policy",
                type=click.Choice(["learned", "scripted", "random"]),
                default="learned",
                show_default=True,
                help="How the knee is chosen; scripted and random are baselines.",
            ),
            click.option(
                "--learn/--freeze",
                "learning",
                default=None,
                help="Whether the table changes. Default: it does with --policy learned.",
            ),
            click.option(
                "--table",
                type=click.Path(path_type=Path),
                help="Start from this table.npz instead of from nothing.",
            ),
            click.option(
                "--resume",
                type=FOLDER,
                metavar="RUN",
                help="Go on from the run in this folder: with its table and parameters, "
                "exploration and cycle count where they were. The world begins anew, so it is not "
                "the run that would have come without the stop.",
            ),
            PARAMS,
            SET,
            click.option(
                "--out",
                type=FOLDER,
                default=out,
                show_default=True,
                help="Folder for table.npz, cycles.csv, summary.json and run.png.",
            ),
            click.option("--seed", type=int, default=0, show_default=True, help="Of the run."),
            click.option(
                "--cycles",
                type=int,
                default=cycles,
                show_default=True,
                help="Cycles of the pattern generator: steps of each leg.",
            ),
        ):
            command = option(command)
        return command

    return add


@main.command()
@_options(cycles=6000, out="out/train", way="loop")
def train(**options: Any) -> None:
    """Train one leg on the cantilever trainer.

    \b
    ember train                              6000 steps, about half a minute
    ember train --seed 3 --out out/seed3     another one
    ember walk --table out/train/table.npz   let four such legs walk
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    _run("trainer", **options)


@main.command()
@_options(cycles=300, out="out/walk", way="graph")
def walk(**options: Any) -> None:
    """Let four legs carry a body, still learning.

    \b
    ember walk --table out/train/table.npz   legs that a trainer has taught
    ember walk                               legs that know nothing yet
    ember walk --policy scripted             a knee written by hand
    ember walk --on processes --table ...    seven processes
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    _run("walker", **options)


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
        start_cycle, was = resumed(resume, world)
        params = params if params_files else changed(was, settings)
    plan = Plan(
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
    for line in beginning(plan):
        console.print(line)
    with stop_signals() as stop:
        into = BagOptions(bag, split_mb, split_s) if bag else None
        record, summary = _show(plan, way, out, stop, into, namespace, replace=force)
        what = "trained" if world == "trainer" else "walked"
        drawn = _draw(out / PICTURE, plan, **{what: record})
    console.print(_grid({what: summary}))
    picture = f", {PICTURE}" if drawn else "; no whole cycle to draw"
    console.print(f"In {out}: {TABLE}, cycles.csv, {SUMMARY}{picture}")
    if bag and summary["cycles"]:
        what = "the whole run" if summary["complete"] else "the run until then"
        console.print(f"In {bag}: {what}; `ember replay {bag}` runs it again")
    if not summary["complete"]:
        _end_early(summary, out)


def _show(
    plan: Plan,
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
    label = "walking" if plan.world == "walker" else "training"
    with _progress(f"{label} ({way})", plan.cycles, stop) as go_on:
        record, summary = run(plan, way, out, go_on, typed(), bag, namespace, replace)
        go_on(summary["cycles"], summary["falls"])
    return record, summary


def _draw(file: Path, plan: Plan, **records: Any) -> bool:
    from ember_ros.report import figures

    return figures.draw(file, ticks=plan.params.gait.ticks, **records)


def _end_early(summary: dict[str, Any], out: Path) -> None:
    console.print(f"Stopped after {summary['cycles']} cycles; what was learnt is in {out / TABLE}.")
    sys.exit(INTERRUPTED)


@contextmanager
def _progress(label: str, total: int, stop: Stop, unit: str = "cycles") -> Iterator[GoOn]:
    with progress(label, total) as update:

        def go_on(done: int, falls: int) -> bool:
            if unit == "cycles":
                update(done, f"{done}/{total} cycles, {falls} falls")
            else:
                update(done, f"{done} %" if unit == "%" else f"{done}/{total} {unit}")
            return not stop.asked

        yield go_on


def _number(value: float | None, form: str = ".3f") -> str:
    return "-" if value is None else format(value, form)


def _grid(summaries: dict[str, dict[str, Any]]) -> Grid:
    """Lay summaries out side by side for the terminal."""
    grid = Grid(show_header=len(summaries) > 1, box=None, padding=(0, 2, 0, 0))
    grid.add_column("")
    for name in summaries:
        grid.add_column(name, justify="right")
    lines: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("cycles", lambda s: str(s["cycles"])),
        ("falls", lambda s: "-" if s["world"] == "trainer" else str(s["falls"])),
        ("first and last mean cycles", lambda s: str(s["first"]["cycles"])),
        ("distance a cycle, first, m", lambda s: _number(s["first"]["distance_per_cycle_m"])),
        ("distance a cycle, last, m", lambda s: _number(s["last"]["distance_per_cycle_m"])),
        ("stance contact, last", lambda s: _number(s["last"]["contact_share"], ".0%")),
        ("peak force, first, N", lambda s: _number(s["first"]["peak_force_n"], ".0f")),
        ("peak force, last, N", lambda s: _number(s["last"]["peak_force_n"], ".0f")),
        ("ticks a second", lambda s: _number(s["ticks_per_s"], ".0f")),
        ("table SHA-256", lambda s: s["table_sha256"][:12]),
        ("commands SHA-256", lambda s: s["commands_sha256"][:12]),
        ("senses SHA-256", lambda s: s["senses_sha256"][:12]),
    ]
    for label, show in lines:
        grid.add_row(label, *(show(summary) for summary in summaries.values()))
    return grid


@main.command()
@click.option("--cycles", type=int, default=6000, show_default=True, help="On the trainer.")
@click.option("--walk-cycles", type=int, default=300, show_default=True, help="On the body.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of both runs.")
@NAMESPACE
@PARAMS
@SET
@click.option(
    "--out",
    type=FOLDER,
    default="out/demo",
    show_default=True,
    help="Folder for both runs and demo.png.",
)
@FORCE
def demo(
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
    training = Plan("trainer", cycles, seed=seed, params=params)
    walking = Plan("walker", walk_cycles, seed=seed, params=params, table=out / "train" / TABLE)
    with stop_signals() as stop:
        trained, first = _show(training, "loop", out / "train", stop, replace=force)
        (out / "demo.png").unlink(missing_ok=True)  # it shows another training
        summaries, records = {"one leg, trainer": first}, {"trained": trained}
        if not stop.asked:
            walked, second = _show(
                walking, "graph", out / "walk", stop, namespace=namespace, replace=force
            )
            summaries["four legs, body"], records["walked"] = second, walked
        drawn = _draw(out / "demo.png", training, **records)
    console.print(_grid(summaries))
    picture = "demo.png" if drawn else "no whole cycle to draw"
    runs = " and ".join(["train", "walk"][: len(summaries)])
    console.print(f"In {out}: {picture}, and the runs in {runs}")
    last = list(summaries.values())[-1]
    if stop.asked:
        _end_early(last, out / ("walk" if len(summaries) > 1 else "train"))


@main.command()
@click.option("--cycles", type=click.IntRange(4), default=100, show_default=True, help="A walk's.")
@click.option("--repeats", type=click.IntRange(1), default=5, show_default=True, help="Turns.")
@click.option("--train-cycles", type=click.IntRange(1), default=6000, show_default=True)
@click.option("--epochs", type=click.IntRange(10), default=10_000, show_default=True)
@PARAMS
@SET
@click.option(
    "--out",
    type=FOLDER,
    default="out/bench",
    show_default=True,
    help="Folder for bench.json and bench.md.",
)
def bench(
    params_files: tuple[Path, ...], settings: tuple[str, ...], out: Path, **sizes: int
) -> None:
    """Measure ticks a second and what a tick costs.

    One walk is run by physics alone, the loop, the graph in one process and in seven, in turn and
    over and over; medians and ratios within one turn are printed. The machine should be idle.
    """
    from ember_ros import bench as measure

    params = load_params(*params_files, settings=settings)
    with doing("measuring") as say:
        found = measure.bench(params, say=say, **sizes)
    out.mkdir(parents=True, exist_ok=True)
    (out / "bench.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    text = measure.page(found, typed())
    (out / "bench.md").write_text(text, encoding="utf-8")
    grid = Grid(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, figure in measure.lines(found):
        grid.add_row(name, figure)
    console.print(grid)
    console.print(f"In {out}: bench.md, bench.json")


@main.command()
@click.argument("name", type=click.Choice([*STUDIES, RELEARN, ISOTROPY, ALL]))
@click.option(
    "--seeds",
    type=click.IntRange(1, 100),  # from 100 on they are held out
    help="How many; of learners at most 4, of sensitivity 3. Default: 10 (relearn: 5; isotropy "
    "has one).",
)
@click.option(
    "--cycles",
    type=click.IntRange(1),
    help="On the trainer. Default: 6000 (relearn: that are recorded, 1000).",
)
@click.option(
    "--walk-cycles",
    type=click.IntRange(1),
    help="On the body, where a walk is long; others take 1/14. "
    "Default: 7000 (relearn: 300, isotropy: 500).",
)
@click.option(
    "--out",
    type=FOLDER,
    default="out/experiments",
    show_default=True,
    help="Folder for REPRODUCTION.md, and for results/NAME.md, .json, .csv and .png.",
)
@click.option(
    "--trials",
    type=FOLDER,
    default="out/trials",
    show_default=True,
    help="Folder of all single runs; what is there is not run again.",
)
@click.option(
    "--redraw",
    is_flag=True,
    help="Run nothing: make pages, tables and figures again from the results in --out.",
)
def experiment(
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
    command = typed()
    if name == RELEARN:
        if redraw:
            _write_page(name, read(name, out / RESULTS), relearn.page, out)
        else:
            _relearn(seeds or 5, cycles or relearn.CYCLES, walk_cycles or 300, out, trials, command)
        return
    need("matplotlib", why="to draw what comes of it")
    if name == ISOTROPY:
        if seeds not in (None, 1):
            raise click.UsageError("isotropy has one training: --seeds is not for it")
        if redraw:
            _write_isotropy(read(name, out / RESULTS), out)
        else:
            _isotropy(cycles or 6000, walk_cycles or 500, out, trials, command)
        return
    need("scipy", why="for the statistics of experiments")
    studies = list(STUDIES.values()) if name == ALL else [STUDIES[name]]
    if redraw:
        _redraw(studies, out)
        return
    size = Size(seeds or 10, cycles or 6000, walk_cycles or 7000)
    needed = [trial for study in studies for arm in study.arms(size) for trial in arm.trials]
    with stop_signals() as stop, _progress(name, 100, stop, "%") as go_on:
        whole = lab.run_all(needed, trials, lambda spent, of: go_on(100 * spent // of, 0))
    if not whole:
        console.print(f"Stopped; what was run is in {trials}, and is not run again.")
        sys.exit(INTERRUPTED)
    _write(studies, [collect(study, size, command, trials) for study in studies], out)


def _redraw(studies: Sequence[Study], out: Path) -> None:
    """Write again what is made from results that are there."""
    found = [read(study.name, out / RESULTS) for study in studies]
    for study, each in zip(studies, found, strict=True):
        why = belongs(study, each)
        if why is not None:
            console.print(f"{study.name}: not what this version would come to: {why}")
    try:
        _write(studies, found, out)
    except KeyError as error:
        raise ParameterError(
            f"what this version draws is not in these results: {error}; without --redraw they are "
            "made again"
        ) from error


def _write(studies: Sequence[Study], found: Sequence[Found], out: Path) -> None:
    for study, each in zip(studies, found, strict=True):
        write(study, each, out / RESULTS)
    made = [f"{study.name}.md" for study in studies]
    if len(studies) == len(STUDIES):
        (out / DOCUMENT).write_text(document(out / RESULTS), encoding="utf-8")
        made.append(f"../{DOCUMENT}")
    console.print(f"In {out / RESULTS}: {', '.join(made)}, with .json, .csv and .png of each")


def _relearn(
    seeds: int, cycles: int, walk_cycles: int, out: Path, trials: Path, command: str
) -> None:
    with stop_signals() as stop, _progress(RELEARN, seeds, stop, "seeds") as go_on:
        found = relearn.relearn_experiment(
            seeds, cycles, walk_cycles, trials / RELEARN, lambda done, of: go_on(done, 0), command
        )
    if len(found["seeds"]) < seeds:
        console.print(f"Stopped after {len(found['seeds'])} of {seeds} seeds; nothing was written.")
        sys.exit(INTERRUPTED)
    _write_page(RELEARN, found, relearn.page, out)


def _isotropy(cycles: int, walk_cycles: int, out: Path, trials: Path, command: str) -> None:
    need("pybullet", why="to build the worlds")
    with stop_signals() as stop, _progress(ISOTROPY, 100, stop, "%") as go_on:
        found = isotropy.isotropy_experiment(
            cycles, walk_cycles, trials, lambda done, of: go_on(100 * done // of, 0), command
        )
    if found is None:
        console.print("Stopped; nothing was written.")
        sys.exit(INTERRUPTED)
    _write_isotropy(found, out)


def _write_isotropy(found: Found, out: Path) -> None:
    isotropy.draw(found, out / RESULTS / f"{ISOTROPY}.png")
    _write_page(ISOTROPY, found, isotropy.page, out)


def _write_page(name: str, found: Found, page: Callable[[Found], str], out: Path) -> None:
    """Write the page and the numbers of an experiment that has no trials of its own."""
    folder = out / RESULTS
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(page(found), encoding="utf-8")
    (folder / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    made = [f"{name}.md", f"{name}.json", *(file.name for file in folder.glob(f"{name}.png"))]
    console.print(f"In {folder}: {', '.join(made)}")


@main.command("params")
@click.option("--describe", is_flag=True, help="Say unit, range and meaning instead of YAML.")
def params_command(describe: bool) -> None:
    """Print every parameter, as a file to edit or as a list to read.

    \b
    ember params > mine.yaml
    ember walk --params mine.yaml
    ros2 run ember_ros sim_node --ros-args --params-file mine.yaml
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    if not describe:
        click.echo(dump_params(Params()), nl=False)
        return
    for name, spec in SPECS.items():
        default = spec.default
        shown = ", ".join(map(str, default)) if isinstance(default, tuple) else str(default)
        click.echo(f"{name} = {shown} [{spec.unit}], {range_of(spec)}")
        click.echo(f"    {spec.doc}")


for command in COMMANDS:
    main.add_command(command)
