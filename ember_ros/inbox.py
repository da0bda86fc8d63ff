"""Collects the messages of each tick until those of all sources have arrived. Pure.

The sources of a tick arrive in any order. A message may arrive twice, late, or with a stamp far in
the future. A value is only used together with the values of the same tick.
"""

from __future__ import annotations

from typing import Any

KEPT = 4
"""Ticks kept per source: more than lockstep ever needs, few enough to drop wrong stamps soon."""


class Inbox:
    """One slot per source and tick."""

    def __init__(self, *sources: str) -> None:
        """Start empty, before any tick."""
        self.last = -1
        """The last tick that was complete."""
        self._received: dict[str, dict[int, Any]] = {source: {} for source in sources}
        self._stale: dict[str, tuple[int, Any]] = {}

    def put(self, source: str, tick: int, value: Any) -> bool:
        """Store a value; return False if its tick is over."""
        if tick <= self.last:
            self._stale[source] = tick, value
            return False
        slots = self._received[source]
        slots.pop(tick, None)
        slots[tick] = value
        if len(slots) > KEPT:
            del slots[next(iter(slots))]  # the one received first
        return True

    def pop(self, tick: int) -> tuple[Any, ...] | None:
        """Return all values of a tick, in the order of the sources, and end the tick.

        Values of earlier ticks are dropped, values of later ticks are kept.

        Returns:
            The values, or None while one is missing; then nothing changes.
        """
        values = []
        for slots in self._received.values():
            if tick not in slots:
                return None
            values.append(slots[tick])
        self.last = tick
        self._stale.clear()
        for slots in self._received.values():
            if len(slots) == 1:
                slots.clear()
            else:
                for old in [t for t in slots if t <= tick]:
                    del slots[old]
        return tuple(values)

    def pending(self, source: str) -> list[int]:
        """Return the ticks after the last complete one for which ``source`` has a value."""
        return sorted(self._received[source])

    def time_restarted(self) -> bool:
        """Return whether all sources, one after the other, sent the same tick that is over.

        A publisher delivers in order, so this is a new world whose time starts again. In this case
        everything stored is dropped except the values of that tick, which can be popped next.
        """
        ticks = {tick for tick, _ in self._stale.values()}
        if len(self._stale) < len(self._received) or len(ticks) > 1 or self.last in ticks:
            return False
        self.last = -1
        for source, slots in self._received.items():
            slots.clear()
            slots.update([self._stale[source]])
        self._stale.clear()
        return True
