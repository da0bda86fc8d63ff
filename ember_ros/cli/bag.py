"""``ember bag``: shows the content of a bag, exports it as CSV, or repairs it."""

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
    """Show the content of a bag, export it as CSV, or repair it."""


@bag_command.command("info")
@options.BAG
@options.namespace_in_bag()
@click.option("--cycles", is_flag=True, help="Also print one line per cycle.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, including all cycles.")
def _info(bag: Path, namespace: str | None, cycles: bool, as_json: bool) -> None:
    """Show what a bag holds: run, cycles, falls, gaps, damage, provenance."""
    with Bag(bag, namespace=namespace) as opened:
        report, rows = inspection.info(opened)
    if as_json:
        report["rows"] = [row._asdict() for row in rows]
        click.echo(json.dumps(report, indent=2))
    else:
        console.print(grid(inspection.describe(report)))
        heads = ("cycle" if cycles else "cycles", *inspection.CYCLE_COLUMNS)
        lines = inspection.cycle_lines(rows, each=cycles)
        console.print(grid(lines, "rl" + "r" * 6, heads, whole=True))
    if report["damaged"]:
        sys.exit(DIFFERENT)


@bag_command.command("csv")
@options.BAG
@options.namespace_in_bag()
@options.out("out/csv", "ticks.csv and cycles.csv")
def _csv(bag: Path, namespace: str | None, out: Path) -> None:
    """Export one line per tick and leg, and one line per cycle and leg, for pandas."""
    with Bag(bag, namespace=namespace) as opened:
        files = inspection.write_csv(opened, out)
    console.print(f"In {out}: {', '.join(file.name for file in files)}")
    for damage in opened.damages:
        console.print(f"damaged: {inspection.describe_damage(damage.tick, damage.leg)}")
    if opened.damages:
        sys.exit(DIFFERENT)


@bag_command.command("repair")
@options.BAG
@click.option("--drop-original", is_flag=True, help="Remove the damaged bag afterwards.")
def _repair(bag: Path, drop_original: bool) -> None:
    """Repair a bag whose recording was interrupted.

    All complete chunks are kept, and metadata.yaml is written again. The damaged bag stays next to
    the new one, as BAG.orig. A bag without damage is not changed.
    """
    done = repair(bag, drop=drop_original)
    if done.healthy:
        console.print(
            f"{bag} has no damage: {done.messages} messages, {done.seconds:.3f} s. Nothing was "
            "changed."
        )
        return
    lines: list[tuple[str, Any]] = [
        ("recovered", f"{done.messages} messages, {done.seconds:.3f} s"),
        ("complete chunks", done.chunks),
        ("damaged chunks", done.damaged),
        ("incomplete at the end", f"{done.torn_bytes} bytes"),
    ]
    with contextlib.suppress(BagError), Bag(bag) as opened:
        ticks = opened.phases()
        lines.insert(1, ("ticks", f"{ticks} ({ticks / opened.params.gait.ticks:g} cycles)"))
    if done.original is not None:
        lines.append(("damaged bag", f"{done.original.name}, next to it"))
    console.print(grid(lines))
