"""The machine without ROS: the same plan gives the same bits, and what was learnt comes home."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ember_ros.errors import ParameterError, TableError
from ember_ros.loop import Loop
from ember_ros.params import TRAINER_LEG, Params, replace
from ember_ros.params_file import load_params
from ember_ros.report.run_statistics import RunStatistics
from ember_ros.run_config import RunConfig
from ember_ros.signals import LegSense
from ember_ros.worlds import make_world
from leg_node.assembly import empty_table
from leg_node.table_file import save_table
from sim_node.fake import FakeWorld
from support.gaits import ReferenceGait
from support.learning import reference_table
from support.legs import LEGS, beat
from support.needs import needs_bullet
from support.runs import SignalLog

PARAMS = load_params("plain")
TICKS = PARAMS.gait.ticks
EAGER = replace(PARAMS, {"walk.epsilon_start": 0.3, "walk.epsilon_end": 0.3})

bullet_worlds = [pytest.param(where, marks=needs_bullet) for where in ("trainer", "walker")]
every_world = pytest.mark.parametrize("where", ["fake", *bullet_worlds])
two_worlds = pytest.mark.parametrize("where", ["fake", bullet_worlds[1]])


class Ran(NamedTuple):
    """What came of a run."""

    table: str
    senses: str
    commands: str
    visits: int
    summary: dict[str, Any]

    @property
    def bits(self) -> tuple[str, str, str]:
        """The three hashes that two equal runs agree in."""
        return self.table, self.senses, self.commands


@contextmanager
def looping(where: str, cycles: int, **config: Any) -> Iterator[Loop]:
    """Give a loop in a world, the fake one with a fall now and then, and close it."""
    world = None
    if where == "fake":
        world = FakeWorld(LEGS, config.get("params", PARAMS), falls_at={50, 51, 200})
    loop = Loop(RunConfig("trainer" if where == "trainer" else "walker", cycles, **config), world)
    try:
        yield loop
    finally:
        loop.close()


def run(where: str, cycles: int, *, extra: int = 0, **config: Any) -> Ran:
    """Run a plan, and some ticks more, and bring everything home."""
    with looping(where, cycles, **config) as loop:
        recorder = RunStatistics(config.get("params", PARAMS), loop.world.legs)
        for _ in range(cycles * TICKS + extra):
            loop.tick(recorder)
        recorder.finish(loop.world.observe(), loop.world.body())
        table, summary = loop.finish(), recorder.summary()
        return Ran(
            table.sha256(),
            summary["senses_sha256"],
            summary["commands_sha256"],
            int(table.visits.sum()),
            summary,
        )


# -- determinism ---------------------------------------------------------------------------------


@every_world
@pytest.mark.parametrize("policy", ["learned", "scripted", "random"])
def test_the_same_plan_gives_the_same_bits(where: str, policy: str) -> None:
    """Table, senses and commands of two runs have the same three hashes."""
    assert run(where, 8, policy=policy, seed=3).bits == run(where, 8, policy=policy, seed=3).bits


@every_world
def test_another_seed_gives_other_bits(where: str) -> None:
    """All three hashes differ: the seed reaches what is done, so what is sensed and learnt."""
    one, other = run(where, 4, seed=1), run(where, 4, seed=2)
    assert all(a != b for a, b in zip(one.bits, other.bits, strict=True))


@needs_bullet
def test_a_modulated_trainer_is_as_deterministic() -> None:
    """The world's own random numbers come from the run's seed too."""
    params = replace(PARAMS, {"trainer.modulation": 0.05})
    runs = [run("trainer", 6, params=params, policy="scripted", seed=s) for s in (5, 5, 6)]
    assert runs[0].bits == runs[1].bits
    assert runs[0].senses != runs[2].senses


@every_world
def test_nobody_is_disturbed_by_being_watched(where: str) -> None:
    """With an observer or without: the same table."""
    with looping(where, 4, seed=1) as loop:
        for _ in range(4 * TICKS):
            loop.tick()
        assert loop.finish().sha256() == run(where, 4, seed=1).table


@every_world
def test_two_loops_in_turn_are_two_loops(where: str) -> None:
    """Ticked in turn in one process, two robots end as each does alone."""
    with looping(where, 4, seed=1) as one, looping(where, 4, seed=2) as other:
        for _ in range(4 * TICKS):
            one.tick()
            other.tick()
        assert one.finish().sha256() == run(where, 4, seed=1).table
        assert other.finish().sha256() == run(where, 4, seed=2).table


# -- walking and learning ------------------------------------------------------------------------


@needs_bullet
def test_the_script_walks() -> None:
    """Twenty cycles by the written knee: more than 0.3 m a cycle, straight enough, no fall."""
    summary = run("walker", 20, policy="scripted").summary
    assert summary["falls"] == 0
    assert summary["distance_per_cycle_m"] > 0.3
    assert summary["roll_sd_rad"] < 0.1
    assert summary["pitch_sd_rad"] < 0.1


@needs_bullet
def test_the_script_walks_on_the_trainer() -> None:
    """The same script carries the trainer's bar forward, without seeing what it is mounted on."""
    assert run("trainer", 20, policy="scripted").summary["distance_per_cycle_m"] > 0.05


