"""How a table is read for choosing and for bootstrapping: a seam of its own. Pure.

Updates always touch one cell of the table; a reading turns its values and visits into what a leg
believes of a state's actions. To swap it, write a class with ``row``.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ember_ros.params import Learning
from leg_node.table import Floats, Table


class Reading(Protocol):
    """What a leg believes of a state's actions."""

    def row(self, tick: int, state: int) -> list[float]:
        """Return one value an action."""
        ...


class PlainReading:
    """The paper's: the values as they stand."""

    def __init__(self, table: Table) -> None:
        """Read from ``table``, now and later."""
        self._table = table

    def row(self, tick: int, state: int) -> list[float]:
        """Return the state's values."""
        return self._table.row(state)


class SmoothReading:
    """Similar local states want similar local actions (paper, section V): neighbours have a say.

    Two things, each with its own switch. ``smooth``: a cell's neighbours count by a kernel that
    falls with every bin between them, and by how often they were visited; stance and swing have
    nothing to say to each other. ``prior``: what is known of a whole state stands in for actions
    that were hardly tried, less ``pessimism``: an untried action is not good merely because all
    others have been found to cost something.
    """

    def __init__(
        self, table: Table, shape: tuple[int, int, int, int, int], numbers: Learning, ticks: int
    ) -> None:
        """Read from ``table``, anew every ``smooth_every`` cycles.

        Args:
            table: now and later.
            shape: bins of hip, force, inclination, swing and hair.
            numbers: ``smooth`` and its companions.
            ticks: of a cycle.
        """
        self._table, self._numbers = table, numbers
        self._shape = (*shape, table.actions)
        self._every = numbers.smooth_every * ticks
        self._turn = -1
        self._values: Floats = np.empty((table.states, table.actions))
        hip, force, inclination, swing, hair, actions = map(self._kernel, self._shape)
        # Neighbouring axes together, so that a spread is three products of matrices.
        self._hip, self._contact = hip, np.kron(force, inclination)
        self._rest = np.kron(np.eye(len(swing)), np.kron(hair, actions))

    def _kernel(self, bins: int) -> Floats:
        places = np.arange(bins)
        kernel: Floats = self._numbers.smooth ** np.abs(places[:, None] - places).astype(float)
        return kernel

    def row(self, tick: int, state: int) -> list[float]:
        """Return what the table and its neighbourhood say of the state's actions."""
        turn = tick // self._every
        if turn != self._turn:
            self._turn = turn
            self._read()
        row: list[float] = self._values[state].tolist()
        return row

    def _spread(self, field: Floats) -> Floats:
        """Return a field in which every cell has its neighbours' share, its own once."""
        bins = len(self._hip), len(self._contact), len(self._rest)
        field = (self._hip @ field.reshape(bins[0], -1)).reshape(bins)
        spread: Floats = self._contact @ (field @ self._rest)
        return spread.reshape(self._shape)

    def _read(self) -> None:
        numbers = self._numbers
        values = self._table.values.reshape(self._shape)
        visits = self._table.visits.reshape(self._shape)
        own = np.minimum(visits, numbers.visits_own).astype(float)
        near = np.minimum(visits, numbers.visits_near).astype(float)
        weight = self._spread(near) + (own - near)
        total = self._spread(near * values) + (own - near) * values
        known = weight.sum(axis=-1, keepdims=True)
        state = np.divide(
            total.sum(axis=-1, keepdims=True), known, out=np.zeros_like(known), where=known > 0.0
        )
        total += numbers.prior * (state - numbers.pessimism)
        weight += numbers.prior
        believed = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0.0)
        self._values = believed.reshape(self._table.states, self._table.actions)
