"""Puts together what belongs to one tick, in whatever order it comes. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

LATE = 64
"""Ticks after which what is missing of a tick is no longer waited for: two cycles."""


class Window:
    """The parts of ticks that are not complete yet; each tick comes out once, and in order."""

    def __init__(
        self,
        parts: Sequence[str],
        also: Callable[[Mapping[str, Any]], bool] = lambda found: True,
        late: int = LATE,
    ) -> None:
        """Wait for these parts of every tick.

        Args:
            parts: what a complete tick has; others may come too.
            also: what else must hold of a tick that has them.
            late: ticks after which a tick comes out as it is.
        """
        self.parts = frozenset(parts)
        self._also = also
        self.last = -1
        """The last tick that came out."""
        self._late = late
        self._ticks: dict[int, dict[str, Any]] = {}
        self._newest = -1

    @property
    def newest(self) -> int:
        """Return the newest tick that has begun, -1 before the first."""
        return self._newest

    def put(self, tick: int, part: str, value: Any) -> bool:
        """Keep a part; return False if its tick came out before."""
        if tick <= self.last:
            return False
        self._ticks.setdefault(tick, {}).setdefault(part, value)
        if tick > self._newest:
            self._newest = tick
        return True

    def take(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield the ticks that are complete or late, in order, none before an earlier one."""
        while self._ticks:
            tick = min(self._ticks)
            found = self._ticks[tick]
            whole = self.parts <= found.keys() and self._follows(tick) and self._also(found)
            if not whole and self._newest - tick < self._late:
                return
            yield self._out(tick)

    def rest(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield all that is left, in order."""
        while self._ticks:
            yield self._out(min(self._ticks))

    def _follows(self, tick: int) -> bool:
        """Return whether no earlier tick can still come: a run begins with tick 0."""
        return tick == self.last + 1

    def _out(self, tick: int) -> tuple[int, dict[str, Any]]:
        self.last = tick
        return tick, self._ticks.pop(tick)
