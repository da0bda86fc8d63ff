"""All nodes of a robot in one process: the bits of the loop, whatever strangers say or who dies."""

from __future__ import annotations

import dataclasses
import itertools
import re
import struct
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import SetBool

from ember_ros import cdr, topics, wire
from ember_ros.errors import EmberError
from ember_ros.graph import Graph
from ember_ros.params import Params, cells_sha256
from ember_ros.params_file import load_params
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, LegCommand, LegSense, TDUpdate
from leg_node import calls
from leg_node.assembly import empty_table
from leg_node.node import UPDATES_LOST
from leg_node.shared import LocalCopy, SharedTable, UpdateBatch
from leg_node.table_file import save_table
from support.configs import changed
from support.legs import LEGS
from support.robot import LEG_NODES, PATIENCE_S, Robot, level, run_to_end
from support.ros import Ros
from support.runs import Bits
from support.waiting import in_time

CYCLES = 20
TICKS = 32
TICK_NS = Params().gait.tick_ns


def walk(seed: int = 3, sync_every: int = 32, **options: Any) -> RunConfig:
    """Return a plan of a walker that learns."""
    return RunConfig(
        "walker",
        CYCLES,
        seed=seed,
        params=changed(Params(), walk__sync_every=sync_every),
        **options,
    )


PLANS = {
    "walker": walk(),
    "walker, one table for all": walk(sync_every=1),
    "walker, the end within an epoch": walk(sync_every=48, seed=4),
    "walker, frozen": walk(learning=False),
    "walker, scripted": walk(policy="scripted"),
    "walker, random": walk(policy="random"),
    "trainer": RunConfig("trainer", 2 * CYCLES, seed=5),
    "trainer, 16 ticks": RunConfig("trainer", 8, seed=6, params=changed(Params(), gait__ticks=16)),
}


def refusals(nodes: dict[str, Any]) -> dict[str, int]:
    """Return what each node that counts refused."""
    return {name: node.refused for name, node in nodes.items() if name != "cpg_node"}


# -- the same bits -----------------------------------------------------------------------------


SLOW = {
    "walker, one table for all",
    "walker, the end within an epoch",
    "walker, scripted",
    "walker, random",
}


@pytest.mark.parametrize(
    "changes",
    [
        {"parts__cpg": "support.oscillators.ContactDrivenCpg"},
        {f"robot__{n}": v for n, v in vars(load_params("hexapod").robot).items()},
    ],
    ids=["an oscillator that hears the legs", "six legs"],
)
def test_a_robot_of_other_parts_ends_with_the_bits_of_the_loop(
    ros: Ros,
    by_loop: Callable[[RunConfig], Bits],
    by_graph: Callable[[Any], Bits],
    changes: dict[str, Any],
) -> None:
    """Which legs there are and what the phase hangs on is data: loop and graph still agree."""
    config = RunConfig("walker", 4, seed=3, params=changed(Params(), **changes))
    with closing(Graph(config, patience=PATIENCE_S, context=ros.context)) as graph:
        run_to_end(graph)
        assert by_graph(graph) == by_loop(config) != by_loop(dataclasses.replace(config, seed=4))
        assert by_loop(config) != by_loop(RunConfig("walker", 4, seed=3))
        assert not any(refusals(graph.nodes).values())


SLOW = {"walker, one table for all", "walker, the end within an epoch", "walker, scripted"}


@pytest.mark.parametrize(
    "config",
    [pytest.param(PLANS[n], id=n, marks=[pytest.mark.slow] * (n in SLOW)) for n in PLANS],
)
def test_the_graph_ends_with_the_bits_of_the_loop(
    ros: Ros,
    by_loop: Callable[[RunConfig], Bits],
    by_graph: Callable[[Any], Bits],
    config: RunConfig,
) -> None:
    """Table, senses and commands are equal, bit for bit, and nothing healthy is refused."""
    with closing(Graph(config, patience=PATIENCE_S, context=ros.context)) as graph:
        run_to_end(graph)
        assert by_graph(graph) == by_loop(config)
        assert not any(refusals(graph.nodes).values())
        assert len(graph.sim.recorder.body_rows()) == config.cycles


