"""``import ember_ros as er``: the loop's bits as arrays, parts by class, runs saved and read."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import ember_ros as er
from ember_ros.arrays import Ticks
from ember_ros.cli.run import config_from_options
from ember_ros.errors import MissingError, ParameterError, RunError, TableError
from ember_ros.loop import Loop
from ember_ros.params import LearningParams, params_sha256, replace
from ember_ros.params_file import load_params
from ember_ros.report.run_statistics import RunStatistics
from ember_ros.run import run
from ember_ros.run_config import RunConfig
from ember_ros.shipped import DATA
from leg_node.discretizer import PaperDiscretizer
from leg_node.learner import QLearning
from leg_node.reward import PaperReward
from leg_node.table import Table
from leg_node.table_file import save_table
from sim_node.fake import FakeWorld

ROOT = Path(__file__).resolve().parents[1]
BULLET = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is missing")
FALL = 70
"""The tick at which the fake world finds the robot put back on its feet."""


class Ground(FakeWorld):
    """A world without physics in which the robot falls once."""

    def __init__(self, params: er.Params, *, seed: int = 0, gui: bool = False) -> None:
        super().__init__(params=params, falls_at=(FALL,))


class Bench(Ground):
    """The same, for learning as on the trainer."""

    stage = "train"


class Softly(PaperReward):
    """A reward of one's own."""

    names = (*PaperReward.names, "softly")

    def terms(self, sense: er.LegSense, as_stance: bool) -> dict[str, float]:
        return {**super().terms(sense, as_stance), "softly": -0.01 * sense.force_peak}


class Coarse:
    """A discretizer that names no axes."""

    shape = (3, 2)
    neighbours = (True, False)

    def __init__(self, params: er.Params) -> None:
        pass

    def index(self, sense: er.LegSense, stance: bool) -> int:
        return 2 * min(2, max(0, int(sense.knee * 2.0))) + stance


class Misnamed(PaperDiscretizer):
    """A discretizer with fewer names than axes."""

    names = ("hip", "force")  # type: ignore[assignment]


