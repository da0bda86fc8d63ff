"""One sim, CPG, table and leg of a name: who comes second says so, and the first feels nothing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from rclpy.node import Node

from cpg_node.node import CpgNode
from ember_ros import cdr, name_lock, topics
from ember_ros.bag.player_node import PlayerNode
from ember_ros.bag.reader import Bag
from ember_ros.errors import BagError
from ember_ros.graph import Graph
from ember_ros.name_lock import NAME_TAKEN, NameLock, NameTakenError, wait_until_alone
from ember_ros.params import Params, replace
from ember_ros.run_config import RunConfig
from ember_ros.spinning import node_main
from leg_node.node import LegNode
from leg_node.table_node import TableNode
from sim_node.node import SimNode
from support.bags import SHIPPED_BAG
from support.robot import PATIENCE_S, overrides, run_to_end
from support.ros import Ros
from support.runs import Bits
from support.waiting import in_time

CONFIG = RunConfig("walker", 6, seed=4, params=replace(Params(), {"walk.sync_every": 32}))
SOON_S = 1.0
"""Wall time for a lease where nobody is to be waited for."""
MAKERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "/clock": (SimNode, {}),
    "/cpg/phase": (CpgNode, {}),
    "/table/push": (TableNode, {}),
    "/front_left/command": (LegNode, {"leg": "front_left"}),
}


def make(ros: Ros, place: str, **kwargs: Any) -> Any:
    """Return the node whose place that is."""
    kind, options = MAKERS[place]
    return kind(
        context=ros.context,
        parameter_overrides=overrides(options),
        **kwargs,
    )


@pytest.fixture
def short_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait a second for who was killed: here nobody is."""
    monkeypatch.setattr(name_lock, "LEASE_S", SOON_S)


@pytest.mark.parametrize("place", MAKERS)
def test_a_second_node_of_one_name_is_refused_and_a_successor_is_not(ros: Ros, place: str) -> None:
    """It names the first in full and says how to live beside it; a namespace is another place."""
    first = ros.add(make(ros, place))
    name = first.get_fully_qualified_name()
    with pytest.raises(
        NameTakenError, match=rf"^{place} is taken by {name} \(process \d+\)"
    ) as why:
        make(ros, place)
    assert "--namespace" in str(why.value)
    assert "ROS_DOMAIN_ID" in str(why.value)
    ros.add(make(ros, place, namespace="robot_2"))
    ros.remove(first)
    ros.add(make(ros, place))


def test_a_table_that_comes_second_touches_no_file(ros: Ros, tmp_path: Path) -> None:
    """The store is the first one's."""
    file = tmp_path / "table.npz"
    save = overrides({"save": str(file)})
    first = ros.add(TableNode(context=ros.context, parameter_overrides=save))
    before = {each: each.stat().st_mtime_ns for each in tmp_path.iterdir()}
    with pytest.raises(NameTakenError):
        TableNode(context=ros.context, parameter_overrides=save)
    assert before
    assert {each: each.stat().st_mtime_ns for each in tmp_path.iterdir()} == before
    ros.remove(first)


@pytest.mark.slow
def test_of_two_runs_one_is_refused_and_the_other_ends_with_its_own_bits(
    ros: Ros, by_loop: Callable[[RunConfig], Bits], by_graph: Callable[[Any], Bits]
) -> None:
    """Before and while the first runs; once it is closed, a next one may."""
    with closing(Graph(CONFIG, patience=PATIENCE_S, context=ros.context)) as graph:
        for _ in range(2):
            with pytest.raises(NameTakenError, match=r"^/ as a whole is taken by /sim_node"):
                Graph(CONFIG, context=ros.context)
            ros.spin_until(lambda: graph.sim.tick >= 40, "tick 40", graph.spin_once)
        assert by_graph(run_to_end(graph)) == by_loop(CONFIG)
    with closing(Graph(CONFIG, patience=PATIENCE_S, context=ros.context)) as graph:
        assert by_graph(run_to_end(graph)) == by_loop(CONFIG)


def test_a_bag_is_not_played_beside_a_robot_nor_a_robot_begun_beside_a_bag(ros: Ros) -> None:
    """Who plays it has the seats of all whom it speaks for."""
    with Bag(SHIPPED_BAG) as bag:
        player = ros.add(PlayerNode(bag, paused=True, context=ros.context))
        with pytest.raises(NameTakenError, match=r"^/clock is taken by /player_node"):
            make(ros, "/clock")
        ros.remove(player)
        sim = ros.add(make(ros, "/clock"))
        with pytest.raises(BagError, match="robot is running here: /clock is taken by /sim_node"):
            PlayerNode(bag, context=ros.context)
        ros.remove(sim)


