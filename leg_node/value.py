"""What a leg believes of a state's actions: how a table is read to choose and to bootstrap. Pure.

Updates always touch one cell of the table; an estimate turns its values and visits into one value
an action. To swap it, write a class with ``q_values`` and name it as ``parts.value``.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ember_ros.params import LearningParams
from leg_node.discretizer import Discretizer
from leg_node.table import Floats, Table


class ValueEstimate(Protocol):
    """The values of a state's actions.

    Made with ``(table, discretizer, learning_params, ticks)``: the table to read, now and later;
    what its states mean; the learning parameters of the stage; ticks of a cycle.
    """

    def q_values(self, tick: int, state: int) -> list[float]:
        """Return one value an action."""
        ...


def paper_or_smoothed(
    table: Table, discretizer: Discretizer, learning_params: LearningParams, ticks: int
) -> ValueEstimate:
    """Return ``SmoothedValues`` if ``smooth`` or ``prior`` is set, ``TableValues`` otherwise."""
    smoothed = learning_params.smooth > 0.0 or learning_params.prior > 0.0
    kind = SmoothedValues if smoothed else TableValues
    return kind(table, discretizer, learning_params, ticks)


class TableValues:
    """The paper's: the values as they stand in the table."""

    def __init__(
        self, table: Table, discretizer: Discretizer, learning_params: LearningParams, ticks: int
    ) -> None:
        """Read from ``table``, now and later."""
        self._table = table

    def q_values(self, tick: int, state: int) -> list[float]:
        """Return the state's values."""
        return self._table.row(state)


class SmoothedValues:
    """Similar local states want similar local actions (paper, section V): neighbours have a say.

    Two things, each with its own switch. ``smooth``: a cell's neighbours count by a kernel that
    falls with every bin between them, and by how often they were visited, along the axes that the
    discretizer calls neighbours. ``prior``: what is known of a whole state stands in for actions
    that were hardly tried, less ``pessimism``: an untried action is not good merely because all
    others have been found to cost something.

    Only sums, products and quotients of single numbers in an order of its own: the bits do not
    hang on CPU, BLAS, width of SIMD or number of threads, as those of products of matrices do.
    """

    def __init__(
        self, table: Table, discretizer: Discretizer, learning_params: LearningParams, ticks: int
    ) -> None:
        """Read from ``table``, anew every ``smooth_every`` cycles.

        Args:
            table: now and later.
            discretizer: ``shape`` and ``neighbours`` of it.
            learning_params: ``smooth`` and its companions.
            ticks: of a cycle.
        """
        self._table, self._learning_params = table, learning_params
        self._shape = (*discretizer.shape, table.actions)
        # The axes as they are worked on: actions first, since they move in long stretches of
        # memory then. The order decides the last bits.
        last = len(self._shape) - 1
        self._order = (last, 0, *range(last - 1, 0, -1))
        like = (*discretizer.neighbours, True)
        self._spread = [n for n, axis in enumerate(self._order) if like[axis]]
        self._every = learning_params.smooth_every * ticks
        self._turn = -1
        self._values: Floats = np.empty((table.states, table.actions))

    def q_values(self, tick: int, state: int) -> list[float]:
        """Return what the table and its neighbourhood say of the state's actions."""
        turn = tick // self._every
        if turn != self._turn:
            self._turn = turn
            self._read()
        row: list[float] = self._values[state].tolist()
        return row

    def _read(self) -> None:
        learning_params = self._learning_params
        values = self._table.values.reshape(self._shape).transpose(self._order)
        visits = self._table.visits.reshape(self._shape).transpose(self._order)
        near = np.ascontiguousarray(np.minimum(visits, learning_params.visits_near), dtype=float)
        more = np.minimum(visits, learning_params.visits_own) - near
        both = np.empty((2, *near.shape))  # weights, and values by weight
        weight, total = both
        weight[:] = near
        np.multiply(near, values, out=total)
        for axis in self._spread:
            _spread(both, axis + 1, learning_params.smooth)
        weight += more
        total += more * values
        known = _sum(weight)
        state = np.divide(_sum(total), known, out=np.zeros_like(known), where=known > 0.0)
        total += learning_params.prior * (state - learning_params.pessimism)
        weight += learning_params.prior
        believed = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0.0)
        back: Floats = believed.transpose(np.argsort(self._order))
        self._values = back.reshape(self._table.states, self._table.actions)


def _spread(field: Floats, axis: int, share: float) -> None:
    """Add to every bin of an axis ``share ** distance`` of every other one, in place.

    What has come from one side is carried on from bin to bin: two sums a bin.
    """
    bins = list(np.moveaxis(field, axis, 0))
    last = len(bins) - 1
    above = [np.zeros_like(bins[0])]  # what the bins beyond each one give it, the last one first
    for n in range(last, 0, -1):
        above.append(share * (bins[n] + above[-1]))
    for n in range(1, last + 1):
        bins[n] += share * bins[n - 1]  # which has its share of all before it already
    for n in range(last):
        bins[n] += above[last - n]


def _sum(field: Floats) -> Floats:
    """Return the sum along the first axis, one after the other."""
    total: Floats = field[0].copy()
    for each in field[1:]:
        total += each
    return total