class Double(QLearning):
    """A learner of two tables, of which it uses the first."""

    tables = 2

    def __init__(
        self,
        estimates: Sequence[er.ValueEstimate],
        learning_params: LearningParams,
        shape: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        super().__init__(estimates[:1], learning_params, shape, rng)


class Still:
    """A policy that always takes the last action."""

    def __init__(self, params: er.Params, *others: Any) -> None:
        self._last = len(params.leg.knee_speeds) - 1

    def choose(self, sense: er.LegSense, gait: er.GaitStep, state: int) -> int:
        return self._last


class Tick(NamedTuple):
    """What a loop says of a tick."""

    beat: er.Beat
    senses: Sequence[er.LegSense]
    commands: Sequence[er.LegCommand]
    body: er.BodyState
    transitions: Sequence[er.Transition]


class Listener:
    """Keeps what a loop says as it says it."""

    def __init__(self) -> None:
        self.received: list[Tick] = []

    def tick(self, *said: Any) -> None:
        self.received.append(Tick(*said))


def by_hand(config: RunConfig) -> tuple[list[Tick], RunStatistics, Table]:
    """Run a plan by the loop; return what it said, its record and its table."""
    loop, recorder, listener = Loop(config), RunStatistics(config.params, config.legs), Listener()
    for _ in range(config.cycles * config.params.gait.ticks):
        loop.tick(recorder, listener)
    table = loop.finish()
    recorder.finish(loop.world.observe(), loop.world.body())
    loop.close()
    return listener.received, recorder, table


def walked(cycles: int = 4, **options: Any) -> er.Run:
    """Walk in the fake world."""
    return er.walk(**{"cycles": cycles, "world": Ground, "progress": False, **options})


def hashes(summary: dict[str, Any]) -> dict[str, Any]:
    """Return all of a summary but what hangs on the clock."""
    return {name: said for name, said in summary.items() if name not in ("wall_s", "ticks_per_s")}


@pytest.fixture(scope="module")
def long() -> tuple[er.Run, list[Tick], RunStatistics, Table]:
    """A walk over a fall, and the same by hand."""
    done = walked(seed=3, policy="random", learning=True)
    return done, *by_hand(done.config)


def test_a_run_is_the_loops_to_the_bit(
    long: tuple[er.Run, list[Tick], RunStatistics, Table],
) -> None:
    """Hashes of all signals, lines a cycle and table are those of the loop run by hand."""
    done, _, recorder, table = long
    assert hashes(done.summary) == hashes(recorder.summary())
    assert done.record.rows == recorder.rows
    assert done.table.sha256 == table.sha256()
    assert done.summary["falls"] == 1


def test_arrays_say_what_the_loop_said(
    long: tuple[er.Run, list[Tick], RunStatistics, Table],
) -> None:
    """Every number of every tick, by the tick that it is about."""
    done, received, recorder, _ = long
    for name in er.LegSense._fields[1:]:
        said = [[getattr(sense, name) for sense in tick.senses] for tick in received]
        assert np.array_equal(getattr(done.senses, name), said), name
    for name in er.LegCommand._fields[1:]:
        said = [[getattr(command, name) for command in tick.commands] for tick in received]
        assert np.array_equal(getattr(done.commands, name), said), name
    assert done.states.tolist() == [
        [transition.next_state for transition in t.transitions] for t in received
    ]
    assert done.stances.tolist() == [
        [transition.next_stance for transition in t.transitions] for t in received
    ]
    speeds = np.array(done.params.leg.knee_speeds)
    assert np.array_equal(speeds[done.actions], done.commands.knee_speed)
    assert done.phases.tolist() == [tick.beat.phase for tick in received]
    assert done.body.height.tolist() == [tick.body.height for tick in received]
    assert done.body.falls.tolist() == [tick.body.falls for tick in received]
    pose = done.body
    pose_columns = (pose.x, pose.y, pose.roll, pose.pitch, pose.yaw)
    assert [number for row in np.stack(pose_columns, 1).tolist() for number in row] == list(
        recorder.traces
    )
    # What a transition says is about the tick before.
    for tick, (_, _, _, _, transitions) in enumerate(received[1:]):
        for leg, transition in enumerate(transitions):
            assert done.credited[tick, leg] == transition.credited
            assert done.reward[tick, leg] == transition.reward
            assert done.td_errors[tick, leg] == transition.td_error
            assert {n: each[tick, leg] for n, each in done.rewards.items()} == dict(
                transition.terms
            )
            if transition.credited:
                assert done.actions[tick, leg] == transition.action
                assert done.states[tick, leg] == transition.state
                assert done.stances[tick, leg] == transition.stance
    uncredited = np.flatnonzero(~done.credited.any(axis=1)).tolist()
    assert uncredited == [FALL - 1, len(received) - 1]
    assert np.flatnonzero(done.senses.first_tick.any(axis=1)).tolist() == [FALL]
    assert not done.reward[~done.credited].any()


def columns(run: er.Run) -> dict[str, tuple[np.ndarray[Any, Any], tuple[int, ...]]]:
    """Return every array of a run by its name, with the shape that it should have."""
    ticks = run.config.cycles * run.params.gait.ticks
    both = (ticks, len(run.legs))
    found: dict[str, tuple[np.ndarray[Any, Any], tuple[int, ...]]] = {}
    for group, shape in (("senses", both), ("commands", both), ("body", (ticks,))):
        values = getattr(run, group)
        for each in dataclasses.fields(values):
            found[f"{group}.{each.name}"] = (getattr(values, each.name), shape)
    for name, values in run.rewards.items():
        found[f"rewards.{name}"] = (values, both)
    for name in ("reward", "credited", "states", "actions", "stances", "td_errors"):
        found[name] = (getattr(run, name), both)
    found["phases"] = (run.phases, (ticks,))
    return found


@pytest.mark.parametrize("cycles", [0, 2])
def test_every_array_has_its_shape_and_type_and_keeps_it(cycles: int) -> None:
    """(ticks, legs) or (ticks,), of 64 bits or bool, and read-only; without a tick as well."""
    whole = {"states", "actions", "body.falls"}
    truths = {"senses.hair", "senses.contact", "senses.first_tick", "credited", "stances"}
    done = walked(cycles)
    assert len(done.legs) == 4
    for name, (values, shape) in columns(done).items():
        kind = np.int64 if name in whole else np.bool_ if name in truths else np.float64
        assert (values.shape, values.dtype) == (shape, kind), name
        assert not values.flags.writeable, name
    assert {each.name for each in dataclasses.fields(Ticks)} <= set(dir(er.Run))


def test_a_run_is_frozen_and_tells_itself_in_three_lines() -> None:
    """World, cycles and hashes, and no array."""
    done = walked(2, seed=5)
    with pytest.raises(dataclasses.FrozenInstanceError):
        done.config = None  # type: ignore[misc,assignment]
    lines = repr(done).splitlines()
    assert len(lines) == 3
    assert lines[0].startswith("Run in ")
    assert "2 cycles, legs 4, seed 5, policy learned, learning" in lines[0]
    assert done.table.sha256[:12] in lines[2]
    assert "hip: float64 (64, 4)" in repr(done.senses)
    assert "17 hip x 8 force x 8 inclination x 2 swing x 2 hair x 9 action" in repr(done.table)


@BULLET
def test_train_and_walk_are_the_loop_in_both_worlds(tmp_path: Path) -> None:
    """From nothing, and from what was learnt: the run, its table, its file: the same bits."""
    trained = er.train(3, seed=2, progress=False)
    _, recorder, table = by_hand(RunConfig("trainer", 3, seed=2))
    assert hashes(trained.summary) == hashes(recorder.summary())
    assert trained.table.sha256 == table.sha256()
    file = tmp_path / "table.npz"
    save_table(file, table, trained.params, 2)
    _, recorder, table = by_hand(RunConfig("walker", 2, seed=4, table=file))
    for start in (trained, trained.table, file, str(file)):
        done = er.walk(start, 2, 4, progress=False)
        assert hashes(done.summary) == hashes(recorder.summary())
        assert done.table.sha256 == table.sha256()


def test_params_are_laid_one_on_the_other(tmp_path: Path) -> None:
    """Files by name and path, dicts, numpy's numbers; a Params below them; the later wins."""
    file = tmp_path / "mine.yaml"
    file.write_text("/**: {ros__parameters: {walker: {mass: 6.0, radius: 0.19}}}\n")
    plain = load_params("plain", "narrow")
    assert er.make_params() == er.Params()
    assert er.make_params("plain", "narrow") == plain
    mixed = er.make_params("plain", {"walker.mass": np.float64(4.0)}, file, "narrow")
    assert mixed == replace(plain, {"walker.mass": 6.0, "walker.radius": 0.19})
    speeds = np.array([-7.0, 0.0, 7.0])
    own = er.make_params(plain, str(file), {"leg.knee_speeds": speeds, "train.smooth_every": 2})
    assert own.leg.knee_speeds == (-7.0, 0.0, 7.0)
    assert own.walker.mass == 6.0
    for given in ({"walker.mass": 4.0}, [{"walker.mass": 5.5}, {"walker.mass": 4.0}]):
        assert walked(0, params=given).params == replace(er.Params(), {"walker.mass": 4.0})
    assert walked(0, params="hexapod").legs == load_params("hexapod").robot.legs


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"params": {"walker.mas": 4.0}}, r"no parameter 'walker\.mas'; did you mean walker\.mass"),
        ({"params": {"walker.mass": -1}}, r"walker\.mass = -1 is out of range"),
        ({"params": {3: 4.0}}, r"params: 3 is no parameter name"),
        ({"params": "nowhere"}, r"cannot read the parameter file nowhere.* hexapod"),
        ({"params": [4]}, r"params = 4: a Params, a dict of full names"),
        ({"params": ["plain", er.Params()]}, r"a Params has all parameters, so it must be"),
        ({"cycles": 2.5}, r"cycles = 2\.5 must be a whole number"),
        ({"seed": -1}, r"seed = -1"),
        ({"reward": PaperReward(er.Params())}, r"reward = .* is neither a class nor the dotted"),
        ({"reward": "Mine"}, r"parts\.reward must be a dotted path"),
        ({"reward": "nowhere.Mine"}, r"parts\.reward = 'nowhere\.Mine': there is no module"),
        ({"reward": PaperDiscretizer}, r"makes a PaperDiscretizer without terms; a reward has"),
        ({"discretizer": PaperReward}, r"parts\.discretizer = .* without shape, neighbours, index"),
        ({"policy": Coarse}, r"policy = .* cannot be made: .*positional"),
        ({"policy": "lerned"}, r"there is no policy 'lerned'"),
        ({"world": Coarse}, r"world = .* cannot be made: "),
        ({"world": "moon"}, r"there is no world 'moon'"),
        ({"cpg": "__main__.Nothing"}, r"__main__\.Nothing' cannot be used: what a notebook"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(options: dict[str, Any], why: str) -> None:
    """A name, a value, a type or a class that does not fit: what, and what would be right."""
    with pytest.raises(ParameterError, match=why):
        walked(**{"cycles": 1, **options})


def test_a_class_is_named_by_its_path() -> None:
    """It stands in the parameters and their hash, as if it had been written into a file."""
    done = walked(2, reward=Softly)
    assert done.params.parts.reward == f"{__name__}.Softly"
    assert params_sha256(done.params) != params_sha256(er.Params())
    written = walked(2, params={"parts.reward": f"{__name__}.Softly"})
    assert hashes(written.summary) == hashes(done.summary)
    assert tuple(done.rewards) == Softly.names
    touched = done.credited[:-1]
    assert np.array_equal(
        done.rewards["softly"][:-1], np.where(touched, -0.01 * done.senses.force_peak[1:], 0.0)
    )


def test_a_class_that_cannot_be_found_again_is_refused() -> None:
    """Of a function, or defined anew since."""

    class Inner(PaperReward):
        pass

    with pytest.raises(ParameterError, match=r"at the top level of a module or notebook"):
        walked(1, reward=Inner)
    older = type("Softly", (PaperReward,), {"__module__": __name__})
    with pytest.raises(ParameterError, match=r"reward = .* is not the present value of .*Softly"):
        walked(1, reward=older)


def test_every_part_can_be_a_class() -> None:
    """World, policy and learner of one's own; the world says which learning parameters hold."""
    done = walked(2, world=Bench, policy=Still, learner=Double, discretizer=Coarse)
    assert (done.config.stage, done.config.learning) == ("train", True)
    assert (done.actions == len(done.params.leg.knee_speeds) - 1).all()
    assert done.states.max() < 6
    assert not walked(1, policy="scripted").config.learning
    assert walked(1, policy="scripted", learning=True).config.learning


@pytest.mark.parametrize(
    ("policy", "learns"),
    [("learned", True), ("scripted", False), ("random", False), (f"{__name__}.Still", True)],
)
def test_a_policy_learns_by_default_alike_in_python_and_on_the_command_line(
    policy: str, learns: bool
) -> None:
    """All but those that choose without the table; a word about it is heeded by both."""

    def by_options(learning: bool | None) -> RunConfig:
        return config_from_options(
            "walker",
            cycles=1,
            seed=0,
            params_files=(),
            settings=(),
            table=None,
            resume=None,
            learning=learning,
            policy=policy,
        )

    assert walked(1, policy=policy).config.learning is learns
    assert by_options(None).learning is learns
    for learning in (True, False):
        assert walked(1, policy=policy, learning=learning).config.learning is learning
        assert by_options(learning).learning is learning


def test_a_table_brings_its_parameters(tmp_path: Path) -> None:
    """A run goes on as it was learnt, by memory or by file; a dict lies on top of that."""
    first = walked(2, reward=Softly, params={"walker.mass": 4.0})
    first.save(tmp_path / "first")
    file = tmp_path / "first" / "table.npz"
    for start in (first, first.table, file):
        done = walked(1, table=start, params={"walker.length": 1.0})
        assert done.params == replace(first.params, {"walker.length": 1.0})
        assert done.start_sha256 == first.table.sha256
        assert (done.table.visits >= first.table.visits).all()
    frozen = walked(1, table=first, learning=False)
    assert frozen.table.sha256 == first.table.sha256


def test_a_table_of_another_meaning_is_refused(tmp_path: Path) -> None:
    """Other knee speeds, parts or bins: by memory and by file, with the same words."""
    first = walked(1)
    first.save(tmp_path)
    for start in (first, tmp_path / "table.npz"):
        for options in (
            {"params": {"state.hip_low": -0.6}},
            {"params": {"leg.load": 20.0}},
            {"reward": Softly},
        ):
            with pytest.raises(TableError, match=r"was learnt with another partition of the state"):
                walked(1, table=start, **options)


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ("nowhere.npz", r"there is no table nowhere\.npz"),
        (4, r"table = 4: a path, a run, a QTable or None would be right"),
        (__file__, r"is not a whole ember_ros table"),
    ],
)
def test_a_table_that_is_none_is_named(table: Any, why: str) -> None:
    """No file, no table, or nothing that could be one."""
    with pytest.raises(TableError, match=why):
        walked(1, table=table)


