"""How a table is read: plainly, or smoothed over similar states."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ember_ros.params import Learning, Rate
from leg_node.table import Floats, Table
from leg_node.value import SmoothedValues, TableValues

SHAPE, ACTIONS, TICKS = (3, 2, 4, 2, 2), 3, 4
STATES = 96


def some_table(seed: int = 0) -> Table:
    """Return a table in which some cells were never tried."""
    rng, table = np.random.default_rng(seed), Table(STATES, ACTIONS)
    table.visits[:] = rng.integers(0, 12, len(table)) * rng.integers(0, 2, len(table))
    table.values[:] = rng.normal(size=len(table)) * (table.visits > 0)
    return table


def by_definition(table: Table, numbers: Learning) -> Floats:
    """Return the smoothed values, cell by cell, as the class's docstring defines them."""
    cells = list(itertools.product(*map(range, (*SHAPE, ACTIONS))))
    total, weight = np.zeros(len(cells)), np.zeros(len(cells))
    for i, a in enumerate(cells):
        for j, b in enumerate(cells):
            if a[3] != b[3]:
                continue  # stance and swing have nothing to say to each other
            bins = sum(abs(a[axis] - b[axis]) for axis in (0, 1, 2, 4, 5))
            kernel = numbers.smooth**bins
            most = numbers.visits_own if i == j else numbers.visits_near
            visits = kernel * min(int(table.visits[j]), most)
            weight[i] += visits
            total[i] += visits * table.values[j]
    totals, weights = total.reshape(STATES, ACTIONS), weight.reshape(STATES, ACTIONS)
    known = weights.sum(axis=1, keepdims=True)
    state = totals.sum(axis=1, keepdims=True) / np.where(known > 0, known, 1.0)
    prior = numbers.prior * (state - numbers.pessimism)
    believed: Floats = (totals + prior) / (weights + numbers.prior)
    return believed


def test_plain_reading_is_the_table() -> None:
    """No more and no less, also after it was learnt from."""
    table = some_table()
    reading = TableValues(table)
    assert reading.row(0, 7) == table.row(7)
    table.update(7 * ACTIONS, 5.0, Rate(0.1, 1.0))
    assert reading.row(1, 7) == table.row(7)


@pytest.mark.parametrize("seed", [0, 1])
def test_smoothed_reading_is_what_it_says(seed: int) -> None:
    """The separable sums equal the definition, cell by cell, to rounding."""
    numbers, table = Learning(smooth=0.3, visits_own=9, visits_near=4), some_table(seed)
    reading = SmoothedValues(table, SHAPE, numbers, TICKS)
    got = np.array([reading.row(0, state) for state in range(STATES)])
    assert np.abs(got - by_definition(table, numbers)).max() < 1e-12


def test_untried_actions_are_no_better_than_their_state() -> None:
    """Where all that was tried was bad, an untried action is believed to be worse, not 0."""
    table = Table(STATES, ACTIONS)
    for _ in range(50):
        table.update(0, -2.0, Rate(0.01, 1.0))
        table.update(1, -3.0, Rate(0.01, 1.0))
    row = SmoothedValues(table, SHAPE, Learning(smooth=1e-9), TICKS).row(0, 0)
    assert row[2] < min(row[:2])


def test_a_smoothed_reading_holds_for_its_cycles() -> None:
    """It is made anew every ``smooth_every`` cycles, at ticks that all ways of running share."""
    table = some_table()
    reading = SmoothedValues(table, SHAPE, Learning(smooth=0.3, smooth_every=2), TICKS)
    first = reading.row(0, 3)
    table.update(3 * ACTIONS, 100.0, Rate(0.5, 1.0))
    assert reading.row(2 * TICKS - 1, 3) == first
    assert reading.row(2 * TICKS, 3) != first
