"""Recorded runs of the loop, and bags written message by message."""

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

SHIPPED_BAG = DATA / BAG
"""The bag that comes with the package."""


class RecordedRun(NamedTuple):
    """A recorded run."""

    bag: Path
    config: RunConfig
    ticks: int
    table: str
    """SHA-256 of the table at the end."""


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
) -> RecordedRun:
    """Record a run of the loop, with some additional ticks.

    Args:
        bag: the folder of the bag.
        config: the configuration of the run.
        falls_at: ticks at which the robot falls in the fake world.
        world: the world; None for the fake world.
        extra: number of ticks after the last cycle.
        namespace: namespace of the robot.
        about: versions to record in the run metadata; by default the installed ones.
        writer: an open bag to record into; its caller closes it.
    """
    loop = Loop(config, world or FakeWorld(config.legs, config.params, falls_at=falls_at))
    bag_writer = writer or McapWriter(BagOptions(bag))
    try:
        run_metadata = RunMetadata.of_config(config, loop.shared.table, dict(about or versions()))
        recording = RunWriter(bag_writer, run_metadata, loop.shared.table, namespace=namespace)
        for _ in range(config.cycles * config.params.gait.ticks + extra):
            loop.tick(recording)
        recording.finish()
        sha = loop.finish().sha256()
        if writer is None:
            bag_writer.close({"table_sha256": sha})
        return RecordedRun(bag, config, recording.ticks, sha)
    finally:
        if writer is None:
            bag_writer.abandon()
        loop.close()


def raws_of(bag: Path) -> list[Raw]:
    """Return all messages of a bag, in order."""
    with Bag(bag) as opened:
        return list(opened.raw())


def write(bag: Path, raws: Iterable[Raw], table_sha256: str | None = None) -> Path:
    """Write messages unchanged into a bag; add the hash of the table at the end if not None."""
    writer = McapWriter(BagOptions(bag))
    try:
        for n, raw in enumerate(raws):
            writer.write(writer.channel(raw.topic, raw.kind), raw.ns, raw.data)
            if n % 500 == 499:  # a chunk has a few ticks, as with a recorder
                writer.flush()
        writer.close({"table_sha256": table_sha256} if table_sha256 else None)
    finally:
        writer.abandon()
    return bag