@every_world
def test_frozen_learning_leaves_the_table(where: str, tmp_path: Path) -> None:
    """A table given, learning off: what ends is what began, and its use does not change it."""
    config: dict[str, Any] = {"policy": "random", "seed": 4}
    with looping(where, 3, **config) as loop:
        for _ in range(3 * TICKS):
            loop.tick()
        table = loop.finish()
        learnt = table.sha256()
        save_table(tmp_path / "table.npz", table, PARAMS, 4)
    frozen = run(where, 3, table=tmp_path / "table.npz", learning=False, seed=5)
    assert frozen.table == learnt
    going_on = run(where, 3, table=tmp_path / "table.npz", seed=5)
    assert going_on.table != learnt
    assert run(where, 3, learning=False).table == empty_table(PARAMS).sha256()


def test_a_table_is_used_from_the_first_tick(tmp_path: Path) -> None:
    """What was learnt before decides the first commands, of every leg."""
    table = empty_table(PARAMS)
    table.values[2::9] = 1.0
    save_table(tmp_path / "table.npz", table, PARAMS, 0)
    params = replace(PARAMS, {"walk.epsilon_start": 0.0, "walk.epsilon_end": 0.0})
    with looping("fake", 1, params=params, table=tmp_path / "table.npz") as loop:
        received = SignalLog()
        loop.tick(received)
        assert {c.knee_speed for c in received.commands[0]} == {PARAMS.leg.knee_speeds[2]}


def test_a_wrong_table_is_refused_before_the_run(tmp_path: Path) -> None:
    """A missing table, or one of another partition, never becomes an empty one."""
    with pytest.raises(TableError, match="there is no table"):
        Loop(RunConfig("walker", 1, table=tmp_path / "none.npz"), FakeWorld(LEGS))
    params = replace(PARAMS, {"state.hip_bins": 5})
    save_table(tmp_path / "other.npz", empty_table(params), params, 0)
    with pytest.raises(TableError, match=r"other\.npz"):
        Loop(RunConfig("walker", 1, table=tmp_path / "other.npz"), FakeWorld(LEGS))


# -- sharing -------------------------------------------------------------------------------------


class PaidForSpeed:
    """A reward of one's own: the knee's speed, and a fine in stance."""

    names = ("speed", "fine")

    def __init__(self, params: Params) -> None:
        """Take nothing from the parameters."""

    def terms(self, sense: LegSense, as_stance: bool) -> dict[str, float]:
        """Return both."""
        return {"speed": abs(sense.knee_speed), **({"fine": -0.5} if as_stance else {})}


