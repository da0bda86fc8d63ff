"""Parts that are swapped from outside the package: the same bits on loop, graph and processes."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from ember_ros.errors import TableError, UpdateError
from ember_ros.loop import Loop
from ember_ros.params import Params, cells_sha256, params_sha256, replace
from ember_ros.params_file import dump_params, load_params
from ember_ros.report.run_statistics import load_record
from ember_ros.run_config import RunConfig
from leg_node.assembly import empty_table
from leg_node.table_file import load_table, save_table
from support.robot import PATIENCE_S
from support.ros import Ros
from support.runs import Bits, bits_of, by_graph, by_loop

OUTSIDE = Path(__file__).parent / "outside"
CYCLES = 6
SWAPPED: dict[str, dict[str, Any]] = {
    "reward": {"parts.reward": "mine.Reward"},
    "discretizer": {"parts.discretizer": "mine.Discretizer"},
    "learner of the package": {"parts.learner": "leg_node.sarsa.SarsaLambda"},
    "learner with two tables": {"parts.learner": "mine.DoubleQ"},
    "value": {"parts.value": "mine.Value"},
    "gait": {"parts.gait": "mine.Gait"},
    "cpg of a varying period": {"parts.cpg": "mine.Varying"},
    "cpg with feedback": {"parts.cpg": "mine.Adaptive"},
    "all": {
        "parts.reward": "mine.Reward",
        "parts.discretizer": "mine.Discretizer",
        "parts.learner": "mine.DoubleQ",
        "parts.cpg": "mine.Adaptive",
    },
}


@pytest.fixture(autouse=True)
def outside(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let somebody else's module be found, here and in child processes."""
    monkeypatch.syspath_prepend(str(OUTSIDE))
    monkeypatch.setenv("PYTHONPATH", str(OUTSIDE))


def config(changes: dict[str, Any], **rest: Any) -> RunConfig:
    """Return a walk that explores and syncs within its cycles, and not with its end."""
    numbers = {"walk.epsilon_start": 0.3, "walk.epsilon_end": 0.1, "walk.sync_every": 20}
    return RunConfig("walker", CYCLES, seed=5, params=replace(Params(), numbers | changes), **rest)


def three_ways(ros: Ros, out: Path, each: RunConfig) -> list[Bits]:
    """Return the bits of a plan by loop, graph and processes."""
    from ember_ros.graph import Graph, processes

    graph = Graph(each, context=ros.context, patience=PATIENCE_S)
    try:
        while not graph.sim.done:
            graph.spin_once(0.0)
        graph.finish()
        found = [by_loop(each), by_graph(graph)]
    finally:
        graph.close()
    with processes(each, out, patience=PATIENCE_S) as running:
        running.wait()
    table = load_table(out / "table.npz", each.params)[0]
    return [*found, bits_of(table.sha256(), load_record(out).measured)]


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize("name", list(SWAPPED))
def test_a_part_of_ones_own_ends_with_the_same_bits_everywhere(
    ros: Ros, tmp_path: Path, name: str
) -> None:
    """Named in the parameters, it is used by all three, and it changes what comes out."""
    bits = three_ways(ros, tmp_path, config(SWAPPED[name]))
    assert bits[0] == bits[1] == bits[2]
    assert bits[0] != by_loop(config({}))


@pytest.mark.ros
@pytest.mark.slow
def test_a_world_and_a_policy_of_ones_own_end_with_the_same_bits(ros: Ros, tmp_path: Path) -> None:
    """Both are named by the run, not by the robot."""
    each = RunConfig("mine.World", CYCLES, seed=5, policy="mine.Policy")
    assert (each.stage, each.legs) == ("train", ("front_left", "front_right"))
    bits = three_ways(ros, tmp_path, each)
    assert bits[0] == bits[1] == bits[2]
    assert bits[0].falls == 1


