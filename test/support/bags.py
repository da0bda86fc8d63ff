"""Runs of the loop that are recorded, and bags that are written anew, message by message."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from ember_ros.bag.card import Card
from ember_ros.bag.reading import Bag, Raw
from ember_ros.bag.recording import Recording
from ember_ros.bag.storage import BagOptions, BagWriter
from ember_ros.loop import Loop
from ember_ros.plan import Plan
from ember_ros.shipped import BAG, DATA
from ember_ros.versions import versions
from ember_ros.worlds import World
from sim_node.fake import FakeWorld

KEPT = DATA / BAG
"""The bag that comes with the package."""


class Made(NamedTuple):
    """A run that was recorded."""

    bag: Path
    plan: Plan
    ticks: int
    table: str
    """SHA-256 at the end."""


def record(
    bag: Path,
    plan: Plan,
    *,
    falls_at: Collection[int] = (),
    world: World | None = None,
    extra: int = 0,
    namespace: str = "",
    about: Mapping[str, str] | None = None,
    writer: BagWriter | None = None,
) -> Made:
    """Record a run of a plan in the loop, and some ticks more.

    Args:
        bag: the folder of the bag.
        plan: what is run.
        falls_at: ticks at which the robot falls in the fake world.
        world: another world than the fake one.
        extra: ticks after the plan's last cycle.
        namespace: of the robot.
        about: the versions that the card tells; by default those that are installed.
        writer: an open bag to record into; its caller closes it.
    """
    loop = Loop(plan, world or FakeWorld(plan.legs, plan.params, falls_at=falls_at))
    into = writer or BagWriter(BagOptions(bag))
    try:
        card = Card.of_plan(plan, loop.shared.table, dict(about or versions()))
        recording = Recording(into, card, loop.shared.table, namespace=namespace)
        for _ in range(plan.cycles * plan.params.gait.ticks + extra):
            loop.tick(recording)
        recording.finish()
        sha = loop.finish().sha256()
        if writer is None:
            into.close({"table_sha256": sha})
        return Made(bag, plan, recording.ticks, sha)
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
    writer = BagWriter(BagOptions(bag))
    try:
        for n, raw in enumerate(raws):
            writer.write(writer.channel(raw.topic, raw.kind), raw.ns, raw.data)
            if n % 500 == 499:  # a chunk a few ticks, as a recorder leaves them
                writer.flush()
        writer.close({"table_sha256": table_sha256} if table_sha256 else None)
    finally:
        writer.abandon()
    return bag
