"""Recorder, player and the world that records itself: what is heard, asked, written and said."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from rclpy.node import Node
from std_srvs.srv import SetBool

from ember_ros import cdr, topics, wire
from ember_ros.bag import player_node
from ember_ros.bag.metadata_client import MetadataClient
from ember_ros.bag.player_node import PlayerNode
from ember_ros.bag.reader import Bag, Raw
from ember_ros.bag.recorder_node import RecorderNode
from ember_ros.bag.repair import repair
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.run_writer import RunWriter, absolute
from ember_ros.bag.storage import BagOptions, McapWriter, read_metadata, size_of
from ember_ros.errors import BagError, ParameterError
from ember_ros.graph import Graph
from ember_ros.loop import Loop
from ember_ros.offline.relearn import relearn
from ember_ros.offline.replay import replay
from ember_ros.params import Params, as_dict, replace
from ember_ros.run_config import RunConfig
from ember_ros.signals import LegCommand
from ember_ros.versions import versions
from leg_node.assembly import empty_table
from leg_node.node import LegNode
from leg_node.table_file import save_table
from leg_node.table_node import TableNode
from sim_node import node as sim_module
from sim_node.fake import FakeWorld
from support.bags import raws_of
from support.configs import small_config
from support.legs import LEGS
from support.needs import needs_bags
from support.robot import PATIENCE_S, Robot, matched, overrides
from support.ros import Ros

pytestmark = needs_bags

CYCLES = 4
TICKS = 32
ALL = CYCLES * TICKS
TICK_NS = Params().gait.tick_ns
FALLS = {50, 51}


def config(cycles: int = CYCLES, **options: Any) -> RunConfig:
    """Return a plan of a small walker; options with ``__`` in their names are parameters."""
    return small_config(cycles, **options)


def world_of(config: RunConfig) -> FakeWorld:
    """Return a world without physics, in which the robot falls twice."""
    return FakeWorld(config.legs, config.params, falls_at=FALLS)


def robot_of(ros: Ros, config: RunConfig, namespace: str = "", **how: Any) -> Robot:
    """Start all nodes of a plan but the world, which robot.begin starts."""
    without = ["sim_node", *how.pop("without", [])]
    return Robot(
        ros, config, namespace, without=without, patience=PATIENCE_S, world=world_of, **how
    )


def recording(ros: Ros, folder: Path, namespace: str = "", **parameters: Any) -> Any:
    """Return a recorder node that spins."""
    return ros.add(
        RecorderNode(
            context=ros.context,
            namespace=namespace,
            parameter_overrides=overrides({"bag": str(folder), **parameters}),
        )
    )


def recorder_of(recorder: Any, namespace: str = "") -> Any:
    """Return what a recorder node records one robot with."""
    return recorder._robots[namespace]


def until_recorded(ros: Ros, recorder: Any, ticks: int, namespace: str = "") -> None:
    """Spin until a recorder has written so many ticks of a robot."""

    def written() -> bool:
        robot = recorder_of(recorder, namespace)
        return robot.run_writer is not None and robot.run_writer.ticks >= ticks

    ros.spin_until(written, f"{ticks} ticks are recorded")


def untimed(bag: Path) -> dict[str, Any]:
    """Return the metadata of a bag but for when it was recorded."""
    told = read_metadata(bag)
    told["custom_data"].pop("date")
    return told


def until_quiet(ros: Ros, messages: int = 0) -> None:
    """Let everything be heard that was said in this process: one callback a turn."""
    for _ in range(messages + 200):
        ros.spin_once(0.0)


def bytes_of(bag: Path) -> dict[str, bytes]:
    """Return the files of a bag but its metadata."""
    return {file.name: file.read_bytes() for file in bag.iterdir() if file.suffix == ".mcap"}


def warnings(ros: Ros) -> Callable[[], str]:
    """Listen to the log of all nodes; return a function that gives what was warned of so far."""
    received = ros.messages(topics.Topic("/rosout", "rcl_interfaces/msg/Log"), matched=False)

    def said() -> str:
        until_quiet(ros)
        return "\n".join(f"{m.name}: {m.msg}" for m in received if m.level > 20)

    return said


def by_loop(folder: Path, config: RunConfig, *namespaces: str) -> Path:
    """Record a run in the loop, the same for each namespace, into one bag."""
    writer = McapWriter(BagOptions(folder))
    try:
        loop = Loop(config, world_of(config))
        run_metadata = RunMetadata.of_config(config, loop.shared.table, versions())
        recordings = [
            RunWriter(writer, run_metadata, loop.shared.table, namespace=each)
            for each in namespaces or [""]
        ]
        for _ in range(config.cycles * TICKS):
            loop.tick(*recordings)
        for each in recordings:
            each.finish()
        writer.close()
    finally:
        writer.abandon()
    return folder


def told(bag: Path) -> list[Raw]:
    """Return all messages of a bag in order, but those that only bags carry."""
    return [raw for raw in raws_of(bag) if "/run/" not in raw.topic]


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give the bag of a run of a loop."""
    return by_loop(tmp_path_factory.mktemp("walked") / "bag", config())


