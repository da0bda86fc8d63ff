"""Collects the parts of each tick, in whatever order they arrive. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

LATE = 64
"""Ticks after which a tick no longer waits for its missing parts: two cycles.

A part that is further ahead of the newest tick is kept aside until other parts confirm it: one
wrong stamp must not make everything that follows late.
"""


class _Ahead(NamedTuple):
    """A part of a tick far ahead of the newest one."""

    tick: int
    part: str
    value: Any
    newest: int
    """The newest tick when the part arrived."""


class Window:
    """The parts of ticks that are not complete yet; each tick is returned once, and in order."""

    def __init__(
        self,
        parts: Sequence[str],
        is_complete: Callable[[Mapping[str, Any]], bool] = lambda parts: True,
        late: int = LATE,
    ) -> None:
        """Begin before tick 0.

        Args:
            parts: names of what a complete tick has; parts of other names are kept too.
            is_complete: a further condition on the parts of a tick that has all of them.
            late: ticks after which a tick is returned without its missing parts.
        """
        self.parts = frozenset(parts)
        self._is_complete = is_complete
        self.last = -1
        """The last tick that was returned."""
        self._late = late
        self._ticks: dict[int, dict[str, Any]] = {}
        self._newest = -1
        self._ahead: list[_Ahead] = []
        self.displaced = 0
        """Parts that were dropped, since no others arrived for ticks near theirs."""

    @property
    def newest(self) -> int:
        """Return the newest tick that has a part, -1 before the first."""
        return self._newest

    def put(self, tick: int, part: str, value: Any) -> bool:
        """Keep a part; return False if its tick was returned before."""
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
        """Keep a part that is far ahead aside until others confirm its tick.

        They do when more than half of the parts are near it, or when the same part goes on there
        while the newest tick stays the same.
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

    def pop_complete(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield the ticks that are complete or late, in order, each after all earlier ones."""
        while self._ticks:
            tick = min(self._ticks)
            parts = self._ticks[tick]
            complete = (
                self.parts <= parts.keys() and self._follows(tick) and self._is_complete(parts)
            )
            if not complete and self._newest - tick < self._late:
                return
            yield self._pop(tick)

    def pop_rest(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield all ticks that are left, in order."""
        if self._newest < 0:  # too few parts to doubt any
            for each in self._ahead:
                self._keep(*each[:3])
        else:
            self.displaced += len(self._ahead)
        self._ahead = []
        while self._ticks:
            yield self._pop(min(self._ticks))

    def _follows(self, tick: int) -> bool:
        """Return whether no earlier tick can still arrive: a run begins with tick 0."""
        return tick == self.last + 1

    def _pop(self, tick: int) -> tuple[int, dict[str, Any]]:
        self.last = tick
        return tick, self._ticks.pop(tick)
