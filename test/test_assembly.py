"""Putting a leg together: parts that are found by their paths, or refused with what is wrong."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ember_ros import parts
from ember_ros.errors import ParameterError
from ember_ros.loop import Loop
from ember_ros.params import TRAINER_LEG, LearningParams, Params, replace
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, LegSense, TDUpdate, Transition
from leg_node.assembly import empty_table, make_discretizer, make_leg
from leg_node.discretizer import Discretizer, PaperDiscretizer
from leg_node.gait import GaitStep, HipRamp
from leg_node.learner import QLearning
from leg_node.reward import PaperReward
from leg_node.table import Table
from leg_node.value import TableValues, ValueEstimate
from sim_node.fake import FakeWorld
from support.legs import LEGS
from support.runs import SignalLog

PARAMS = Params()
NOT_A_CLASS = 3


def named(**classes: str) -> Params:
    """Return parameters with parts of this file."""
    return replace(PARAMS, {f"parts.{part}": f"{__name__}.{n}" for part, n in classes.items()})


# -- parts of one's own --------------------------------------------------------------------------


class Shaped:
    """A partition of a shape that a test decides."""

    shape: Any = (2, 3)
    neighbours: Any = (True, False)

    def __init__(self, params: Params) -> None:
        """Take nothing from the parameters."""

    def index(self, sense: LegSense, stance: bool) -> int:
        """Return the contact and one of three bins of the knee."""
        return 3 * sense.contact + min(2, int(2.0 * max(0.0, sense.knee)))


class NeedsMore:
    """A part of another form."""

    def __init__(self, params: Params, more: int) -> None:
        """Ask for what no part is given."""


class AlwaysStance:
    """A gait that stands, and holds the hip."""

    def __init__(self, params: Params, offset: float) -> None:
        """Take nothing."""

    def step(self, beat: Beat, sense: LegSense) -> GaitStep:
        """Return stance, where the hip is."""
        return GaitStep(True, 0.0, sense.hip)


class DoubleQ:
    """Double Q-learning: two tables, of which a coin decides which one is updated by the other."""

    tables = 2

    def __init__(
        self,
        estimates: Sequence[ValueEstimate],
        learning_params: LearningParams,
        shape: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        """Take two estimates."""
        self._one, self._two = estimates
        self._gamma, (self._states, self._actions), self._rng = learning_params.gamma, shape, rng

    def q_values(self, tick: int, state: int) -> list[float]:
        """Return the sums."""
        both = (self._one.q_values(tick, state), self._two.q_values(tick, state))
        return [a + b for a, b in zip(*both, strict=True)]

    def learn(self, transition: Transition) -> Iterable[TDUpdate]:
        """Return the update of one table by the other."""
        own = int(self._rng.integers(2))
        mine, other = (self._one, self._two)[:: 1 - 2 * own]
        row = mine.q_values(transition.tick, transition.next_state)
        best = other.q_values(transition.tick, transition.next_state)[row.index(max(row))]
        cell = (own * self._states + transition.state) * self._actions + transition.action
        return [TDUpdate(transition.tick, cell, transition.reward + self._gamma * best)]

    def flush(self) -> Iterable[TDUpdate]:
        """Return nothing."""
        return []


class Fifth:
    """A policy of one's own: always the fifth speed; it keeps what it was made with."""

    def __init__(
        self,
        params: Params,
        learning_params: LearningParams,
        q_values: Any,
        rng: Any,
        start_cycle: int,
    ) -> None:
        """Keep what it was made with."""
        self.made_with = (learning_params, q_values(0, 0), start_cycle)

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        """Return the fifth."""
        return 4


# -- found by their paths ------------------------------------------------------------------------


def test_the_default_parts_are_the_paper_s() -> None:
    """Each path leads to the class that its room is about."""
    found = {part: parts.find(path, part) for part, path in vars(PARAMS.parts).items()}
    assert found["gait"] is HipRamp
    assert found["discretizer"] is PaperDiscretizer
    assert found["reward"] is PaperReward
    assert found["learner"] is QLearning
    assert len(found) == 6


