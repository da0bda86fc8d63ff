"""What is believed of actions: as the table says, or smoothed over similar states."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest

from ember_ros.params import LearningParams, Rate
from ember_ros.signals import LegSense
from leg_node.table import Floats, Table
from leg_node.value import SmoothedValues, TableValues, paper_or_smoothed

SHAPE, ACTIONS, TICKS = (3, 2, 4, 2, 2), 3, 4
STATES = 96


@dataclass(frozen=True)
class Axes:
    """A discretizer, as far as an estimate looks at it."""

    shape: tuple[int, ...] = SHAPE
    neighbours: tuple[bool, ...] = (True, True, True, False, True)

    def index(self, sense: LegSense, stance: bool) -> int:
        """Return nothing: no estimate asks for it."""
        raise NotImplementedError


AXES = Axes()


def some_table(seed: int = 0) -> Table:
    """Return a table in which some cells were never tried."""
    rng, table = np.random.default_rng(seed), Table(STATES, ACTIONS)
    table.visits[:] = rng.integers(0, 12, len(table)) * rng.integers(0, 2, len(table))
    table.values[:] = rng.normal(size=len(table)) * (table.visits > 0)
    return table


def by_definition(table: Table, learning_params: LearningParams, axes: Axes = AXES) -> Floats:
    """Return the smoothed values, cell by cell, as the class's docstring defines them."""
    cells = list(itertools.product(*map(range, (*SHAPE, ACTIONS))))
    total, weight = np.zeros(len(cells)), np.zeros(len(cells))
    for i, a in enumerate(cells):
        for j, b in enumerate(cells):
            like = (*axes.neighbours, True)
            if any(x != y for x, y, near in zip(a, b, like, strict=True) if not near):
                continue  # such as stance and swing, which have nothing to say to each other
            bins = sum(abs(x - y) for x, y in zip(a, b, strict=True))
            kernel = learning_params.smooth**bins
            most = learning_params.visits_own if i == j else learning_params.visits_near
            visits = kernel * min(int(table.visits[j]), most)
            weight[i] += visits
            total[i] += visits * table.values[j]
    totals, weights = total.reshape(STATES, ACTIONS), weight.reshape(STATES, ACTIONS)
    known = weights.sum(axis=1, keepdims=True)
    state = totals.sum(axis=1, keepdims=True) / np.where(known > 0, known, 1.0)
    prior = learning_params.prior * (state - learning_params.pessimism)
    believed: Floats = (totals + prior) / (weights + learning_params.prior)
    return believed


def test_plain_values_are_the_table() -> None:
    """No more and no less, also after it was learnt from."""
    table = some_table()
    values = TableValues(table, AXES, LearningParams(), TICKS)
    assert values.q_values(0, 7) == table.row(7)
    table.update(7 * ACTIONS, 5.0, Rate(0.1, 1.0))
    assert values.q_values(1, 7) == table.row(7)


@pytest.mark.parametrize("seed", [0, 1])
def test_smoothed_values_are_what_they_say(seed: int) -> None:
    """The separable sums equal the definition, cell by cell, to rounding."""
    learning_params, table = (
        LearningParams(smooth=0.3, visits_own=9, visits_near=4),
        some_table(seed),
    )
    values = SmoothedValues(table, AXES, learning_params, TICKS)
    got = np.array([values.q_values(0, state) for state in range(STATES)])
    assert np.abs(got - by_definition(table, learning_params)).max() < 1e-12


def test_untried_actions_are_no_better_than_their_state() -> None:
    """Where all that was tried was bad, an untried action is believed to be worse, not 0."""
    table = Table(STATES, ACTIONS)
    for _ in range(50):
        table.update(0, -2.0, Rate(0.01, 1.0))
        table.update(1, -3.0, Rate(0.01, 1.0))
    row = SmoothedValues(table, AXES, LearningParams(smooth=1e-9), TICKS).q_values(0, 0)
    assert row[2] < min(row[:2])


def test_smoothed_values_hold_for_their_cycles() -> None:
    """They are made anew every ``smooth_every`` cycles, at ticks that all ways of running share."""
    table = some_table()
    values = SmoothedValues(table, AXES, LearningParams(smooth=0.3, smooth_every=2), TICKS)
    first = values.q_values(0, 3)
    table.update(3 * ACTIONS, 100.0, Rate(0.5, 1.0))
    assert values.q_values(2 * TICKS - 1, 3) == first
    assert values.q_values(2 * TICKS, 3) != first


def test_the_discretizer_says_which_axes_are_smoothed() -> None:
    """Where another axis than that of swing has no neighbours, nothing passes along that one."""
    axes = Axes(neighbours=(False, True, False, True, True))
    learning_params, table = LearningParams(smooth=0.3), some_table(2)
    values = SmoothedValues(table, axes, learning_params, TICKS)
    got = np.array([values.q_values(0, state) for state in range(STATES)])
    assert np.abs(got - by_definition(table, learning_params, axes)).max() < 1e-12
    assert np.abs(got - by_definition(table, learning_params)).max() > 1e-3


def test_a_discretizer_of_two_axes_can_be_smoothed() -> None:
    """Any number of axes, each with its own number of bins."""
    axes, learning_params, table = (
        Axes((12, 8), (True, True)),
        LearningParams(smooth=0.5, prior=0.0),
        some_table(3),
    )
    values = SmoothedValues(table, axes, learning_params, TICKS)
    cells = list(itertools.product(range(12), range(8), range(ACTIONS)))
    here, at = (5, 3, 1), cells.index((5, 3, 1))
    near = np.minimum(table.visits, learning_params.visits_near)
    own = min(int(table.visits[at]), learning_params.visits_own) - int(near[at])
    bins = [sum(abs(x - y) for x, y in zip(cell, here, strict=True)) for cell in cells]
    weights = near * 0.5 ** np.array(bins)
    weights[at] += own
    wanted = float(weights @ table.values / weights.sum())
    assert values.q_values(0, at // ACTIONS)[at % ACTIONS] == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize(
    ("learning_params", "kind"),
    [
        (LearningParams(smooth=0.0, prior=0.0), TableValues),
        (LearningParams(smooth=0.3, prior=0.0), SmoothedValues),
        (LearningParams(smooth=0.0, prior=5.0), SmoothedValues),
    ],
)
def test_the_parameters_decide_which_of_the_two(
    learning_params: LearningParams, kind: type
) -> None:
    """Without a neighbour's say and without a prior it is the paper's table, and costs nothing."""
    assert type(paper_or_smoothed(some_table(), AXES, learning_params, TICKS)) is kind