@pytest.mark.slow
def test_a_graph_runs_twice_the_same_way_and_from_a_table(
    ros: Ros,
    tmp_path: Path,
    by_loop: Callable[[RunConfig], Bits],
    by_graph: Callable[[Any], Bits],
) -> None:
    """Two graphs, one after the other, end alike, also when they begin with what was learnt."""
    file = tmp_path / "table.npz"
    with closing(Graph(PLANS["walker"], patience=PATIENCE_S, context=ros.context)) as first:
        save_table(file, run_to_end(first).nodes["table_node"].shared.table, Params(), 3)
    config = walk(table=file)
    ends = []
    for _ in range(2):
        with closing(Graph(config, patience=PATIENCE_S, context=ros.context)) as graph:
            ends.append(by_graph(run_to_end(graph)))
    assert ends[0] == ends[1] == by_loop(config)
    assert ends[0] != by_loop(PLANS["walker"])


@pytest.mark.slow
def test_two_robots_in_two_namespaces_do_not_feel_each_other(
    ros: Ros, by_loop: Callable[[RunConfig], Bits], by_graph: Callable[[Any], Bits]
) -> None:
    """In one domain, at once, tick by tick in turn, each ends with the bits of its own loop."""
    configs = {"robot_1": walk(seed=8), "deep/robot_2": walk(seed=9, sync_every=4)}
    with ExitStack() as stack:
        graphs = {
            name: stack.enter_context(
                closing(Graph(config, patience=PATIENCE_S, context=ros.context, namespace=name))
            )
            for name, config in configs.items()
        }
        go_on = in_time()
        while not all(graph.sim.done for graph in graphs.values()):
            go_on()
            for graph in graphs.values():
                graph.spin_once(0.0)
        for name, graph in graphs.items():
            graph.finish()
            assert by_graph(graph) == by_loop(configs[name])
            assert not any(refusals(graph.nodes).values())


@pytest.mark.slow
def test_who_looks_on_changes_nothing(
    ros: Ros, by_loop: Callable[[RunConfig], Bits], by_graph: Callable[[Any], Bits]
) -> None:
    """With every topic heard, odometry included, the bits are the same, and all topics speak."""
    with closing(Graph(walk(), patience=PATIENCE_S, context=ros.context)) as graph:
        received = {
            topic.name: ros.messages(topic)
            for topic in (
                topics.CLOCK,
                topics.PHASE,
                topics.FALLS,
                topics.ODOMETRY,
                topics.DIAGNOSTICS,
                *(kind(leg) for leg in LEGS
                  for kind in (topics.joint_states, topics.contact, topics.command)),
            )
        }  # fmt: skip
        ros.spin_until(lambda: graph.sim.done, "the last tick", graph.spin_once)
        graph.finish()
        assert by_graph(graph) == by_loop(walk())
        ros.spin_until(
            lambda: len(received["rear_right/command"]) == CYCLES * TICKS, "all is heard"
        )
        clock = [message.clock for message in received["clock"]]
        assert [c.sec * 10**9 + c.nanosec for c in clock] == [
            n * TICK_NS for n in range(CYCLES * TICKS)
        ]
        assert [message.position.tolist() for message in received["cpg/phase"]] == [
            [n / TICKS] for n in range(CYCLES * TICKS)
        ]
        assert received["odometry"]
        assert {m.header.frame_id for m in received["odometry"]} == {"odom"}
        for message in received["diagnostics"]:
            assert [s.name for s in message.status] == ["sim_node", *LEGS]
            assert {s.level for s in message.status} == {DiagnosticStatus.OK}


# -- what is wrong from the start --------------------------------------------------------------


def test_a_graph_that_cannot_be_made_leaves_nothing(ros: Ros, tmp_path: Path) -> None:
    """A missing table raises an EmberError; the fixture sees that no node is left."""
    with pytest.raises(EmberError, match="there is no table"):
        Graph(walk(table=tmp_path / "none.npz"), context=ros.context)


def test_a_graph_that_is_stopped_early_keeps_what_was_learnt(ros: Ros) -> None:
    """Stopped in the middle of an epoch, every update that a leg made is in the table."""
    with closing(Graph(walk(), patience=PATIENCE_S, context=ros.context)) as graph:
        graph.run(lambda: graph.sim.world.observe()[0].tick < 100)
        table = graph.nodes["table_node"].shared.table
        acted, falls = graph.sim.world.observe()[0].tick, graph.sim.world.body().falls
        assert acted < CYCLES * TICKS
        # A leg learns of every tick but the first; of the present one if it was its turn already.
        assert 4 * (acted - 1 - falls) <= table.visits.sum() <= 4 * (acted - falls)
        legs = [graph.nodes[name].module.copy for name in LEG_NODES]
        assert not any(copy.oldest_unacknowledged() for copy in legs)


