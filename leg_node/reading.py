"""How a table is read for choosing and for bootstrapping: a seam of its own. Pure.

Updates always touch one cell of the table; a reading turns its values and visits into what a leg
believes of a state's actions. To swap it, write a class with ``row``.
"""

from __future__ import annotations

from typing import Protocol

from leg_node.table import Table


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
