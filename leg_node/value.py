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

    Between two readings ``q_values`` returns a snapshot: neither updates nor pulls are seen before
    the next reading. This also holds for the bootstrap value of the learner.

    Only sums, products and quotients of single numbers in an order of its own: the bits do not
    depend on CPU, BLAS, width of SIMD or number of threads, as those of products of matrices do.
    """

    def __init__(
        self, table: Table, discretizer: Discretizer, learning_params: LearningParams, ticks: int
    ) -> None:
        """Read from ``table``, anew every ``smooth_every`` cycles.

        Args:
            table: now and later.
            discretizer: ``shape`` and ``neighbours`` of it.
            learning_params: ``smooth`` and its companions.
            ticks: of a nominal cycle.
        """
        self._table, self._learning_params = table, learning_params
        self._shape = (*discretizer.shape, table.actions)
        # The axes as they are worked on: actions first, since they move in long stretches of
        # memory then. The order decides the last bits.
        last = len(self._shape) - 1
        self._order = (last, 0, *range(last - 1, 0, -1))
        neighbours = (*discretizer.neighbours, True)  # similar knee speeds do similar things
        self._spread_axes = [place for place, axis in enumerate(self._order) if neighbours[axis]]
        """Places in ``_order`` of the axes along which neighbours have a say."""
        self._ticks_per_reading = learning_params.smooth_every * ticks
        self._reading = -1
        """Number of the present reading, counted from tick 0."""
        self._values: Floats = np.empty((table.states, table.actions))
        """What was read, ``(states, actions)``."""

    def q_values(self, tick: int, state: int) -> list[float]:
        """Return what the table and its neighbourhood say of the state's actions."""
        reading = tick // self._ticks_per_reading
        if reading != self._reading:
            self._reading = reading
            self._read()
        row: list[float] = self._values[state].tolist()
        return row

    def _read(self) -> None:
        """Read the whole table into ``_values``.

        With Q and N, the values and visits of all cells, and V, the mean Q of a state's actions by
        weight, also over neighbours::

            near     = min(N, visits_near)
            own      = min(N, visits_own) - near
            weight   = spread(near) + own
            weighted = spread(near * Q) + own * Q
            V        = sum of weighted / sum of weight, each over the actions
            believed = (weighted + prior * (V - pessimism)) / (weight + prior)

        ``spread`` adds to each cell its neighbours, by the kernel. All arrays have the axes of
        ``_order``, (actions, first axis of the discretizer, its others from the last on); V has no
        axis of actions.
        """
        params = self._learning_params
        values = self._table.values.reshape(self._shape).transpose(self._order)
        visits = self._table.visits.reshape(self._shape).transpose(self._order)
        near = np.ascontiguousarray(np.minimum(visits, params.visits_near), dtype=float)
        own = np.minimum(visits, params.visits_own) - near
        both = np.empty((2, *near.shape))  # in one array, so that both are spread in one go
        weight, weighted = both
        weight[:] = near
        np.multiply(near, values, out=weighted)
        for axis in self._spread_axes:
            _add_neighbours(both, axis + 1, params.smooth)
        weight += own
        weighted += own * values
        state_weight = _sum(weight)
        state_value = np.divide(
            _sum(weighted), state_weight, out=np.zeros_like(state_weight), where=state_weight > 0.0
        )
        weighted += params.prior * (state_value - params.pessimism)
        weight += params.prior
        believed = np.divide(weighted, weight, out=np.zeros_like(weighted), where=weight > 0.0)
        in_table_order: Floats = believed.transpose(np.argsort(self._order))
        self._values = in_table_order.reshape(self._table.states, self._table.actions)


def _add_neighbours(field: Floats, axis: int, share: float) -> None:
    """Add to every bin of an axis ``share ** distance`` of every other one, in place.

    What has come from one side is carried on from bin to bin: two sums a bin.
    """
    bins = list(np.moveaxis(field, axis, 0))
    last = len(bins) - 1
    from_above = [np.zeros_like(bins[0])]  # what each bin is given by those above, last bin first
    for n in range(last, 0, -1):
        from_above.append(share * (bins[n] + from_above[-1]))
    for n in range(1, last + 1):
        bins[n] += share * bins[n - 1]  # which has its share of all before it already
    for n in range(last):
        bins[n] += from_above[last - n]


def _sum(field: Floats) -> Floats:
    """Return the sum along the first axis, one after the other."""
    total: Floats = field[0].copy()
    for each in field[1:]:
        total += each
    return total