# -- falls -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_fall_is_counted_told_and_credited_to_nobody(
    ros: Ros, by_loop: Callable[[RunConfig], Bits], by_graph: Callable[[Any], Bits]
) -> None:
    """Each fall is said on ``falls`` and sets all restart bits for a tick; then no leg learns."""
    config = RunConfig(
        "walker",
        CYCLES,
        seed=1,
        policy="random",
        params=changed(Params(), walker__hip_half_width=0.1),
    )
    assert by_loop(config).falls >= 3
    with closing(Graph(config, patience=PATIENCE_S, context=ros.context)) as graph:
        falls = ros.messages(topics.FALLS)
        contacts = {leg: ros.messages(topics.contact(leg)) for leg in LEGS}
        run_to_end(graph)
        assert by_graph(graph) == by_loop(config)
        happened = by_loop(config).falls
        ros.spin_until(
            lambda: all(len(received) == CYCLES * TICKS for received in contacts.values()),
            "all is heard",
        )
        ros.spin_until(lambda: len(falls) > happened, "all falls are heard")
        assert [message.data for message in falls] == list(range(happened + 1))
        column = wire.CONTACT.index("restart")
        restarts = {
            leg: [n for n, message in enumerate(received) if message.position[column]]
            for leg, received in contacts.items()
        }
        assert len(restarts["front_left"]) == happened
        assert restarts == dict.fromkeys(LEGS, restarts["front_left"])
        # Every tick is credited to the one before, but the first tick and those after a fall.
        visits = graph.nodes["table_node"].shared.table.visits.sum()
        assert visits == 4 * (CYCLES * TICKS - 1 - happened)


# -- strangers ---------------------------------------------------------------------------------


class Stranger:
    """Publishes on a robot's own topics beside its nodes, and knows what time it is."""

    def __init__(self, ros: Ros, graph: Graph) -> None:
        """Match a publisher with every topic that a node of the robot hears."""
        self.graph = graph
        kinds = (topics.joint_states, topics.contact, topics.command)
        every = [topics.PHASE, *(kind(leg) for leg in LEGS for kind in kinds)]
        self._publishers = {topic.name: ros.publisher(topic) for topic in every}
        self.senses = wire.SenseWire("rear_left", TICK_NS)
        self.commands = wire.CommandWire("rear_left", TICK_NS)
        self.turn = 0

    @property
    def tick(self) -> int:
        """Return the present tick of the world."""
        senses: tuple[LegSense, ...] = self.graph.sim.world.observe()
        return senses[0].tick

    def say(self, name: str, data: bytes) -> None:
        """Publish bytes."""
        self._publishers[name].publish(data)

    def joints(self, tick: int, **changes: Any) -> bytes:
        """Return ``joint_states`` of a tick."""
        return self.senses.pack(self._sense(tick)._replace(**changes))[0]

    def contact(self, tick: int, **changes: Any) -> bytes:
        """Return a ``contact`` of a tick."""
        return self.senses.pack(self._sense(tick)._replace(**changes))[1]

    def command(self, tick: int, **changes: Any) -> bytes:
        """Return a ``command`` of a tick."""
        return self.commands.pack(LegCommand(tick, 5.0, -5.0, 1.0, 1.0)._replace(**changes))

    @staticmethod
    def beat(tick: int, *, tick_ns: int = TICK_NS, **changes: Any) -> bytes:
        """Return a ``cpg/phase`` of a tick."""
        return wire.BeatWire(tick_ns).pack(Beat(tick, tick / TICKS)._replace(**changes))

    @staticmethod
    def _sense(tick: int) -> LegSense:
        return LegSense(tick, 0.3, 0.3, 1.0, 1.0, 9.0, 9.0, 0.1, 0.001, False, True, False)