def test_a_part_is_made_with_what_it_needs() -> None:
    """The class that the path names, given the arguments."""
    made = parts.make(named(discretizer="Shaped"), "discretizer", PARAMS)
    assert type(made).__name__ == "Shaped"


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        (
            "no_such_package.rewards.Mine",
            r"parts.reward = 'no_such_package.rewards.Mine': there is no module "
            r"'no_such_package' to be imported here; an installed package, or a folder in "
            r"PYTHONPATH, would be right",
        ),
        ("leg_node.no_such.Mine", r"there is no module 'leg_node.no_such' to be imported here"),
        (
            "leg_node.reward.PaperRewards",
            r"parts.reward = 'leg_node.reward.PaperRewards' cannot be used: .*has no attribute "
            r"'PaperRewards'",
        ),
        ("test_assembly.NOT_A_CLASS", r"is no class; a class would be right"),
        ("leg_node.reward", r"is no class; a class would be right"),
        (
            "test_assembly.NeedsMore",
            r"parts.reward = 'test_assembly.NeedsMore' cannot be made: .*missing 1 required "
            r"positional argument: 'more'",
        ),
    ],
)
def test_a_part_that_cannot_be_is_refused(path: str, reason: str) -> None:
    """No such module, no such name, nothing that can be called, or made in another way.

    The error says by which parameter, and the robot is not built.
    """
    params = replace(PARAMS, {"parts.reward": path})
    with pytest.raises(ParameterError, match=reason):
        make_leg(params, TRAINER_LEG)


