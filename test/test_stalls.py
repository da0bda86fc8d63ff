"""Nobody freezes: whatever is lost, early or repeated, the robot goes on, with the same bits."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest
from rcl_interfaces.srv import GetParameters

from cpg_node.node import CpgNode
from ember_ros import cdr, topics, wire
from ember_ros.graph import Graph
from ember_ros.params import Params
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat
from leg_node.table_node import TableNode
from support.legs import LEGS
from support.robot import KINDS, PATIENCE_S, Robot, run_to_end
from support.ros import Ros
from support.runs import Bits
from support.waiting import in_time

TICKS = 32
TICK_NS = Params().gait.tick_ns
BRIEF = RunConfig("walker", 8, seed=3)
TRAILING = "leg_rear_right"


def lose(publisher: Any, *numbers: int) -> list[int]:
    """Let some messages of a publisher, counted from 0, get lost; return a list of those."""
    publish, count, lost = publisher.publish, iter(range(10**9)), []

    def publish_or_lose(message: Any) -> None:
        number = next(count)
        if number in numbers:
            lost.append(number)
        else:
            publish(message)

    publisher.publish = publish_or_lose
    return lost


PUBLISHERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "clock": lambda nodes: nodes["sim_node"]._clock_publisher,
    "joint_states": lambda nodes: nodes["sim_node"]._joints[3],
    "contact": lambda nodes: nodes["sim_node"]._contacts[3],
    "phase": lambda nodes: nodes["cpg_node"]._publisher,
    "command": lambda nodes: nodes[TRAILING]._command_publisher,
    "transition": lambda nodes: nodes[TRAILING]._transition_publisher,
}


@pytest.mark.parametrize("what", PUBLISHERS)
def test_a_lost_message_is_repeated_and_changes_no_bit(
    ros: Ros,
    by_loop: Callable[[RunConfig], Bits],
    by_graph: Callable[[Any], Bits],
    what: str,
) -> None:
    """The first one, one in a row of two, and one in the middle of an epoch."""
    with closing(Graph(BRIEF, patience=PATIENCE_S, context=ros.context)) as graph:
        lost = lose(PUBLISHERS[what](graph.nodes), 0, 40, 41, 70)
        assert by_graph(run_to_end(graph)) == by_loop(BRIEF)
        assert lost == [0, 40, 41, 70]
        assert not any(getattr(node, "refused", 0) for node in graph.nodes.values())


@pytest.mark.parametrize("ahead", [1, 2, 10**9])
def test_the_clock_of_a_stranger_neither_stops_the_robot_nor_changes_a_bit(
    ros: Ros,
    by_loop: Callable[[RunConfig], Bits],
    by_graph: Callable[[Any], Bits],
    ahead: int,
) -> None:
    """As of `ros2 bag play --clock`: the next tick, one after that, and wall time."""
    with closing(Graph(BRIEF, patience=PATIENCE_S, context=ros.context)) as graph:
        clock = ros.publisher(topics.CLOCK)
        go_on, last, sent = in_time(), -1, 0
        while not graph.sim.done:
            go_on()
            graph.spin_once(0.001)
            if graph.sim.tick != last and graph.sim.tick % 5 == 3:
                clock.publish(cdr.pack_clock((graph.sim.tick + ahead) * TICK_NS))
                sent += 1
            last = graph.sim.tick
        graph.finish()
        assert sent > 40
        assert by_graph(graph) == by_loop(BRIEF)


@pytest.mark.parametrize("topic", [topics.CLOCK, topics.PHASE], ids=["clock", "phase"])
def test_a_flood_of_old_messages_stops_nobody(
    ros: Ros,
    by_loop: Callable[[RunConfig], Bits],
    by_graph: Callable[[Any], Bits],
    topic: topics.Topic,
) -> None:
    """Far more than a queue holds, again and again."""
    old = {
        topics.CLOCK.name: cdr.pack_clock(0),
        topics.PHASE.name: wire.BeatWire(TICK_NS).pack(Beat(0, 0.0)),
    }[topic.name]
    with closing(Graph(BRIEF, patience=PATIENCE_S, context=ros.context)) as graph:
        flood = ros.publisher(topic)
        go_on, last = in_time(), -1
        while not graph.sim.done:
            go_on()
            graph.spin_once(0.001)
            if graph.sim.tick != last and graph.sim.tick % 32 == 7:
                for _ in range(20 * topics.DEPTH):
                    flood.publish(old)
            last = graph.sim.tick
        graph.finish()
        assert by_graph(graph) == by_loop(BRIEF)


def test_a_world_that_dies_before_its_first_step_is_followed_by_another(ros: Ros) -> None:
    """The CPG and three legs have answered tick 0; the new world gets the same answers again."""
    robot = Robot(ros, BRIEF, without=["leg_front_left", "sim_node"], patience=PATIENCE_S)
    commands = {leg: ros.messages(topics.command(leg), matched=False) for leg in LEGS[1:]}
    world = robot.start("sim_node", cycles=BRIEF.cycles)
    world._missing = list  # it does not wait for the fourth leg
    ros.spin_until(lambda: all(commands.values()), "three legs have answered")
    assert robot.tick == 0
    robot.kill("sim_node")
    robot.start("leg_front_left")
    robot.start("sim_node", cycles=BRIEF.cycles)
    robot.spin_to_tick(2 * TICKS)
    assert not any(robot.sim.recorder.summary()["absent_ticks"].values())


def test_phases_of_the_future_do_not_stop_legs_that_wait_for_the_table(ros: Ros) -> None:
    """More of them than an inbox keeps, while tick 0 waits for a table that comes late."""
    robot = Robot(ros, BRIEF, without=["table_node"], patience=PATIENCE_S)
    legs = [robot.nodes[f"leg_{leg}"] for leg in LEGS]
    ros.spin_until(lambda: all(leg._inbox.pending("phase") for leg in legs), "tick 0 waits")
    phase = ros.publisher(topics.PHASE)
    for tick in range(1000, 1008):
        phase.publish(wire.BeatWire(TICK_NS).pack(Beat(tick, tick / TICKS)))
    ros.spin_until(lambda: all(1007 in leg._inbox.pending("phase") for leg in legs), "all arrived")
    robot.start("table_node")
    robot.spin_to_tick(2 * TICKS)
    assert not any(robot.sim.recorder.summary()["absent_ticks"].values())


def test_simulated_time_switches_no_safety_off(ros: Ros) -> None:
    """With `use_sim_time` on every node the walk starts, and a dead leg stops it no longer."""
    names = ["table_node", "cpg_node", "sim_node", *(f"leg_{leg}" for leg in LEGS)]
    options: dict[str, Any] = {name: {"use_sim_time": True} for name in names}
    options["sim_node"] |= {"cycles": 1000, "patience": 0.5}
    robot = Robot(ros, BRIEF, **options)
    robot.spin_to_tick(5)
    robot.kill("leg_front_left")
    robot.spin_to_tick(robot.tick + TICKS)
    assert robot.sim.recorder.summary()["absent_ticks"]["front_left"] > 0
    robot.kill("table_node")
    robot.spin_to_tick(robot.tick + 2 * TICKS)


class SlowTable(TableNode):
    """A table whose answers take longer than a leg waits at first."""

    def _on_pull(
        self, request: GetParameters.Request, response: GetParameters.Response
    ) -> GetParameters.Response:
        time.sleep(0.15)  # the network, in both directions
        return super()._on_pull(request, response)


def test_a_first_table_that_comes_late_is_welcome(
    ros: Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every answer takes three times as long as a leg waits: the legs start all the same."""
    monkeypatch.setitem(KINDS, "table_node", SlowTable)
    patience: dict[str, Any] = {f"leg_{leg}": {"table_patience": 0.05} for leg in LEGS}
    robot = Robot(ros, BRIEF, sim_node={"patience": PATIENCE_S}, **patience)
    robot.spin_to_tick(2 * TICKS)
    assert all(robot.nodes[f"leg_{leg}"].module.copy.version is not None for leg in LEGS)