LEG, SIM = ("leg_rear_left",), ("sim_node",)
JOINTS, CONTACT, COMMAND = (
    kind("rear_left").name for kind in (topics.joint_states, topics.contact, topics.command)
)
PHASE = topics.PHASE.name
HEARERS_OF_PHASE = (*LEG_NODES, *SIM)
NAN = float("nan")
BARE_PHASE = cdr.ENCAPSULATION + struct.pack("<d", 0.5)
"""What a CPG of before the stamp says."""
SAYS: dict[str, tuple[tuple[str, ...], str, Callable[[Stranger], bytes]]] = {
    "joints not finite": (LEG, JOINTS, lambda s: s.joints(s.tick, knee=NAN)),
    "joints of another leg's names": (LEG, JOINTS, lambda s: s.contact(s.tick)),
    "joints that are no message": (LEG, JOINTS, lambda s: b"\0\1\0\0nonsense"),
    "joints between ticks": (
        LEG, JOINTS, lambda s: wire.SenseWire("rear_left", TICK_NS - 1).pack(s._sense(7))[0]
    ),
    "joints of the past": (LEG, JOINTS, lambda s: s.joints(s.tick - 2)),
    "contact not finite": (LEG, CONTACT, lambda s: s.contact(s.tick, slip=float("inf"))),
    "contact with a bit of 2": (LEG, CONTACT, lambda s: s.contact(s.tick, hair=2)),
    "contact cut short": (LEG, CONTACT, lambda s: s.contact(s.tick)[:-9]),
    "contact of the past": (LEG, CONTACT, lambda s: s.contact(s.tick - 2)),
    "command not finite": (SIM, COMMAND, lambda s: s.command(s.tick, knee_speed=NAN)),
    "command of negative torque": (SIM, COMMAND, lambda s: s.command(s.tick, hip_torque=-1.0)),
    "command that is no message": (SIM, COMMAND, lambda s: b""),
    "command of the past": (SIM, COMMAND, lambda s: s.command(s.tick - 1)),
    "command of the future": (SIM, COMMAND, lambda s: s.command(s.tick + 1000)),
    "phase not finite": (HEARERS_OF_PHASE, PHASE, lambda s: s.beat(s.tick, phase=NAN)),
    "phase under 0": (HEARERS_OF_PHASE, PHASE, lambda s: s.beat(s.tick, phase=-1.0)),
    "phase without a stamp": (HEARERS_OF_PHASE, PHASE, lambda s: BARE_PHASE),
    "phase of another oscillator": (HEARERS_OF_PHASE, PHASE, lambda s: s.joints(s.tick)),
    "phase between ticks": (HEARERS_OF_PHASE, PHASE, lambda s: s.beat(7, tick_ns=TICK_NS - 1)),
    "phase of the past": (HEARERS_OF_PHASE, PHASE, lambda s: s.beat(s.tick - 2)),
    "phase of the future": (SIM, PHASE, lambda s: s.beat(s.tick + 1000)),
}  # fmt: skip


BRIEF = dataclasses.replace(walk(), cycles=8)
"""With a fall in it, and with pushes; short, as it is run for every stranger."""


def disturbed(
    ros: Ros, by_graph: Callable[[Any], Bits], say: Callable[[Stranger], bool]
) -> tuple[Bits, int, dict[str, int]]:
    """Run a graph in which a stranger says something now and then, if it likes.

    Return the bits, how often the stranger spoke, and what each node refused.
    """
    with closing(Graph(BRIEF, patience=PATIENCE_S, context=ros.context)) as graph:
        stranger = Stranger(ros, graph)
        go_on = in_time()
        events = 0
        while not graph.sim.done:
            go_on()
            graph.spin_once(0.001)
            events += 1
            early, late = 3, BRIEF.cycles * TICKS - 4
            if events % 23 == 0 and early < stranger.tick < late and say(stranger):
                stranger.turn += 1
        graph.finish()
        return by_graph(graph), stranger.turn, refusals(graph.nodes)


@pytest.mark.parametrize("what", SAYS)
@pytest.mark.slow
def test_what_a_stranger_says_is_refused_and_counted_and_changes_no_bit(
    ros: Ros, by_loop: Callable[[RunConfig], Bits], by_graph: Callable[[Any], Bits], what: str
) -> None:
    """Malformed, of the past or of the future: each message is counted by who hears it."""
    hearers, topic, make = SAYS[what]

    def say(stranger: Stranger) -> bool:
        nodes = stranger.graph.nodes
        if any(nodes[name].refused < stranger.turn for name in hearers):
            return False  # the one before is still on its way
        stranger.say(topic, make(stranger))
        return True

    ends, said, counted = disturbed(ros, by_graph, say)
    assert said > 20
    assert ends == by_loop(BRIEF)
    assert counted == {name: said * (name in hearers) for name in counted}


