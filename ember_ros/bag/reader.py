"""Opens a bag, checks it, and returns one robot's run tick by tick. Pure.

Our own bags, those of `ros2 bag record` and those of any other recorder of the same topics are read
in the same way: messages are assigned to ticks by their stamps, not by their order in the bag.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ember_ros import cdr, topics, wire
from ember_ros.bag.files import Files, files_of
from ember_ros.bag.messages import Connection
from ember_ros.bag.run_metadata import RunMetadata, read_run_metadata
from ember_ros.bag.run_writer import absolute, crc_of
from ember_ros.bag.storage import METADATA, STORAGES, read_metadata
from ember_ros.bag.window import LATE, Window
from ember_ros.errors import BagError, EmberError, SignalError
from ember_ros.params import Params
from ember_ros.shipped import shipped_bag
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from ember_ros.worlds import WORLDS, legs_of, stage_of
from leg_node.table import Table


class Tick(NamedTuple):
    """The messages of one tick in a bag; legs in their order."""

    tick: int
    beat: Beat
    senses: tuple[LegSense | None, ...]
    """None where one of a leg's two messages is not in the bag."""
    commands: tuple[LegCommand | None, ...]
    body: BodyState
    """The body's state, or the last one before; falls are counted from the bag's start."""
    transitions: tuple[Transition | None, ...]
    """Each leg's transition of the tick before; None of a leg that publishes none."""


class Damage(NamedTuple):
    """Senses whose CRC-32 is not the recorded one."""

    tick: int
    leg: str
    found: int
    """CRC-32 of the senses in the bag."""
    recorded: int
    """The CRC-32 that was recorded."""


_Stamped = TypeVar("_Stamped", Beat, LegCommand, Transition)


class Raw(NamedTuple):
    """One message of the bag, serialized."""

    topic: str
    kind: str
    ns: int
    data: bytes


class _Reading:
    """State of one pass through the bag; see ``Bag.ticks``."""

    def __init__(self) -> None:
        self.computed: dict[int, tuple[int, ...]] = {}  # CRC-32 of each leg's senses, by tick
        self.recorded: dict[int, tuple[int, ...]] = {}
        self.pose: tuple[float, ...] = (0.0,) * 6