class Counting:
    """An oscillator with a memory: its phase is right only if every tick is stepped once."""

    def __init__(self, params: Params) -> None:
        """Start at the phase of tick 0."""
        self._steps = -1

    def step(self, tick: int, feedback: object) -> float:
        """Return the number of steps so far, in ticks of the default oscillator."""
        self._steps += 1
        return self._steps / TICKS


def test_an_oscillator_is_stepped_once_a_tick_whatever_clocks_are_received(ros: Ros) -> None:
    """Repeated and impossible clocks while the ticks go on leave its memory alone."""
    node = ros.add(
        CpgNode(
            context=ros.context,
            parameter_overrides=[],
            cli_args=["--ros-args", "-p", f"parts.cpg:={__name__}.Counting"],
        )
    )
    phases = ros.messages(topics.PHASE, raw=True)
    clock = ros.publisher(topics.CLOCK)
    reader = wire.BeatWire(TICK_NS)

    def send(tick: int) -> None:
        clock.publish(cdr.pack_clock(tick * TICK_NS))

    def until_published(count: int) -> None:
        ros.spin_until(lambda: len(phases) >= count, f"{count} beats")

    for tick in range(40):
        send(tick)
        until_published(2 * tick + 1)
        for wrong in (tick + 7, 10**9, tick):
            send(wrong)
        until_published(2 * tick + 2)
    assert [reader.read(data) for data in phases[::2]] == [Beat(t, t / TICKS) for t in range(40)]
    assert phases[::2] == phases[1::2]
    assert node._beats.last.tick == 39
