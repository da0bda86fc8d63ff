"""Records a run from within the sim_node, and synchronises the world with a recorder node."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node

from ember_ros import cdr, topics
from ember_ros.bag.metadata_client import MetadataClient
from ember_ros.bag.run_writer import RunWriter
from ember_ros.bag.storage import BagOptions
from ember_ros.bag.writer_process import WriterProcess
from ember_ros.errors import SignalError
from ember_ros.observer import Observer

AHEAD = 24  # maximum ticks ahead of a recorder: Fast DDS queues 512 messages between two processes


class BagRecorder:
    """Records the run into a bag; requests the run's metadata from the nodes before."""

    def __init__(self, node: Node, world: str, options: BagOptions) -> None:
        """Create the bag.

        Args:
            node: the sim_node.
            world: name of the world.
            options: of the bag.

        Raises:
            BagError: the bag cannot be created.
        """
        self._node, self._world = node, world
        self._writer = WriterProcess(options)
        self._inquiry = MetadataClient(node, node.get_namespace())
        self._run_writer: RunWriter | None = None

    def start(self, late: bool) -> Observer | None:
        """Request the run's metadata from the nodes; start to record once all have responded.

        Args:
            late: whether to start without the nodes that have not responded, because they are not
                nodes of this package.

        Returns:
            The observer that writes the ticks into the bag; None until all have responded.

        Raises:
            BagError: the bag cannot be written.
        """
        if self._inquiry.poll() and not late:
            return None
        run_metadata, table, wrong = self._inquiry.run_metadata(self._world, 0)
        for why in wrong:
            self._node.get_logger().warning(f"the bag cannot be replayed: {why}")
        namespace = self._node.get_namespace()
        self._run_writer = RunWriter(self._writer, run_metadata, table, namespace=namespace)
        return self._run_writer

    def finish(self) -> None:
        """Write the end of the bag and close it.

        Raises:
            BagError: it cannot be written completely.
        """
        if self._run_writer is not None:
            self._run_writer.finish()
        self._writer.close()

    def close(self) -> None:
        """Abandon the bag if it was not finished; do nothing otherwise."""
        self._writer.abandon()


class RecorderLink:
    """Flow control: receives the progress of a recorder node, so that the world can wait for it."""

    def __init__(self, node: Node, required: bool, refuse: Callable[[Exception], None]) -> None:
        """Subscribe to the recorder's progress.

        Args:
            node: the sim_node.
            required: whether the run must not start without a recorder.
            refuse: is called with the error of a malformed message.
        """
        self._node, self._required, self._refuse = node, required, refuse
        self.tick: int | None = None
        """The last tick that the recorder received; None if the world waits for no recorder."""
        self.on_progress: Callable[[], None] = lambda: None
        """Called when the recorder has received another tick."""
        topics.RECORDED.subscribe(node, self._on_recorder_tick)

    def _on_recorder_tick(self, data: bytes) -> None:
        try:
            self.tick = cdr.read_int(data, topics.RECORDED.name, -1)
        except SignalError as why:
            self._refuse(why)
            return
        self.on_progress()

    def is_missing(self, late: bool) -> bool:
        """Return whether the run has to wait for the first message of a recorder.

        Args:
            late: whether a recorder on the graph has had enough time to publish.
        """
        if self.tick is not None:
            return False
        return self._required or (self.is_present() and not late)

    def is_present(self) -> bool:
        """Return whether a recorder is on the graph."""
        return bool(self._node.count_publishers(topics.RECORDED.name))

    def is_behind(self, tick: int) -> bool:
        """Return whether a tick is so far ahead of the recorder that a queue may overflow."""
        return self.tick is not None and tick - self.tick > AHEAD


class Timeout:
    """A wall-clock timeout that starts with the first call of ``is_over``."""

    def __init__(self, timeout_s: float) -> None:
        """Set the length of the timeout, s."""
        self._timeout_s = timeout_s
        self._start: float | None = None

    def is_over(self) -> bool:
        """Return whether the timeout has passed since the first call."""
        now = time.monotonic()
        if self._start is None:
            self._start = now
        return now - self._start >= self._timeout_s