def test_what_is_reported_is_what_was_paid() -> None:
    """Legs of another reward are reported by it, term by term, not by the paper's."""
    params = replace(PARAMS, {"parts.reward": f"{__name__}.PaidForSpeed"})
    with looping("fake", 2, policy="random", params=params) as loop:
        received, recorder = SignalLog(), RunStatistics(PARAMS, LEGS)
        for _ in range(2 * TICKS):
            loop.tick(received, recorder)
        recorder.finish(loop.world.observe(), loop.world.body())
        credited = 0
        for place in range(4):
            for senses, paid in zip(received.senses, received.transitions, strict=True):
                transition, sense = paid[place], senses[place]
                assert transition.credited is (sense.tick > 0 and not sense.first_tick)
                if transition.credited:
                    terms = {
                        "speed": abs(sense.knee_speed),
                        "fine": -0.5 if transition.stance else 0.0,
                    }
                    assert dict(transition.terms) == terms
                    assert transition.reward == terms["speed"] + terms["fine"]
                    credited += 1
        assert loop.finish().visits.sum() == credited
    rows = recorder.body_rows()
    first = recorder.summary()["first"]
    assert first["reward_by_term"].keys() == {"speed", "fine"}
    assert first["reward"] == pytest.approx(rows[0].reward)
    assert first["reward"] == pytest.approx(sum(first["reward_by_term"].values()))
    assert first["reward_by_term"]["fine"] < 0.0 < first["reward_by_term"]["speed"]


class Misspelt(PaidForSpeed):
    """A reward of one's own with a slip of the pen."""

    names = ("sped", "fine")


def test_a_term_that_nobody_knows_is_not_left_out_in_silence() -> None:
    """What would not be paid is told at the first tick that is credited, with the names."""
    params = replace(PARAMS, {"parts.reward": f"{__name__}.Misspelt"})
    with looping("fake", 1, params=params) as loop:
        loop.tick()
        with pytest.raises(
            ParameterError, match=r"Misspelt gives the terms speed.*of its names, sped, fine, would"
        ):
            loop.tick()


@two_worlds
@pytest.mark.parametrize("sync_every", [1, 7, 32, 1000])
@pytest.mark.parametrize("extra", [0, 5])
def test_everything_comes_home(where: str, sync_every: int, extra: int) -> None:
    """Whatever the epoch, cut short or not: visits in the table are the updates that were made.

    A leg updates at each tick but the first, and not after it was put back on its feet.
    """
    params = replace(EAGER, {"walk.sync_every": sync_every})
    with looping(where, 9, params=params, seed=2) as loop:
        received = SignalLog()
        for _ in range(9 * TICKS + extra):
            loop.tick(received)
        table = loop.finish()
    updates = sum(not sense.first_tick for senses in received.senses[1:] for sense in senses)
    assert updates <= 4 * (9 * TICKS + extra - 1)
    assert (updates < 4 * (9 * TICKS + extra - 1)) == any(body.falls for body in received.bodies)
    assert int(table.visits.sum()) == updates


def test_finish_may_be_called_twice() -> None:
    """Nothing is merged twice."""
    with looping("fake", 2) as loop:
        for _ in range(TICKS + 3):
            loop.tick()
        first = loop.finish().sha256()
        assert loop.finish().sha256() == first


def test_finish_before_the_first_tick() -> None:
    """A run of no tick ends with the table it began with."""
    with looping("fake", 0) as loop:
        assert loop.finish().sha256() == empty_table(PARAMS).sha256()


@pytest.mark.parametrize("sync_every", [1, 2, 7, 32])
def test_a_lone_leg_does_not_notice_sharing(sync_every: int) -> None:
    """With one leg the epoch changes nothing: the same commands and table as without sharing."""
    params = replace(PARAMS, {"train.sync_every": sync_every})
    runs = []
    for each in (params, PARAMS):
        loop = Loop(RunConfig("trainer", 6, params=each), FakeWorld((TRAINER_LEG,), each))
        received = SignalLog()
        for _ in range(6 * TICKS):
            loop.tick(received)
        runs.append((loop.finish().sha256(), received.commands))
    assert runs[0] == runs[1]


