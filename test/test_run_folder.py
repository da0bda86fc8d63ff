"""A run's folder: what lay in it, what is saved while it runs, and who else writes into it."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import Any

import pytest

import ember_ros.run
from ember_ros import spinning
from ember_ros.errors import ParameterError
from ember_ros.plan import Plan
from ember_ros.run import EARLIER, SUMMARY, TABLE, run
from leg_node.table_file import load_table

pytest.importorskip("pybullet")

PLAN = Plan("trainer", 3, seed=1)


def go(out: Path, plan: Plan = PLAN, way: str = "loop", **more: Any) -> dict[str, Any]:
    """Run a plan."""
    return run(plan, way, out, more.get("go_on", lambda cycles, falls: True), "test")[1]


def files(folder: Path) -> dict[str, bytes]:
    """Return all files in a folder."""
    return {each.name: each.read_bytes() for each in folder.iterdir()}


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("ROS_DOMAIN_ID", "300"),
        ("ROS_DOMAIN_ID", "-1"),
        ("ROS_DOMAIN_ID", "abc"),
        ("ROS_LOG_DIR", "/proc/nope"),
        ("RMW_IMPLEMENTATION", "rmw_that_is_not_here"),
    ],
)
@pytest.mark.parametrize("way", ["graph", "processes"])
def test_where_ros_cannot_start_an_earlier_run_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, value: str, way: str
) -> None:
    """The variable is named with what would be right, and nothing in the folder has changed."""
    pytest.importorskip("rclpy")
    go(tmp_path)
    before = files(tmp_path)
    monkeypatch.setenv(variable, value)
    spinning._check_middleware.cache_clear()
    try:
        with pytest.raises(ParameterError, match=f"^{variable}={value}: "):
            go(tmp_path, way=way)
    finally:
        spinning._check_middleware.cache_clear()
    assert files(tmp_path) == before


def test_a_run_that_cannot_begin_brings_the_earlier_one_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it has written before its first cycle ended."""
    go(tmp_path)
    before = files(tmp_path)

    def fails(plan: Plan, out: Path, *others: Any) -> None:
        assert not (out / SUMMARY).exists()
        (out / "cycles.csv").write_text("cycle,module\n")
        (out / TABLE).write_text("half")
        raise ParameterError("it cannot begin")

    monkeypatch.setattr(ember_ros.run, "_loop", fails)
    with pytest.raises(ParameterError, match="cannot begin"):
        go(tmp_path)
    assert files(tmp_path) == before


def test_what_a_killed_run_had_set_aside_is_not_lost(tmp_path: Path) -> None:
    """Killed before its first cycle ended: the next that cannot begin brings the earlier back."""
    go(tmp_path)
    before = files(tmp_path)
    aside = tmp_path / EARLIER
    aside.mkdir()
    for name in before:
        (tmp_path / name).replace(aside / name)
    (tmp_path / "cycles.csv").write_text("cycle,module\n")
    with pytest.raises(ParameterError, match="no policy"):
        go(tmp_path, Plan("trainer", 1, policy="none"))
    assert files(tmp_path) == before


def test_what_a_killed_run_had_set_aside_goes_once_it_had_begun(tmp_path: Path) -> None:
    """Its own first cycle is more than what it replaced."""
    go(tmp_path)
    (tmp_path / EARLIER).mkdir()
    (tmp_path / EARLIER / SUMMARY).write_text("older")
    go(tmp_path, Plan("trainer", 2, seed=2))
    assert "older" not in (tmp_path / SUMMARY).read_text()
    assert not (tmp_path / EARLIER).exists()


def test_a_run_replaces_the_earlier_one(tmp_path: Path) -> None:
    """Nothing of it is left over."""
    go(tmp_path)
    (tmp_path / "run.png").write_text("the earlier one's")
    told = go(tmp_path, Plan("trainer", 2, seed=2))
    assert told["cycles"] == 2
    assert not (tmp_path / EARLIER).exists()
    assert not (tmp_path / "run.png").exists()


def test_a_run_may_start_from_the_table_that_it_replaces(tmp_path: Path) -> None:
    """``--table out/train/table.npz --out out/train --force`` goes on from what was learnt."""
    go(tmp_path)
    before = load_table(tmp_path / TABLE, PLAN.params)[0].visits.sum()
    go(tmp_path, Plan("trainer", 3, seed=1, table=tmp_path / TABLE))
    after = load_table(tmp_path / TABLE, PLAN.params)[0].visits.sum()
    assert after == 2 * before


def test_two_runs_do_not_write_into_one_folder(tmp_path: Path) -> None:
    """The second is refused before it touches anything; when the first has gone, it may."""
    go(tmp_path)
    before = files(tmp_path)
    held = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with pytest.raises(ParameterError, match=r"another run is writing into .*--out"):
        go(tmp_path)
    assert files(tmp_path) == before
    os.close(held)
    go(tmp_path)


def test_what_is_learnt_is_saved_while_the_loop_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each checkpoint the folder holds a whole table of all that was pushed until then.

    It changes nothing in the run.
    """
    monkeypatch.setattr(ember_ros.run, "CHECKPOINT_S", 0.0)
    visits = []

    def look(cycles: int, falls: int) -> bool:
        visits.append(int(load_table(tmp_path / TABLE, PLAN.params)[0].visits.sum()))
        return True

    saved = go(tmp_path, go_on=look)
    ticks = PLAN.params.gait.ticks
    assert visits == [0, ticks - 1, 2 * ticks - 1]
    monkeypatch.setattr(ember_ros.run, "CHECKPOINT_S", 1e9)
    assert go(tmp_path)["table_sha256"] == saved["table_sha256"]