@pytest.mark.parametrize("source", ["joints", "contact", "phase"])
@pytest.mark.parametrize("ahead", [1, 5])
def test_what_a_leg_hears_of_the_future_is_never_used(
    ros: Ros,
    by_loop: Callable[[RunConfig], Bits],
    by_graph: Callable[[Any], Bits],
    source: str,
    ahead: int,
) -> None:
    """A flood of senses or phases of ticks to come, the next one too, changes no bit."""

    def say(stranger: Stranger) -> bool:
        tick = stranger.tick + ahead + stranger.turn % 50 * (ahead > 1)
        if source == "phase":
            stranger.say(PHASE, stranger.beat(tick))
        elif source == "joints":
            stranger.say(JOINTS, stranger.joints(tick))
        else:
            stranger.say(CONTACT, stranger.contact(tick))
        return True

    ends, said, _ = disturbed(ros, by_graph, say)
    assert said > 100
    assert ends == by_loop(BRIEF)


def test_old_messages_that_agree_by_chance_do_not_begin_time_anew(
    ros: Ros, by_loop: Callable[[RunConfig], Bits], by_graph: Callable[[Any], Bits]
) -> None:
    """Joints, contact and phase of tick 3, told ticks apart while time goes on, are just old."""

    def say(stranger: Stranger) -> bool:
        which = stranger.turn % 3
        if stranger.tick < 10 * (stranger.turn + 1):
            return False
        stranger.say(
            (JOINTS, CONTACT, PHASE)[which],
            (stranger.joints(3), stranger.contact(3), stranger.beat(3))[which],
        )
        return True

    ends, said, _ = disturbed(ros, by_graph, say)
    assert said > 20
    assert ends == by_loop(BRIEF)


def test_a_malformed_push_during_a_run_changes_no_bit(
    ros: Ros, by_loop: Callable[[RunConfig], Bits], by_graph: Callable[[Any], Bits]
) -> None:
    """A stranger's push of nonsense is refused with a reason; the run ends as without it."""
    good = UpdateBatch(0, "stranger", 3, cells_sha256(Params()), (TDUpdate(3, 7, 1.0),))
    bad = (good._replace(cells_sha256="?"), good._replace(updates=(TDUpdate(3, -7, 1.0),)))
    with closing(Graph(BRIEF, patience=PATIENCE_S, context=ros.context)) as graph:
        push = ros.client(topics.PUSH)
        for n in range(4):
            go_on = in_time()
            while graph.sim.tick < 50 * n:
                go_on()
                graph.spin_once(0.01)
            result = ros.call(push, calls.write_push(bad[n % 2]), graph.spin_once).result
            assert not result.successful
            assert result.reason
        assert by_graph(run_to_end(graph)) == by_loop(BRIEF)
        counted = refusals(graph.nodes)
        assert counted == {**dict.fromkeys(counted, 0), "table_node": 4}


# -- who dies and who comes back ---------------------------------------------------------------


def test_a_leg_that_dies_is_absent_and_one_that_comes_back_is_present(ros: Ros) -> None:
    """The others walk on without it, its joints held still; a new one is waited for again."""
    robot = Robot(ros, walk(), sim_node={"patience": 0.2, "cycles": 1000})
    diagnostics = ros.messages(topics.DIAGNOSTICS)
    robot.spin_to_tick(40)
    assert level(diagnostics[-1], "rear_left") == (DiagnosticStatus.OK, "present")
    robot.kill("leg_rear_left")
    died = robot.tick
    robot.spin_to_tick(died + 64)
    assert level(diagnostics[-1], "rear_left") == (DiagnosticStatus.ERROR, "absent")
    assert level(diagnostics[-1], "rear_right") == (DiagnosticStatus.OK, "present")
    absent = robot.sim.recorder.summary()["absent_ticks"]
    assert absent["rear_left"] >= 63
    assert [absent[leg] for leg in LEGS if leg != "rear_left"] == [0, 0, 0]
    robot.start("leg_rear_left")
    ros.spin_until(
        lambda: level(diagnostics[-1], "rear_left") == (DiagnosticStatus.OK, "present"),
        "rear_left is back",
    )
    missed = robot.sim.recorder.summary()["absent_ticks"]["rear_left"]
    back = robot.tick
    robot.spin_to_tick(back + 100)
    assert robot.sim.recorder.summary()["absent_ticks"]["rear_left"] <= missed + 1