@pytest.mark.ros
@pytest.mark.slow
def test_a_hexapod_walks_with_the_same_bits_everywhere(ros: Ros, tmp_path: Path) -> None:
    """Six legs, three segments, from a parameter file; the legs know what one leg was taught."""
    trained = Loop(RunConfig("trainer", 60, params=load_params("hexapod")))
    for _ in range(60 * 32):
        trained.tick()
    save_table(tmp_path / "leg.npz", trained.finish(), Params(), 0)
    trained.close()
    hexapod = load_params("hexapod", settings=["walk.epsilon_start=0.2", "walk.epsilon_end=0.2"])
    each = RunConfig("walker", CYCLES, seed=2, params=hexapod, table=tmp_path / "leg.npz")
    assert len(each.legs) == 6
    bits = three_ways(ros, tmp_path / "out", each)
    assert bits[0] == bits[1] == bits[2]


@pytest.mark.parametrize("name", [name for name in SWAPPED if not name.startswith("cpg")])
def test_a_table_of_another_meaning_is_refused(tmp_path: Path, name: str) -> None:
    """A table knows which parts it was learnt with: the file is refused, and so is a push."""
    mine, default = replace(Params(), SWAPPED[name]), Params()
    save_table(tmp_path / "mine.npz", empty_table(mine), mine, 0)
    with pytest.raises(TableError, match=r"these parameters need|other parts"):
        load_table(tmp_path / "mine.npz", default)
    load_table(tmp_path / "mine.npz", mine)
    assert cells_sha256(mine) != cells_sha256(default)
    from leg_node.shared import SharedTable, UpdateBatch

    shared = SharedTable(empty_table(mine), legs=4, cells=cells_sha256(mine), rate=mine.walk.rate)
    with pytest.raises(UpdateError, match="learnt with other parameters"):
        shared.push(UpdateBatch(0, "run", 0, cells_sha256(default), ()))


def test_an_oscillator_is_no_matter_of_the_table(tmp_path: Path) -> None:
    """A table may be taken to another rhythm; the run's parameters are others all the same."""
    mine, default = replace(Params(), {"parts.cpg": "mine.Varying"}), Params()
    assert cells_sha256(mine) == cells_sha256(default)
    assert params_sha256(mine) != params_sha256(default)


def test_what_is_named_is_in_a_parameter_file(tmp_path: Path) -> None:
    """So that one file tells a whole robot, parts and all."""
    mine = replace(Params(), SWAPPED["all"])
    (tmp_path / "mine.yaml").write_text(dump_params(mine), encoding="utf-8")
    assert load_params(tmp_path / "mine.yaml") == mine


def test_a_reward_of_ones_own_is_what_is_recorded() -> None:
    """Its terms are in the transitions, and in the summary, under their own names."""
    from ember_ros.report.run_statistics import RunStatistics

    each = config(SWAPPED["reward"])
    loop, recorder = Loop(each), RunStatistics(each.params, each.legs)
    for _ in range(64):
        loop.tick(recorder)
    recorder.finish(loop.world.observe(), loop.world.body())
    loop.close()
    assert set(recorder.summary()["last"]["reward_by_term"]) == {"stands", "quiet"}
    assert loop.legs[0].last_transition.reward > 0.0


def test_a_varying_period_is_counted_by_the_phase() -> None:
    """A line a cycle of the oscillator, however many ticks it takes."""
    from ember_ros.report.run_statistics import RunStatistics

    each = config(SWAPPED["cpg of a varying period"])
    loop, recorder = Loop(each), RunStatistics(each.params, each.legs)
    phases = []
    for _ in range(CYCLES * 32):
        loop.tick(recorder)
        phases.append(loop.beats.last.phase)
    recorder.finish(loop.world.observe(), loop.world.body())
    loop.close()
    assert phases == sorted(phases)
    assert len({round(b - a, 9) for a, b in pairwise(phases)}) > 10
    assert [row.cycle for row in recorder.body_rows()] == list(range(int(phases[-1]) + 1))
    assert len(recorder.body_rows()) < CYCLES
