"""Runs that go on: from a table, with exploration where it was, and told what is other now."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ember_ros.errors import ParameterError, TableError
from ember_ros.loop import Loop
from ember_ros.params import Params, replace
from ember_ros.resume import resume_point, start_messages
from ember_ros.run import SUMMARY, TABLE, run
from ember_ros.run_config import MAX_INTEGER, RunConfig
from leg_node.assembly import empty_table
from leg_node.policy import epsilon_at
from leg_node.table_file import load_table, save_table
from sim_node.fake import FakeWorld
from support.needs import needs_bullet

EAGER = replace(Params(), {"train.epsilon_cycles": 20, "train.epsilon_end": 0.0})


def go(out: Path, config: RunConfig, way: str = "loop") -> dict[str, Any]:
    """Run a plan."""
    return run(config, way, out, lambda cycles, falls: True, "test")[1]


def test_exploration_goes_on_where_it_was(tmp_path: Path) -> None:
    """A leg that starts at cycle 20 explores as one does after 20 cycles: here not at all."""
    table = empty_table(EAGER)
    table.values[3::9] = 1.0
    table.visits[:] = 50
    save_table(tmp_path / TABLE, table, EAGER, 0)
    chosen = []
    for start in (0, 20):
        config = RunConfig("trainer", 1, params=EAGER, table=tmp_path / TABLE, start_cycle=start)
        loop, actions = Loop(config, FakeWorld(("leg",), EAGER)), set()
        for _ in range(10):
            loop.tick()
            actions.add(loop.legs[0].last_transition.action)
        chosen.append(actions - {-1})
    assert epsilon_at(EAGER.train, 20) == 0.0
    assert len(chosen[0]) > 3
    assert chosen[1] == {3}


@needs_bullet
@pytest.mark.parametrize("way", ["loop", "graph"])
@pytest.mark.slow
def test_a_run_is_resumed_with_what_it_had(tmp_path: Path, way: str) -> None:
    """Cycles add up, over two runs, and the parameters are the run's own."""
    go(tmp_path / "a", RunConfig("trainer", 4, params=EAGER, seed=1), way)
    assert resume_point(tmp_path / "a", "trainer") == (4, EAGER)
    table = tmp_path / "a" / TABLE
    more = RunConfig("trainer", 3, params=EAGER, seed=2, table=table, start_cycle=4)
    told = go(tmp_path / "b", more, way)
    assert (told["start_cycle"], told["cycles"]) == (4, 3)
    assert resume_point(tmp_path / "b", "trainer") == (7, EAGER)
    visits = [load_table(tmp_path / n / TABLE, EAGER)[0].visits.sum() for n in "ab"]
    assert visits == [4 * 32 - 1, 4 * 32 - 1 + 3 * 32 - 1]


@pytest.mark.ros
@needs_bullet
@pytest.mark.slow
def test_loop_and_graph_resume_alike(tmp_path: Path) -> None:
    """The same bits from the same cycle."""
    config = RunConfig("trainer", 8, params=EAGER, seed=2, start_cycle=19)
    told = [go(tmp_path / way, config, way) for way in ("loop", "graph")]
    for name in ("table_sha256", "commands_sha256", "senses_sha256", "transitions_sha256"):
        assert told[0][name] == told[1][name]
    other = go(tmp_path / "other", RunConfig("trainer", 8, params=EAGER, seed=2))
    assert other["commands_sha256"] != told[0]["commands_sha256"]


def test_a_killed_run_is_resumed_from_its_checkpoint(tmp_path: Path) -> None:
    """It left a table that says how far it was, and no summary."""
    save_table(tmp_path / TABLE, empty_table(EAGER), EAGER, 0, {"cycle": 11})
    assert resume_point(tmp_path, "trainer") == (11, EAGER)


def test_what_cannot_be_resumed_is_said(tmp_path: Path) -> None:
    """Another world, no word of how far it came, no table."""
    with pytest.raises(TableError, match="there is no table"):
        resume_point(tmp_path, "trainer")
    save_table(tmp_path / TABLE, empty_table(EAGER), EAGER, 0)
    with pytest.raises(ParameterError, match="does not say how many cycles"):
        resume_point(tmp_path, "trainer")
    told = {"world": "walker", "start_cycle": 0, "cycles": 3}
    (tmp_path / SUMMARY).write_text(json.dumps(told))
    with pytest.raises(ParameterError, match="is a run of the walker"):
        resume_point(tmp_path, "trainer")


def test_what_is_other_now_is_named(tmp_path: Path) -> None:
    """Parameters that differ from those a table was learnt with, and what exploring will do."""
    file = tmp_path / TABLE
    save_table(file, empty_table(EAGER), EAGER, 0)
    assert start_messages(RunConfig("walker", 1, params=EAGER, table=file)) == []
    now = replace(EAGER, {"reward.lead": 0, "walker.mass": 4.0})
    lines = start_messages(RunConfig("trainer", 1, params=now, table=file))
    assert lines[0] == (
        f"{file} was learnt with other parameters: walker.mass 5.0, now 4.0; reward.lead 2, now 0"
    )
    assert "100 % of the actions are random at first" in lines[1]
    many = {f"trainer.{n}": 0.4 for n in ("stop_low", "stop_height", "tip_mass")}
    many |= {f"reward.{n}": 0.1 for n in ("slip", "height", "force", "force_limit")}
    many |= {f"walker.{n}": 0.3 for n in ("radius", "hip_half_width", "mass")}
    told = start_messages(RunConfig("trainer", 1, params=replace(EAGER, many), table=file))
    assert told[0].endswith("; and 2 more")
    (only,) = start_messages(RunConfig("trainer", 1, params=EAGER, table=file, start_cycle=10))
    assert only == "continuing from cycle 10, exploring 50 % at first"


@pytest.mark.parametrize("seed", [-1, MAX_INTEGER + 1])
def test_a_seed_is_one_that_nodes_can_hold(seed: int) -> None:
    """A parameter of a node has 63 bits."""
    with pytest.raises(ParameterError, match=f"seed = {seed}: 0 to {MAX_INTEGER}"):
        RunConfig("walker", 1, seed=seed)
