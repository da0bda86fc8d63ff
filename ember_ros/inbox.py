"""What a leg has heard of each tick, until all of a tick is there. Pure.

The sources of a tick come in any order, and some may come twice, late, or with a stamp of the far
future. The phase says what tick it is; nothing of another tick is ever used with it.
"""

from __future__ import annotations

from typing import Any

KEPT = 4
"""Ticks kept of each source: more than lockstep ever needs, few enough to forget bad ones."""


class Inbox:
    """One slot a source and tick."""

    def __init__(self, *sources: str) -> None:
        """Begin empty, before any tick."""
        self.last = -1
        """The last tick that was complete."""
        self._heard: dict[str, dict[int, Any]] = {source: {} for source in sources}
        self._stale: dict[str, tuple[int, Any]] = {}

    def put(self, source: str, tick: int, value: Any) -> bool:
        """Keep a value; return False if its tick is over."""
        if tick <= self.last:
            self._stale[source] = tick, value
            return False
        heard = self._heard[source]
        heard.pop(tick, None)
        heard[tick] = value
        if len(heard) > KEPT:
            del heard[next(iter(heard))]  # the one heard first
        return True

    def take(self, tick: int) -> tuple[Any, ...] | None:
        """Return all values of a tick in the order of sources if they are there, and end it.

        What is of earlier ticks goes; what is of later ones stays.
        """
        values = []
        for heard in self._heard.values():
            if tick not in heard:
                return None
            values.append(heard[tick])
        self.last = tick
        self._stale.clear()
        for heard in self._heard.values():
            if len(heard) == 1:
                heard.clear()
            else:
                for old in [t for t in heard if t <= tick]:
                    del heard[old]
        return tuple(values)

    def later(self, source: str) -> list[int]:
        """Return the ticks after the last complete one of which ``source`` was heard."""
        return sorted(self._heard[source])

    def began_anew(self) -> bool:
        """Return whether all sources, one after the other, spoke of one tick that is over.

        A publisher delivers in order, so this is a new world whose time begins anew; then all that
        was heard is forgotten but for this tick, which is there to be taken.
        """
        ticks = {tick for tick, _ in self._stale.values()}
        if len(self._stale) < len(self._heard) or len(ticks) > 1 or self.last in ticks:
            return False
        self.last = -1
        for source, heard in self._heard.items():
            heard.clear()
            heard.update([self._stale[source]])
        self._stale.clear()
        return True
