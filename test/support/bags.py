"""Runs of the loop that are recorded, and bags that are written anew, message by message."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from ember_ros.bag.reader import Bag, Raw
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.run_writer import RunWriter
from ember_ros.bag.storage import BagOptions, McapWriter
from ember_ros.loop import Loop
from ember_ros.run_config import RunConfig
from ember_ros.shipped import BAG, DATA
from ember_ros.versions import versions
from ember_ros.worlds import World
from sim_node.fake import FakeWorld

KEPT = DATA / BAG
"""The bag that comes with the package."""


class Made(NamedTuple):
    """A run that was recorded."""

    bag: Path
    config: RunConfig
    ticks: int
    table: str
    """SHA-256 at the end."""


def record(
    bag: Path,
    config: RunConfig,
    *,
    falls_at: Collection[int] = (),
    world: World | None = None,
    extra: int = 0,
    namespace: str = "",
    about: Mapping[str, str] | None = None,
    writer: McapWriter | None = None,
) -> Made:
    """Record a run of a plan in the loop, and some ticks more.

    Args:
        bag: the folder of the bag.
        config: what is run.
        falls_at: ticks at which the robot falls in the fake world.
        world: another world than the fake one.
        extra: ticks after the plan's last cycle.
        namespace: of the robot.
        about: the versions that the card tells; by default those that are installed.
        writer: an open bag to record into; its caller closes it.
    """
    loop = Loop(config, world or FakeWorld(config.legs, config.params, falls_at=falls_at))
    into = writer or McapWriter(BagOptions(bag))
    try:
        run_metadata = RunMetadata.of_config(config, loop.shared.table, dict(about or versions()))
        recording = RunWriter(into, run_metadata, loop.shared.table, namespace=namespace)
        for _ in range(config.cycles * config.params.gait.ticks + extra):
            loop.tick(recording)
        recording.finish()
        sha = loop.finish().sha256()
        if writer is None:
            into.close({"table_sha256": sha})
        return Made(bag, config, recording.ticks, sha)
    finally:
        if writer is None:
            into.abandon()
        loop.close()


def raws_of(bag: Path) -> list[Raw]:
    """Return all messages of a bag, in order."""
    with Bag(bag) as opened:
        return list(opened.raw())


def write(bag: Path, raws: Iterable[Raw], table_sha256: str | None = None) -> Path:
    """Write messages as they are into a bag, sealed with the hash of a table if one is given."""
    writer = McapWriter(BagOptions(bag))
    try:
        for n, raw in enumerate(raws):
            writer.write(writer.channel(raw.topic, raw.kind), raw.ns, raw.data)
            if n % 500 == 499:  # a chunk a few ticks, as a recorder leaves them
                writer.flush()
        writer.close({"table_sha256": table_sha256} if table_sha256 else None)
    finally:
        writer.abandon()
    return bag