class Bag:
    """A bag that is open for reading, and one robot in it."""

    def __init__(
        self, path: Path, *, namespace: str | None = None, params: Params | None = None
    ) -> None:
        """Open a bag.

        Args:
            path: its folder, one file of it, or ``walk`` for the bag that is part of the package.
            namespace: of the robot; needed if the bag has more than one.
            params: for a bag of another recorder, without run metadata; the defaults for None.

        Raises:
            BagError: it is missing, cut off, damaged, or no bag of a robot.
        """
        self.path = shipped_bag(path)
        self._files = _open(self.path)
        self.damages: list[Damage] = []
        """Damaged senses in the last pass of ``ticks``."""
        self.stale = 0
        """Messages in the last pass whose tick was returned before, or far ahead of all others."""
        try:
            self.connections: dict[str, Connection] = {}
            for connection in self._files.connections.values():
                self.connections.setdefault(connection.topic, connection)
            self.namespace = self._choose(namespace)
            self.run_metadata, self.table = self._read_run()
            self.params = self.run_metadata.params if self.run_metadata else params or Params()
            self.world = self.run_metadata.world if self.run_metadata else self._world()
            self.legs = self._legs()
            self._check_topics()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Bag:
        """Return the bag."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, t: TracebackType | None
    ) -> None:
        """Close the bag."""
        self.close()

    def close(self) -> None:
        """Close the files; safe to call twice."""
        self._files.close()

    # -- content -----------------------------------------------------------------------------

    def _name(self, topic: topics.Topic) -> str:
        return absolute(self.namespace, topic.name)

    def robots(self) -> list[str]:
        """Return the namespaces that have legs."""
        known = {leg for world in WORLDS for leg in legs_of(world, Params())}
        namespaces = set()
        for topic in self.connections:
            prefix, _, end = topic.rpartition("/")
            namespace, _, leg = prefix.rpartition("/")
            if end == "joint_states" and (leg in known or f"{prefix}/contact" in self.connections):
                namespaces.add(namespace.strip("/"))
        return sorted(namespaces)

    def _choose(self, namespace: str | None) -> str:
        robots = self.robots()
        named = ", ".join(f"/{robot}" for robot in robots)
        if namespace is not None:
            if namespace.strip("/") not in robots:
                raise BagError(f"{self.path} has no robot in {namespace}; it has {named or 'none'}")
            return namespace.strip("/")
        if len(robots) > 1:
            raise BagError(f"{self.path} has robots in {named}: choose one with --namespace")
        if not robots:
            names = ", ".join(sorted(self.connections)) or "none"
            raise BagError(
                f"{self.path} has no robot of ember_ros in it; topics like "
                f"/front_left/joint_states and /cpg/phase would be right, its topics are: {names}"
            )
        return robots[0]

    def _world(self) -> str:
        """Return the world whose legs are in the bag."""
        for world in WORLDS:
            legs = legs_of(world, self.params)
            if any(self._name(topics.joint_states(leg)) in self.connections for leg in legs):
                if not self._other_legs(legs):
                    return world
                break  # a robot with further legs, whose messages would be ignored
        raise BagError(
            f"{self.path} has legs of other names than {', '.join(self.params.robot.legs)}; the "
            "robot's parameter file, by --params, would be right"
        )

    def _other_legs(self, legs: Sequence[str]) -> list[str]:
        """Return the names of other legs in the robot's namespace than these."""
        prefix, others = self._name(topics.CLOCK).removesuffix(topics.CLOCK.name), []
        for topic in self.connections:
            leg, _, what = topic.removeprefix(prefix).rpartition("/")
            own = topic.startswith(prefix) and "/" not in leg and what == "joint_states"
            if own and leg not in legs and self._name(topics.contact(leg)) in self.connections:
                others.append(leg)
        return others

    def _legs(self) -> tuple[str, ...]:
        """Return the names of the legs, without importing a user's own world."""
        if self.run_metadata is not None and self.world not in WORLDS:
            return tuple(self.run_metadata.legs)
        return legs_of(self.world, self.params)

    def _needed(self) -> list[topics.Topic]:
        makers = (topics.joint_states, topics.contact, topics.command)
        return [topics.PHASE, *(make(leg) for leg in self.legs for make in makers)]

    def _check_topics(self) -> None:
        of_run = (topics.CRC, topics.RUN_METADATA, topics.VALUES, topics.VISITS)
        transitions = map(topics.transition, self.legs)
        optional = (topics.CLOCK, topics.ODOMETRY, topics.FALLS, *of_run, *transitions)
        for topic in (*self._needed(), *optional):
            name = self._name(topic)
            connection = self.connections.get(name)
            if connection is None and topic not in optional:
                raise BagError(
                    f"{self.path} has no {name} ({topic.kind}); `--bag` and the recorder_node "
                    "record all topics of a run"
                )
            if connection is None:
                continue
            # A topic may have messages of other types too.
            kinds = [topic.kind, *([topics.BARE_PHASE.kind] if topic == topics.PHASE else [])]
            keys = [(name, kind) for kind in kinds if (name, kind) in self._files.connections]
            connection = self._files.connections[keys[0]] if keys else connection
            self.connections[name] = connection
            if connection.encoding != "cdr":
                raise BagError(
                    f"{self.path}: {name} is written as {connection.encoding!r}; cdr would be right"
                )
            if connection.msgtype not in kinds:
                raise BagError(
                    f"{self.path}: {name} is of type {connection.msgtype}; {topic.kind} would be "
                    "right"
                )

    @functools.cached_property
    def _legs_with_transitions(self) -> list[str]:
        """Return the legs whose transitions are recorded in the current layout.

        Older transitions have no next state: their legs are read as if they published none.
        """
        first = {leg: self._first(topics.transition(leg)) for leg in self.legs}
        return [leg for leg, data in first.items() if data and not wire.is_older_transition(data)]

    def _read_run(self) -> tuple[RunMetadata | None, Table | None]:
        """Return the run metadata and the start table, if the bag has them."""
        text = self._first(topics.RUN_METADATA)
        if text is None:
            return None, None
        where = f"{self.path}: {self._name(topics.RUN_METADATA)}"
        try:
            run_metadata = read_run_metadata(cdr.read_text(text, where), where)
        except SignalError as error:
            raise BagError(str(error)) from error
        values, visits = self._first(topics.VALUES), self._first(topics.VISITS)
        if values is None or visits is None:
            return run_metadata, None
        try:
            (shape, _, learnt), (_, _, counts) = (
                cdr.read_array(data, code, where) for data, code in ((values, "d"), (visits, "q"))
            )
            # The message gives the size. The parts that the metadata names are not imported: they
            # may be missing here, and reading a bag must not run code that it names.
            table = Table(*shape)
            table.values[:] = np.frombuffer(learnt, "<f8")
            table.visits[:] = np.frombuffer(counts, "<i8")
        except (SignalError, ValueError, TypeError) as error:
            raise BagError(f"{self.path}: the table at the start is damaged: {error}") from error
        if table.sha256() != run_metadata.start_table_sha256:
            raise BagError(
                f"{self.path}: the table at the start is not the one that was recorded (SHA-256 "
                f"{table.sha256()[:12]}..., recorded "
                f"{str(run_metadata.start_table_sha256)[:12]}...)"
            )
        return run_metadata, table

    def _first(self, topic: topics.Topic) -> bytes | None:
        """Return the first message of a topic."""
        with reading(self.path):
            messages = self._files.messages([(self._name(topic), topic.kind)])
            return next((message.data for message in messages), None)

    @property
    def table_sha256(self) -> str | None:
        """Return the SHA-256 of the table at the end of the run, if it is known."""
        if not self.path.is_dir():
            return None
        custom = read_metadata(self.path).get("custom_data") or {}
        return custom.get("table_sha256") if isinstance(custom, dict) else None

    @property
    def stage(self) -> str:
        """Return whose learning parameters the legs had: by the run metadata, or by the world."""
        for leg in self.run_metadata.legs.values() if self.run_metadata else ():
            return leg.stage
        return stage_of(self.world) if self.world in WORLDS else "walk"

    @property
    def reward_terms(self) -> tuple[str, ...]:
        """Return the names of the reward's terms; none without transitions."""
        for leg in self._legs_with_transitions:
            data = self._first(topics.transition(leg))
            assert data is not None
            transition = wire.TransitionWire(leg, self.params.gait.tick_ns).read(data)
            return tuple(name for name, _ in transition.terms)
        return ()

    def messages(self, topic: topics.Topic) -> int:
        """Return the number of messages of one of the robot's topics."""
        connection = self.connections.get(self._name(topic))
        return 0 if connection is None else int(connection.msgcount)

    def phases(self) -> int:
        """Return the number of phases: the bag has no more ticks."""
        return self.messages(topics.PHASE)

    def raw(self, start_ns: int = 0) -> Iterator[Raw]:
        """Yield all messages of all topics from a time on, in the order of their times.

        Args:
            start_ns: time to skip, from the first message on.
        """
        start = self.start_ns + start_ns if start_ns else None
        with reading(self.path):
            for ns, topic, kind, data in self._files.messages(start=start):
                yield Raw(topic, kind, ns, data)

    @functools.cached_property
    def start_ns(self) -> int:
        """Return the time of the first message."""
        with reading(self.path):
            return next((message.ns for message in self._files.messages()), 0)

    @property
    def files(self) -> list[Path]:
        """Return the files of the bag."""
        return self._files.paths

    # -- tick by tick ------------------------------------------------------------------------

    def ticks(self) -> Iterator[Tick]:
        """Yield the robot's ticks in order; a tick without a phase is skipped.

        Raises:
            BagError: a message is damaged, or the bag holds two runs.
        """
        self.damages, self.stale = [], 0
        reading = _Reading()
        readers = self._readers(reading)
        clocked = self._name(topics.CLOCK) in self.connections
        beat = self._name(topics.CLOCK if clocked else topics.PHASE)
        parts = [self._name(topic) for topic in self._needed()]
        optional = [
            self._name(t)
            for t in (topics.ODOMETRY, *map(topics.transition, self._legs_with_transitions))
        ]
        parts += [name for name in optional if name in self.connections]
        window, falls, newest, back = Window(parts), 0, -1, False
        phase = self._name(topics.PHASE)
        for topic, _, data in self._messages([*readers, beat]):
            if topic == beat:
                for tick, messages in window.pop_complete():
                    falls += self._has_fall(messages)
                    yield from self._tick(tick, messages, falls, reading)
            reader = readers.get(topic)
            if reader is None:
                continue
            try:
                tick, value = reader(data)
            except EmberError as error:
                raise BagError(
                    f"{self.path}: {topic} near tick {max(0, window.newest)} is damaged: {error}"
                ) from error
            if tick >= 0 and not window.put(tick, topic, (data, value)):
                self.stale += 1
            if topic == phase:
                if tick < newest and back:  # a single one may be wrong
                    raise BagError(
                        f"{self.path}: after tick {newest}, {topic} begins again at tick "
                        f"{tick}: there are two runs in this bag"
                    )
                back = tick < newest
                newest = max(newest, min(tick, window.newest))
        for tick, messages in window.pop_rest():
            falls += self._has_fall(messages)
            yield from self._tick(tick, messages, falls, reading)
        self.stale += window.displaced

    def _messages(self, names: list[str]) -> Iterator[tuple[str, int, bytes]]:
        keys = [self.connections[name][:2] for name in names if name in self.connections]
        with reading(self.path):
            for ns, topic, _, data in self._files.messages(keys):
                yield topic, ns, data

    def _readers(self, reading: _Reading) -> dict[str, Callable[[bytes], tuple[int, Any]]]:
        """Return each topic's reader, which returns a tick, or -1, and a value."""
        gait = self.params.gait
        tick_ns = gait.tick_ns
        phase, odometry = self._name(topics.PHASE), self._name(topics.ODOMETRY)
        crc = self._name(topics.CRC)

        bare = self.connections[phase].msgtype == topics.BARE_PHASE.kind
        beats = wire.BeatWire(tick_ns)

        def read_beat(data: bytes) -> Beat:
            return wire.read_bare_phase(data, gait.ticks, phase) if bare else beats.read(data)

        def read_body(data: bytes) -> tuple[int, Any]:
            ns, pose = wire.read_odometry(data, odometry)
            return wire.tick_of(ns, tick_ns, odometry), pose

        def read_crc(data: bytes) -> tuple[int, Any]:
            shape, before, numbers = cdr.read_array(data, "I", crc)
            if shape[1:] != (len(self.legs),) or len(before) != 8 or shape[0] > LATE:
                raise SignalError(
                    f"{crc}: an array of {shape}; (up to {LATE} ticks, {len(self.legs)}), and two "
                    "numbers before it, would be right"
                )
            (count, legs) = shape
            low, high = np.frombuffer(before, "<u4").tolist()
            rows = np.frombuffer(numbers, "<u4").reshape(count, legs).tolist()
            for tick, row in enumerate(rows, low + (high << 32)):
                reading.recorded[tick] = tuple(row)
                self._check(tick, reading)
            while len(reading.recorded) > 4 * LATE:  # of ticks that are not in the bag
                del reading.recorded[next(iter(reading.recorded))]
            return -1, None

        readers: dict[str, Callable[[bytes], tuple[int, Any]]] = {
            phase: _with_tick(read_beat),
            odometry: read_body,
            crc: read_crc,
        }
        for leg in self.legs:
            senses, commands = wire.SenseWire(leg, tick_ns), wire.CommandWire(leg, tick_ns)
            readers[self._name(topics.joint_states(leg))] = senses.read_joints
            readers[self._name(topics.contact(leg))] = senses.read_contact
            readers[self._name(topics.command(leg))] = _with_tick(commands.read)
            if leg in self._legs_with_transitions:
                transitions = wire.TransitionWire(leg, tick_ns)
                readers[self._name(topics.transition(leg))] = _with_tick(transitions.read)
        return readers

    def _has_fall(self, messages: dict[str, Any]) -> bool:
        """Return whether the robot was reset at a tick, after a fall."""
        for leg in self.legs:
            part = messages.get(self._name(topics.contact(leg)))
            if part is not None:
                return bool(part[1].first[wire.CONTACT.index("restart")])
        return False

    def _tick(
        self, tick: int, messages: dict[str, Any], falls: int, reading: _Reading
    ) -> Iterator[Tick]:
        """Yield the tick of these messages, if it has a phase."""
        senses: list[LegSense | None] = []
        commands: list[LegCommand | None] = []
        transitions: list[Transition | None] = []
        crcs = []
        for leg in self.legs:
            joints = messages.get(self._name(topics.joint_states(leg)), (None, None))
            contact = messages.get(self._name(topics.contact(leg)), (None, None))
            command = messages.get(self._name(topics.command(leg)), (None, None))
            both = joints[1] is not None and contact[1] is not None
            senses.append(wire.SenseWire.sense(tick, joints[1], contact[1]) if both else None)
            commands.append(command[1])
            transition = messages.get(self._name(topics.transition(leg)), (None, None))
            transitions.append(transition[1])
            crcs.append(crc_of(joints[0], contact[0]))
        reading.computed[tick] = tuple(crcs)
        self._check(tick, reading)
        if len(reading.computed) > 4 * LATE:  # never checked: the bag has no CRCs, or is cut off
            del reading.computed[next(iter(reading.computed))]
        beat = messages.get(self._name(topics.PHASE))
        if beat is not None:
            reading.pose = messages.get(self._name(topics.ODOMETRY), (None, reading.pose))[1]
            body = BodyState._make((*reading.pose, falls))
            yield Tick(tick, beat[1], tuple(senses), tuple(commands), body, tuple(transitions))

    def _check(self, tick: int, reading: _Reading) -> None:
        """Compare the CRCs of a tick's senses with the recorded ones once both are there."""
        if tick not in reading.computed or tick not in reading.recorded:
            return
        for leg, computed, recorded in zip(
            self.legs, reading.computed.pop(tick), reading.recorded.pop(tick), strict=True
        ):
            if computed != recorded:
                self.damages.append(Damage(tick, leg, computed, recorded))


