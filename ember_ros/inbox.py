"""Collects the messages of each tick until those of all sources have arrived. Pure.

The sources of a tick arrive in any order. A message may arrive twice, late, or with a stamp far in
the future. A value is only used together with the values of the same tick.
"""

from __future__ import annotations

import enum
from typing import Any

KEPT = 4
"""Ticks kept per source: more than lockstep ever needs, few enough to drop wrong stamps soon."""


class Receipt(enum.Enum):
    """What a message is for the inbox that it was put into."""

    NEW = enum.auto()
    """It belongs to a tick that is not complete yet."""
    REPEATED = enum.auto()
    """It is the same value that the last complete tick was made of."""
    OVER = enum.auto()
    """Its tick is over."""


class Inbox:
    """One slot per source and tick."""

    def __init__(self, *sources: str) -> None:
        """Start empty, before any tick."""
        self.last = -1
        """The last tick that was complete."""
        self._received: dict[str, dict[int, Any]] = {source: {} for source in sources}
        self._last_values: dict[str, Any] = {}  # of the last complete tick
        self._stale: dict[str, tuple[int, Any]] = {}

    def put(self, source: str, tick: int, value: Any) -> Receipt:
        """Store a value, unless its tick is over."""
        if tick <= self.last:
            self._stale[source] = tick, value
            if tick == self.last and (source, value) in self._last_values.items():
                return Receipt.REPEATED
            return Receipt.OVER
        slots = self._received[source]
        slots.pop(tick, None)
        if len(slots) == KEPT:
            del slots[min(slots, key=self._support)]
        slots[tick] = value
        return Receipt.NEW

    def _support(self, tick: int) -> int:
        """Return how many sources have sent a value of a tick.

        A full source drops a tick that no other source knows, such as a wrong stamp, before one
        that is nearly complete; among equals, the one received first. It always takes the newest:
        ticks of which one message was lost must not keep out the ones that follow.
        """
        return sum(tick in slots for slots in self._received.values())

    def pop(self, tick: int) -> tuple[Any, ...] | None:
        """Return all values of a tick, in the order of the sources, and end the tick.

        Values of earlier ticks are dropped, values of later ticks are kept.

        Returns:
            The values, or None while one is missing; then nothing changes.
        """
        values = {}
        for source, slots in self._received.items():
            if tick not in slots:
                return None
            values[source] = slots[tick]
        self.last, self._last_values = tick, values
        self._stale.clear()
        for slots in self._received.values():
            if len(slots) == 1:
                slots.clear()
            else:
                for old in [t for t in slots if t <= tick]:
                    del slots[old]
        return tuple(values.values())

    def pending(self, source: str) -> list[int]:
        """Return the ticks after the last complete one for which ``source`` has a value."""
        return sorted(self._received[source])

    def time_restarted(self) -> bool:
        """Return whether all sources, one after the other, sent the same tick that is over.

        A publisher delivers in order, so this is a new world whose time starts again. A new world
        may also start at the last complete tick if that was tick 0: then its values differ. If they
        do not, the tick was only repeated.

        If time restarted, everything stored is dropped except the values of that tick, which can be
        popped next.
        """
        ticks = {tick for tick, _ in self._stale.values()}
        if len(self._stale) < len(self._received) or len(ticks) > 1:
            return False
        values = {source: value for source, (_, value) in self._stale.items()}
        if self.last in ticks and (self.last > 0 or values == self._last_values):
            return False
        self.last, self._last_values = -1, {}
        for source, slots in self._received.items():
            slots.clear()
            slots.update([self._stale[source]])
        self._stale.clear()
        return True