@two_worlds
def test_a_sync_every_tick_is_a_literally_shared_table(where: str) -> None:
    """``sync_every = 1``: bit for bit the table that all legs read and write at every tick."""
    params = replace(EAGER, {"walk.sync_every": 1})
    with looping(where, 8, params=params, seed=6) as loop:
        received = SignalLog()
        for _ in range(8 * TICKS):
            loop.tick(received)
        table = loop.finish()
    assert table.sha256() == reference_table([received.signals], params).sha256()


def test_legs_learn_from_each_other() -> None:
    """After a sync each leg's copy holds cells that only another leg visited."""
    with looping("fake", 3, params=EAGER, seed=1) as loop:
        for _ in range(2 * TICKS):
            loop.tick()
        own = [leg.copy.table.visits.copy() for leg in loop.legs]
        loop.tick()
        for leg, before in zip(loop.legs, own, strict=True):
            assert leg.copy.table.visits.sum() > before.sum() + 3 * (TICKS - 2)
        hashes = {leg.copy.table.visits.sum() for leg in loop.legs}
        assert len(hashes) == 1


# -- the tick ------------------------------------------------------------------------------------


def test_a_tick_is_of_one_tick() -> None:
    """Beat, senses and commands that an observer hears all carry the same tick."""
    with looping("fake", 3) as loop:
        received = SignalLog()
        for _ in range(3 * TICKS):
            loop.tick(received)
        assert loop.now == 3 * TICKS
    for tick, (heard_beat, senses, commands) in enumerate(
        zip(received.phases, received.senses, received.commands, strict=True)
    ):
        assert heard_beat == beat(tick)
        assert {sense.tick for sense in senses} == {command.tick for command in commands} == {tick}


def test_a_leg_s_name_and_place_go_with_its_senses() -> None:
    """The commands are in the order of the world's legs: each leg drives its own hip."""
    with looping("fake", 2) as loop:
        assert [leg.leg for leg in loop.legs] == list(loop.world.legs) == list(LEGS)
        for _ in range(TICKS):
            loop.tick()
        for leg, sense in zip(LEGS, loop.world.observe(), strict=True):
            goal = ReferenceGait(PARAMS, leg).hip_goal(TICKS - 1)
            assert sense.hip == pytest.approx(goal, abs=0.01)


# -- plans ---------------------------------------------------------------------------------------


def test_plans_name_their_legs_and_stage() -> None:
    """The trainer has one leg and trains it; the walker has four and walks."""
    assert (RunConfig("trainer", 1).legs, RunConfig("trainer", 1).stage) == (
        (TRAINER_LEG,),
        "train",
    )
    assert (RunConfig("walker", 1).legs, RunConfig("walker", 1).stage) == (LEGS, "walk")


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"world": "moon"}, r"no world 'moon'; it is trainer or walker"),
        ({"cycles": -1}, "cycles = -1 must be 0 or more"),
        ({"seed": -1}, "seed = -1: 0 to 9223372036854775807 would be right"),
    ],
)
def test_a_wrong_plan_is_refused(wrong: dict[str, Any], reason: str) -> None:
    """A plan that cannot be run says why when it is made."""
    with pytest.raises(ParameterError, match=reason):
        RunConfig(**{"world": "walker", "cycles": 1, **wrong})


def test_a_wrong_world_is_refused() -> None:
    """A world that does not exist is not another one by mistake."""
    with pytest.raises(ParameterError, match="no world 'fake'"):
        make_world("fake", PARAMS, 0)


def test_without_pybullet_a_world_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where PyBullet is missing, building a world is a ParameterError, not a traceback."""
    for name in ("sim_node.bullet", "sim_node.trainer", "sim_node.walker"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ParameterError, match="pip install pybullet"):
        make_world("walker", PARAMS, 0)


def test_a_wrong_policy_is_refused() -> None:
    """The loop is not built around a leg that cannot be."""
    with pytest.raises(ParameterError, match="no policy 'best'"):
        Loop(RunConfig("walker", 1, policy="best"), FakeWorld(LEGS))