def test_a_name_of_any_length_is_a_seat() -> None:
    """A socket's name holds 108 bytes; what is said of who has it is cut, and places stay apart."""
    deep = "/" + "/".join(["robot"] * 30)
    first, other = (
        NameLock(0, f"{deep}/clock", f"{deep}/sim_node"),
        NameLock(0, f"{deep}/c", "/sim_node"),
    )
    with pytest.raises(NameTakenError, match=r"/robot/sim_node \(process"):
        NameLock(0, f"{deep}/clock", "/x")
    NameLock(1, f"{deep}/clock", "/x").release()
    first.release()
    NameLock(0, f"{deep}/clock", "/x").release()
    other.release()


# -- strangers ---------------------------------------------------------------------------------


@pytest.mark.usefixtures("short_lease")
def test_a_stranger_on_the_graph_is_named_before_the_first_tick(ros: Ros) -> None:
    """A node that is not ours says the phase: a graph of its own context runs no tick, and ends."""
    ros.publisher(topics.PHASE, matched=False)
    with closing(Graph(CONFIG, patience=PATIENCE_S)) as graph:
        with pytest.raises(NameTakenError, match=r"^/cpg/phase is taken by /test_observer"):
            graph.run(in_time())
        assert graph.sim.tick == 0


def test_a_stranger_who_leaves_is_forgotten(ros: Ros) -> None:
    """Who was only on the way out is waited for."""
    stranger = topics.PHASE.publish(ros.node)
    cpg = ros.add(make(ros, "/cpg/phase"))
    ros.spin_until(cpg.duplicates, "it is seen")
    looks = 0

    def go_on() -> bool:
        nonlocal looks
        looks += 1
        if looks == 3:
            ros.node.destroy_publisher(stranger)
        return True

    wait_until_alone([cpg], go_on)
    assert looks > 3
    assert cpg.duplicates() == []


def test_who_was_killed_here_is_no_stranger(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a seat, but with our name on the graph: a dead one, unless other machines hear us."""
    ghost = ros.add(Node("cpg_node", context=ros.context))
    topics.PHASE.publish(ghost)
    cpg = ros.add(make(ros, "/cpg/phase"))
    both = [("cpg_node", "/")] * 2
    ros.spin_until(
        lambda: [n for n in ros.node.get_node_names_and_namespaces() if n in both] == both, "both"
    )
    assert cpg.duplicates() == []
    wait_until_alone([cpg])
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    assert cpg.duplicates() == ["/cpg_node"]


def test_a_stranger_s_table_is_seen(ros: Ros) -> None:
    """Services are told apart by who serves them."""
    topics.PUSH.serve(ros.node, lambda request, response: response)
    table = ros.add(make(ros, "/table/push"))
    ros.spin_until(lambda: table.duplicates() == ["/test_observer"], "it is seen")


# -- the executables ---------------------------------------------------------------------------


def test_a_node_that_comes_second_ends_with_a_code_of_its_own(
    ros: Ros, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line that begins with ``error:``, and 3."""
    ros.add(make(ros, "/cpg/phase"))
    assert node_main(CpgNode, ["--ros-args", "-r", "__ns:=/"]) == NAME_TAKEN == 3
    said = capsys.readouterr()
    assert said.err.startswith("error: /cpg/phase is taken by /cpg_node (process ")
    assert said.err.count("\n") == 1
    assert not said.out


@pytest.mark.usefixtures("short_lease")
def test_a_node_that_meets_a_stranger_ends_before_it_says_anything(
    ros: Ros, capsys: pytest.CaptureFixture[str]
) -> None:
    """A CPG of another make: ours hears the clock and answers nothing."""
    phases = ros.messages(topics.PHASE, matched=False)
    ros.publisher(topics.PHASE, matched=False)
    ros.publisher(topics.CLOCK, matched=False).publish(cdr.pack_clock(0))
    assert node_main(CpgNode, []) == NAME_TAKEN
    assert "error: /cpg/phase is taken by /test_observer" in capsys.readouterr().err
    ros.spin_once()
    assert phases == []
