"""Records any running robot: ``ros2 run ember_ros recorder_node --ros-args -p bag:=DIR``.

It says how far it is, and a world in lockstep does not run away from it. What it misses all the
same, of a robot that waits for nobody, it counts and says. A world can also record itself, with the
same bytes and at less cost (``ember walk --bag``, ``sim_node -p bag:=DIR``).
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rclpy.node import Node

from ember_ros import cdr, topics, wire
from ember_ros.bag.metadata_client import MetadataClient
from ember_ros.bag.run_writer import RunWriter, TickMessages, absolute
from ember_ros.bag.storage import BagOptions, size_of
from ember_ros.bag.window import Window
from ember_ros.bag.writer_process import WriterProcess
from ember_ros.errors import BagError, ParameterError, SignalError
from ember_ros.params import Params
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.spinning import main_of
from ember_ros.worlds import WORLDS, legs_of, stage_of
from leg_node.assembly import numbers_of

WATCH_S = 0.1
SAY_S = 5.0  # wall time between two lines of progress
ANSWER_S = 5.0  # wall time that nodes have to say what they were told, from the first message on
TELL_TICKS = 8
HELD = 10_000
"""Messages a topic that wait to be heard: a recorder that was held up for a while loses nothing."""


class _Ear:
    """One robot, heard."""

    def __init__(self, node: Node, writer: WriterProcess, namespace: str) -> None:
        self.namespace = namespace
        self.anew = False
        """Whether time began anew: the run that is recorded is over."""
        self.missing = 0
        """Messages that ticks were written without."""
        self.recording: RunWriter | None = None
        self.last = -1
        self.fallen = 0
        self._node, self._writer = node, writer
        self._inquiry = MetadataClient(node, namespace)
        self._heard: list[tuple[str, bytes]] = []  # before it is known what determines the run
        self._since: float | None = None
        self._told_by: int | None = None  # how many messages were heard when the table answered
        self._falls: deque[bytes] = deque()
        self._first = True
        self._lasts: dict[str, int] = {}
        self._back: set[str] = set()  # who just spoke of a tick before its last
        self._tick_ns = 0
        self._readers: dict[str, Callable[[bytes], int]] = {}
        self._progress = self._named(topics.RECORDED).publish(node)
        self._ready = False
        self._clocks = 0
        self._subscriptions = {
            topic.name: self._named(topic).subscribe(node, self._hearer(topic.name), held=HELD)
            for topic in self._topics([leg for world in WORLDS for leg in legs_of(world, Params())])
        }

    def _named(self, topic: topics.Topic) -> topics.Topic:
        return topics.Topic(absolute(self.namespace, topic.name), topic.kind)

    @staticmethod
    def _topics(legs: list[str]) -> list[topics.Topic]:
        makers = (topics.joint_states, topics.contact, topics.transition, topics.command)
        common = [topics.FALLS, topics.ODOMETRY, topics.PHASE, topics.CLOCK]
        return [*(make(leg) for leg in legs for make in makers), *common]

    def _hearer(self, name: str) -> Callable[[bytes], None]:
        def hear(data: bytes) -> None:
            if self.recording is None:
                self._heard.append((name, bytes(data)))
            else:
                self._take(name, bytes(data))
            if name == topics.CLOCK.name:
                self._tell(bytes(data))

        return hear

    def _tell(self, clock: bytes) -> None:
        """Say now and then which tick was heard."""
        self._clocks += 1
        if self._clocks % TELL_TICKS == 0 and self._tick_ns:
            with contextlib.suppress(SignalError):
                ns = cdr.read_clock(clock, topics.CLOCK.name)
                self._progress.publish(cdr.pack_int(ns // self._tick_ns))

    # -- beginning ---------------------------------------------------------------------------

    def watch(self) -> None:
        """Ask what determines the run, and begin once that is known and somebody was heard."""
        if self.recording is not None:
            return
        waiting = self._inquiry.ask()
        if not waiting and not self._ready and self._inquiry.world is not None:
            self._get_ready(self._inquiry.world)
        if self._told_by is None and topics.PULL.name not in waiting:
            self._told_by = len(self._heard)
        if not self._heard:
            return
        now = time.monotonic()
        if self._since is None:
            self._since = now
        if not waiting or now - self._since >= ANSWER_S:
            self._begin()

    def _get_ready(self, world: str) -> None:
        """Let the world begin, once everything that it will say is being listened to."""
        every = self._topics(list(self._inquiry.legs))
        for topic in every:  # legs of other names than the defaults
            if topic.name not in self._subscriptions:
                hear = self._hearer(topic.name)
                self._subscriptions[topic.name] = self._named(topic).subscribe(
                    self._node, hear, held=HELD
                )
        names = [topic.name for topic in every]
        if all(self._subscriptions[name].handle.get_publisher_count() for name in names):
            self._ready = True
            self._tick_ns = self._inquiry.params(world).gait.tick_ns
            last = -1  # or, of a world that is running already, the tick that was heard last
            for name, data in self._heard:
                if name == topics.CLOCK.name:
                    last = cdr.read_clock(data, name) // self._tick_ns
            self._progress.publish(cdr.pack_int(last))

    def _begin(self) -> None:
        heard, self._heard = self._heard, []
        world = self._inquiry.world or self._guess({name for name, _ in heard})
        if world is None:
            self._heard = heard
            return
        self._prepare(world, self._inquiry.params(world))
        ticks = [self._tick_of(name, data) for name, data in heard]
        first = min((tick for tick in ticks if tick is not None), default=None)
        if first is None:
            self._heard = heard
            return
        before = [tick for tick in ticks[: self._told_by or 0] if tick is not None]
        told_at = max(before, default=-1)
        run_metadata, table, wrong = self._inquiry.run_metadata(world, first)
        numbers = numbers_of(run_metadata.params, stage_of(world))
        if table is not None and told_at + 1 >= numbers.sync_every:
            wrong.append("the table was asked for when legs had already learnt into it")
            run_metadata, table = run_metadata.without_table(), None
        for why in wrong:
            self._node.get_logger().warning(f"the bag cannot be replayed: {why}")
        self.recording = RunWriter(self._writer, run_metadata, table, namespace=self.namespace)
        # Topic by topic is how a first turn hears what was waiting: put back in the order of ticks.
        order = sorted(range(len(heard)), key=lambda n: -1 if ticks[n] is None else ticks[n] or 0)
        for n in order:
            self._take(*heard[n])

    def _guess(self, names: set[str]) -> str | None:
        """Return the world whose legs were heard, where no sim node says it."""
        for world in WORLDS:
            if any(topics.joint_states(leg).name in names for leg in legs_of(world, Params())):
                return world
        return None

    def _prepare(self, world: str, params: Params) -> None:
        self._legs = legs_of(world, params)
        self._tick_ns = tick_ns = params.gait.tick_ns

        def by_stamp(name: str) -> Callable[[bytes], int]:
            return lambda data: wire.tick_of(cdr.stamp_of(data, name), tick_ns, name)

        names = [topic.name for topic in self._topics(list(self._legs))]
        self._readers = {name: by_stamp(name) for name in names}
        clock = topics.CLOCK.name
        self._readers[clock] = lambda d: wire.tick_of(cdr.read_clock(d, clock), tick_ns, clock)
        del self._readers[topics.FALLS.name]
        self._senses = {topics.contact(g).name: wire.SenseWire(g, tick_ns) for g in self._legs}
        # Who has no publisher when it begins is not waited for: a real leg has no odometry.
        spoken = {n for n in names if self._node.count_publishers(absolute(self.namespace, n))}
        self._counts_falls = topics.FALLS.name in spoken
        self._window = Window(sorted(spoken & self._readers.keys()), self._falls_are_there)

    # -- hearing -----------------------------------------------------------------------------

    def _tick_of(self, name: str, data: bytes) -> int | None:
        """Return the tick that a message names, or None for one that names none."""
        if name not in self._readers:
            return None
        try:
            return self._readers[name](data)
        except SignalError as why:
            self._node.get_logger().warning(f"not recorded: {why}", throttle_duration_sec=SAY_S)
            return None

    def _take(self, name: str, data: bytes) -> None:
        if self.anew:
            return
        if name == topics.FALLS.name:
            self._falls.append(data)
        else:
            tick = self._tick_of(name, data)
            if tick is None:
                return
            kept = self._window.put(tick, name, data)
            if name in (topics.CLOCK.name, topics.PHASE.name):
                back = tick < self._lasts.get(name, -1)
                self.anew = back and name in self._back  # one alone may be wrong
                (self._back.add if back else self._back.discard)(name)
                self._lasts[name] = max(self._lasts.get(name, -1), min(tick, self._window.newest))
            if not kept or self.anew:
                return
        for tick, found in self._window.take():
            self._write(tick, found)

    def _fell(self, found: Mapping[str, bytes]) -> bool:
        """Return whether a tick comes with a message of falls: the first, and after each fall."""
        if self._first:
            return True
        for name, senses in self._senses.items():
            if name in found:
                with contextlib.suppress(SignalError):
                    contact = senses.read_contact(found[name])[1]
                    return contact.first[wire.CONTACT.index("restart")] == 1.0
        return False

    def _falls_are_there(self, found: Mapping[str, bytes]) -> bool:
        """Return whether the falls that a tick comes with were heard: they carry no stamp."""
        return bool(self._falls) or not self._counts_falls or not self._fell(found)

    def _write(self, tick: int, found: Mapping[str, bytes]) -> None:
        assert self.recording is not None
        falls = self._falls.popleft() if self._falls and self._fell(found) else None
        if falls is not None:
            with contextlib.suppress(SignalError):  # whatever it says, it is recorded
                self.fallen = cdr.read_int(falls, topics.FALLS.name)
        self._first = False
        self.missing += len(self._window.parts - found.keys())
        self.missing += max(0, tick - self.last - 1) * len(self._window.parts) * (self.last >= 0)
        self.last = tick
        self.recording.put(
            tick,
            TickMessages(
                found.get(topics.CLOCK.name),
                falls,
                found.get(topics.ODOMETRY.name),
                [found.get(topics.joint_states(leg).name) for leg in self._legs],
                [found.get(topics.contact(leg).name) for leg in self._legs],
                found.get(topics.PHASE.name),
                [found.get(topics.command(leg).name) for leg in self._legs],
                [found.get(topics.transition(leg).name) for leg in self._legs],
            ),
        )

    def finish(self) -> None:
        """Write what is still waited for."""
        if self.recording is None and self._heard:
            self._begin()
        if self.recording is not None:
            for tick, found in self._window.rest():
                self._write(tick, found)
            self.recording.finish()

    def line(self) -> str:
        """Return how far it is."""
        if self.recording is None:
            return f"/{self.namespace.strip('/')}: nothing is recorded, no robot speaks here yet"
        ticks = self.recording.ticks
        lost = f"{self.missing} messages missing" if self.missing else "nothing missing"
        return f"/{self.namespace.strip('/')}: {ticks} ticks, {self.fallen} falls, {lost}"


class RecorderNode(Node):  # type: ignore[misc]
    """Hears everything, and says nothing but how far it is.

    Subscribes: all topics of a robot, as their bytes. Publishes: ``recorder/tick``
    (std_msgs/Int64), -1 when it is ready. Calls, once each, before it begins: the
    nodes' ``get_parameters`` and ``table/pull``, for what determines the run.
    Parameters: ``bag``, ``split_mb``, ``split_s``, ``all_robots``.
    """

    GROUPS = ()
    OPTIONS = ("bag", "split_mb", "split_s", "all_robots")

    def __init__(self, **kwargs: Any) -> None:
        """Make the node and the bag; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range, or ``bag`` is not given.
            BagError: the bag cannot be made.
        """
        super().__init__(
            "recorder_node", automatically_declare_parameters_from_overrides=True, **kwargs
        )
        self.done = False
        declare_params(self, self.GROUPS)  # refuses unknown names
        options = declare_options(self, self.OPTIONS)
        if not options["bag"]:
            raise ParameterError("give the folder of a new bag: --ros-args -p bag:=DIR")
        self._folder = Path(options["bag"])
        given = (options[name] for name in BagOptions._fields[1:])
        self._writer = WriterProcess(BagOptions(self._folder, *given))
        self._writer.flush()  # returns when it is ready to write: what comes now is not held up
        self._all = options["all_robots"]
        self._ears: dict[str, _Ear] = {}
        if not self._all:
            self._listen(self.get_namespace().strip("/"))
        self._said = time.monotonic()
        self._watch_timer = self.create_timer(WATCH_S, self._watch)

    def _listen(self, namespace: str) -> None:
        self._ears[namespace] = _Ear(self, self._writer, namespace)

    def _watch(self) -> None:
        if self._all:
            end = "/" + topics.PHASE.name
            for topic, _ in sorted(self.get_topic_names_and_types()):
                namespace = topic[: -len(end)].strip("/")
                if topic.endswith(end) and namespace not in self._ears:
                    self._listen(namespace)
        for ear in self._ears.values():
            ear.watch()
            if ear.anew and not self.done:
                self.done = True
                self.get_logger().warning(
                    f"time began anew in /{ear.namespace} after tick {ear.last}: one run a bag, "
                    "this one ends here"
                )
        now = time.monotonic()
        if now - self._said >= SAY_S:
            self._said = now
            self._say()

    def _say(self) -> None:
        lines = "; ".join(ear.line() for ear in self._ears.values()) or "no robot on the graph yet"
        self.get_logger().info(f"{lines}; {size_of(self._folder) / 1e6:.1f} MB")

    def finish(self, spin: Callable[[], None]) -> None:
        """Write what was heard, and end the bag well.

        Raises:
            BagError: nothing was heard, or the bag could not be written to its end.
        """
        self.done = True
        for ear in self._ears.values():
            ear.finish()
        self._writer.close()
        if not any(ear.recording for ear in self._ears.values()):
            where = "anywhere" if self._all else f"in {self.get_namespace()}"
            raise BagError(
                f"no robot was heard {where}: the bag {self._folder} is empty; a robot in the same "
                "namespace, domain and discovery range would be heard"
            )
        self._say()

    def destroy_node(self) -> None:
        """Destroy the node; a bag that was not finished ends here."""
        self._writer.abandon()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal."""
    sys.exit(main_of(RecorderNode, args))


if __name__ == "__main__":
    main()
