"""Publishes the messages of a bag at their recorded times: for rviz, Foxglove, PlotJuggler."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.exceptions import InvalidTopicNameException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool

from ember_ros import topics
from ember_ros.bag.reader import Bag, Raw
from ember_ros.bag.run_writer import absolute
from ember_ros.errors import BagError
from ember_ros.name_lock import NameLock, NameTakenError
from ember_ros.timers import create_steady_timer

PAUSE = topics.Service("play/pause", "std_srvs/srv/SetBool")
MAX_PER_TURN = 256
"""Messages per turn: Fast DDS queues 512 between two processes."""
LONGEST_GAP_S = 30.0
"""Of the bag's time without a message: a longer gap is left out."""
NOT_PLAYED = ("/rosout", "/parameter_events")
"""Topics that `ros2 bag record --all` records, and that every running node publishes itself."""
SHORTEST_S, LONGEST_S = 0.001, 0.05
"""Limits of the timer's period, wall time; it is half a tick where that is between them."""
DISCOVERY_S = 1.0
"""Wall time in which a player looks for other publishers of its topics."""


class PlayerNode(Node):  # type: ignore[misc]
    """Publishes the topics of one robot in a bag under the names they were recorded with.

    Publishes: all topics of the bag; ``/clock`` too if the robot's own is another.
    Serves: ``play/pause`` (std_srvs/SetBool).
    """

    def __init__(
        self,
        bag: Bag,
        *,
        rate: float = 1.0,
        start_s: float = 0.0,
        paused: bool = False,
        live: Collection[str] = (),
        **kwargs: Any,
    ) -> None:
        """Make the node; it plays while it is spun.

        Args:
            bag: an open one.
            rate: factor of the recorded speed.
            start_s: simulated seconds to skip.
            paused: whether to begin paused.
            live: legs whose commands and transitions are left out: live nodes publish them, and
                playing begins when these nodes are there.
            **kwargs: go to rclpy's ``Node``.

        Raises:
            BagError: the bag has no such live leg, it ends before ``start_s``, or a robot on this
                machine publishes one of the topics.
        """
        super().__init__("player_node", namespace=bag.namespace or None, **kwargs)
        self.done = False
        self.failed: BagError | None = None
        """Why it ended before the bag, if it did."""
        self.paused = paused
        self.played = 0
        """Messages published so far."""
        self.seconds = start_s
        """Position in the bag, in the bag's time without the gaps that are left out."""
        for leg in live:
            if leg not in bag.legs:
                raise BagError(f"{bag.path} has no leg {leg!r}; it has {', '.join(bag.legs)}")
        self._rate, self._live = rate, tuple(live)
        self._origin = bag.start_ns
        prefix = absolute(bag.namespace, "").rstrip("/") + "/"
        others = tuple(
            absolute(each, "") + "/"
            for each in bag.robots()
            if each != bag.namespace and absolute(each, "").startswith(prefix)
        )
        makers = (topics.command, topics.transition)
        left_out = {absolute(bag.namespace, make(leg).name) for leg in live for make in makers}
        self._bag_publishers: dict[str, Any] = {}
        self._locks: list[NameLock] = []
        for topic, connection in bag.connections.items():
            if topic in left_out or not topic.startswith(prefix) or topic.startswith(others):
                continue
            if topic in NOT_PLAYED:
                self.get_logger().info(f"{topic} is left out: every node here has its own")
                continue
            if connection.encoding != "cdr" or connection.msgtype.split("/")[1:2] != ["msg"]:
                self.get_logger().warning(
                    f"{topic} is left out: not CDR of ROS 2, but {connection.encoding} of type "
                    f"{connection.msgtype!r}"
                )
                continue
            try:
                named = topics.Topic(topic, connection.msgtype)
                self._bag_publishers[topic] = named.publish(self)
                self._locks.append(self._lock(topic))
            except (ImportError, AttributeError, ValueError):
                self.get_logger().warning(
                    f"{topic} is left out: {connection.msgtype} is not installed here"
                )
            except InvalidTopicNameException:
                self.get_logger().warning(f"{topic} is left out: it is no valid topic name")
        self._types = {topic: bag.connections[topic].msgtype for topic in self._bag_publishers}
        self.messages = sum(bag.connections[topic].msgcount for topic in self._bag_publishers)
        """Messages to publish in all."""
        self._clock_name = absolute(bag.namespace, topics.CLOCK.name)
        self._global_clock = None
        if self._clock_name in self._bag_publishers and self._clock_name != "/clock":
            self._global_clock = topics.Topic("/clock", topics.CLOCK.kind).publish(self)
        self._messages: Iterator[Raw] = bag.raw(int(start_s * 1e9))
        self._next = next(self._messages, None)
        if self._next is None:
            raise BagError(f"{bag.path} ends before {start_s} s")
        self._leg_inputs = [
            self._bag_publishers[absolute(bag.namespace, make(leg).name)]
            for leg in live
            for make in (topics.joint_states, topics.contact)
        ]
        self._waiting = bool(live)
        self._last = time.monotonic()
        PAUSE.serve(self, self._pause)
        tick_s = bag.params.gait.tick_s
        create_steady_timer(self, min(max(tick_s / rate / 2, SHORTEST_S), LONGEST_S), self._turn)

    def _lock(self, topic: str) -> NameLock:
        """Lock the name of a topic's publisher, so that no robot starts beside the recorded one."""
        try:
            return NameLock(self.context.get_domain_id(), topic, self.get_fully_qualified_name())
        except NameTakenError as error:
            taken = str(error).partition(";")[0]
            raise BagError(
                f"a robot is running here: {taken}; stop it, or play in another ROS_DOMAIN_ID"
            ) from None

    def others(self) -> list[str]:
        """Return the topics of the bag that have another publisher: a running robot."""
        return [topic for topic in self._bag_publishers if self.count_publishers(topic) > 1]

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.paused = request.data
        response.success = True
        response.message = f"{'paused' if self.paused else 'playing'} at {self.seconds:.3f} s"
        return response

    def _turn(self) -> None:
        """Publish the messages that are due."""
        now = time.monotonic()
        elapsed, self._last = now - self._last, now
        if self._waiting:
            publishers = (self.count_publishers(topics.command(leg).name) for leg in self._live)
            if not (
                all(each.get_subscription_count() for each in self._leg_inputs) and all(publishers)
            ):
                self.get_logger().info(
                    f"waiting for {', '.join(self._live)}", throttle_duration_sec=5.0
                )
                return
            self._waiting = False
            return
        if self.paused or self.done:
            return
        self.seconds += elapsed * self._rate
        due = self._origin + int(self.seconds * 1e9)
        if self._next is not None and (gap := self._next.ns - due) > LONGEST_GAP_S * 1e9:
            self.get_logger().info(f"nothing for {gap * 1e-9:.0f} s: left out")
            self._origin, due = self._origin + gap, due + gap
        limit = self.played + MAX_PER_TURN
        while self._next is not None and self._next.ns <= due and self.played < limit:
            publisher = self._bag_publishers.get(self._next.topic)
            if publisher is not None and self._next.kind == self._types[self._next.topic]:
                publisher.publish(self._next.data)
                self.played += 1
                if self._global_clock is not None and self._next.topic == self._clock_name:
                    self._global_clock.publish(self._next.data)
            try:
                self._next = next(self._messages, None)
            except BagError as error:  # raised by the caller: an executor would log it as a crash
                self.failed, self._next = error, None
        self.done = self._next is None

    def finish(self, spin: Callable[[], None]) -> None:
        """Do nothing: all messages are published."""

    def destroy_node(self) -> None:
        """Destroy the node and release its seats."""
        super().destroy_node()
        for lock in self._locks:
            lock.release()


@contextmanager
def playing(
    bag: Bag, go_on: Callable[[], bool], **options: Any
) -> Iterator[tuple[PlayerNode, Callable[[], None]]]:
    """Make a paused player on a graph where nothing else publishes its topics.

    Args:
        bag: an open one.
        go_on: returns whether to go on looking for other publishers.
        **options: go to ``PlayerNode``.

    Yields:
        The player, and a function that spins it for at most ``LONGEST_S``.

    Raises:
        BagError: as ``PlayerNode``, or a robot on the graph publishes one of the topics.
    """
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        node = PlayerNode(bag, paused=True, **options)
        executor = EventsExecutor()
        executor.add_node(node)
        deadline = time.monotonic() + DISCOVERY_S
        while time.monotonic() < deadline and go_on():
            executor.spin_once(timeout_sec=LONGEST_S)
        if others := node.others():
            raise BagError(
                f"a robot is running here: {', '.join(others[:3])} and others have publishers, and "
                "its nodes would receive the recorded messages; stop it, or play in another "
                "ROS_DOMAIN_ID"
            )
        yield node, lambda: executor.spin_once(timeout_sec=LONGEST_S)
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
