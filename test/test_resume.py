"""Runs that continue from a table: exploration schedule, cycle count and printed differences."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ember_ros.cli.run import config_from_options
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

EXPLORING = replace(Params(), {"train.epsilon_cycles": 20, "train.epsilon_end": 0.0})


def run_summary(out: Path, config: RunConfig, mode: str = "loop") -> dict[str, Any]:
    """Run a configuration and return its summary."""
    return run(config, mode, out, lambda cycles, falls: True, "test")[1]


def test_exploration_continues_from_start_cycle(tmp_path: Path) -> None:
    """A run from cycle 20 has the epsilon of cycle 20, which is 0 here."""
    table = empty_table(EXPLORING)
    table.values[3::9] = 1.0
    table.visits[:] = 50
    save_table(tmp_path / TABLE, table, EXPLORING, 0)
    actions_by_start = []
    for start in (0, 20):
        config = RunConfig(
            "trainer", 1, params=EXPLORING, table=tmp_path / TABLE, start_cycle=start
        )
        loop, actions = Loop(config, FakeWorld(("leg",), EXPLORING)), set()
        for _ in range(10):
            loop.tick()
            actions.add(loop.legs[0].last_transition.action)
        actions_by_start.append(actions - {-1})
    assert epsilon_at(EXPLORING.train, 20) == 0.0
    assert len(actions_by_start[0]) > 3
    assert actions_by_start[1] == {3}


@needs_bullet
@pytest.mark.parametrize("mode", ["loop", "graph"])
@pytest.mark.slow
def test_resume_point_adds_up_cycles_and_keeps_parameters(tmp_path: Path, mode: str) -> None:
    """The cycles of two runs add up, and the parameters are those of the run."""
    run_summary(tmp_path / "a", RunConfig("trainer", 4, params=EXPLORING, seed=1), mode)
    assert resume_point(tmp_path / "a", "trainer") == (4, EXPLORING)
    table = tmp_path / "a" / TABLE
    resumed = RunConfig("trainer", 3, params=EXPLORING, seed=2, table=table, start_cycle=4)
    summary = run_summary(tmp_path / "b", resumed, mode)
    assert (summary["start_cycle"], summary["cycles"]) == (4, 3)
    assert resume_point(tmp_path / "b", "trainer") == (7, EXPLORING)
    visits = [load_table(tmp_path / n / TABLE, EXPLORING)[0].visits.sum() for n in "ab"]
    assert visits == [4 * 32 - 1, 4 * 32 - 1 + 3 * 32 - 1]


@pytest.mark.ros
@needs_bullet
@pytest.mark.slow
def test_loop_and_graph_resume_with_the_same_bits(tmp_path: Path) -> None:
    """Both continue from the same cycle; a run from cycle 0 differs."""
    config = RunConfig("trainer", 8, params=EXPLORING, seed=2, start_cycle=19)
    summaries = [run_summary(tmp_path / mode, config, mode) for mode in ("loop", "graph")]
    for name in ("table_sha256", "commands_sha256", "senses_sha256", "transitions_sha256"):
        assert summaries[0][name] == summaries[1][name]
    other = run_summary(tmp_path / "other", RunConfig("trainer", 8, params=EXPLORING, seed=2))
    assert other["commands_sha256"] != summaries[0]["commands_sha256"]


def test_a_killed_run_is_resumed_from_its_checkpoint(tmp_path: Path) -> None:
    """Its table has the number of cycles; there is no summary."""
    save_table(tmp_path / TABLE, empty_table(EXPLORING), EXPLORING, 0, {"cycle": 11})
    assert resume_point(tmp_path, "trainer") == (11, EXPLORING)


def test_resume_errors_name_the_reason(tmp_path: Path) -> None:
    """No table, unknown number of cycles, another world."""
    with pytest.raises(TableError, match="there is no table"):
        resume_point(tmp_path, "trainer")
    save_table(tmp_path / TABLE, empty_table(EXPLORING), EXPLORING, 0)
    with pytest.raises(ParameterError, match="does not say how many cycles"):
        resume_point(tmp_path, "trainer")
    summary = {"world": "walker", "start_cycle": 0, "cycles": 3}
    (tmp_path / SUMMARY).write_text(json.dumps(summary))
    with pytest.raises(ParameterError, match="is a run of the walker"):
        resume_point(tmp_path, "trainer")


def test_start_messages_name_changed_parameters_and_exploration(tmp_path: Path) -> None:
    """Parameters that differ from those of the table, and the share of random actions."""
    file = tmp_path / TABLE
    save_table(file, empty_table(EXPLORING), EXPLORING, 0)
    assert start_messages(RunConfig("walker", 1, params=EXPLORING, table=file)) == []
    now = replace(EXPLORING, {"reward.lead": 0, "walker.mass": 4.0})
    lines = start_messages(RunConfig("trainer", 1, params=now, table=file))
    assert lines[0] == (
        f"{file} was learnt with other parameters: walker.mass 5.0, now 4.0; reward.lead 2, now 0"
    )
    assert "100 % of the actions are random at first" in lines[1]
    many = {f"trainer.{n}": 0.4 for n in ("stop_low", "stop_height", "tip_mass")}
    many |= {f"reward.{n}": 0.1 for n in ("slip", "height", "force", "force_limit")}
    many |= {f"walker.{n}": 0.3 for n in ("radius", "hip_half_width", "mass")}
    lines = start_messages(RunConfig("trainer", 1, params=replace(EXPLORING, many), table=file))
    assert lines[0].endswith("; and 2 more")
    (only,) = start_messages(RunConfig("trainer", 1, params=EXPLORING, table=file, start_cycle=10))
    assert only == "continuing from cycle 10, exploring 50 % at first"


@pytest.mark.parametrize("seed", [-1, MAX_INTEGER + 1])
def test_a_seed_outside_the_integer_range_is_refused(seed: int) -> None:
    """A node parameter is a signed 64-bit integer."""
    with pytest.raises(ParameterError, match=f"seed = {seed}: 0 to {MAX_INTEGER}"):
        RunConfig("walker", 1, seed=seed)


def test_a_changed_parameter_is_checked_against_the_resumed_run_s_own(tmp_path: Path) -> None:
    """Not against the defaults, which the run does not have."""
    params = replace(EXPLORING, {"trainer.stop_high": 0.7})
    run_summary(tmp_path, RunConfig("trainer", 1, params=params), "loop")
    config = config_from_options(
        "trainer",
        cycles=1,
        seed=0,
        params_files=(),
        settings=("trainer.stop_low=0.6",),
        table=None,
        resume=tmp_path,
        learning=None,
        policy="learned",
    )
    assert config.params == replace(params, {"trainer.stop_low": 0.6})
