"""``ember replay``, ``play`` and ``relearn``: the commands that use a recorded run."""

from __future__ import annotations

import contextlib
import functools
import sys
from pathlib import Path
from typing import Any

import click

from ember_ros.bag.reader import Bag
from ember_ros.cli import options
from ember_ros.cli.codes import DIFFERENT, INTERRUPTED
from ember_ros.cli.keys import space
from ember_ros.errors import BagError, ParameterError, no_ros
from ember_ros.graph import by_graph
from ember_ros.offline import relearn, replay
from ember_ros.params import SPECS, Params, replace
from ember_ros.params_file import changed, load_params, read_settings
from ember_ros.spinning import prepare_environment, stop_signals
from ember_ros.terminal import command_line, console, grid, progress
from leg_node.table_file import load_table, save_table


def _rate(text: str, **more: Any) -> options.Decorator:
    return click.option("--rate", show_default=True, help=f"Times real time{text}.", **more)


@click.command("replay")
@options.BAG
@options.backend(
    ("loop", "graph"),
    "loop",
    "loop: without ROS, fastest. graph: real leg nodes, table node and CPG node.",
)
@_rate("; 0: as fast as possible", type=options.FiniteRange(0.0), default=0.0)
@options.namespace_in_bag("; with --on graph also the namespace of the nodes")
@click.option(
    "--table", "table_file", type=options.FILE, help="Write the table at the end to this new file."
)
def replay_command(
    bag: Path, backend: str, rate: float, namespace: str | None, table_file: Path | None
) -> None:
    """Repeat a recorded run and compare it with the record.

    New leg modules start in the recorded initial state and receive the recorded senses. All
    commands and the table at the end must be equal, bit for bit. The exit code is 0 if they are,
    and 1 if not; then the first difference is printed.

    \b
    ember replay walk
    ember replay walk --on graph --rate 1
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    if table_file is not None and table_file.exists():
        raise ParameterError(f"{table_file} exists already; a new file would be right")
    run: replay.Runner = replay.by_loop
    if backend == "graph":
        run = functools.partial(by_graph, namespace=namespace or "")
    with stop_signals() as stop, _robot(bag, namespace, backend) as opened:
        with progress(f"replaying ({backend})", opened.phases()) as update:

            def go_on(ticks: int) -> bool:
                if ticks % 32 == 0:
                    update(ticks, f"{ticks} ticks")
                return not stop.requested

            try:
                done = replay.replay(opened, run=run, rate=rate, go_on=go_on)
            except ModuleNotFoundError as error:
                raise no_ros(error) from error
            update(done.ticks, f"{done.ticks} ticks")
        if table_file is not None:
            save_table(table_file, done.table, opened.params, 0)
            console.print(f"In {table_file}: the table at the end")
    console.print(grid(replay.describe(done, opened.params.gait.tick_s)))
    if done.missing:
        console.print(f"The record ends early: {done.missing}.")
    if done.difference is not None:
        console.print(f"First difference: {done.difference}.")
    if done.transition_difference is not None:
        console.print(f"First difference in a transition: {done.transition_difference}.")
    console.print(replay.conclusion_of(done.parts, complete=not (done.stopped or done.missing)))
    if not done.equal:
        sys.exit(DIFFERENT)
    if stop.requested:
        sys.exit(INTERRUPTED)


def _robot(bag: Path, namespace: str | None, backend: str) -> Bag:
    """Open one robot of a bag; a graph can run a bag's only robot in any namespace."""
    if backend == "graph" and namespace is not None:
        with contextlib.suppress(BagError):  # more than one robot, or an error raised below
            return Bag(bag)
    return Bag(bag, namespace=namespace)


