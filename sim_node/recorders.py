"""What records a run from within the world's node, and what makes it wait for who records it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rclpy.node import Node

from ember_ros import cdr, topics
from ember_ros.bag.metadata_client import MetadataClient
from ember_ros.bag.run_writer import RunWriter
from ember_ros.bag.storage import BagOptions
from ember_ros.bag.writer_process import WriterProcess
from ember_ros.errors import SignalError
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition

AHEAD = 24  # ticks ahead of a recorder: Fast DDS holds 512 messages between two processes


class BagObserver:
    """Records the run into a bag, as an observer; what determined it is asked of the nodes."""

    def __init__(self, node: Node, world: str, options: BagOptions) -> None:
        """Make the bag.

        Args:
            node: the world's.
            world: its name.
            options: of the bag.

        Raises:
            BagError: the bag cannot be made.
        """
        self._node, self._world = node, world
        self._writer = WriterProcess(options)
        self._inquiry = MetadataClient(node, node.get_namespace())
        self._recording: RunWriter | None = None

    def begin(self, late: bool) -> bool:
        """Ask what determines the run; begin to record, and return True, when all have answered.

        Args:
            late: whether to go on without those who have not: they are not nodes of ours.

        Raises:
            BagError: the bag cannot be written.
        """
        if self._inquiry.poll() and not late:
            return False
        run_metadata, table, wrong = self._inquiry.run_metadata(self._world, 0)
        for why in wrong:
            self._node.get_logger().warning(f"the bag cannot be replayed: {why}")
        namespace = self._node.get_namespace()
        self._recording = RunWriter(self._writer, run_metadata, table, namespace=namespace)
        return True

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Write one tick.

        Raises:
            BagError: the bag cannot be written.
        """
        assert self._recording is not None
        self._recording.tick(beat, senses, commands, body, transitions)

    def finish(self) -> None:
        """End the bag well.

        Raises:
            BagError: it cannot be written to its end.
        """
        if self._recording is not None:
            self._recording.finish()
        self._writer.close()

    def close(self) -> None:
        """Let go of the bag; one that was not finished ends here."""
        self._writer.abandon()


class RecorderLink:
    """How far a recorder node is that listens to this robot; the world is never far ahead of it."""

    def __init__(self, node: Node, wanted: bool, refuse: Callable[[Exception], None]) -> None:
        """Listen to a recorder.

        Args:
            node: the world's.
            wanted: whether not to begin without one.
            refuse: is given what is wrong with a message.
        """
        self._node, self._wanted, self._refuse = node, wanted, refuse
        self.tick: int | None = None
        """The last tick that it heard; None where nobody is waited for."""
        self.on_progress: Callable[[], None] = lambda: None
        """Called when it is further."""
        topics.RECORDED.subscribe(node, self._on_tick)

    def _on_tick(self, data: bytes) -> None:
        try:
            self.tick = cdr.read_int(data, topics.RECORDED.name, -1)
        except SignalError as why:
            self._refuse(why)
            return
        self.on_progress()

    def is_missing(self, late: bool) -> bool:
        """Return whether the run is to wait for a recorder's first word.

        Args:
            late: whether one that is there had its time.
        """
        if self.tick is not None:
            return False
        return self._wanted or (self.is_there() and not late)

    def is_there(self) -> bool:
        """Return whether there is a recorder on the graph."""
        return bool(self._node.count_publishers(topics.RECORDED.name))

    def is_behind(self, tick: int) -> bool:
        """Return whether a tick is further ahead than what lies between two processes can hold."""
        return self.tick is not None and tick - self.tick > AHEAD


class Waiting:
    """How long all that records has been waited for, once everybody else is there."""

    def __init__(self, patience_s: float) -> None:
        """Wait for so long."""
        self._patience = patience_s
        self._since: float | None = None

    def is_over(self) -> bool:
        """Return whether it has been long enough; the time counts from the first call."""
        now = time.monotonic()
        if self._since is None:
            self._since = now
        return now - self._since >= self._patience
