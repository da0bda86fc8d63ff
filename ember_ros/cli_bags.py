"""The commands of ``ember`` that begin with a bag: replay, play, relearn, and a look inside."""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
from rich.table import Table as Grid

from ember_ros.bag import look
from ember_ros.bag.reading import Bag
from ember_ros.bag.relearn import relearn
from ember_ros.bag.repair import repair
from ember_ros.bag.replay import WAYS, replay, verdict
from ember_ros.errors import BagError, ParameterError, no_ros
from ember_ros.params import SPECS, replace
from ember_ros.params_file import changed, config_names, dump_params, load_params, read_settings
from ember_ros.run import TABLE
from ember_ros.spinning import prepare_environment, stop_signals
from ember_ros.terminal import console, progress, typed
from leg_node.table_file import load_table, save_table

DIFFERENT = 1
"""Exit code of a replay that came out otherwise, or of a bag with damage in it."""
INTERRUPTED = 130
"""Exit code of an end by Ctrl-C, as the shell has it."""
LOOK_S = 1.0
"""Wall time that a player looks whether somebody else is on the topics."""

PARAMS = click.option(
    "--params",
    "params_files",
    multiple=True,
    type=click.Path(path_type=Path),
    help="A ROS parameter file (section /**; `ember params` prints one), or the name of one that "
    f"comes with the package: {', '.join(config_names())}. May be given more than once; what a "
    "later one says wins.",
)


def _settings(
    context: click.Context, parameter: click.Parameter, given: tuple[str, ...]
) -> tuple[str, ...]:
    read_settings(given)  # what is wrong with one is said before anything is opened
    return given


SET = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="GROUP.FIELD=VALUE",
    callback=_settings,
    help="One parameter, on top of --params; may be given more than once.",
)
"""Beside every ``PARAMS``."""


class _Folder(click.Path):
    """A folder; no name is none: it would be this folder here."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return its path."""
        if value == "":
            self.fail("'' names no folder; `.` is the one you are in", param, ctx)
        return super().convert(value, param, ctx)


FOLDER = _Folder(path_type=Path, file_okay=False)


class _Namespace(click.ParamType):  # type: ignore[type-arg, unused-ignore]
    """The name of a robot: words as ROS has them, with slashes between them."""

    name = "namespace"

    def convert(self, value: str, param: Any, ctx: Any) -> str:
        """Return the namespace without slashes around it."""
        name = value.strip("/")
        if name and not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
            self.fail(f"{value!r} is no namespace; letters, digits and _ would be right: robot_2")
        return name


NAMESPACE = click.option(
    "--namespace",
    type=_Namespace(),
    default="",
    help="Of all nodes, as robot_2: beside another robot on the same graph.",
)
_BAG = click.argument("bag", type=click.Path(path_type=Path))
_NAMESPACE = click.option("--namespace", help="Of the robot, where the bag holds more than one.")