# -- the recorder beside a robot ---------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("namespace", ["", "deep/robot_2"])
def test_a_recorder_writes_the_bytes_that_the_world_writes(
    ros: Ros, tmp_path: Path, namespace: str
) -> None:
    """Started before the world it hears everything: the same file as the world's own, whole."""
    own, received = tmp_path / "own" / "bag", tmp_path / "heard" / "bag"
    said = warnings(ros)
    recorder = recording(ros, received, namespace)
    robot = robot_of(ros, config(), namespace)
    robot.begin(recorder, bag=str(own))
    robot.run()
    until_recorded(ros, recorder, ALL, namespace)
    assert recorder_of(recorder, namespace).missing == 0
    recorder.finish(ros.spin_once)
    assert list(bytes_of(received)) == ["bag_0.mcap"]
    assert bytes_of(received) == bytes_of(own)
    assert untimed(received) == untimed(own)
    assert "cannot be replayed" not in said()
    with Bag(received) as bag:
        assert bag.namespace == namespace
        done = replay(bag)
    assert done.equal
    assert (done.ticks, done.compared) == (ALL, 4 * ALL)
    assert done.table.sha256() == robot.table


@pytest.mark.slow
def test_a_recorder_records_every_robot_on_the_graph(ros: Ros, tmp_path: Path) -> None:
    """Two robots, one's name the beginning of the other's, one bag: each is replayed by itself."""
    configs = {"robot_1": config(seed=8), "robot_12": config(seed=9, walk__sync_every=4)}
    robots = {name: robot_of(ros, each, name) for name, each in configs.items()}
    recorder = recording(ros, tmp_path / "bag", all_robots=True)
    for name in robots:
        ros.spin_until(
            lambda name=name: ros.node.count_publishers(f"/{name}/{topics.RECORDED.name}"),  # type: ignore[misc]
            f"the recorder listens to {name}",
        )
    for robot in robots.values():
        robot.begin(recorder)
    ros.spin_until(lambda: all(robot.sim.done for robot in robots.values()), "the last ticks")
    for name, robot in robots.items():
        robot.finish()
        until_recorded(ros, recorder, ALL, name)
        assert recorder_of(recorder, name).missing == 0
    recorder.finish(ros.spin_once)
    with pytest.raises(BagError, match=r"has robots in /robot_1, /robot_12: choose one"):
        Bag(tmp_path / "bag")
    for name, robot in robots.items():
        with Bag(tmp_path / "bag", namespace=name) as bag:
            assert bag.run_metadata is not None
            assert bag.run_metadata.legs["rear_left"].seed == configs[name].seed
            done = replay(bag)
        assert (done.difference, done.missing, done.ticks) == (None, None, ALL)
        assert done.table.sha256() == robot.table
        alone = tmp_path / name / "bag"
        by_loop(alone, configs[name])
        with Bag(alone) as bag:
            assert replay(bag).table.sha256() == robot.table


@pytest.mark.slow
def test_a_recorder_that_joins_late_and_leaves_early_says_so_and_holds_nobody(
    ros: Ros, tmp_path: Path
) -> None:
    """The card has the first tick, a replay refuses in words, what is there can be learnt from."""
    said = warnings(ros)
    robot = robot_of(ros, config(10**6))
    robot.begin(patience=2.0)
    robot.spin_to_tick(100)
    joined = robot.tick
    recorder = recording(ros, tmp_path / "bag")
    until_recorded(ros, recorder, 100)
    recorder.finish(ros.spin_once)
    ros.remove(recorder)
    robot.spin_to_tick(robot.tick + 100)
    assert "recorded from tick" in said()
    assert "no longer waits for it" not in said()
    with Bag(tmp_path / "bag") as bag:
        assert bag.run_metadata is not None
        first = bag.run_metadata.first_tick
        assert first >= joined - 1
        assert next(bag.raw()).ns == first * TICK_NS
        ticks = list(bag.ticks())
        assert [tick.tick for tick in ticks] == list(
            range(ticks[0].tick, ticks[0].tick + len(ticks))
        )
        assert bag.table is None
        with pytest.raises(BagError, match=rf"it was recorded from tick {first} on"):
            replay(bag)
    learnt = relearn([tmp_path / "bag"])
    assert learnt.ticks == len(ticks)
    assert learnt.updates > 0


