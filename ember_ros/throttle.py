"""What is said over and over, said now and then with a count.

A log of a thousand lines a minute hides the one that matters, and one that drops lines in silence
ends with what is over already. So a matter has a few lines a window of time; of those held back,
the last one is said when the window ends, with how many there were.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

SAY_S = 5.0
"""A window: wall time from a matter's first line on, s."""
AT_ONCE = 2
"""Lines a window that are said at once: that somebody is absent, and that it is back."""


class _Matter(NamedTuple):
    since: float
    said: int
    held: int
    last: str


class Throttle:
    """Lets the lines on a matter through, or holds them back."""

    def __init__(
        self,
        say: Callable[[str], object],
        window_s: float = SAY_S,
        at_once: int = AT_ONCE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin with nothing said; lines go to ``say``."""
        self._emit, self._window_s, self._at_once, self._clock = say, window_s, at_once, clock
        self._matters: dict[str, _Matter] = {}

    def say(self, matter: str, text: str) -> None:
        """Say a line now, or hold it back."""
        now, known = self._clock(), self._matters.get(matter)
        if known is None or now - known.since >= self._window_s:
            self._matters[matter] = _Matter(now, 1, 0, "")
            self._tell(text, known.held if known else 0)
        elif known.said < self._at_once:
            self._matters[matter] = known._replace(said=known.said + 1)
            self._tell(text, 0)
        else:
            self._matters[matter] = known._replace(held=known.held + 1, last=text)

    def remind(self, matter: str, text: str) -> None:
        """Say once a window that something still is so; when it is over, it is said no more."""
        now, known = self._clock(), self._matters.get(matter)
        if known is None or now - known.since >= self._window_s:
            self._matters[matter] = _Matter(now, 1, 0, "")
            self._tell(text, 0)

    def flush(self) -> None:
        """Say the last line held back of each matter whose window is over; to be called often."""
        now = self._clock()
        for name, matter in self._matters.items():
            if matter.held and now - matter.since >= self._window_s:
                self._matters[name] = _Matter(now, self._at_once, 0, "")
                self._tell(matter.last, matter.held - 1)

    def _tell(self, text: str, more: int) -> None:
        self._emit(f"{text} (and {more} more such lines)" if more else text)