@pytest.mark.slow
def test_a_cpg_that_dies_stops_the_world_and_a_new_one_takes_it_on(
    ros: Ros, by_loop: Callable[[RunConfig], Bits]
) -> None:
    """The world stands still and says so; the new CPG reads the phase off the clock, to the bit."""
    robot = Robot(ros, walk(), sim_node={"patience": 0.2})
    diagnostics = ros.messages(topics.DIAGNOSTICS)
    robot.spin_to_tick(40)
    robot.kill("cpg_node")
    ros.spin_until(
        lambda: level(diagnostics[-1], "sim_node") == (DiagnosticStatus.WARN, "no phase"),
        "diagnostics say that there is no phase",
    )
    stopped = robot.tick
    count = len(diagnostics)
    ros.spin_until(lambda: len(diagnostics) > count + 2, "diagnostics go on")
    assert robot.tick == stopped
    robot.start("cpg_node")
    assert robot.run() == by_loop(walk())
    assert not any(refusals(robot.nodes).values())


@pytest.mark.slow
def test_a_table_node_can_be_changed_for_another_that_has_its_file(
    ros: Ros, tmp_path: Path, by_loop: Callable[[RunConfig], Bits]
) -> None:
    """Stopped and started again between two epochs, with what it saved, it is the same table."""
    file = str(tmp_path / "table.npz")
    robot = Robot(ros, walk(), table_node={"save": file})
    for tick in (3 * 32 + 10, 9 * 32 + 10):
        robot.spin_to_tick(tick)
        robot.nodes["table_node"].finish(ros.spin_once)
        robot.kill("table_node")
        robot.start("table_node", table=file, save=file)
        ros.client(topics.PULL)
        ros.client(topics.PUSH)
    assert robot.run() == by_loop(walk())


@pytest.mark.slow
def test_legs_go_on_without_the_table_and_give_a_new_one_what_they_kept(ros: Ros) -> None:
    """Nothing that was learnt is lost or doubled between the table that died and the new one."""
    robot = Robot(ros, walk(), sim_node={"cycles": 2 * CYCLES, "patience": 5.0})
    robot.spin_to_tick(200)
    old = robot.kill("table_node")
    robot.spin_to_tick(400)
    new = robot.start("table_node")
    robot.run()
    old.shared.merge()
    ticks, falls = 2 * CYCLES * TICKS, robot.sim.recorder.summary()["falls"]
    assert not any(robot.sim.recorder.summary()["absent_ticks"].values())
    learnt = old.shared.table.visits.sum() + new.shared.table.visits.sum()
    assert learnt == 4 * (ticks - 1 - falls)


@pytest.mark.slow
def test_what_legs_kept_is_handed_in_at_the_end_too(ros: Ros) -> None:
    """A push that a dead table never heard is said again at once when a leg ends."""
    # Longer than legs take to end.
    patient: dict[str, Any] = {name: {"table_patience": 1.5} for name in LEG_NODES}
    robot = Robot(ros, walk(), sim_node={"cycles": 10**6, "patience": 5.0}, **patient)
    robot.spin_to_tick(200)
    robot.kill("table_node")
    robot.spin_to_tick(400)
    robot.start("table_node")
    ros.client(topics.PUSH)
    robot.sim.finish(ros.spin_once)
    for name in LEG_NODES:
        robot.nodes[name].finish(ros.spin_once)
    assert [
        name for name in LEG_NODES if robot.nodes[name].module.copy.oldest_unacknowledged()
    ] == []