@click.command("play")
@options.BAG
@_rate("", type=options.FiniteRange(0.0, min_open=True), default=1.0)
@click.option(
    "--start",
    type=options.FiniteRange(0.0),
    default=0.0,
    help="Simulated seconds to skip at the start.",
)
@click.option("--paused", is_flag=True, help="Start paused.")
@click.option(
    "--live",
    multiple=True,
    metavar="LEG",
    help="Leave out this leg's commands, because a live leg node publishes them. Playing starts "
    "once the node is connected.",
)
@options.namespace_in_bag()
def play_command(
    bag: Path,
    rate: float,
    start: float,
    paused: bool,
    live: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Publish the topics of a bag, for rviz, Foxglove or PlotJuggler.

    They include /clock. The space key pauses, and so does the service play/pause
    (std_srvs/SetBool).

    \b
    ember play walk --rate 0.25
    ember play walk --live front_left   with a leg_node for that leg, -p shared:=false
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    prepare_environment()
    try:
        from ember_ros.bag.player_node import playing
    except ModuleNotFoundError as error:
        raise no_ros(error) from error
    with (
        stop_signals() as stop,
        Bag(bag, namespace=namespace) as opened,
        playing(opened, lambda: not stop.requested, rate=rate, start_s=start, live=live) as player,
    ):
        node, turn = player
        node.paused = paused
        with progress("playing", node.messages) as update, space() as pressed:
            while not stop.requested and not node.done:
                turn()
                if pressed():
                    node.paused = not node.paused
                paused_now = ", paused" if node.paused else ""
                update(node.played, f"{node.seconds:.1f} s{paused_now}")
        if node.failed is not None:
            raise node.failed
        console.print(f"{node.played} messages")
    if stop.requested:
        sys.exit(INTERRUPTED)


class _Numbers(click.ParamType):  # type: ignore[type-arg, unused-ignore]
    """Numbers separated by commas."""

    name = "float,float,..."

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, ...]:
        """Return the numbers."""
        try:
            return tuple(float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not a list of numbers; 0.1,0.5,1 would be right", param, ctx)


def _numbers() -> options.Decorator:
    """Return a decorator that adds an option for each parameter in ``reward`` and ``state``."""
    added = []
    for name, spec in SPECS.items():
        if name.split(".")[0] in ("reward", "state"):
            kind: Any = int if isinstance(spec.default, int) else float
            if isinstance(spec.default, tuple):
                kind = _Numbers()
            text = f"{spec.doc} [{spec.unit}]"
            added.append(click.option(f"--{name}", name.replace(".", "__"), type=kind, help=text))
    return options.combined(*added)


@click.command("relearn")
@click.argument("bags", nargs=-1, required=True, type=options.FILE)
@click.option("--alpha", type=float, help="Minimum learning rate: alpha_floor of the stage.")
@click.option("--gamma", type=float, help="Discount factor per tick.")
@click.option("--bins", type=int, help="Number of bins for the hip angle: state.hip_bins.")
@click.option(
    "--passes", type=click.IntRange(1), default=1, show_default=True, help="Passes over all bags."
)
@options.shared_with_nodes("--stage", also=". Default: that of the first bag's world", default=None)
@options.TABLE
@options.PARAMS
@options.namespace_in_bag()
@options.out("out/relearn", "table.npz, params.yaml and relearn.json")
@options.force("Replace what an earlier relearn left in --out.")
@_numbers()
def relearn_command(
    bags: tuple[Path, ...],
    alpha: float | None,
    gamma: float | None,
    bins: int | None,
    passes: int,
    stage: str | None,
    table: Path | None,
    params_files: tuple[Path, ...],
    settings: tuple[str, ...],
    namespace: str | None,
    out: Path,
    force: bool,
    **numbers: Any,
) -> None:
    """Learn a table from bags with other parameters, offline.

    Q-learning is off-policy: the table is computed from the recorded senses and actions with other
    rewards, partitions and rates, whatever policy was recorded. Bags are processed in the order of
    the command line. Parameters are those of the first bag, or those of --params.

    \b
    ember relearn walk --gamma 0.9 --reward.slip 2
    ember relearn out/random*/bag --passes 5 --bins 25
    ember walk --table out/relearn/table.npz --params out/relearn/params.yaml
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    if not force:
        relearn.refuse_to_replace(out)
    file_params = load_params(*params_files) if params_files else None
    with Bag(bags[0], namespace=namespace, params=file_params) as first:
        stage = stage or first.stage
        base = file_params or first.params
    changes = dict(read_settings(settings))
    named = {name.replace("__", "."): value for name, value in numbers.items()}
    changes |= {name: value for name, value in named.items() if value is not None}
    base_set = changed(base, settings)
    changes |= relearn.short_forms(base_set, stage, alpha=alpha, gamma=gamma, bins=bins)
    start = load_table(table, replace(base, changes))[0] if table else None
    total = passes * sum(_phases(bag, namespace, base) for bag in bags)
    with stop_signals() as stop, progress("learning", total) as update:

        def go_on(ticks: int, falls: int) -> bool:
            if ticks % 64 == 0:
                update(ticks, f"{ticks} ticks, {falls} falls")
            return not stop.requested

        try:
            learnt = relearn.relearn(
                bags,
                changes,
                params=file_params,
                stage=stage,
                table=start,
                passes=passes,
                namespace=namespace,
                go_on=go_on,
            )
        except BagError as error:
            if not stop.requested:
                raise
            click.echo(f"error: {error}", err=True)
            sys.exit(INTERRUPTED)
        update(total, f"{learnt.ticks} ticks, {learnt.falls} falls")
    request = {
        "command": command_line(),
        "bags": [str(bag) for bag in bags],
        "passes": passes,
        "stage": stage,
        "changes": changes,
        "start_table": str(table) if table else None,
    }
    relearn.write(learnt, out, request)
    console.print(grid(relearn.describe(learnt)))
    console.print(f"In {out}: {', '.join(relearn.OUTPUTS)}")
    new = f"--table {out / relearn.TABLE} --params {out / relearn.PARAMS}"
    console.print(f"ember walk {new}")


def _phases(bag: Path, namespace: str | None, params: Params) -> int:
    with Bag(bag, namespace=namespace, params=params) as opened:
        return opened.phases()
