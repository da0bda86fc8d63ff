"""The Q-table: values and visit counts of every (state, action). Pure; its file is `table_file`.

One cell is updated by one rule, here, wherever the update happens: in a leg's own copy, in the
shared table, in a replay.
"""

from __future__ import annotations

import hashlib
from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ember_ros.params import Rate

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def as_floats(numbers: array[float]) -> Floats:
    """Return a view of doubles."""
    return np.frombuffer(numbers, dtype=np.float64)


def as_ints(numbers: array[int]) -> Ints:
    """Return a view of 64-bit integers."""
    return np.frombuffer(numbers, dtype=np.int64)


class Table:
    """Values and visits of ``states x actions`` cells, addressed row-major by one index."""

    def __init__(self, states: int, actions: int) -> None:
        """Make an empty table: all values and visits 0."""
        self.states, self.actions = states, actions
        self.values: Floats = np.zeros(states * actions)
        self.visits: Ints = np.zeros(states * actions, dtype=np.int64)
        # Single cells are read and written through memoryviews: these give Python numbers, three
        # times as fast as indexing the arrays, and share their memory.
        self._value: Any = self.values.data
        self._visit: Any = self.visits.data

    def split(self, count: int) -> list[Table]:
        """Return ``count`` tables of equal size, one behind the other, that share this memory."""
        states = self.states // count
        cells = states * self.actions
        return (
            [self._part(states, slice(n * cells, (n + 1) * cells)) for n in range(count)]
            if count > 1
            else [self]
        )

    def _part(self, states: int, cells: slice) -> Table:
        part = Table(0, self.actions)
        part.states, part.values, part.visits = states, self.values[cells], self.visits[cells]
        part._value, part._visit = part.values.data, part.visits.data
        return part

    def __len__(self) -> int:
        """Return the number of cells."""
        return self.states * self.actions

    def row(self, state: int) -> list[float]:
        """Return the values of a state's actions."""
        start = state * self.actions
        row: list[float] = self._value[start : start + self.actions].tolist()
        return row

    def read(self, cell: int) -> tuple[float, int]:
        """Return the value and the visits of one cell."""
        return self._value[cell], self._visit[cell]

    def write(self, cell: int, value: float, visits: int) -> None:
        """Overwrite one cell."""
        self._value[cell] = value
        self._visit[cell] = visits

    def update(self, cell: int, target: float, rate: Rate) -> float:
        """Move one cell towards ``target``: ``N += 1; Q += alpha (target - Q)``.

        ``alpha`` is ``1 / N`` within the bounds of ``rate``.

        Returns:
            ``target - Q`` as it was before: the temporal-difference error.
        """
        floor, ceiling = rate
        visits = self._visit[cell] + 1
        alpha = 1.0 / visits
        if alpha < floor:
            alpha = floor
        elif alpha > ceiling:
            alpha = ceiling
        value: float = self._value[cell]
        error = target - value
        self._visit[cell] = visits
        self._value[cell] = value + alpha * error
        return error

    def copy_from(self, other: Table) -> None:
        """Take over all cells of a table of the same size."""
        self.values[:] = other.values
        self.visits[:] = other.visits

    def sha256(self) -> str:
        """Return the SHA-256 of the table's size, values and visits."""
        digest = hashlib.sha256(f"{self.states}x{self.actions}".encode())
        digest.update(self.values.astype("<f8").tobytes())
        digest.update(self.visits.astype("<i8").tobytes())
        return digest.hexdigest()
