"""Records one running robot: receives its messages and writes every tick in order."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Mapping

from rclpy.node import Node
from rclpy.subscription import Subscription

from ember_ros import cdr, topics, wire
from ember_ros.bag.metadata_client import MetadataClient
from ember_ros.bag.run_writer import RunWriter, TickMessages, absolute
from ember_ros.bag.window import Window
from ember_ros.bag.writer_process import WriterProcess
from ember_ros.errors import SignalError
from ember_ros.params import Params
from ember_ros.worlds import WORLDS, legs_of, stage_of
from leg_node.assembly import learning_params_of

LOG_S = 5.0
"""Wall time between two lines of progress, and between two warnings of one kind."""
RESPONSE_S = 5.0
"""Wall time, from the first message on, that nodes have to respond to the metadata client."""
PROGRESS_TICKS = 8
"""Clock messages between two messages on ``recorder/tick``."""
QUEUE_DEPTH = 10_000
"""Messages a topic that wait for their callback: a recorder that is delayed loses none."""


class RobotRecorder:
    """Records the robot of one namespace.

    Messages are kept back until the metadata client has its responses. Then the run writer begins,
    and each tick is written once all its messages are there.
    """

    def __init__(self, node: Node, writer: WriterProcess, namespace: str) -> None:
        """Subscribe to the robot's topics.

        Args:
            node: that subscribes and calls services.
            writer: of the bag.
            namespace: of the robot.
        """
        self.namespace = namespace
        self.restarted = False
        """Whether the simulated time went back: the run that is recorded is over."""
        self.missing = 0
        """Messages that ticks were written without."""
        self.run_writer: RunWriter | None = None
        """None until the recording begins."""
        self.last_tick = -1
        """The last tick that was written."""
        self._node, self._writer = node, writer
        self._metadata_client = MetadataClient(node, namespace)
        self._backlog: list[tuple[str, bytes]] = []  # received before the recording began
        self._start: float | None = None  # wall time when the first message was there
        self._before_table: int | None = None  # length of the backlog when the table arrived
        self._fall_count = 0
        self._falls: deque[bytes] = deque()
        self._is_first = True
        self._newest: dict[str, int] = {}  # newest tick by topic
        self._went_back: set[str] = set()  # topics whose latest tick was before their newest
        self._tick_ns = 0
        self._tick_readers: dict[str, Callable[[bytes], int]] = {}
        self._progress_publisher = self._absolute(topics.RECORDED).publish(node)
        self._ready = False
        self._clocks = 0
        names = [leg for world in WORLDS for leg in legs_of(world, Params())]
        self._subscriptions = {topic.name: self._subscribe(topic) for topic in self._topics(names)}

    def _absolute(self, topic: topics.Topic) -> topics.Topic:
        return topics.Topic(absolute(self.namespace, topic.name), topic.kind)

    @staticmethod
    def _topics(legs: list[str]) -> list[topics.Topic]:
        makers = (topics.joint_states, topics.contact, topics.transition, topics.command)
        common = [topics.FALLS, topics.ODOMETRY, topics.PHASE, topics.CLOCK]
        return [*(make(leg) for leg in legs for make in makers), *common]

    def _subscribe(self, topic: topics.Topic) -> Subscription:
        def callback(data: bytes) -> None:
            if self.run_writer is None:
                self._backlog.append((topic.name, bytes(data)))
            else:
                self._receive(topic.name, bytes(data))
            if topic.name == topics.CLOCK.name:
                self._publish_progress(bytes(data))

        return self._absolute(topic).subscribe(self._node, callback, depth=QUEUE_DEPTH)

    def _publish_progress(self, clock: bytes) -> None:
        """Publish the newest tick, once every ``PROGRESS_TICKS`` clock messages."""
        self._clocks += 1
        if self._clocks % PROGRESS_TICKS == 0 and self._tick_ns:
            with contextlib.suppress(SignalError):
                ns = cdr.read_clock(clock, topics.CLOCK.name)
                self._progress_publisher.publish(cdr.pack_int(ns // self._tick_ns))

    # -- begin -------------------------------------------------------------------------------

    def poll(self) -> None:
        """Request what determines the run; begin once that and a first message are there."""
        if self.run_writer is not None:
            return
        missing = self._metadata_client.poll()
        if not missing and not self._ready and self._metadata_client.world is not None:
            self._get_ready(self._metadata_client.world)
        if self._before_table is None and topics.PULL.name not in missing:
            self._before_table = len(self._backlog)
        if not self._backlog:
            return
        now = time.monotonic()
        if self._start is None:
            self._start = now
        if not missing or now - self._start >= RESPONSE_S:
            self._begin()

    def _get_ready(self, world: str) -> None:
        """Let the world begin, once each of its publishers is matched with a subscription."""
        robot_topics = self._topics(list(self._metadata_client.legs))
        for topic in robot_topics:  # legs of other names than the defaults
            if topic.name not in self._subscriptions:
                self._subscriptions[topic.name] = self._subscribe(topic)
        names = [topic.name for topic in robot_topics]
        if all(self._subscriptions[name].handle.get_publisher_count() for name in names):
            self._ready = True
            self._tick_ns = self._metadata_client.params(world).gait.tick_ns
            last = -1  # or the newest tick of a world that is running already
            for name, data in self._backlog:
                if name == topics.CLOCK.name:
                    last = cdr.read_clock(data, name) // self._tick_ns
            self._progress_publisher.publish(cdr.pack_int(last))

    def _begin(self) -> None:
        """Begin the recording with the backlog, if the world and a first tick are known."""
        client = self._metadata_client
        world = client.world or self._guess_world({name for name, _ in self._backlog})
        if world is None:
            return
        self._prepare(world, client.params(world))
        ticks = [self._tick_of(name, data) for name, data in self._backlog]
        first = min((tick for tick in ticks if tick is not None), default=None)
        if first is None:
            return
        backlog, self._backlog = self._backlog, []
        before = [tick for tick in ticks[: self._before_table or 0] if tick is not None]
        table_tick = max(before, default=-1)  # the newest tick when the table arrived
        run_metadata, table, problems = client.run_metadata(world, first)
        learning_params = learning_params_of(run_metadata.params, stage_of(world))
        if table is not None and table_tick + 1 >= learning_params.sync_every:
            problems.append("the table was requested after legs had pushed updates to it")
            run_metadata, table = run_metadata.without_table(), None
        for problem in problems:
            self._node.get_logger().warning(f"the bag cannot be replayed: {problem}")
        self.run_writer = RunWriter(self._writer, run_metadata, table, namespace=self.namespace)
        # The executor's first turn takes what waits topic by topic: put it in the order of ticks.
        order = sorted(range(len(backlog)), key=lambda n: -1 if ticks[n] is None else ticks[n] or 0)
        for n in order:
            self._receive(*backlog[n])

    def _guess_world(self, names: set[str]) -> str | None:
        """Return the world that has the legs of these topics, where no sim node responds."""
        for world in WORLDS:
            if any(topics.joint_states(leg).name in names for leg in legs_of(world, Params())):
                return world
        return None

    def _prepare(self, world: str, params: Params) -> None:
        """Make what reads and orders the messages of a world's robot."""
        self._legs = legs_of(world, params)
        self._tick_ns = tick_ns = params.gait.tick_ns

        def by_stamp(name: str) -> Callable[[bytes], int]:
            return lambda data: wire.tick_of(cdr.stamp_of(data, name), tick_ns, name)

        names = [topic.name for topic in self._topics(list(self._legs))]
        self._tick_readers = {name: by_stamp(name) for name in names}
        clock = topics.CLOCK.name
        self._tick_readers[clock] = lambda data: wire.tick_of(
            cdr.read_clock(data, clock), tick_ns, clock
        )
        del self._tick_readers[topics.FALLS.name]
        self._senses = {topics.contact(g).name: wire.SenseWire(g, tick_ns) for g in self._legs}
        # No tick waits for a topic that has no publisher now: a real leg has no odometry.
        published = {n for n in names if self._node.count_publishers(absolute(self.namespace, n))}
        self._has_falls = topics.FALLS.name in published
        self._window = Window(
            sorted(published & self._tick_readers.keys()), self._falls_are_complete
        )

    # -- receive -----------------------------------------------------------------------------

    def _tick_of(self, name: str, data: bytes) -> int | None:
        """Return the tick of a message, or None if it has none."""
        if name not in self._tick_readers:
            return None
        try:
            return self._tick_readers[name](data)
        except SignalError as error:
            self._node.get_logger().warning(f"not recorded: {error}", throttle_duration_sec=LOG_S)
            return None

    def _receive(self, name: str, data: bytes) -> None:
        if self.restarted:
            return
        if name == topics.FALLS.name:
            self._falls.append(data)
        else:
            tick = self._tick_of(name, data)
            if tick is None:
                return
            kept = self._window.put(tick, name, data)
            if name in (topics.CLOCK.name, topics.PHASE.name):
                back = tick < self._newest.get(name, -1)
                self.restarted = back and name in self._went_back  # a single one may be wrong
                (self._went_back.add if back else self._went_back.discard)(name)
                self._newest[name] = max(self._newest.get(name, -1), min(tick, self._window.newest))
            if not kept or self.restarted:
                return
        for tick, messages in self._window.pop_complete():
            self._write(tick, messages)

    def _has_fall(self, messages: Mapping[str, bytes]) -> bool:
        """Return whether a tick has a message of falls: the first, and each one after a fall."""
        if self._is_first:
            return True
        for name, senses in self._senses.items():
            if name in messages:
                with contextlib.suppress(SignalError):
                    contact = senses.read_contact(messages[name])[1]
                    return contact.first[wire.CONTACT.index("restart")] == 1.0
        return False

    def _falls_are_complete(self, messages: Mapping[str, bytes]) -> bool:
        """Return whether the falls of a tick were received, which carry no stamp."""
        return bool(self._falls) or not self._has_falls or not self._has_fall(messages)

    # -- write -------------------------------------------------------------------------------

    def _write(self, tick: int, messages: Mapping[str, bytes]) -> None:
        assert self.run_writer is not None
        falls = self._falls.popleft() if self._falls and self._has_fall(messages) else None
        if falls is not None:
            with contextlib.suppress(SignalError):  # it is recorded even if it cannot be read
                self._fall_count = cdr.read_int(falls, topics.FALLS.name)
        self._is_first = False
        self.missing += len(self._window.parts - messages.keys())
        if self.last_tick >= 0:
            self.missing += max(0, tick - self.last_tick - 1) * len(self._window.parts)
        self.last_tick = tick
        self.run_writer.write(
            tick,
            TickMessages(
                messages.get(topics.CLOCK.name),
                falls,
                messages.get(topics.ODOMETRY.name),
                [messages.get(topics.joint_states(leg).name) for leg in self._legs],
                [messages.get(topics.contact(leg).name) for leg in self._legs],
                messages.get(topics.PHASE.name),
                [messages.get(topics.command(leg).name) for leg in self._legs],
                [messages.get(topics.transition(leg).name) for leg in self._legs],
            ),
        )

    def finish(self) -> None:
        """Write the ticks that are not complete yet, and end the run."""
        if self.run_writer is None and self._backlog:
            self._begin()
        if self.run_writer is not None:
            for tick, messages in self._window.pop_rest():
                self._write(tick, messages)
            self.run_writer.finish()

    def progress(self) -> str:
        """Return how far the recording is, in words."""
        name = f"/{self.namespace.strip('/')}"
        if self.run_writer is None:
            return f"{name}: nothing is recorded, no robot publishes here yet"
        lost = f"{self.missing} messages missing" if self.missing else "nothing missing"
        return f"{name}: {self.run_writer.ticks} ticks, {self._fall_count} falls, {lost}"
