"""What the world's node publishes and logs about the run, beside what the legs need."""

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
    """Publishes where the body is, and falls when there are more."""

    def __init__(self, node: Node, tick_ns: int, ticks: int) -> None:
        """Make the publishers of a node.

        Args:
            node: the world's.
            tick_ns: length of a tick, ns.
            ticks: of a cycle, for the log.
        """
        self._node, self._tick_ns, self._ticks = node, tick_ns, ticks
        self._falls_publisher = topics.FALLS.publish(node)
        self._odometry = topics.ODOMETRY.publish(node)
        self._falls = -1

    def publish(self, tick: int, body: BodyState) -> None:
        """Publish the body at the start of a tick."""
        if body.falls != self._falls:
            if body.falls > max(self._falls, 0):
                self._node.get_logger().warning(
                    f"fall {body.falls} in cycle {tick // self._ticks}; put back on its feet"
                )
            self._falls = body.falls
            self._falls_publisher.publish(cdr.pack_int(body.falls))
        self._odometry.publish(wire.pack_odometry(tick * self._tick_ns, body))


class Diagnostics:
    """Publishes who is absent, and what was refused."""

    def __init__(self, node: Node, legs: Sequence[str], tick_ns: int, ticks: int) -> None:
        """Make the publisher of a node."""
        self._legs, self._tick_ns, self._ticks = legs, tick_ns, ticks
        self._publisher = topics.DIAGNOSTICS.publish(node)

    def publish(
        self, tick: int, falls: int, refused: int, away: Collection[str], stuck: str | None
    ) -> None:
        """Publish the state of the robot.

        Args:
            tick: the present one.
            falls: so far.
            refused: messages that were not used.
            away: legs that do not answer.
            stuck: why the world stands still; None where it goes on.
        """
        message = DiagnosticArray()
        cdr.set_stamp(message.header.stamp, tick * self._tick_ns)
        message.status = [
            DiagnosticStatus(
                name="sim_node",
                level=DiagnosticStatus.WARN if away or stuck else DiagnosticStatus.OK,
                message=stuck or "walking",
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
                    level=DiagnosticStatus.ERROR if leg in away else DiagnosticStatus.OK,
                    message="absent" if leg in away else "present",
                )
            )
        self._publisher.publish(message)


class Lateness:
    """In real time: logs now and then how often legs were late, and once that none is any more.

    A leg that misses every other tick comes and goes a thousand times a minute.
    """

    def __init__(self, node: Node) -> None:
        """Begin with nobody late."""
        self._node = node
        self._late: Counter[str] = Counter()  # ticks without a leg since the last line
        self._since = time.monotonic()
        self._was_late = False

    def count(self, late: Collection[str]) -> None:
        """Count the legs that were late for a tick, and log if it is time."""
        self._late.update(late)
        now = time.monotonic()
        if now - self._since < LOG_WINDOW_S or not (self._late or self._was_late):
            return
        if self._late:
            legs = ", ".join(f"{leg} {ticks}" for leg, ticks in sorted(self._late.items()))
            self._node.get_logger().warning(
                f"ticks held still for want of a command in time: {legs}"
            )
        else:
            self._node.get_logger().info("all legs are in time again")
        self._was_late = bool(self._late)
        self._late.clear()
        self._since = now