def test_a_table_comes_by_the_name_it_has_in_the_package() -> None:
    """Its name will do, from any folder."""
    assert walked(0, table="trained").start_sha256 == er.QTable.load(DATA / "trained.npz").sha256


def test_the_table_has_the_axes_of_its_discretizer() -> None:
    """Values and visits are the learner's cells in their order; names where there are any."""
    done = walked(3)
    table = done.table
    assert table.axes == ("hip", "force", "inclination", "swing", "hair", "action")
    assert table.q.shape == table.visits.shape == (17, 8, 8, 2, 2, 9)
    assert table.q.dtype == np.float64
    assert table.visits.dtype == np.int64
    assert not table.q.flags.writeable
    assert table.visits.sum() == done.credited.sum()
    counted = np.zeros((17 * 8 * 8 * 2 * 2, 9), dtype=np.int64)
    np.add.at(counted, (done.states[done.credited], done.actions[done.credited]), 1)
    assert np.array_equal(table.visits.reshape(counted.shape), counted)
    best = table.best_action
    assert best.shape == (17, 8, 8, 2, 2)
    known = table.visits.sum(-1) > 0
    assert (best[~known] == -1).all()
    assert np.array_equal(best[known], table.q[known].argmax(-1))
    coarse = walked(1, discretizer=Coarse, learner=Double).table
    assert coarse.axes == ("table", "axis_0", "axis_1", "action")
    assert coarse.q.shape == (2, 3, 2, 9)
    assert coarse.best_action.shape == (3, 2)
    assert not coarse.visits[1].any()