def test_a_leg_whose_updates_are_lost_ends_with_an_exit_code_of_its_own(ros: Ros) -> None:
    """The table is gone when the legs end; with a table, the code is 0."""
    robot = Robot(ros, walk(), sim_node={"cycles": 1000, "patience": 5.0})
    robot.spin_to_tick(40)
    legs = [robot.nodes[name] for name in LEG_NODES]
    legs[0].finish(ros.spin_once)
    robot.kill("table_node")
    ros.spin_until(lambda: not legs[1]._push_client.service_is_ready(), "the table is gone")
    for leg in legs[1:]:
        leg.finish(ros.spin_once)
    assert [leg.exit_code for leg in legs] == [0, *[UPDATES_LOST] * 3]


@pytest.mark.slow
def test_frozen_legs_come_back_to_a_table_that_comes_back(ros: Ros, tmp_path: Path) -> None:
    """Legs that do not learn push nothing; they pull again all the same once there is a table."""
    file = str(tmp_path / "table.npz")
    robot = Robot(
        ros,
        walk(learning=False),
        sim_node={"cycles": 10**6, "patience": 5.0},
        table_node={"save": file},
    )
    robot.spin_to_tick(100)
    robot.nodes["table_node"].finish(ros.spin_once)
    robot.kill("table_node")
    robot.spin_to_tick(200)
    shared = robot.start("table_node", table=file).shared
    push = ros.client(topics.PUSH)
    taught = UpdateBatch(0, "a teacher", 0, cells_sha256(Params()), (TDUpdate(3, 7, 0.25),))
    assert ros.call(push, calls.write_push(taught)).result.successful
    ros.spin_until(lambda: shared.table.visits[7] == 1, "somebody pulls")
    legs = [node.module.copy.table for name, node in robot.nodes.items() if name in LEG_NODES]
    ros.spin_until(lambda: all(t.visits[7] == 1 for t in legs), "every leg has what was taught")


@pytest.mark.slow
def test_a_new_world_begins_time_anew_and_legs_go_on(ros: Ros) -> None:
    """Legs notice that time began anew and answer its first tick; what they learnt stays.

    Nothing is credited from the old world to the new one, nothing is lost, nothing counted twice.
    """
    robot = Robot(ros, walk(), sim_node={"cycles": 1000})
    commands = {leg: ros.messages(topics.command(leg), raw=True) for leg in LEGS}
    robot.spin_to_tick(100)
    falls = robot.kill("sim_node").recorder.summary()["falls"]
    acted = {leg: [wire.CommandWire(leg, TICK_NS).read(d).tick for d in commands[leg]]
             for leg in LEGS}  # fmt: skip
    for leg in LEGS:
        assert acted[leg] == list(range(len(acted[leg])))
        commands[leg].clear()
    robot.start("sim_node", cycles=CYCLES)
    robot.spin_to_tick(5)
    robot.run()
    assert len(robot.sim.recorder.body_rows()) == CYCLES
    assert not any(robot.sim.recorder.summary()["absent_ticks"].values())
    falls += robot.sim.recorder.summary()["falls"]
    before = sum(map(len, acted.values()))
    visits = robot.nodes["table_node"].shared.table.visits.sum()
    assert visits == before + 4 * CYCLES * TICKS - 8 - 4 * falls


def test_a_leg_in_a_new_life_lays_no_pair_twice() -> None:
    """After time began anew a pull takes away what is merged, not what was pushed first."""
    table, sha = empty_table(Params()), "cells"
    shared = SharedTable(table, legs=4, cells=sha, rate=Params().walk.rate)
    copy = LocalCopy(
        empty_table(Params()), leg=0, run="one", cells=sha, rate=Params().walk.rate, sync_every=32
    )

    def epoch(first: int, last: int) -> None:
        upto = copy.epoch_to_pull(first)
        if upto is not None:
            copy.apply(shared.pull(copy.version, upto), upto)
        for tick in range(first, last + 1):
            copy.learn(TDUpdate(tick, tick % 7, tick / 9))
        copy.close_epoch(last)
        while (push := copy.oldest_unacknowledged()) is not None:
            shared.push(push)
            copy.acknowledged(push)

    for n in range(3):
        epoch(32 * n, 32 * n + 31)
    epoch(96, 100)
    copy.reset(100, "two")
    for n in range(5):
        epoch(32 * n, 32 * n + 31)
        assert copy.table.visits.sum() == 101 + 32 * (n + 1)
    shared.merge()
    assert shared.table.sha256() == copy.table.sha256()


# -- learning off, and real time ---------------------------------------------------------------


