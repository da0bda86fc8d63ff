"""Puts together what belongs to one tick, in whatever order it comes. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

LATE = 64
"""Ticks after which what is missing of a tick is no longer waited for: two cycles. What is further
ahead than that of all that came is believed only when the others are there too: one wrong stamp
must not make everything that follows come too late."""


class _Ahead(NamedTuple):
    """A part that came for a tick far ahead."""

    tick: int
    part: str
    value: Any
    newest: int
    """The newest tick when it came."""


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
        self._ahead: list[_Ahead] = []
        self.displaced = 0
        """Parts that were left out, since no others came for ticks near theirs."""

    @property
    def newest(self) -> int:
        """Return the newest tick that has begun, -1 before the first."""
        return self._newest

    def put(self, tick: int, part: str, value: Any) -> bool:
        """Keep a part; return False if its tick came out before."""
        if tick <= self.last:
            return False
        if tick <= self._newest + self._late:
            self._keep(tick, part, value)
        else:
            self._set_aside(_Ahead(tick, part, value, self._newest))
        return True

    def _keep(self, tick: int, part: str, value: Any) -> None:
        self._ticks.setdefault(tick, {}).setdefault(part, value)
        if tick > self._newest:
            self._newest = tick

    def _set_aside(self, new: _Ahead) -> None:
        """Wait with a part that is far ahead until there is reason to believe that time is there.

        That is when more than half of the parts are, or when one goes on there while nothing goes
        on here.
        """
        kept = [each for each in self._ahead if self._newest - each.newest <= self._late]
        self.displaced += len(self._ahead) - len(kept)
        near = [each for each in kept if abs(each.tick - new.tick) <= self._late]
        self._ahead = [*kept, new]
        parts = {new.part, *(each.part for each in near)}
        goes_on = any(
            each.part == new.part and each.tick < new.tick and each.newest == self._newest
            for each in near
        )
        if goes_on or (len(parts) > 1 and 2 * len(parts) > len(self.parts)):
            self._ahead = [each for each in kept if each not in near]
            for each in (*near, new):
                self._keep(*each[:3])

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
        if self._newest < 0:  # too little came for any doubt
            for each in self._ahead:
                self._keep(*each[:3])
        else:
            self.displaced += len(self._ahead)
        self._ahead = []
        while self._ticks:
            yield self._out(min(self._ticks))

    def _follows(self, tick: int) -> bool:
        """Return whether no earlier tick can still come: a run begins with tick 0."""
        return tick == self.last + 1

    def _out(self, tick: int) -> tuple[int, dict[str, Any]]:
        self.last = tick
        return tick, self._ticks.pop(tick)