def test_a_module_that_lacks_another_one_says_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of one's own that imports what is not installed: that is named, not the file."""
    (tmp_path / "of_my_own.py").write_text("import not_installed_here\nclass Mine: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ParameterError, match="there is no module 'not_installed_here'"):
        parts.find("of_my_own.Mine", "parts.gait")


def test_a_part_comes_from_a_folder_in_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No package has to be made of it."""
    (tmp_path / "my_gait.py").write_text("class Mine:\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    try:
        assert parts.find("my_gait.Mine", "parts.gait").__name__ == "Mine"
    finally:
        sys.modules.pop("my_gait", None)


def test_a_policy_may_be_named_by_its_path() -> None:
    """Made with the parameters of the stage, the learner's values and the cycles before."""
    leg = make_leg(PARAMS, TRAINER_LEG, stage="train", policy=f"{__name__}.Fifth", start_cycle=7)
    (sense,) = FakeWorld((TRAINER_LEG,)).observe()
    assert leg.tick(sense, Beat(0, 0.0)).knee_speed == PARAMS.leg.knee_speeds[4]
    made: Any = leg._policy
    assert made.made_with == (PARAMS.train, [-1.0] * 9, 7)  # untried: less the pessimism
    with pytest.raises(ParameterError, match=r"policy = 'no_such.Policy': there is no module"):
        make_leg(PARAMS, TRAINER_LEG, policy="no_such.Policy")


# -- the discretizer and the size of the table ---------------------------------------------------


def test_the_table_has_the_size_that_the_discretizer_asks_for() -> None:
    """Its states, times the tables of the learner, times the knee speeds."""
    table = empty_table(named(discretizer="Shaped"))
    assert (table.states, table.actions) == (6, 9)
    table = empty_table(named(discretizer="Shaped", learner="DoubleQ"))
    assert (table.states, table.actions) == (12, 9)


@pytest.mark.parametrize(
    ("shape", "neighbours"),
    [
        ((), ()),
        ((0, 3), (True, True)),
        ((-2, -3), (True, True)),
        ((2.0, 3), (True, True)),
        ((True, 3), (True, True)),
        (("2", 3), (True, True)),
        ((2, 3), (True,)),
        ((2, 3), (True, True, True)),
        ((2,), ()),
        (None, (True,)),
        (6, (True,)),
        ((2,), True),
    ],
)
def test_a_shape_that_is_none_is_refused(
    monkeypatch: pytest.MonkeyPatch, shape: Any, neighbours: Any
) -> None:
    """No axes, bins that are no whole number of 1 or more, or not one neighbour an axis."""
    monkeypatch.setattr(Shaped, "shape", shape)
    monkeypatch.setattr(Shaped, "neighbours", neighbours)
    if shape is None:
        monkeypatch.delattr(Shaped, "shape")
    params = named(discretizer="Shaped")
    for make in (make_discretizer, empty_table, lambda params: make_leg(params, TRAINER_LEG)):
        with pytest.raises(ParameterError, match=r"parts\.discretizer = .*Shaped'.*shape"):
            make(params)


@pytest.mark.parametrize(
    ("bins", "learner", "good"),
    [(444_444, "", True), (444_445, "", False), (222_222, "DoubleQ", True),
     (222_223, "DoubleQ", False)],
)  # fmt: skip
def test_a_table_has_its_most_cells(
    monkeypatch: pytest.MonkeyPatch, bins: int, learner: str, good: bool
) -> None:
    """Four million, all tables of a learner together; what is more says how many it is."""
    monkeypatch.setattr(Shaped, "shape", (bins,))
    monkeypatch.setattr(Shaped, "neighbours", (True,))
    params = named(discretizer="Shaped", **({"learner": learner} if learner else {}))
    if good:
        assert make_discretizer(params).shape == (bins,)
        return
    cells = bins * (2 if learner else 1) * 9
    with pytest.raises(ParameterError, match=rf"{cells} cells; up to 4000000 would be right"):
        make_discretizer(params)


def test_a_partition_of_numbers_alone_may_be_too_large() -> None:
    """A parameter file can ask for more than memory holds: refused in one bounded line."""
    edges = [n / 9.0 for n in range(100_000)]
    params = replace(PARAMS, {"state.hip_bins": 1000, "state.force_edges": edges})
    with pytest.raises(ParameterError, match=r"\(1000 x 100001 x 8 x 2 x 2\) x 9 actions") as error:
        empty_table(params)
    assert len(str(error.value)) < 400


def test_a_discretizer_of_one_s_own_is_learnt_in() -> None:
    """States of transitions and cells of the table are its own, and there are no others."""
    params = named(discretizer="Shaped")
    loop, received = (
        Loop(RunConfig("walker", 2, params=params, policy="random"), FakeWorld()),
        SignalLog(),
    )
    for _ in range(64):
        loop.tick(received)
    table, mine = loop.finish(), Shaped(params)
    assert len(table) == 54
    for senses, told in zip(received.senses, received.transitions, strict=True):
        for sense, did in zip(senses, told, strict=True):
            assert did.next_state == mine.index(sense, did.next_stance)
    assert table.visits.sum() == 4 * 63


def test_a_gait_of_one_s_own_decides_stance_and_hip() -> None:
    """The leg says so, is rewarded so, and drives its hip there."""
    loop, received = (
        Loop(RunConfig("walker", 2, params=named(gait="AlwaysStance")), FakeWorld()),
        SignalLog(),
    )
    for _ in range(64):
        loop.tick(received)
    told = [did for each in received.transitions for did in each]
    assert all(did.next_stance for did in told)
    assert {dict(did.terms)["swing_free"] for did in told} == {0.0}
    assert {command.hip_speed for each in received.commands for command in each} == {0.0}


def test_a_learner_of_two_tables_learns_in_both() -> None:
    """One behind the other in the table that legs share; each update is one cell of either."""
    params = replace(
        named(discretizer="Shaped", learner="DoubleQ"),
        {"walk.sync_every": 8, "walk.smooth": 0.0, "walk.prior": 0.0},
    )
    loop = Loop(
        RunConfig("walker", 3, params=params, policy="random", seed=2), FakeWorld(LEGS, params)
    )
    for _ in range(96):
        loop.tick()
    one, two = loop.finish().split(2)
    assert one.visits.sum() + two.visits.sum() == 4 * 95
    assert min(one.visits.sum(), two.visits.sum()) > 4 * 95 / 3
    leg = loop.legs[0]
    for state in range(6):
        wanted = [a + b for a, b in zip(one.row(state), two.row(state), strict=True)]
        for share in (one, two):
            assert len(share.row(state)) == 9
        learner: Any = leg._learner
        leg.copy.table.copy_from(loop.shared.table)
        assert learner.q_values(95, state) == wanted


# -- parts of a table ----------------------------------------------------------------------------


def test_one_part_is_the_table_itself() -> None:
    """No copy, no view."""
    table = Table(4, 3)
    assert table.split(1) == [table]


@pytest.mark.parametrize("count", [2, 3, 4])
def test_parts_lie_one_behind_the_other_in_one_memory(count: int) -> None:
    """What is written by the whole is read by a part and the other way round, cell by cell."""
    table, states = Table(12, 3), 12 // count
    shares = table.split(count)
    assert [(part.states, part.actions, len(part)) for part in shares] == [
        (states, 3, 3 * states)
    ] * count
    for n, part in enumerate(shares):
        for state in range(states):
            for action in range(3):
                cell = (n * states + state) * 3 + action
                table.write(cell, float(cell), cell)
                assert part.read(state * 3 + action) == (float(cell), cell)
                part.write(state * 3 + action, -float(cell), 2 * cell)
                assert table.read(cell) == (-float(cell), 2 * cell)
            assert part.row(state) == table.row(n * states + state)
            assert np.shares_memory(part.values, table.values)
            assert np.shares_memory(part.visits, table.visits)


def test_what_replaces_the_whole_is_seen_by_its_parts() -> None:
    """As when a leg pulls: estimates that read a part read what the shared table has."""
    table, other = Table(4, 2), Table(4, 2)
    other.values[:] = range(8)
    discretizer: Discretizer = Shaped(PARAMS)
    reads = [TableValues(part, discretizer, PARAMS.walk, 32) for part in table.split(2)]
    table.copy_from(other)
    assert [each.q_values(0, 1) for each in reads] == [[2.0, 3.0], [6.0, 7.0]]


def test_a_learner_of_three_tables_has_all_states_in_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The shared table is as many times as long."""
    monkeypatch.setattr(DoubleQ, "tables", 3)
    table = empty_table(named(discretizer="Shaped", learner="DoubleQ"))
    assert [part.states for part in table.split(3)] == [6, 6, 6]
