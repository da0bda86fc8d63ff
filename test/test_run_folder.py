"""A run's folder: what lay in it, what is saved while it runs, and who else writes into it."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import ember_ros.run
from ember_ros import spinning
from ember_ros.errors import ParameterError, StoppedError
from ember_ros.run import EARLIER, SUMMARY, TABLE, recover, run
from ember_ros.run_config import RunConfig
from leg_node.table_file import load_table

pytest.importorskip("pybullet")

CONFIG = RunConfig("trainer", 3, seed=1)


def go(out: Path, config: RunConfig = CONFIG, way: str = "loop", **more: Any) -> dict[str, Any]:
    """Run a plan, as with ``--force``."""
    return run(config, way, out, more.get("go_on", lambda cycles, falls: True), "test")[1]


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

    def fails(config: RunConfig, out: Path, *others: Any) -> None:
        assert not (out / SUMMARY).exists()
        (out / "cycles.csv").write_text("cycle,module\n")
        (out / TABLE).write_text("half")
        raise ParameterError("it cannot begin")

    monkeypatch.setattr(ember_ros.run, "_loop", fails)
    with pytest.raises(ParameterError, match="cannot begin"):
        go(tmp_path)
    assert files(tmp_path) == before


class Killed(BaseException):
    """A ``kill -9`` at some point: nothing is tidied up behind it."""


def killed_after(monkeypatch: pytest.MonkeyPatch, moves: int) -> None:
    """Have a run die after so many moves of files, its clean-up included."""
    left = moves

    def move(call: Callable[..., Any]) -> Callable[..., Any]:
        def go(*args: Any, **kw: Any) -> Any:
            nonlocal left
            if left <= 0:
                raise Killed
            left -= 1
            return call(*args, **kw)

        return go

    for name in ("replace", "rename", "unlink", "rmdir", "mkdir"):
        monkeypatch.setattr(Path, name, move(getattr(Path, name)))


@pytest.mark.parametrize("table", [False, True])
def test_a_kill_at_any_point_before_the_first_cycle_costs_nothing_of_the_earlier_run(
    tmp_path: Path, table: bool
) -> None:
    """While it is set aside, while the new one begins, and while it comes back, again and again."""
    earlier, tried = tmp_path / "earlier", 0
    go(earlier)
    before = files(earlier)
    start = earlier / TABLE if table else None

    def begins(config: RunConfig, out: Path, *others: Any) -> None:
        (out / "cycles.csv").write_text("cycle,module\n")
        (out / TABLE).write_bytes(b"half")
        raise ParameterError("it cannot begin")

    for moves in range(60):
        out = tmp_path / str(moves)
        shutil.copytree(earlier, out)
        config = RunConfig("trainer", 3, seed=1, table=out / TABLE if start else None)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ember_ros.run, "_loop", begins)
            killed_after(patch, moves)
            with pytest.raises((Killed, ParameterError)) as ended:
                go(out, config)
        for again in (3, 1):  # two more are killed, while they bring it back
            with pytest.MonkeyPatch.context() as patch:
                killed_after(patch, again)
                with suppress(Killed):
                    recover(out)
        recover(out)
        assert files(out) == before, moves
        tried = moves
        if ended.type is ParameterError:
            break
    assert 15 < tried < 59  # it was killed everywhere, and then not at all


def test_what_a_killed_run_had_set_aside_goes_once_it_had_begun(tmp_path: Path) -> None:
    """Its own first cycle is more than what it replaced: it is not brought back over it."""
    go(tmp_path)
    now = files(tmp_path)
    (tmp_path / EARLIER).mkdir()
    (tmp_path / EARLIER / SUMMARY).write_text("older")
    with pytest.raises(ParameterError, match="no policy"):
        go(tmp_path, RunConfig("trainer", 1, policy="none"))
    assert files(tmp_path) == now


def test_a_run_that_is_stopped_before_its_first_cycle_replaces_nothing(tmp_path: Path) -> None:
    """It says so; where there was no earlier one, it is a run of no cycles."""
    go(tmp_path)
    before = files(tmp_path)
    with pytest.raises(StoppedError, match="is as it was"):
        go(tmp_path, go_on=lambda cycles, falls: False)
    assert files(tmp_path) == before
    told = go(tmp_path / "new", go_on=lambda cycles, falls: False)
    assert told["cycles"] == 0


@pytest.mark.parametrize("name", ["cycles.csv", "summary.json", TABLE])
def test_a_folder_where_a_file_will_be_is_said_and_stays(tmp_path: Path, name: str) -> None:
    """It is nobody's but the user's."""
    (tmp_path / name).mkdir()
    (tmp_path / name / "mine").write_text("mine")
    with pytest.raises(ParameterError, match=rf"{name} is a folder"):
        go(tmp_path)
    assert (tmp_path / name / "mine").read_text() == "mine"
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_a_run_replaces_the_earlier_one(tmp_path: Path) -> None:
    """Nothing of it is left over."""
    go(tmp_path)
    (tmp_path / "run.png").write_text("the earlier one's")
    told = go(tmp_path, RunConfig("trainer", 2, seed=2))
    assert told["cycles"] == 2
    assert not (tmp_path / EARLIER).exists()
    assert not (tmp_path / "run.png").exists()


def test_a_run_may_start_from_the_table_that_it_replaces(tmp_path: Path) -> None:
    """``--table out/train/table.npz --out out/train --force`` goes on from what was learnt."""
    go(tmp_path)
    before = load_table(tmp_path / TABLE, CONFIG.params)[0].visits.sum()
    go(tmp_path, RunConfig("trainer", 3, seed=1, table=tmp_path / TABLE))
    after = load_table(tmp_path / TABLE, CONFIG.params)[0].visits.sum()
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
        visits.append(int(load_table(tmp_path / TABLE, CONFIG.params)[0].visits.sum()))
        return True

    saved = go(tmp_path, go_on=look)
    ticks = CONFIG.params.gait.ticks
    assert visits == [0, ticks - 1, 2 * ticks - 1]
    monkeypatch.setattr(ember_ros.run, "CHECKPOINT_S", 1e9)
    assert go(tmp_path)["table_sha256"] == saved["table_sha256"]
