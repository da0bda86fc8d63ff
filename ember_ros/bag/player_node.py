"""Says again what a bag holds, as fast as it was: for rviz, Foxglove, PlotJuggler, a live leg."""

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

PAUSE = topics.Service("play/pause", "std_srvs/srv/SetBool")
MAX_PER_TURN = 256
"""Messages a turn: Fast DDS holds 512 between two processes."""
LONGEST_GAP_S = 30.0
"""Of the bag's own time without a message: what is longer is left out."""
NOT_PLAYED = ("/rosout", "/parameter_events")
"""What `ros2 bag record --all` records too, and every node that runs publishes itself."""
SHORTEST_S, LONGEST_S = 0.001, 0.05
"""Wall time between two looks at what is due: about a tick, within these."""
DISCOVERY_S = 1.0
"""Wall time that a player looks whether somebody else is on the topics."""


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
            rate: times the recorded speed.
            start_s: simulated seconds to leave out at the beginning.
            paused: whether to begin paused.
            live: legs whose commands and transitions are left out, since live nodes say them; it
                begins when these are there.
            **kwargs: go to rclpy's ``Node``.

        Raises:
            BagError: a live leg is none of the bag's, the bag ends before ``start_s``, or a robot
                on this machine says one of the topics.
        """
        super().__init__("player_node", namespace=bag.namespace or None, **kwargs)
        self.done = False
        self.failed: BagError | None = None
        """Why it ended before the bag did, if it did."""
        self.paused = paused
        self.played = 0
        """Messages that were published."""
        self.seconds = start_s
        """How far into the bag it is, in the bag's own time without the gaps that are left out."""
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
        said = (topics.command, topics.transition)
        left_out = {absolute(bag.namespace, make(leg).name) for leg in live for make in said}
        self._sayers: dict[str, Any] = {}
        self._locks: list[NameLock] = []
        for topic, connection in bag.connections.items():
            if topic in left_out or not topic.startswith(prefix) or topic.startswith(others):
                continue
            if topic in NOT_PLAYED:
                self.get_logger().info(f"{topic} is left out: every node here has its own")
                continue
            if connection.encoding != "cdr" or connection.msgtype.split("/")[1:2] != ["msg"]:
                self.get_logger().warning(
                    f"{topic} is left out: no messages of ROS 2, but {connection.encoding} of type "
                    f"{connection.msgtype!r}"
                )
                continue
            try:
                named = topics.Topic(topic, connection.msgtype)
                self._sayers[topic] = named.publish(self)
                self._locks.append(self._lock(topic))
            except (ImportError, AttributeError, ValueError):
                self.get_logger().warning(
                    f"{topic} is left out: there is no {connection.msgtype} in this environment"
                )
            except InvalidTopicNameException:
                self.get_logger().warning(f"{topic} is left out: that is no name of a topic")
        self._types = {topic: bag.connections[topic].msgtype for topic in self._sayers}
        self.messages = sum(bag.connections[topic].msgcount for topic in self._sayers)
        """How many there are to publish."""
        self._clock_name = absolute(bag.namespace, topics.CLOCK.name)
        self._also = None
        if self._clock_name in self._sayers and self._clock_name != "/clock":
            self._also = topics.Topic("/clock", topics.CLOCK.kind).publish(self)
        self._messages: Iterator[Raw] = bag.raw(int(start_s * 1e9))
        self._next = next(self._messages, None)
        if self._next is None:
            raise BagError(f"{bag.path} ends before {start_s} s")
        self._hears = [
            self._sayers[absolute(bag.namespace, make(leg).name)]
            for leg in live
            for make in (topics.joint_states, topics.contact)
        ]
        self._waited = bool(live)
        self._last = time.monotonic()
        PAUSE.serve(self, self._pause)
        tick_s = bag.params.gait.tick_s
        self.create_timer(min(max(tick_s / rate / 2, SHORTEST_S), LONGEST_S), self._turn)

    def _lock(self, topic: str) -> NameLock:
        """Take the seat of who says a topic, so that no robot begins beside the recorded one."""
        try:
            return NameLock(self.context.get_domain_id(), topic, self.get_fully_qualified_name())
        except NameTakenError as why:
            taken = str(why).partition(";")[0]
            raise BagError(
                f"a robot is running here: {taken}; stop it, or play in another ROS_DOMAIN_ID"
            ) from None

    def others(self) -> list[str]:
        """Return the topics of the bag that somebody else publishes: a robot that is running."""
        return [topic for topic in self._sayers if self.count_publishers(topic) > 1]

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.paused = request.data
        response.success = True
        response.message = f"{'paused' if self.paused else 'playing'} at {self.seconds:.3f} s"
        return response

    def _turn(self) -> None:
        """Publish what is due."""
        now = time.monotonic()
        passed, self._last = now - self._last, now
        if self._waited:
            says = (self.count_publishers(topics.command(leg).name) for leg in self._live)
            if not (all(hears.get_subscription_count() for hears in self._hears) and all(says)):
                self.get_logger().info(
                    f"waiting for {', '.join(self._live)}", throttle_duration_sec=5.0
                )
                return
            self._waited = False
            return
        if self.paused or self.done:
            return
        self.seconds += passed * self._rate
        due = self._origin + int(self.seconds * 1e9)
        if self._next is not None and (gap := self._next.ns - due) > LONGEST_GAP_S * 1e9:
            self.get_logger().info(f"nothing for {gap * 1e-9:.0f} s: left out")
            self._origin, due = self._origin + gap, due + gap
        most = self.played + MAX_PER_TURN
        while self._next is not None and self._next.ns <= due and self.played < most:
            publisher = self._sayers.get(self._next.topic)
            if publisher is not None and self._next.kind == self._types[self._next.topic]:
                publisher.publish(self._next.data)
                self.played += 1
                if self._also is not None and self._next.topic == self._clock_name:
                    self._also.publish(self._next.data)
            try:
                self._next = next(self._messages, None)
            except BagError as error:  # told outside: an executor would log it as a crash
                self.failed, self._next = error, None
        self.done = self._next is None

    def finish(self, spin: Callable[[], None]) -> None:
        """Nothing to bring home."""

    def destroy_node(self) -> None:
        """Destroy the node and leave its seats."""
        super().destroy_node()
        for lock in self._locks:
            lock.release()


@contextmanager
def playing(
    bag: Bag, go_on: Callable[[], bool], **options: Any
) -> Iterator[tuple[PlayerNode, Callable[[], None]]]:
    """Make a player, paused, on a graph where nobody else says what it will say.

    Args:
        bag: an open one.
        go_on: whether to go on looking for others.
        **options: go to ``PlayerNode``.

    Yields:
        The player, and what spins it for a turn of at most ``LONGEST_S``.

    Raises:
        BagError: as ``PlayerNode``, or a robot on the graph says one of the topics.
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
                f"a robot is running here: {', '.join(others[:3])} and the like are published by "
                "others, who would take the recorded ones for theirs; stop it, or play in another "
                "ROS_DOMAIN_ID"
            )
        yield node, lambda: executor.spin_once(timeout_sec=LONGEST_S)
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