def test_a_table_of_the_wrong_size_or_content_is_refused() -> None:
    """Somebody may put one together: it is held as a file is."""
    table = walked(0).table
    for change, why in (
        ({"q": table.q[:-1]}, r"q is float64 \(16, 8, 8, 2, 2, 9\); these parameters need float64"),
        ({"visits": table.q}, r"visits is float64 .* need int64"),
        ({"q": table.q + np.inf}, r"not finite"),
        ({"visits": table.visits - 1}, r"under 0"),
    ):
        with pytest.raises(TableError, match=why):
            dataclasses.replace(table, **change)
    own = dataclasses.replace(table, q=table.q + 1.0)
    assert walked(0, table=own).table.sha256 == own.sha256
    with pytest.raises(TableError, match=r"a table of 4 cells"):
        er.QTable.of(Table(2, 2), er.Params())
    with pytest.raises(TableError, match=r"names 2 axes, \('hip', 'force'\); a name for each of 5"):
        walked(0, discretizer=Misnamed)


def test_a_saved_run_is_what_ember_leaves(tmp_path: Path) -> None:
    """The same files with the same bytes, but for the clock and what was typed."""
    done = walked(3, seed=1)
    done.save(tmp_path / "face")
    run(done.config, "loop", tmp_path / "ember", lambda cycles, falls: True, "ember walk")
    names = sorted(file.name for file in (tmp_path / "face").iterdir())
    assert names == sorted(file.name for file in (tmp_path / "ember").iterdir())
    assert {"table.npz", "cycles.csv", "summary.json", "traces.npy"} <= set(names)
    for name in ("cycles.csv", "traces.npy"):
        one, other = ((tmp_path / way / name).read_bytes() for way in ("face", "ember"))
        assert one == other, name
    one, other = (
        json.loads((tmp_path / way / "summary.json").read_text()) for way in ("face", "ember")
    )
    assert list(one) == list(other)
    for summary in (one, other):
        for name in ("wall_s", "ticks_per_s", "command", "provenance"):
            del summary[name]
    assert one == other
    with np.load(tmp_path / "face" / "table.npz") as a, np.load(tmp_path / "ember/table.npz") as b:
        assert {name: a[name].tobytes() for name in a} == {name: b[name].tobytes() for name in b}