def _grid(lines: list[tuple[str, Any]]) -> Grid:
    grid = Grid(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in lines:
        grid.add_row(name, str(value))
    return grid


def _robot(bag: Path, namespace: str | None, way: str) -> Bag:
    """Open a bag at one of its robots; a graph runs its only one in whatever namespace is asked."""
    if way == "graph" and namespace is not None:
        with contextlib.suppress(BagError):  # more than one, or said below
            return Bag(bag)
    return Bag(bag, namespace=namespace)


@click.command("replay")
@_BAG
@click.option(
    "--on",
    "way",
    type=click.Choice(WAYS),
    default="loop",
    show_default=True,
    help="loop: no ROS, fastest. graph: real leg nodes, table node and CPG node.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0.0),
    default=0.0,
    show_default=True,
    help="Times real time; 0: as fast as can be.",
)
@click.option(
    "--namespace",
    type=_Namespace(),
    help="Of the robot, where the bag holds more than one; with --on graph, of the nodes as well.",
)
@click.option(
    "--table",
    "table_file",
    type=click.Path(path_type=Path),
    help="Write its table here, into a new file.",
)
def replay_command(
    bag: Path, way: str, rate: float, namespace: str | None, table_file: Path | None
) -> None:
    """Run a recorded run again, and hold it against the record.

    Four fresh leg modules start as the recorded ones did, and are shown what these sensed. Every
    command and the table at the end must be equal, bit for bit. The exit code is 0 if they are, 1
    if not; then the first difference is told.

    \b
    ember replay bags/walk
    ember replay bags/walk --on graph --rate 1
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    if table_file is not None and table_file.exists():
        raise ParameterError(f"{table_file} is there already; a new file would be right")
    with stop_signals() as stop, _robot(bag, namespace, way) as opened:
        from ember_ros import topics

        with progress(f"replaying ({way})", opened.messages(topics.PHASE)) as update:

            def go_on(ticks: int) -> bool:
                if ticks % 32 == 0:
                    update(ticks, f"{ticks} ticks")
                return not stop.asked

            try:
                done = replay(opened, on=way, rate=rate, namespace=namespace or "", go_on=go_on)
            except ModuleNotFoundError as error:
                raise no_ros(error) from error
            update(done.ticks, f"{done.ticks} ticks")
        tick_s = opened.params.gait.tick_s
        if table_file is not None:
            save_table(table_file, done.table, opened.params, 0)
            console.print(f"In {table_file}: the table in the end")
    sha = done.table.sha256()
    faster = done.ticks * tick_s / done.seconds if done.seconds else 0.0
    lines: list[tuple[str, Any]] = [
        ("ticks", f"{done.ticks} ({done.cycles:g} cycles), {faster:.0f} times real time"),
        ("commands", f"{done.compared} held against the record"),
    ]
    lines += [(leg, f"{n} ticks without a recorded command") for leg, n in done.unanswered.items()]
    if done.stopped:
        known = "not compared: stopped before the end"
    elif done.recorded_sha256 is None:
        known = "the run's own was not recorded"
    else:
        same = done.recorded_sha256 == sha
        known = "as recorded" if same else f"recorded was {done.recorded_sha256[:12]}"
    lines.append(("table SHA-256", f"{sha[:12]}, {known}"))
    console.print(_grid(lines))
    if done.missing:
        console.print(f"The record ends early: {done.missing}.")
    if done.difference is not None:
        console.print(f"First difference: {done.difference}.")
    if done.paid_otherwise is not None:
        console.print(f"First difference in what a leg was paid: {done.paid_otherwise}.")
    console.print(verdict(done.parts, whole=not (done.stopped or done.missing)))
    if not done.equal:
        sys.exit(DIFFERENT)
    if stop.asked:
        sys.exit(INTERRUPTED)


@click.command("play")
@_BAG
@click.option("--rate", type=click.FloatRange(0.0, min_open=True), default=1.0, show_default=True)
@click.option(
    "--start", type=click.FloatRange(0.0), default=0.0, help="Simulated seconds to leave out."
)
@click.option("--paused", is_flag=True, help="Begin paused.")
@click.option(
    "--live",
    multiple=True,
    metavar="LEG",
    help="Leave this leg's commands out: a live leg node says them. It begins when that is there.",
)
@_NAMESPACE
def play(
    bag: Path,
    rate: float,
    start: float,
    paused: bool,
    live: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Publish a bag's topics again, for rviz, Foxglove, PlotJuggler.

    /clock is among them. The space key pauses, and so does the service play/pause
    (std_srvs/SetBool).

    \b
    ember play bags/walk --rate 0.25
    ember play bags/walk --live front_left   beside a leg_node of that name, -p shared:=false
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    prepare_environment()
    try:
        import rclpy
        from rclpy.experimental.events_executor import EventsExecutor
        from rclpy.signals import SignalHandlerOptions

        from ember_ros.bag.player_node import LONGEST_S, PlayerNode
    except ModuleNotFoundError as error:
        raise no_ros(error) from error
    with stop_signals() as stop, Bag(bag, namespace=namespace) as opened:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = None
        try:
            node = PlayerNode(opened, rate=rate, start_s=start, paused=True, live=live)
            executor = EventsExecutor()
            executor.add_node(node)
            deadline = time.monotonic() + LOOK_S
            while time.monotonic() < deadline and not stop.asked:
                executor.spin_once(timeout_sec=LONGEST_S)
            if others := node.others():
                raise BagError(
                    f"a robot is running here: {', '.join(others[:3])} and the like are published "
                    "by others, who would take the recorded ones for theirs; stop it, or play in "
                    "another ROS_DOMAIN_ID"
                )
            node.paused = paused
            with progress("playing", node.messages) as update, _space() as pressed:
                while not stop.asked and not node.done:
                    executor.spin_once(timeout_sec=LONGEST_S)
                    if pressed():
                        node.paused = not node.paused
                    paused_now = ", paused" if node.paused else ""
                    update(node.played, f"{node.seconds:.1f} s{paused_now}")
            if node.failed is not None:
                raise node.failed
            console.print(f"{node.played} messages")
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
    if stop.asked:
        sys.exit(INTERRUPTED)


@contextlib.contextmanager
def _space() -> Iterator[Callable[[], bool]]:
    """Give a function that tells whether the space key was pressed, where there are keys."""
    if not sys.stdin.isatty():
        yield lambda: False
        return
    import termios
    import tty

    keys = sys.stdin.fileno()
    before = termios.tcgetattr(keys)
    tty.setcbreak(keys)

    def pressed() -> bool:
        if not select.select([keys], [], [], 0.0)[0]:
            return False
        with contextlib.suppress(OSError):  # the terminal is gone
            return os.read(keys, 64).count(b" ") % 2 == 1
        return False

    try:
        yield pressed
    finally:
        with contextlib.suppress(termios.error):  # the same
            termios.tcsetattr(keys, termios.TCSADRAIN, before)


# -- learning again --------------------------------------------------------------------------


def _numbers(command: Any) -> Any:
    """Add an option for every reward and every edge of the partition, by its full name."""
    for name, spec in reversed(list(SPECS.items())):
        if name.split(".")[0] in ("reward", "state"):
            kind: Any = int if isinstance(spec.default, int) else float
            if isinstance(spec.default, tuple):
                kind = _Numbers()
            help_text = f"{spec.doc} [{spec.unit}]"
            command = click.option(f"--{name}", name.replace(".", "__"), type=kind, help=help_text)(
                command
            )
    return command


class _Numbers(click.ParamType):  # type: ignore[type-arg, unused-ignore]
    """Numbers with commas between them."""

    name = "float,float,..."

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, ...]:
        """Return the numbers."""
        try:
            return tuple(float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is no list of numbers; 0.1,0.5,1 would be right", param, ctx)


@click.command("relearn")
@click.argument("bags", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--alpha", type=float, help="Least learning rate: alpha_floor of the stage.")
@click.option("--gamma", type=float, help="Discount a tick.")
@click.option("--bins", type=int, help="Partitions of the hip's range: state.hip_bins.")
@click.option(
    "--passes", type=click.IntRange(1), default=1, show_default=True, help="Over all bags."
)
@click.option(
    "--stage",
    type=click.Choice(["train", "walk"]),
    help="Which learning numbers hold. Default: those of the first bag's world.",
)
@click.option("--table", type=click.Path(path_type=Path), help="Start from it, not from nothing.")
@PARAMS
@SET
@_NAMESPACE
@click.option(
    "--out",
    type=FOLDER,
    default="out/relearn",
    show_default=True,
    help="Folder for table.npz, params.yaml and relearn.json.",
)
@click.option("--force", is_flag=True, help="Replace what an earlier relearn left in --out.")
@_numbers
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
    """Learn a table from bags, with other numbers, without one new tick.

    Q-learning is off-policy: whatever the legs did when the bags were recorded, the table that
    would have been learnt from it with these rewards, partitions and rates is worked out, bag
    after bag in the order given. Numbers are those of the first bag, or those of --params.

    \b
    ember relearn bags/walk --gamma 0.9 --reward.slip 2
    ember relearn out/random*/bag --passes 5 --bins 25
    ember walk --table out/relearn/table.npz --params out/relearn/params.yaml
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    kept = [name for name in (TABLE, "relearn.json") if (out / name).exists()]
    if kept and not force:
        raise ParameterError(
            f"{out} holds {', '.join(kept)} already; give another --out, or --force to replace it"
        )
    given = load_params(*params_files) if params_files else None
    with Bag(bags[0], namespace=namespace, params=given) as first:
        stage = stage or first.stage
        base = changed(given or first.params, settings)
    changes = {name.replace("__", "."): value for name, value in numbers.items()}
    changes |= {f"{stage}.alpha_floor": alpha, f"{stage}.gamma": gamma}
    rate = base.walk.rate if stage == "walk" else base.train.rate
    if alpha is not None and (alpha > rate.ceiling or rate.floor == rate.ceiling):
        changes[f"{stage}.alpha_ceiling"] = alpha  # so that a constant rate stays one
    if bins is not None:
        changes["state.hip_bins"] = bins
    changes = {name: value for name, value in changes.items() if value is not None}
    start = load_table(table, replace(base, changes))[0] if table else None
    total = passes * sum(_ticks(bag, namespace, base) for bag in bags)
    with stop_signals() as stop, progress("learning", total) as update:

        def go_on(ticks: int, falls: int) -> bool:
            if ticks % 64 == 0:
                update(ticks, f"{ticks} ticks, {falls} falls")
            return not stop.asked

        try:
            learnt = relearn(
                bags,
                changes,
                params=given,
                stage=stage,
                table=start,
                passes=passes,
                namespace=namespace,
                go_on=go_on,
            )
        except BagError as error:
            if not stop.asked:
                raise
            click.echo(f"error: {error}", err=True)
            sys.exit(INTERRUPTED)
        update(total, f"{learnt.ticks} ticks, {learnt.falls} falls")
    visited = int((learnt.table.visits > 0).sum())
    told = {
        "command": typed(),
        "bags": [str(bag) for bag in bags],
        "passes": passes,
        "stage": stage,
        "changes": changes,
        "start_table": str(table) if table else None,
        "ticks": learnt.ticks,
        "updates": learnt.updates,
        "skipped": learnt.skipped,
        "falls": learnt.falls,
        "cells_visited": visited,
        "cells": len(learnt.table),
        "table_sha256": learnt.table.sha256(),
    }
    save_table(out / TABLE, learnt.table, learnt.params, 0, {"relearnt": told})
    (out / "params.yaml").write_text(dump_params(learnt.params), encoding="utf-8")
    (out / "relearn.json").write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    console.print(
        _grid(
            [
                ("ticks", f"{learnt.ticks}, {learnt.falls} falls among them"),
                ("updates", learnt.updates),
                ("skipped", f"{learnt.skipped} ticks of single legs without senses or command"),
                ("cells visited", f"{visited} of {len(learnt.table)}"),
                ("table SHA-256", learnt.table.sha256()[:12]),
            ]
        )
    )
    console.print(
        f"In {out}: {TABLE}, params.yaml, relearn.json\n"
        f"ember walk --table {out / TABLE} --params {out / 'params.yaml'}"
    )


def _ticks(bag: Path, namespace: str | None, params: Any) -> int:
    from ember_ros import topics

    with Bag(bag, namespace=namespace, params=params) as opened:
        return opened.messages(topics.PHASE)


# -- looking ---------------------------------------------------------------------------------


@click.group("bag")
def bag_group() -> None:
    """Look into a bag, write it as CSV, or repair one that was cut off."""


@bag_group.command("info")
@_BAG
@_NAMESPACE
@click.option("--cycles", is_flag=True, help="A line for every cycle too.")
@click.option("--json", "as_json", is_flag=True, help="As JSON, cycles and all.")
def bag_info(bag: Path, namespace: str | None, cycles: bool, as_json: bool) -> None:
    """Tell what is inside: run, cycles, falls, gaps, damage, provenance."""
    with Bag(bag, namespace=namespace) as opened:
        found, rows = look.info(opened)
    if as_json:
        found["rows"] = [row._asdict() for row in rows]
        click.echo(json.dumps(found, indent=2))
    else:
        console.print(_grid(_told(found)))
        console.print(_cycles(rows, whole=cycles))
    if found["damaged"]:
        sys.exit(DIFFERENT)


def _told(found: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return what is in a bag in words."""
    files = found.get("files", {})
    size = sum(files.values()) / 1e6
    lines: list[tuple[str, Any]] = [("bag", found["bag"])]
    if files:
        count = "1 file" if len(files) == 1 else f"{len(files)} files"
        lines.append(("storage", f"{found['storage']}, {count}, {size:.2f} MB"))
    lines += [
        ("robot", f"{found['namespace']}, {found['world']}"),
        (
            "ticks",
            f"{found['ticks']} from {found['first_tick']} on: {found['seconds']:g} s, "
            f"{found['cycles']:g} cycles",
        ),
        ("messages", f"{sum(found['messages'].values())} on {len(found['messages'])} topics"),
        ("falls", found["falls"]),
        ("distance", f"{found['distance_m']:.3f} m"),
        ("lost ticks", found["lost_ticks"]),
    ]
    lines += [("  gap", f"ticks {first} to {last}") for first, last in found["gaps"]]
    for key, what in (("senses", "whole senses"), ("command", "a command")):
        lines += [
            (f"  {leg}", f"{n} ticks without {what}")
            for leg, n in found[f"ticks_without_{key}"].items()
        ]
    lines += [
        ("  damaged", f"tick {d['tick']}, {d['leg']}: senses are not those that were recorded")
        for d in found["damaged"]
    ]
    lines += [(name.replace("_", " "), each) for name, each in found.get("provenance", {}).items()]
    card = found.get("card")
    if card is None:
        lines.append(("run", "not told: made by another recorder, cannot be replayed"))
    else:
        told = {json.dumps(each, sort_keys=True) for each in card["legs"].values()}
        for each in map(json.loads, sorted(told)):
            said = ", ".join(f"{name} {value}" for name, value in each.items())
            lines.append(("legs", said))
        lines.append(("versions", ", ".join(f"{k} {v}" for k, v in card["versions"].items())))
        lines.append(("parameters SHA-256", card["params_sha256"][:12]))
        lines.append(("table SHA-256, start", (card["start_table_sha256"] or "not known")[:12]))
    if found["table_sha256"]:
        lines.append(("table SHA-256, end", found["table_sha256"][:12]))
    return lines


def _cycles(rows: list[Any], *, whole: bool) -> Grid:
    """Return a line a module over all cycles, or a line a cycle and module."""
    grid = Grid(box=None, padding=(0, 2, 0, 0))
    heads = ("cycle" if whole else "cycles", "module", "reward", "contact")
    for head in (*heads, "peak N", "slip m", "distance m", "falls"):
        grid.add_column(head, justify="left" if head == "module" else "right", no_wrap=True)

    def line(first: str, module: str, group: list[Any]) -> None:
        n = len(group)
        body = group[0].falls is not None
        grid.add_row(
            first,
            module,
            f"{sum(row.reward for row in group) / n:.3f}",
            f"{sum(row.contact_share for row in group) / n:.0%}",
            f"{max(row.peak_force_n for row in group):.0f}",
            f"{sum(row.slip_m for row in group):.3f}",
            f"{sum(row.distance_m for row in group):.3f}" if body else "",
            str(sum(row.falls for row in group)) if body else "",
        )

    if whole:
        for row in rows:
            line(str(row.cycle), row.module, [row])
    else:
        for module in dict.fromkeys(row.module for row in rows):
            group = [row for row in rows if row.module == module]
            line(str(len(group)), module, group)
    return grid


@bag_group.command("csv")
@_BAG
@_NAMESPACE
@click.option(
    "--out",
    type=FOLDER,
    default="out/csv",
    show_default=True,
    help="Folder for ticks.csv and cycles.csv.",
)
def bag_csv(bag: Path, namespace: str | None, out: Path) -> None:
    """Write a line a tick and leg, and a line a cycle and leg, for pandas."""
    with Bag(bag, namespace=namespace) as opened:
        files = look.write_csv(opened, out)
    console.print(f"In {out}: {', '.join(file.name for file in files)}")
    for damage in opened.damages:
        console.print(
            f"damaged: tick {damage.tick}, {damage.leg}: senses are not those that were recorded"
        )
    if opened.damages:
        sys.exit(DIFFERENT)


@bag_group.command("repair")
@_BAG
@click.option("--drop-original", is_flag=True, help="Remove the damaged bag when that is done.")
def bag_repair(bag: Path, drop_original: bool) -> None:
    """Bring back what is whole in a bag whose recording was cut off.

    Every chunk that was finished is kept, and metadata.yaml is made anew. The damaged bag stays
    beside the new one, as BAG.orig. A bag with which nothing is wrong is not touched.
    """
    done = repair(bag, drop=drop_original)
    if done.healthy:
        console.print(
            f"Nothing is wrong with {bag}: {done.messages} messages, {done.seconds:.3f} s. Nothing "
            "was touched."
        )
        return
    lines = [
        ("brought back", f"{done.messages} messages, {done.seconds:.3f} s"),
        ("whole chunks", done.chunks),
        ("damaged chunks", done.damaged),
        ("torn at the end", f"{done.torn_bytes} bytes"),
    ]
    with contextlib.suppress(BagError), Bag(bag) as opened:
        from ember_ros import topics

        ticks = opened.messages(topics.PHASE)
        lines.insert(1, ("ticks", f"{ticks} ({ticks / opened.params.gait.ticks:g} cycles)"))
    if done.original is not None:
        lines.append(("the damaged bag", f"{done.original.name}, beside it"))
    console.print(_grid(lines))


COMMANDS = (replay_command, play, relearn_command, bag_group)