def test_a_table_that_was_asked_for_too_late_is_not_the_one_at_the_start(
    ros: Ros, tmp_path: Path, walked: Path
) -> None:
    """When legs may have learnt into it nobody knows what they began with; a replay says so."""
    said = warnings(ros)
    recorder = recording(ros, tmp_path / "bag")
    voice = Voice(ros, recorder, told(walked))
    voice.say(range(40))
    ros.add(TableNode(context=ros.context))
    until_heard(ros, recorder, 39)
    recorder.finish(ros.spin_once)
    assert "legs had pushed updates" in said()
    with Bag(tmp_path / "bag") as bag:
        assert bag.run_metadata is not None
        assert (bag.run_metadata.first_tick, bag.run_metadata.start_table_sha256, bag.table) == (
            0,
            None,
            None,
        )
        with pytest.raises(BagError, match="table at its start was not requested in time"):
            replay(bag)


@pytest.mark.slow
def test_a_leg_that_dies_costs_its_commands_and_nothing_else(ros: Ros, tmp_path: Path) -> None:
    """The others, all senses and the body are there, tick by tick; the replay is equal."""
    own, received = tmp_path / "own" / "bag", tmp_path / "heard" / "bag"
    recorder = recording(ros, received)
    robot = robot_of(ros, config(10**6, learning=False))
    robot.begin(recorder, bag=str(own), patience=0.5)
    until_recorded(ros, recorder, 40)
    robot.kill("leg_rear_left")
    died = robot.tick
    robot.spin_to_tick(died + 100)
    robot.finish()
    done = robot.tick
    until_quiet(ros)
    recorder.finish(ros.spin_once)
    for folder in (own, received):
        with Bag(folder) as bag:
            ticks = list(bag.ticks())[:done]
            assert [tick.tick for tick in ticks] == list(range(done))
            assert not any(sense is None for tick in ticks for sense in tick.senses)
            answered = {
                leg: [tick.tick for tick in ticks if tick.commands[n] is not None]
                for n, leg in enumerate(LEGS)
            }
            gone = answered.pop("rear_left")
            assert gone == list(range(len(gone)))
            assert len(gone) in (died, died + 1)
            assert all(ticks_of == list(range(done)) for ticks_of in answered.values())
            again = replay(bag)
        assert again.difference is None
        assert again.unanswered["rear_left"] >= done - len(gone)
    assert recorder_of(recorder).missing >= done - len(gone)


def test_nobody_is_there_and_the_bag_is_empty_and_whole(ros: Ros, tmp_path: Path) -> None:
    """A recorder that heard nobody says so, and leaves a bag that every reader opens, empty."""
    for name, every in {"one": False, "all": True}.items():
        recorder = recording(ros, tmp_path / name, all_robots=every)
        until_quiet(ros)
        with pytest.raises(
            BagError, match="no robot was found " + ("anywhere" if every else "in /")
        ):
            recorder.finish(ros.spin_once)
        ros.remove(recorder)
        assert read_metadata(tmp_path / name)["message_count"] == 0
        with pytest.raises(BagError, match="has no robot of ember_ros in it"):
            Bag(tmp_path / name)


def test_a_recorder_must_be_told_where_to(ros: Ros, tmp_path: Path) -> None:
    """No ``bag``, an unknown parameter, a bag that is there already."""
    (tmp_path / "there").mkdir()

    def make(**parameters: Any) -> None:
        RecorderNode(context=ros.context, parameter_overrides=overrides(parameters))

    with pytest.raises(ParameterError, match="give the folder of a new bag"):
        make()
    with pytest.raises(ParameterError, match="no parameter 'bags'"):
        make(bag=str(tmp_path / "bag"), bags="x")
    with pytest.raises(BagError, match="is there already"):
        make(bag=str(tmp_path / "there"))
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


# -- the recorder beside whoever says the same -------------------------------------------------


class Voice:
    """Says what lies in a bag, message by message, and has no parameters of ours."""

    def __init__(self, ros: Ros, recorder: Any, *runs: Sequence[Raw]) -> None:
        """Match a publisher of each topic with the recorder."""
        self._ros = ros
        kinds = {raw.topic: raw.kind for run in runs for raw in run}
        self._raws = runs[0]
        self.publishers = {
            topic: topics.Topic(topic, kind).publish(ros.node) for topic, kind in kinds.items()
        }
        ros.spin_until(lambda: matched(ros.node, recorder), "the recorder listens")
        until_quiet(ros)  # what is said before an executor knows a node is heard topic by topic

    def say(
        self, ticks: Collection[int], raws: Sequence[Raw] = (), *, without: Iterable[Raw] = ()
    ) -> list[Raw]:
        """Publish all messages of some ticks but those left out; return what was said."""
        left_out = {(raw.topic, raw.ns) for raw in without}
        told = [
            raw
            for raw in raws or self._raws
            if raw.ns // TICK_NS in ticks and (raw.topic, raw.ns) not in left_out
        ]
        for raw in told:
            self.publishers[raw.topic].publish(raw.data)
        until_quiet(self._ros, len(told))
        return told


