"""A robot of other legs than the default ones: recorded, looked into, run again, heard."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from ember_ros import topics
from ember_ros.bag.reader import Bag
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.storage import BagOptions
from ember_ros.errors import BagError
from ember_ros.graph import Graph, by_graph
from ember_ros.offline.relearn import relearn
from ember_ros.offline.replay import by_loop, replay
from ember_ros.params import Params, replace
from ember_ros.params_file import load_params
from ember_ros.report.run_statistics import BODY
from ember_ros.run_config import RunConfig
from ember_ros.versions import versions
from leg_node.assembly import empty_table
from sim_node.fake import FakeWorld
from support import bags
from support.bags import RecordedRun
from support.command import ember
from support.configs import SMALL, changed
from support.needs import needs_bags, needs_bullet
from support.ros import Ros

pytestmark = needs_bags

ROBOT = load_params("hexapod").robot
SIX = ROBOT.legs
TICKS = Params().gait.ticks
CYCLES = 3
FALLS = {20, 50}
PATIENCE_S = 30.0


def hexapod(cycles: int = CYCLES, **options: Any) -> RunConfig:
    """Return a plan of six legs on a small table; options with ``__`` are parameters."""
    changes = {name: options.pop(name) for name in list(options) if "__" in name}
    six = {f"robot.{name}": getattr(ROBOT, name) for name in ROBOT.__dataclass_fields__}
    params = replace(changed(SMALL, **changes), six)
    return RunConfig("walker", cycles, seed=3, params=params, **options)


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Record one run for all tests that only look at it."""
    return bags.record(tmp_path_factory.mktemp("hexapod") / "bag", hexapod(), falls_at=FALLS)


def test_the_card_describes_the_robot(walked: RecordedRun) -> None:
    """Who opens the bag needs no parameter file: the legs are those of the card, in order."""
    assert len(SIX) == 6
    with Bag(walked.bag) as bag:
        assert bag.legs == SIX
        assert bag.params == walked.config.params
        assert bag.run_metadata is not None
        assert bag.run_metadata.config(CYCLES, None) == walked.config
        ticks = list(bag.ticks())
        assert (bag.damages, bag.stale) == ([], 0)
    assert len(ticks) == walked.ticks == CYCLES * TICKS
    for tick in ticks:
        for of_legs in (tick.senses, tick.commands, tick.transitions):
            assert len(of_legs) == 6
            assert None not in of_legs


def test_a_bag_of_others_needs_the_parameters_of_its_robot(
    walked: RecordedRun, tmp_path: Path
) -> None:
    """Without a card nobody knows which legs there are: it is said, and with them it is read."""
    raws = [raw for raw in bags.raws_of(walked.bag) if "/run/" not in raw.topic]
    without_card = bags.write(tmp_path / "bag", raws)
    with pytest.raises(BagError, match=r"legs of other names than front_left, .*--params"):
        Bag(without_card)
    with Bag(without_card, params=walked.config.params) as bag, Bag(walked.bag) as whole:
        assert list(bag.ticks()) == list(whole.ticks())


def test_a_replay_of_six_legs_is_the_run(walked: RecordedRun) -> None:
    """Senses, commands, rewards and the table of six."""
    with Bag(walked.bag) as bag:
        done = replay(bag)
    assert done.parts == dict.fromkeys(("senses", "commands", "rewards", "table"), True)
    assert (done.compared, done.table.sha256()) == (6 * walked.ticks, walked.table)


def test_six_legs_are_learnt_from(walked: RecordedRun) -> None:
    """With the numbers of the run the table of the run, with others another one."""
    learnt = relearn([walked.bag])
    assert learnt.table.sha256() == walked.table
    assert learnt.updates == 6 * (walked.ticks - 1 - len(FALLS))
    assert relearn([walked.bag], {"walk.gamma": 0.5}).table.sha256() != walked.table