def _with_tick(read: Callable[[bytes], _Stamped]) -> Callable[[bytes], tuple[int, _Stamped]]:
    """Return a reader that returns the tick of a message too."""

    def read_with_tick(data: bytes) -> tuple[int, _Stamped]:
        value = read(data)
        return value.tick, value

    return read_with_tick


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise a BagError for any error that a damaged file causes."""
    try:
        yield
    except (EmberError, GeneratorExit, KeyboardInterrupt):
        raise
    except Exception as error:  # zstd, struct, yaml and sqlite raise many kinds
        why = " ".join(str(error).split()) or type(error).__name__
        raise BagError(
            f"{path} is damaged: {why}; `ember bag repair {path}` keeps what is intact"
        ) from error


def _open(path: Path) -> Files:
    """Return the open files of a bag.

    Raises:
        BagError: there is no bag that can be read; the message says why.
    """
    if not path.exists():
        raise BagError(f"there is no bag {path}; `ember walk --bag {path}` would make one")
    if path.is_dir():
        if not (path / METADATA).exists():
            if files_of(path):
                raise BagError(
                    f"{path} has no {METADATA}: its recording was cut off; `ember bag repair "
                    f"{path}` restores it"
                )
            raise BagError(f"{path} is no bag: a folder with {METADATA} would be right")
    elif path.suffix not in STORAGES.values():
        raise BagError(
            f"{path} is no bag; a folder with {METADATA}, or a file of "
            f"{' or '.join(STORAGES.values())}, would be right"
        )
    with reading(path):
        return Files(path)