def until_heard(ros: Ros, recorder: Any, tick: int) -> None:
    """Spin until a recorder has begun to record, and has heard of a tick."""

    def received() -> bool:
        robot = recorder_of(recorder)
        return robot.run_writer is not None and robot._window.newest >= tick

    ros.spin_until(received, f"tick {tick} is heard")
    until_quiet(ros)


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a recorder wait for nobody's answer."""
    monkeypatch.setattr("ember_ros.bag.robot_recorder.RESPONSE_S", 0.0)


def named(*messages: tuple[str, int]) -> list[Raw]:
    """Return messages by topic and tick, without content."""
    return [Raw(absolute("", topic), "", tick * TICK_NS, b"") for topic, tick in messages]


EACH = [topics.CLOCK, topics.ODOMETRY, topics.PHASE]
EACH += [
    make(leg) for leg in LEGS for make in (topics.joint_states, topics.contact, topics.command)
]
LOST: dict[str, tuple[list[tuple[str, int]], int]] = {
    "nothing": ([], 0),
    "one of each topic": ([(each.name, 5 + 3 * n) for n, each in enumerate(EACH)], 15),
    "one topic for a while": ([("rear_left/joint_states", n) for n in range(20, 90)], 70),
    "a whole tick": ([(each.name, 30) for each in EACH], 15),
    "a whole second, with two falls in it": (
        [(each.name, n) for each in (*EACH, topics.FALLS) for n in range(20, 84)],
        15 * 64,
    ),
    "the first tick's senses": ([(topics.contact(leg).name, 0) for leg in LEGS], 4),
    "the last tick's commands": ([(topics.command(leg).name, ALL - 1) for leg in LEGS], 4),
    "a fall": ([("falls", 51)], 0),
    "the touch that tells of a fall": ([("front_left/contact", 50)], 1),
}
"""What is lost, and how many messages that is, falls not counted: they carry no tick."""


@pytest.mark.parametrize("what", LOST)
@pytest.mark.slow
def test_what_a_recorder_misses_is_counted_and_the_rest_is_as_it_was_said(
    ros: Ros, tmp_path: Path, walked: Path, at_once: None, what: str
) -> None:
    """Everything that was heard is in the bag, byte by byte and in its order, and nothing else."""
    lost, count = LOST[what]
    recorder = recording(ros, tmp_path / "bag")
    voice = Voice(ros, recorder, told(walked))
    said = voice.say(range(ALL), without=named(*lost))
    until_heard(ros, recorder, ALL - 1)
    recorder.finish(ros.spin_once)
    assert recorder_of(recorder).missing == count
    assert told(tmp_path / "bag") == said


@pytest.mark.parametrize("life", [100, 40, 3])
def test_time_that_begins_anew_ends_the_bag(
    ros: Ros, tmp_path: Path, walked: Path, at_once: None, life: int
) -> None:
    """One run a bag: the recorder is done, and nothing of the second run is in it."""
    other = told(by_loop(tmp_path / "other", config(seed=4)))
    recorder = recording(ros, tmp_path / "bag")
    voice = Voice(ros, recorder, told(walked), other)
    said = voice.say(range(life))
    until_heard(ros, recorder, life - 1)
    assert not recorder.done
    voice.say(range(ALL), other)
    ros.spin_until(lambda: recorder.done, "the recorder is done")
    recorder.finish(ros.spin_once)
    assert told(tmp_path / "bag") == said


@pytest.mark.parametrize("seconds", [-1, 10, 2**30])
@pytest.mark.slow
def test_one_message_of_another_time_ends_no_recording(
    ros: Ros, tmp_path: Path, walked: Path, at_once: None, seconds: int
) -> None:
    """A wrong clock, phase or stamp is left out, and all that follows is written."""
    recorder = recording(ros, tmp_path / "bag")
    voice = Voice(ros, recorder, told(walked))
    said = voice.say(range(60))
    until_heard(ros, recorder, 59)
    ns = 59 * TICK_NS + seconds * 10**9
    voice.publishers["/clock"].publish(cdr.pack_clock(ns))
    for topic in ("/cpg/phase", "/rear_left/command"):
        data = next(raw.data for raw in reversed(said) if raw.topic == topic)
        voice.publishers[topic].publish(cdr.pack_clock(ns) + data[12:])
    said += voice.say(range(60, ALL))
    until_heard(ros, recorder, ALL - 1)
    assert not recorder.done
    recorder.finish(ros.spin_once)
    assert told(tmp_path / "bag") == said