@needs_bullet
@pytest.mark.slow
@pytest.mark.parametrize("on", ["loop", "graph"])
def test_a_hexapod_is_recorded_and_looked_into_and_run_again(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], on: str
) -> None:
    """``--params hexapod``, as a user types it: walk, info, csv, and a replay on loop and graph."""
    bag, out = tmp_path / "bag", tmp_path / "out"
    words = ["--params", "hexapod", "--cycles", 2, "--on", on, "--bag", bag, "--out", out]
    assert ember("walk", *words) == 0
    capfd.readouterr()
    assert ember("bag", "info", bag, "--json") == 0
    found = json.loads(capfd.readouterr().out)
    assert (found["ticks"], found["lost_ticks"], found["damaged"]) == (2 * TICKS, 0, [])
    assert list(found["card"]["legs"]) == list(SIX)
    for leg in SIX:
        assert found["messages"][f"/{leg}/transition"] == 2 * TICKS
    assert ember("bag", "csv", bag, "--out", tmp_path / "csv") == 0
    with (tmp_path / "csv" / "ticks.csv").open(newline="") as file:
        assert [line["leg"] for line in csv.DictReader(file)] == [*SIX] * (2 * TICKS)
    with (tmp_path / "csv" / "cycles.csv").open(newline="") as file:
        assert [line["module"] for line in csv.DictReader(file)] == [*SIX, BODY] * 2
    for way in ("loop", "graph") if on == "graph" else ("loop",):
        capfd.readouterr()
        assert ember("replay", bag, "--on", way) == 0
        said = capfd.readouterr().out
        assert "equal: senses, commands, rewards, table" in " ".join(said.split())


# -- with nodes ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_world_records_six_legs_as_the_loop_does(ros: Ros, tmp_path: Path) -> None:
    """Asked by the world, the nodes say the plan; loop, graph and replay end with one table."""
    own = hexapod()
    with closing(
        Graph(
            own,
            patience=PATIENCE_S,
            bag=BagOptions(tmp_path / "graph"),
            world=FakeWorld(own.legs, own.params, falls_at=FALLS),
            context=ros.context,
        )
    ) as graph:
        ros.spin_until(lambda: graph.sim.done, "the last tick", graph.spin_once)
        graph.finish()
        learnt = graph.nodes["table_node"].shared.table.sha256()
    made = bags.record(tmp_path / "loop", own, falls_at=FALLS)
    assert learnt == made.table
    with Bag(tmp_path / "graph") as bag, Bag(made.bag) as of_loop:
        assert bag.run_metadata == RunMetadata.of_config(own, empty_table(own.params), versions())
        assert list(bag.ticks()) == list(of_loop.ticks())
        done = replay(bag)
    assert done.equal
    assert done.table.sha256() == learnt


@pytest.mark.parametrize("run", [by_loop, by_graph], ids=["loop", "graph"])
def test_six_leg_nodes_replay_the_bag(
    ros: Ros, walked: RecordedRun, run: Callable[..., Any]
) -> None:
    """The loop's legs and real leg nodes, one a leg of the card: equal, bit for bit."""
    with Bag(walked.bag) as bag:
        done = replay(bag, run=run)
    assert done.equal
    assert (done.compared, done.table.sha256()) == (6 * walked.ticks, walked.table)


@pytest.mark.slow
@pytest.mark.parametrize("namespace", ["", "robot_6"])
def test_a_recorder_beside_six_legs_writes_what_the_world_writes(
    ros: Ros, tmp_path: Path, namespace: str
) -> None:
    """Told nothing, it asks which legs there are, and hears all of them from the first tick on."""
    from ember_ros.bag.recorder_node import RecorderNode
    from support.robot import Robot, overrides

    own, received = tmp_path / "own" / "bag", tmp_path / "heard" / "bag"
    config = hexapod()
    recorder = ros.add(
        RecorderNode(
            context=ros.context,
            namespace=namespace,
            parameter_overrides=overrides({"bag": str(received)}),
        )
    )
    robot = Robot(
        ros,
        config,
        namespace,
        without=["sim_node"],
        patience=PATIENCE_S,
        world=lambda config: FakeWorld(config.legs, config.params, falls_at=FALLS),
    )
    robot.begin(recorder, bag=str(own), recorder=True)
    robot.run()
    robot_recorder = recorder._robots[namespace]
    ros.spin_until(
        (
            lambda: (
                robot_recorder.run_writer is not None
                and robot_recorder.run_writer.ticks >= CYCLES * TICKS
            )
        ),
        "all is recorded",
    )
    assert robot_recorder.missing == 0
    recorder.finish(ros.spin_once)
    (one,), (other,) = own.glob("*.mcap"), received.glob("*.mcap")
    assert one.read_bytes() == other.read_bytes()
    with Bag(received) as bag:
        assert bag.legs == SIX
        assert bag.messages(topics.transition("middle_left")) == CYCLES * TICKS
        done = replay(bag)
    assert done.equal
    assert done.table.sha256() == robot.table
