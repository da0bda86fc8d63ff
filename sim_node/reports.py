"""Reports of the sim_node for people and tools: odometry, falls, diagnostics and late legs."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from ember_ros import cdr, topics, wire
from ember_ros.signals import BodyState
from ember_ros.throttle import LOG_WINDOW_S


class BodyPublisher:
    """Publishes the body's pose at every tick, and the number of falls when it changes."""

    def __init__(self, node: Node, tick_ns: int, ticks: int) -> None:
        """Create the publishers.

        Args:
            node: the sim_node.
            tick_ns: length of a tick, ns.
            ticks: ticks per cycle, for the log.
        """
        self._node, self._tick_ns, self._ticks = node, tick_ns, ticks
        self._falls_publisher = topics.FALLS.publish(node)
        self._odometry = topics.ODOMETRY.publish(node)
        self._falls = -1

    def publish(self, tick: int, body: BodyState) -> None:
        """Publish the pose at the start of a tick; log a new fall."""
        if body.falls != self._falls:
            if body.falls > max(self._falls, 0):
                self._node.get_logger().warning(
                    f"fall {body.falls} in cycle {tick // self._ticks}; put back on its feet"
                )
            self._falls = body.falls
            self._falls_publisher.publish(cdr.pack_int(body.falls))
        self._odometry.publish(wire.pack_odometry(tick * self._tick_ns, body))


class Diagnostics:
    """Publishes the absent legs and the number of refused messages."""

    def __init__(self, node: Node, legs: Sequence[str], tick_ns: int, ticks: int) -> None:
        """Create the publisher.

        Args:
            node: the sim_node.
            legs: names of the legs.
            tick_ns: length of a tick, ns.
            ticks: ticks per cycle.
        """
        self._legs, self._tick_ns, self._ticks = legs, tick_ns, ticks
        self._publisher = topics.DIAGNOSTICS.publish(node)

    def publish(
        self, tick: int, falls: int, refused: int, absent: Collection[str], stalled: str | None
    ) -> None:
        """Publish the state of the robot.

        Args:
            tick: the present one.
            falls: number of falls so far.
            refused: number of messages that were not used.
            absent: legs that do not respond.
            stalled: why the world stands still; None if it does not.
        """
        message = DiagnosticArray()
        cdr.set_stamp(message.header.stamp, tick * self._tick_ns)
        message.status = [
            DiagnosticStatus(
                name="sim_node",
                level=DiagnosticStatus.WARN if absent or stalled else DiagnosticStatus.OK,
                message=stalled or "walking",
                values=[
                    KeyValue(key="cycle", value=str(tick // self._ticks)),
                    KeyValue(key="falls", value=str(falls)),
                    KeyValue(key="refused", value=str(refused)),
                ],
            )
        ]
        for leg in self._legs:
            message.status.append(
                DiagnosticStatus(
                    name=leg,
                    level=DiagnosticStatus.ERROR if leg in absent else DiagnosticStatus.OK,
                    message="absent" if leg in absent else "present",
                )
            )
        self._publisher.publish(message)


class Lateness:
    """Logs late legs in real time: a count per window, and once that no leg is late any more.

    A line for each change would be too many: a leg that misses every other tick changes its state a
    thousand times per minute.
    """

    def __init__(self, node: Node) -> None:
        """Start without late legs."""
        self._node = node
        self._late: Counter[str] = Counter()  # missed ticks of each leg since the last line
        self._window_start = time.monotonic()
        self._was_late = False

    def count(self, late: Collection[str]) -> None:
        """Count the legs that were late for a tick; log the counts at the end of a window."""
        self._late.update(late)
        now = time.monotonic()
        if now - self._window_start < LOG_WINDOW_S or not (self._late or self._was_late):
            return
        if self._late:
            legs = ", ".join(f"{leg} {ticks}" for leg, ticks in sorted(self._late.items()))
            self._node.get_logger().warning(
                f"ticks held still because the command was late: {legs}"
            )
        else:
            self._node.get_logger().info("all legs are on time again")
        self._was_late = bool(self._late)
        self._late.clear()
        self._window_start = now