def test_what_is_no_message_is_not_recorded_and_disturbs_nobody(
    ros: Ros, tmp_path: Path, walked: Path, at_once: None
) -> None:
    """Nonsense on a robot's topics carries no tick: it is left out, and all else is written."""
    recorder = recording(ros, tmp_path / "bag")
    voice = Voice(ros, recorder, told(walked))
    said = voice.say(range(60))
    until_heard(ros, recorder, 59)
    for topic in ("/rear_left/joint_states", "/cpg/phase", "/clock", "/rear_left/command"):
        voice.publishers[topic].publish(b"\0\1\0\0short")
    said += voice.say(range(60, ALL))
    until_heard(ros, recorder, ALL - 1)
    recorder.finish(ros.spin_once)
    assert told(tmp_path / "bag") == said


# -- the world that records itself -------------------------------------------------------------


@pytest.mark.slow
def test_the_world_asks_legs_and_table_what_determines_its_run(ros: Ros, tmp_path: Path) -> None:
    """Told nothing but the folder: the card is the plan's, the table the one at the start."""
    table = empty_table(config().params)
    table.values[::7], table.visits[::7] = 0.25, 3
    save_table(tmp_path / "table.npz", table, config().params, 0)
    own = config(
        seed=7, policy="random", table=tmp_path / "table.npz", reward__slip=2.0,
        walk__smooth=0.3, physics__friction=0.9, walker__mass=4.0, trainer__tip_mass=2.0,
        leg__load=20.0, train__gamma=0.7,
    )  # fmt: skip
    save_table(tmp_path / "table.npz", table, own.params, 0)
    graph = Graph(
        own, patience=PATIENCE_S, bag=BagOptions(tmp_path / "bag"), world=world_of(own),
        namespace="robot_1", context=ros.context,
    )  # fmt: skip
    with closing(graph):
        ros.spin_until(lambda: graph.sim.done, "the last tick", graph.spin_once)
        graph.finish()
        learnt = graph.nodes["table_node"].shared.table.sha256()
    with Bag(tmp_path / "bag") as bag:
        assert bag.run_metadata == RunMetadata.of_config(own, table, versions())
        assert bag.table is not None
        assert bag.table.sha256() == table.sha256()
        done = replay(bag)
    assert done.equal
    assert done.table.sha256() == learnt != table.sha256()


class OtherLeg(Node):  # type: ignore[misc]
    """A leg of others' making: it answers every tick, and has no parameter of ours."""

    def __init__(self, leg: str, **kwargs: Any) -> None:
        """Answer what ``leg`` senses with a knee that is held still."""
        super().__init__("driver", **kwargs)
        senses, commands = wire.SenseWire(leg, TICK_NS), wire.CommandWire(leg, TICK_NS)
        publisher = topics.command(leg).publish(self)

        def hear(data: bytes) -> None:
            tick, _ = senses.read_joints(data)
            publisher.publish(commands.pack(LegCommand(tick, 1.0, 0.0, 12.0, 16.0)))

        topics.joint_states(leg).subscribe(self, hear)
        topics.contact(leg).subscribe(self, lambda data: None)