def test_saving_replaces_nothing_unasked(tmp_path: Path) -> None:
    """As ``ember train`` without ``--force``."""
    first, second = walked(1, seed=1), walked(1, seed=2)
    first.save(tmp_path)
    with pytest.raises(ParameterError, match=r"holds an earlier run"):
        second.save(tmp_path)
    assert er.load(tmp_path).config.seed == 1
    second.save(str(tmp_path), replace=True)
    assert er.load(tmp_path).config.seed == 2
    assert not list(tmp_path.glob(".*"))
    (tmp_path / "file").write_text("")
    with pytest.raises(ParameterError, match=r"cannot create the folder"):
        first.save(tmp_path / "file")


def test_an_earlier_run_comes_back_where_a_new_one_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk costs nothing that was there."""
    first, second = walked(1, seed=1), walked(1, seed=2)
    first.save(tmp_path)

    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ember_ros.run.save_record", full)
    with pytest.raises(ParameterError, match=r"cannot write into .*No space left"):
        second.save(tmp_path, replace=True)
    assert er.load(tmp_path).config.seed == 1


def test_a_saved_run_is_read_again(tmp_path: Path) -> None:
    """Plan, table, lines, pose and summary; for the rest, why it is not there."""
    first = walked(3, seed=1, params={"walker.mass": 4.0}, reward=Softly)
    first.save(tmp_path / "first")
    done = walked(2, seed=2, table=tmp_path / "first" / "table.npz")
    done.save(tmp_path / "second")
    for made, folder in ((first, "first"), (done, "second")):
        again = er.load(tmp_path / folder)
        assert again.config == made.config
        assert again.table.sha256 == made.table.sha256
        assert again.summary == made.summary
        assert again.record.rows == made.record.rows
        for name in ("x", "y", "roll", "pitch", "yaw"):
            assert np.array_equal(getattr(again.body, name), getattr(made.body, name))
        assert again.cycles.equals(made.cycles)
        assert repr(again).splitlines()[1:] == repr(made).splitlines()[1:]
    for name in ("senses", "rewards", "ticks", "save"):
        with pytest.raises(AttributeError, match=rf"{name}'.* the Run that train\(\) or walk\(\)"):
            getattr(again, name)
    with pytest.raises(AttributeError, match=r"'SavedRun' object has no attribute 'nothing'$"):
        getattr(again, "nothing")  # noqa: B009  a type checker would see it
    assert walked(1, table=again).start_sha256 == done.table.sha256


def test_a_folder_without_a_whole_run_is_named(tmp_path: Path) -> None:
    """No folder, a file missing, or one damaged."""
    with pytest.raises(RunError, match=r"nowhere holds no finished run: .*No such file"):
        er.load(tmp_path / "nowhere")
    walked(1).save(tmp_path / "run")
    (tmp_path / "run" / "summary.json").write_text("{}")
    with pytest.raises(RunError, match=r"holds a run that cannot be read: 'start_table'"):
        er.load(tmp_path / "run")


def test_cycles_are_the_lines_of_the_file(tmp_path: Path) -> None:
    """The data frame has the columns and values of ``cycles.csv``; what is empty there is NaN."""
    pytest.importorskip("pandas")
    done = walked(3)
    done.save(tmp_path)
    with (tmp_path / "cycles.csv").open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    frame = done.cycles
    assert list(frame.columns) == list(lines[0])
    assert len(frame) == len(lines) == 3 * 5
    for name in frame.columns:
        written = [line[name] for line in lines]
        if name == "module":
            assert list(frame[name]) == written
        else:
            values = [float(each) if each else np.nan for each in written]
            assert np.array_equal(frame[name].to_numpy(), values, equal_nan=True), name
            assert frame[name].dtype in (np.int64, np.float64), name


def test_without_pandas_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """And where the same numbers are without it."""
    done = walked(1)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingError, match=r"pandas is not installed.*`pip install pandas`"):
        _ = done.cycles
    with pytest.raises(MissingError, match=r"matplotlib is not installed"):
        done.plot()


def test_a_run_is_drawn_as_ember_draws_it(tmp_path: Path) -> None:
    """A Figure with the two panels, of which a notebook can ask the picture."""
    from matplotlib.figure import Figure

    for world, title in ((Ground, "Walker: path"), (Bench, "Trainer")):
        figure = walked(2, world=world).plot()
        assert isinstance(figure, Figure)
        assert len(figure.axes) == 2
        assert figure.axes[0].get_title(loc="left").startswith(title)
        assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    with pytest.raises(RunError, match=r"no whole cycle"):
        walked(0).plot()


def child(code: str, *args: str) -> str:
    """Return what a script prints in a Python of its own."""
    done = subprocess.run(
        [sys.executable, "-c", code, *args],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'test'}"},
        check=False,
        timeout=300.0,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_loads_nothing_of_weight() -> None:
    """No numpy and no module of ours: every node does it."""
    code = (
        "import sys\n"
        "before = set(sys.modules)\n"
        "import ember_ros\n"
        "print(*sorted(set(sys.modules) - before))\n"
    )
    loaded = child(code).split()
    assert "ember_ros" in loaded
    heavy = ("numpy", "matplotlib", "pandas", "pybullet", "rclpy", "yaml", "importlib.metadata")
    assert [n for n in loaded if n.startswith((*heavy, "ember_ros.", "leg_node", "sim_node"))] == []


def test_every_name_is_there_without_what_may_be_missing() -> None:
    """All names are found, listed, and kept, in a Python without matplotlib, pandas and ROS."""
    code = (
        "import importlib.abc, sys\n"
        "hidden = {'matplotlib', 'pandas', 'pybullet', 'rclpy', 'IPython', 'mcap', 'rosbags'}\n"
        "class Wall(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in hidden:\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Wall())\n"
        "import ember_ros as er\n"
        "assert set(er.__all__) <= set(dir(er))\n"
        "for name in er.__all__:\n"
        "    assert getattr(er, name).__name__ == name, name\n"
        "    assert name in vars(er)\n"
        "print(len(er.__all__), er.__version__ != '')\n"
    )
    assert child(code).split() == [str(len(er.__all__)), "True"]
    with pytest.raises(AttributeError, match=r"module 'ember_ros' has no attribute 'nothing'"):
        getattr(er, "nothing")  # noqa: B009  a type checker would see it


def test_no_name_is_hidden_by_a_module() -> None:
    """``import ember_ros.run`` puts a module into the package: none may have one of our names."""
    modules = {file.stem for file in (ROOT / "ember_ros").iterdir()}
    assert not modules & set(er.__all__)


@pytest.mark.slow
def test_a_class_of_a_notebook_works_in_its_own_process(tmp_path: Path) -> None:
    """``__main__.Mine``: it runs and is saved; another process can read it, and not go on."""
    pytest.importorskip("pandas")
    code = (
        "import sys\n"
        "import ember_ros as er\n"
        "from leg_node.reward import PaperReward\n"
        "from test_face import Ground\n"
        "class Mine(PaperReward): pass\n"
        "done = er.walk(cycles=1, world=Ground, reward=Mine, progress=False)\n"
        "done.save(sys.argv[1])\n"
        "print(done.params.parts.reward, done.table.sha256)\n"
    )
    path, sha = child(code, str(tmp_path / "out")).split()
    assert path == "__main__.Mine"
    code = (
        "import sys\n"
        "import ember_ros as er\n"
        "again = er.load(sys.argv[1])\n"
        "print(again.table.sha256, len(again.cycles))\n"
        "try:\n"
        "    er.walk(again, cycles=1, world='test_face.Ground')\n"
        "except er.EmberError as error:\n"
        "    print(error)\n"
    )
    read, why = child(code, str(tmp_path / "out")).splitlines()
    assert read == f"{sha} 5"
    assert why.startswith("parts.reward = '__main__.Mine' cannot be used: what a notebook")


def test_progress_is_told_where_it_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    """By what ``ember`` shows it with: every cycle that begins, with the falls so far."""
    told: list[tuple[Any, ...]] = []

    @contextmanager
    def progress(*what: Any) -> Iterator[Callable[..., None]]:
        told.append(what)
        yield lambda *how: told.append(how)

    monkeypatch.setattr("ember_ros.terminal.progress", progress)
    walked(4)
    assert told == []
    walked(4, progress=True)
    falls = [0, 0, 0, 1]
    cycles = [(n, f"{n}/4 cycles, {fallen} falls") for n, fallen in enumerate(falls)]
    assert told == [("walking", 4), *cycles]


NOTEBOOK = ROOT / "examples" / "notebook.ipynb"


def test_the_notebook_is_short_and_bare() -> None:
    """At most 20 lines of code, and no outputs that would go stale."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    lines = [line for cell in code for line in "".join(cell["source"]).splitlines() if line.strip()]
    assert 10 < len(lines) <= 20
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)


@BULLET
@pytest.mark.skipif(
    find_spec("nbclient") is None or find_spec("ipykernel") is None,
    reason="nbclient or ipykernel is missing",
)
@pytest.mark.slow
def test_the_notebook_runs_and_shows_its_figures() -> None:
    """In a kernel of its own: three pictures, and figures of both rewards over three seeds."""
    code = (
        "import json, sys, nbclient, nbformat\n"
        "book = nbformat.read(sys.argv[1], 4)\n"
        "nbclient.NotebookClient(book, timeout=240, kernel_name='python3').execute()\n"
        "told = [each.get('data', {}) for cell in book.cells for each in cell.get('outputs', [])]\n"
        "print(json.dumps([sorted(each) for each in told]))\n"
        "print(told[-1]['text/plain'])\n"
    )
    kinds, figures = child(code, str(NOTEBOOK)).split("\n", 1)
    assert [("image/png" in each) for each in json.loads(kinds)] == [True, True, True, False]
    assert figures.count(",") == 5
