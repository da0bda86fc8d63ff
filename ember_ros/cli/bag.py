"""``ember bag``: a look inside a bag, its numbers as CSV, and its repair."""

from __future__ import annotations

import contextlib
import json
import sys
from pathlib import Path
from typing import Any

import click

from ember_ros.bag import inspection
from ember_ros.bag.reader import Bag
from ember_ros.bag.repair import repair
from ember_ros.cli import options
from ember_ros.cli.codes import DIFFERENT
from ember_ros.errors import BagError
from ember_ros.terminal import console, grid


@click.group("bag")
def bag_command() -> None:
    """Look into a bag, write it as CSV, or repair one that was cut off."""


@bag_command.command("info")
@options.BAG
@options.robot()
@click.option("--cycles", is_flag=True, help="A line for every cycle too.")
@click.option("--json", "as_json", is_flag=True, help="As JSON, cycles and all.")
def _info(bag: Path, namespace: str | None, cycles: bool, as_json: bool) -> None:
    """Tell what is inside: run, cycles, falls, gaps, damage, provenance."""
    with Bag(bag, namespace=namespace) as opened:
        found, rows = inspection.info(opened)
    if as_json:
        found["rows"] = [row._asdict() for row in rows]
        click.echo(json.dumps(found, indent=2))
    else:
        console.print(grid(inspection.told(found)))
        heads = ("cycle" if cycles else "cycles", *inspection.CYCLE_HEADS)
        lines = inspection.cycles_told(rows, whole=cycles)
        console.print(grid(lines, "rl" + "r" * 6, heads, whole=True))
    if found["damaged"]:
        sys.exit(DIFFERENT)


@bag_command.command("csv")
@options.BAG
@options.robot()
@options.out("out/csv", "ticks.csv and cycles.csv")
def _csv(bag: Path, namespace: str | None, out: Path) -> None:
    """Write a line a tick and leg, and a line a cycle and leg, for pandas."""
    with Bag(bag, namespace=namespace) as opened:
        files = inspection.write_csv(opened, out)
    console.print(f"In {out}: {', '.join(file.name for file in files)}")
    for damage in opened.damages:
        console.print(f"damaged: {inspection.damage_told(damage.tick, damage.leg)}")
    if opened.damages:
        sys.exit(DIFFERENT)


@bag_command.command("repair")
@options.BAG
@click.option("--drop-original", is_flag=True, help="Remove the damaged bag when that is done.")
def _repair(bag: Path, drop_original: bool) -> None:
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
    lines: list[tuple[str, Any]] = [
        ("brought back", f"{done.messages} messages, {done.seconds:.3f} s"),
        ("whole chunks", done.chunks),
        ("damaged chunks", done.damaged),
        ("torn at the end", f"{done.torn_bytes} bytes"),
    ]
    with contextlib.suppress(BagError), Bag(bag) as opened:
        ticks = opened.phases()
        lines.insert(1, ("ticks", f"{ticks} ({ticks / opened.params.gait.ticks:g} cycles)"))
    if done.original is not None:
        lines.append(("the damaged bag", f"{done.original.name}, beside it"))
    console.print(grid(lines))