def test_learning_is_switched_off_for_the_whole_robot(ros: Ros) -> None:
    """While it is off the shared table stays as it is, though the legs walk and push."""
    robot = Robot(ros, walk(), sim_node={"cycles": 1000})
    robot.spin_to_tick(100)
    answer = ros.call(ros.client(topics.LEARNING), SetBool.Request(data=False))
    assert answer.success
    shared = robot.nodes["table_node"].shared
    robot.spin_to_tick(robot.tick + 64)
    before = shared.table.sha256()
    robot.spin_to_tick(robot.tick + 128)
    assert shared.table.sha256() == before
    assert not any(refusals(robot.nodes).values())


def test_in_real_time_nobody_is_waited_for(ros: Ros) -> None:
    """A leg that is gone stops nothing and is named; the world is never faster than the wall."""
    config = dataclasses.replace(walk(), params=changed(Params(), gait__period=0.1))
    began = time.monotonic()
    robot = Robot(ros, config, sim_node={"mode": "realtime", "cycles": 1000, "patience": 1000.0})
    diagnostics = ros.messages(topics.DIAGNOSTICS)
    robot.spin_to_tick(20)
    robot.kill("leg_front_right")
    died = robot.tick
    robot.spin_to_tick(died + 64)
    elapsed = time.monotonic() - began
    assert robot.tick <= elapsed / config.params.gait.tick_s + 1
    ros.spin_until(
        lambda: level(diagnostics[-1], "front_right") == (DiagnosticStatus.ERROR, "absent"),
        "diagnostics say who is absent",
    )
    assert robot.sim.recorder.summary()["absent_ticks"]["front_right"] >= 62


@pytest.mark.slow
def test_in_real_time_lateness_is_counted_and_told_now_and_then(
    ros: Ros, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A leg that is gone and comes back is a line a window, not a line a tick."""
    monkeypatch.setattr("sim_node.reports.LOG_WINDOW_S", 0.5)
    said: list[str] = []

    def log() -> list[str]:
        said.append(capfd.readouterr().err)
        return "".join(said).splitlines()

    def told(text: str) -> list[str]:
        return [line for line in log() if text in line]

    config = dataclasses.replace(walk(), params=changed(Params(), gait__period=1.0))
    robot = Robot(ros, config, sim_node={"mode": "realtime", "cycles": 1000})
    robot.spin_to_tick(5)
    robot.kill("leg_front_right")
    ros.spin_until(lambda: len(told("command was late: ")) > 1, "who is late is told")
    robot.start("leg_front_right")
    ros.spin_until(lambda: told("all legs are on time again"), "that nobody is late any more")
    counts = [re.search(r"front_right (\d+)", line) for line in told("command was late: ")]
    assert any(count and int(count[1]) > 1 for count in counts)
    assert not told("is back")


def test_a_walk_says_that_it_begins_and_what_came_of_it(
    ros: Ros, capfd: pytest.CaptureFixture[str]
) -> None:
    """Success is not silent: one line each, with the world, the legs, the mode and the cycles."""
    with closing(Graph(BRIEF, patience=PATIENCE_S, context=ros.context)) as graph:
        run_to_end(graph)
        falls = graph.sim.world.body().falls
    lines = capfd.readouterr().err.splitlines()
    (began,) = (line for line in lines if "walker starts" in line)
    assert began.endswith(f"walker starts: {', '.join(LEGS)}; lockstep, 8 cycles")
    (ended,) = (line for line in lines if "walker ended" in line)
    assert ended.endswith(f"walker ended after 8 cycles, {falls} falls")


def test_in_real_time_the_world_stands_still_without_a_phase_and_goes_on_with_one(
    ros: Ros,
) -> None:
    """The phase is what time is for the legs: without it nothing is stepped, in any mode."""
    config = dataclasses.replace(walk(), params=changed(Params(), gait__period=0.1))
    robot = Robot(ros, config, sim_node={"mode": "realtime", "cycles": 1000})
    robot.spin_to_tick(20)
    robot.kill("cpg_node")
    ticks = itertools.count()
    stopped = -1

    def stands() -> bool:
        nonlocal stopped
        before, stopped = stopped, robot.tick
        return before == stopped and next(ticks) > 30

    ros.spin_until(stands, "the world stands still")
    robot.start("cpg_node")
    robot.spin_to_tick(stopped + 40)
