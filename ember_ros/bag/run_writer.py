"""Writes a run into a bag, tick by tick, in one order: the same run makes the same bytes.

The loop and the sim node call it as they call every observer; the recorder node passes it the bytes
that it received. A tick is its clock, the falls if there are more, the body's pose, each leg's
senses, the beat, each leg's command, and each leg's transition of the tick before. Every quarter of
a second of simulated time it is flushed to the disk, with a CRC-32 of each leg's senses: every
chunk can be checked by itself.
"""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ember_ros import cdr, topics, wire
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.writer_process import BagWriter
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from ember_ros.worlds import legs_of
from leg_node.table import Table

FLUSH_TICKS = 16
"""Ticks a flush: a quarter of a second at the default period is the most that a kill can cost."""


class TickMessages(NamedTuple):
    """All messages of one tick; None where there is none."""

    clock: bytes | None
    falls: bytes | None
    odometry: bytes | None
    joints: Sequence[bytes | None]
    contacts: Sequence[bytes | None]
    phase: bytes | None
    commands: Sequence[bytes | None]
    transitions: Sequence[bytes | None]


def absolute(namespace: str, name: str) -> str:
    """Return a topic's absolute name."""
    return "/" + "/".join(part for part in (namespace.strip("/"), name) if part)


def crc_of(joints: bytes | None, contact: bytes | None) -> int:
    """Return the CRC-32 of a leg's two messages of one tick."""
    return zlib.crc32(contact or b"", zlib.crc32(joints or b""))


class RunWriter:
    """Writes one robot's run into a bag; its caller closes the bag writer."""

    def __init__(
        self,
        writer: BagWriter,
        run_metadata: RunMetadata,
        table: Table | None,
        *,
        namespace: str = "",
    ) -> None:
        """Write what determined the run.

        Args:
            writer: of the bag.
            run_metadata: of the run.
            table: at the run's start, if it is known.
            namespace: of the robot.

        Raises:
            BagError: the bag cannot be written.
        """
        self.ticks = 0
        """Ticks written so far."""
        self._writer = writer
        self._tick_ns = run_metadata.params.gait.tick_ns
        legs = legs_of(run_metadata.world, run_metadata.params)
        self._legs = len(legs)
        self._beat = wire.BeatWire(self._tick_ns)
        self._senses = [wire.SenseWire(leg, self._tick_ns) for leg in legs]
        self._commands = [wire.CommandWire(leg, self._tick_ns) for leg in legs]
        self._transitions = [wire.TransitionWire(leg, self._tick_ns) for leg in legs]
        self._falls = -1
        self._crcs = array("I")
        self._next = run_metadata.first_tick

        def channel(topic: topics.Topic) -> int:
            return writer.channel(absolute(namespace, topic.name), topic.kind)

        # In the order of a tick.
        self._before = [channel(t) for t in (topics.CLOCK, topics.FALLS, topics.ODOMETRY)]
        self._of_legs = [
            (channel(topics.joint_states(leg)), channel(topics.contact(leg))) for leg in legs
        ]
        published = (*map(topics.command, legs), *map(topics.transition, legs))
        self._after = [channel(t) for t in (topics.PHASE, *published)]
        self._crc = channel(topics.CRC)

        ns = run_metadata.first_tick * self._tick_ns
        writer.write(channel(topics.RUN_METADATA), ns, cdr.pack_text(run_metadata.to_json()))
        if table is not None:
            shape = (table.states, table.actions)
            for topic, code, numbers in (
                (topics.VALUES, "d", table.values.astype("<f8")),
                (topics.VISITS, "q", table.visits.astype("<i8")),
            ):
                data = cdr.pack_array(code, ("state", "action"), shape, numbers.tobytes())
                writer.write(channel(topic), ns, data)
        writer.flush()

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Write one complete tick.

        Raises:
            BagError: the bag cannot be written.
        """
        tick = senses[0].tick
        ns = tick * self._tick_ns
        packed = [w.pack(sense) for w, sense in zip(self._senses, senses, strict=True)]
        falls = None if body.falls == self._falls else cdr.pack_int(body.falls)
        self._falls = body.falls
        messages = TickMessages(
            cdr.pack_clock(ns),
            falls,
            wire.pack_odometry(ns, body),
            [joints for joints, _ in packed],
            [contact for _, contact in packed],
            self._beat.pack(beat),
            [w.pack(c) if c else None for w, c in zip(self._commands, commands, strict=True)],
            [w.pack(t) if t else None for w, t in zip(self._transitions, transitions, strict=True)],
        )
        self.write(tick, messages)

    def write(self, tick: int, messages: TickMessages) -> None:
        """Write the messages of one tick; ticks must come in order.

        Raises:
            BagError: the bag cannot be written.
        """
        if tick != self._next:
            self._write_crcs()  # one message of CRCs covers ticks without gaps
        ns, write = tick * self._tick_ns, self._writer.write
        for channel, data in zip(self._before, messages[:3], strict=True):
            if data is not None:
                write(channel, ns, data)
        for channels, joints, contact in zip(
            self._of_legs, messages.joints, messages.contacts, strict=True
        ):
            if joints is not None:
                write(channels[0], ns, joints)
            if contact is not None:
                write(channels[1], ns, contact)
            self._crcs.append(crc_of(joints, contact))
        for channel, data in zip(
            self._after, (messages.phase, *messages.commands, *messages.transitions), strict=True
        ):
            if data is not None:
                write(channel, ns, data)
        self.ticks += 1
        self._next = tick + 1
        if self._next % FLUSH_TICKS == 0:
            self._write_crcs()
            self._writer.flush()

    def _write_crcs(self) -> None:
        """Write the CRCs of the ticks since the last message of CRCs."""
        count = len(self._crcs) // self._legs
        if not count:
            return
        first = self._next - count
        numbers = np.array([first & 0xFFFFFFFF, first >> 32, *self._crcs], "<u4").tobytes()
        data = cdr.pack_array("I", ("tick", "leg"), (count, self._legs), numbers, offset=2)
        self._writer.write(self._crc, (self._next - 1) * self._tick_ns, data)
        del self._crcs[:]

    def finish(self) -> None:
        """Write the last CRCs and flush; nothing may be written after.

        Raises:
            BagError: the bag cannot be written.
        """
        self._write_crcs()
        self._writer.flush()