@pytest.mark.parametrize("services", [True, False], ids=["asked", "cannot be asked"])
@pytest.mark.slow
def test_a_leg_of_others_making_is_recorded_and_not_replayed(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, services: bool
) -> None:
    """The bag says why it cannot be replayed, in the log and when it is tried; learning works."""
    monkeypatch.setattr(sim_module, "METADATA_S", 0.5)
    said = warnings(ros)
    robot = robot_of(ros, config(2), without=["leg_rear_left"])
    robot.nodes["other"] = ros.add(
        OtherLeg("rear_left", context=ros.context, start_parameter_services=services)
    )
    robot.begin(bag=str(tmp_path / "bag"), patience=0.5 if not services else PATIENCE_S)
    ros.spin_until(lambda: robot.sim.done, "the last tick")
    robot.sim.finish(ros.spin_once)
    assert "cannot be replayed: rear_left has no parameters of a leg node of this package" in said()
    with Bag(tmp_path / "bag") as bag:
        assert bag.run_metadata is not None
        assert list(bag.run_metadata.legs) == [leg for leg in LEGS if leg != "rear_left"]
        ticks = list(bag.ticks())
        assert len(ticks) == 2 * TICKS
        assert {c.knee_speed for t in ticks if (c := t.commands[2]) is not None} == {0.0}
        with pytest.raises(
            BagError, match=r"it has no metadata of rear_left: not leg nodes of ember_ros"
        ):
            replay(bag)
    assert relearn([tmp_path / "bag"]).ticks == 2 * TICKS


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"seed": 9}, r"its legs had different configurations .*'seed': 9"),
        ({"shared": False}, r"its legs had different configurations .*'shared': False"),
        ({"reward.slip": 3.0}, "it has no metadata of rear_left"),
    ],
    ids=["seed", "shared", "parameter"],
)
def test_legs_that_were_told_different_things_are_not_replayed(
    ros: Ros, tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    """No plan says what these legs did: the replay refuses and says why, the bag is whole."""
    robot = robot_of(ros, config(1), leg_rear_left=changes)
    robot.begin(bag=str(tmp_path / "bag"))
    robot.run()
    with Bag(tmp_path / "bag") as bag:
        assert len(list(bag.ticks())) == TICKS
        with pytest.raises(BagError, match=reason):
            replay(bag)


@pytest.mark.slow
@pytest.mark.parametrize("after", [False, True], ids=["at once", "after a while"])
def test_a_disk_that_is_full_ends_the_run_with_an_error(
    ros: Ros, tmp_path: Path, after: bool
) -> None:
    """The world does not walk on unrecorded: a BagError; what was flushed is brought back."""
    folder = tmp_path / "bag"
    long = config(10**6)
    graph = Graph(
        long, patience=PATIENCE_S, bag=BagOptions(folder), world=world_of(long), context=ros.context
    )
    with closing(graph):
        if after:
            ros.spin_until(lambda: size_of(folder) > 60_000, "some chunks", graph.spin_once)
        most = size_of(folder) + 1000
        writes = graph.sim._bag._writer._process.pid
        resource.prlimit(writes, resource.RLIMIT_FSIZE, (most, most))
        ros.spin_until(lambda: graph.sim.done, "the disk is full", graph.spin_once)
        with pytest.raises(BagError, match=r"cannot write the bag .*File too large"):
            graph.finish()
    with pytest.raises(BagError, match="recording was cut off"):
        Bag(folder)
    if after:
        repair(folder)
        with Bag(folder) as bag:
            done = replay(bag)
        assert (done.difference, done.missing, done.ticks % 16) == (None, None, 0)
        assert done.ticks > 0


@pytest.mark.slow
def test_a_writer_that_is_killed_ends_the_run_with_an_error(ros: Ros, tmp_path: Path) -> None:
    """Whatever became of who writes, the run ends with a BagError that says what to do."""
    long = config(10**6)
    graph = Graph(
        long,
        patience=PATIENCE_S,
        bag=BagOptions(tmp_path / "bag"),
        world=world_of(long),
        context=ros.context,
    )
    with closing(graph):
        ros.spin_until(lambda: size_of(tmp_path / "bag") > 60_000, "some chunks", graph.spin_once)
        graph.sim._bag._writer._process.send_signal(signal.SIGKILL)
        ros.spin_until(lambda: graph.sim.done, "the writer is gone", graph.spin_once)
        with pytest.raises(BagError, match="ember bag repair"):
            graph.finish()
    repair(tmp_path / "bag")
    with Bag(tmp_path / "bag") as bag:
        assert replay(bag).difference is None


# -- playing -----------------------------------------------------------------------------------


class Clock:
    """A wall clock that goes on by one step whenever it is looked at."""

    def __init__(self, step_s: float) -> None:
        """Begin at 0."""
        self.step, self.looks = step_s, 0

    def monotonic(self) -> float:
        """Return the time, s."""
        self.looks += 1
        return self.looks * self.step


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Let players live by a clock on which a tick of a bag is two looks at a rate of 10."""
    clock = Clock(TICK_NS * 1e-9 / 20)
    monkeypatch.setattr(player_node, "time", clock)
    return clock


class Playing:
    """A player, and somebody who hears all that it says; paused at first."""

    def __init__(
        self, ros: Ros, folder: Path, namespace: str | None = None, **options: Any
    ) -> None:
        """Open a bag and match everybody with the player of it."""
        self._ros = ros
        self.bag = Bag(folder, namespace=namespace)
        self.raws = list(self.bag.raw())
        options = {"rate": 10.0, "paused": True} | options
        self.node: Any = ros.add(PlayerNode(self.bag, context=ros.context, **options))
        self.received = {
            each.topic_name: ros.messages(topics.Topic(each.topic_name, kind), raw=True)
            for each in self.node.publishers
            if (kind := self._kinds.get(each.topic_name))
        }

    @property
    def _kinds(self) -> dict[str, str]:
        kinds = {topic: str(each.msgtype) for topic, each in self.bag.connections.items()}
        return {"/clock": topics.CLOCK.kind} | kinds

    def pause(self, paused: bool) -> str:
        """Call the service."""
        name = absolute(self.bag.namespace, player_node.PAUSE.name)
        client = self._ros.client(topics.Service(name, player_node.PAUSE.kind))
        answer = self._ros.call(client, SetBool.Request(data=paused))
        self._ros.node.destroy_client(client)
        assert answer.success
        return str(answer.message)

    def play(self) -> None:
        """Play to the end, and hear all of it."""
        self.node.paused = False
        self._ros.spin_until(lambda: self.node.done, "the end of the bag")
        until_quiet(self._ros)
        self._ros.spin_until(
            lambda: sum(map(len, self.received.values())) >= self.node.played, "all is heard"
        )

    def of_bag(self, from_ns: int = 0, without: Collection[str] = ()) -> dict[str, list[bytes]]:
        """Return what of the bag should be heard."""
        return {
            topic: [r.data for r in self.raws if r.topic == topic and r.ns >= from_ns]
            for topic in self.received
            if topic not in without
        }


@pytest.mark.parametrize(("rate", "ticks"), [(0.25, 8.0), (10.0, 0.5), (1000.0, 64.0)])
def test_every_message_is_heard_as_it_was_recorded(
    ros: Ros, walked: Path, clock: Clock, rate: float, ticks: float
) -> None:
    """All topics of the bag, ``/clock`` among them: byte by byte, in order, at any rate.

    It is the same whether a turn plays half a tick or, after it was held up, 64 of them.
    """
    clock.step = ticks * TICK_NS * 1e-9 / rate
    playing = Playing(ros, walked, rate=rate)
    playing.play()
    assert set(playing.received) == set(playing.bag.connections)
    assert playing.received == playing.of_bag()
    assert playing.node.played == len(playing.raws)
    assert len(playing.received["/clock"]) == ALL
    playing.bag.close()


def test_a_robot_in_a_namespace_is_played_alone_and_sets_the_clock_too(
    ros: Ros, tmp_path: Path, clock: Clock
) -> None:
    """Of two robots in a bag one is heard, also if the other's name begins like its own."""
    folder = by_loop(tmp_path / "bag", config(1), "robot_1", "robot_12", "robot_1/trailer")
    playing = Playing(ros, folder, "robot_1")
    playing.play()
    own = {topic for topic in playing.bag.connections if topic.startswith("/robot_1/")}
    own = {topic for topic in own if not topic.startswith("/robot_1/trailer/")}
    assert set(playing.received) == own | {"/clock"}
    expected = playing.of_bag(without=["/clock"])
    assert playing.received == expected | {"/clock": expected["/robot_1/clock"]}
    playing.bag.close()


def test_a_robot_without_a_namespace_is_played_alone(
    ros: Ros, tmp_path: Path, clock: Clock
) -> None:
    """What is in the bag of a robot in a namespace is not heard of the one that has none."""
    folder = by_loop(tmp_path / "bag", config(1), "", "robot_1")
    playing = Playing(ros, folder, "")
    playing.play()
    assert not [topic for topic in playing.received if topic.startswith("/robot_1/")]
    assert playing.received == playing.of_bag()
    playing.bag.close()


def test_a_pause_stops_it_and_it_goes_on_where_it_was(ros: Ros, walked: Path, clock: Clock) -> None:
    """By the service: nothing is said while it is paused, nothing is left out or said twice."""
    playing = Playing(ros, walked)
    assert playing.pause(False).startswith("playing at 0.000 s")
    for part in (1, 2):
        ros.spin_until(
            lambda part=part: playing.node.played > part * len(playing.raws) // 4,  # type: ignore[misc]
            "some is played",
        )
        told = playing.pause(True)
        stopped, seconds = playing.node.played, playing.node.seconds
        assert told == f"paused at {seconds:.3f} s"
        assert not playing.node.done
        looks = clock.looks
        ros.spin_until(lambda looks=looks: clock.looks > looks + 50, "time goes on")  # type: ignore[misc]
        assert (playing.node.played, playing.node.seconds) == (stopped, seconds)
        playing.pause(False)
    playing.play()
    assert playing.received == playing.of_bag()
    playing.bag.close()


@pytest.mark.parametrize("start_s", [1.0, 1.0078125])
def test_what_lies_before_the_start_is_left_out(
    ros: Ros, walked: Path, clock: Clock, start_s: float
) -> None:
    """From a tick on, or from between two: everything from there on is heard, and no more."""
    playing = Playing(ros, walked, start_s=start_s)
    assert playing.node.seconds == start_s
    playing.play()
    assert playing.received == playing.of_bag(round(start_s * 1e9))
    assert playing.received["/run/card"] == []
    playing.bag.close()


def live_leg(ros: Ros, own: RunConfig, leg: str) -> Any:
    """Return a leg that shares no table."""
    numbers = {
        f"{group}.{field}": value
        for group, fields in as_dict(own.params).items()
        for field, value in fields.items()
    }
    options = {"leg": leg, "policy": own.policy, "learning": own.learning, "shared": False}
    return LegNode(context=ros.context, parameter_overrides=overrides(numbers | options))


@pytest.mark.parametrize("with_observer", [False, True], ids=["alone", "with an onlooker"])
def test_a_live_leg_is_waited_for_and_answers_every_tick(
    ros: Ros, tmp_path: Path, clock: Clock, with_observer: bool
) -> None:
    """Its recorded commands are left out; it begins when the leg is there, whoever else listens.

    The leg is written by hand, so what it does live is what was recorded.
    """
    own = config(2, policy="scripted", learning=False)
    folder = by_loop(tmp_path / "bag", own)
    options: dict[str, Any] = {"rate": 10.0, "live": ["front_left"]}
    playing = Playing(ros, folder, paused=False, **options) if with_observer else None
    bag = playing.bag if playing else Bag(folder)
    player = playing.node if playing else ros.add(PlayerNode(bag, context=ros.context, **options))
    looks = clock.looks
    ros.spin_until(lambda: clock.looks > looks + 50, "time goes on")
    assert player.played == 0
    assert player.seconds == 0.0
    leg = ros.add(live_leg(ros, own, "front_left"))
    answers = ros.messages(topics.command("front_left"), raw=True)
    ros.spin_until(lambda: player.done, "the end of the bag")
    recorded = [raw.data for raw in bag.raw() if raw.topic == "/front_left/command"]
    ros.spin_until(lambda: len(answers) == len(recorded), "all answers are heard")
    assert answers == recorded
    assert leg.refused == 0
    if playing:
        assert not {"/front_left/command", "/front_left/transition"} & playing.received.keys()
        assert playing.received == playing.of_bag()
    bag.close()


def test_a_player_refuses_what_it_cannot_play(ros: Ros, walked: Path) -> None:
    """A leg that is none of the bag's, or a start behind its end: a BagError says what there is."""
    with Bag(walked) as bag:
        with pytest.raises(BagError, match=r"no leg 'leg'; it has front_left, front_right"):
            PlayerNode(bag, context=ros.context, live=["front_left", "leg"])
        with pytest.raises(BagError, match=r"ends before 100\.0 s"):
            PlayerNode(bag, context=ros.context, start_s=100.0)


# -- asking ------------------------------------------------------------------------------------

PLANS = {
    "walker": config(0),
    "walker, other numbers": config(
        0, seed=11, policy="random", learning=False, walk__gamma=0.5, reward__slip=2.5,
        walker__mass=4.0, physics__friction=0.8, leg__load=20.0,
        robot__offset=(0.0, 0.5, 0.25, 0.0), parts__cpg="support.oscillators.ContactDrivenCpg",
    ),
    "trainer": RunConfig("trainer", 0, seed=2, params=replace(Params(), {"trainer.tip_mass": 2.0})),
}  # fmt: skip


@pytest.mark.parametrize("namespace", ["", "a/b"])
@pytest.mark.parametrize("name", PLANS)
def test_what_nodes_say_is_what_their_plan_was(ros: Ros, name: str, namespace: str) -> None:
    """Asked from outside, a graph gives the card of its plan and the table that it starts from."""
    own = PLANS[name]
    with closing(
        Graph(own, patience=PATIENCE_S, namespace=namespace, context=ros.context)
    ) as graph:
        client = MetadataClient(ros.node, namespace)
        assert client.world is None
        ros.spin_until(lambda: not client.poll(), "all have answered", graph.spin_once)
        assert client.world == own.world
        run_metadata, table, wrong = client.run_metadata(own.world, 0)
        empty = empty_table(own.params)
        assert run_metadata == RunMetadata.of_config(own, empty, versions())
        assert wrong == []
        assert run_metadata.params.parts.cpg == own.params.parts.cpg
        assert table is not None
        assert table.sha256() == empty.sha256()
        # Of a later tick on the same nodes: what the table was at the start is not known.
        run_metadata, table, wrong = client.run_metadata(own.world, 7)
        assert (run_metadata.first_tick, run_metadata.start_table_sha256, table) == (7, None, None)
        assert "recorded from tick 7 on" in " ".join(wrong)


def test_nobody_who_answers_is_said_with_names(ros: Ros) -> None:
    """Where no robot is, who was waited for is named, and the card claims nothing."""
    client = MetadataClient(ros.node, "")
    for _ in range(20):
        ros.spin_once(0.001)
        assert client.poll() == ["clock", "cpg/phase", "table/pull"]
    run_metadata, table, wrong = client.run_metadata("walker", 0)
    assert (dict(run_metadata.legs), run_metadata.start_table_sha256, table) == ({}, None, None)
    for leg in LEGS:
        assert any(why.startswith(f"{leg} has no parameters") for why in wrong)
    assert "no node serves table/pull" in wrong


def test_a_recorder_that_heard_nobody_ends_with_an_error(
    ros: Ros, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says meanwhile that nothing is recorded, and in the end where it listened in vain."""
    monkeypatch.setattr("ember_ros.bag.recorder_node.LOG_S", 0.0)
    said: list[str] = []

    def reason() -> bool:
        said.append(capfd.readouterr().err)
        return "/robot: nothing is recorded, no robot publishes here yet" in "".join(said)

    recorder = recording(ros, tmp_path / "bag", "/robot")
    ros.spin_until(reason, "that it records nothing")
    with pytest.raises(BagError, match=r"no robot was found in /robot: the bag .*bag is empty"):
        recorder.finish(ros.spin_once)
