"""Rate-limited logging: repeated lines are logged a few times per window, with a count.

A thousand lines per minute hide the one that matters. A log that drops lines silently ends with a
state that is no longer true. So each key has a few lines per window; of the lines held back, the
last one is logged when the window ends, with the number of lines it stands for.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

LOG_WINDOW_S = 5.0
"""Wall time of a window, which starts with the first line of a key, s."""
MAX_TEXT = 500
"""Characters of a line; more are cut off: a message of another node may quote megabytes."""
BURST = 2
"""Lines per window that are logged at once: that a leg is absent, and that it is back."""


class _Window(NamedTuple):
    start: float
    logged: int
    suppressed: int
    last: str


class Throttle:
    """Logs the lines of a key, or holds them back until its window ends."""

    def __init__(
        self,
        log: Callable[[str], object],
        window_s: float = LOG_WINDOW_S,
        burst: int = BURST,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start without open windows.

        Args:
            log: receives each line that is logged.
            window_s: length of a window, s.
            burst: lines of a key that are logged at once in a window.
            clock: returns the time, s.
        """
        self._log, self._window_s, self._burst, self._clock = log, window_s, burst, clock
        self._windows: dict[str, _Window] = {}

    def log(self, key: str, text: str) -> None:
        """Log a line now, or hold it back until the window ends."""
        now, window = self._clock(), self._windows.get(key)
        if window is None or now - window.start >= self._window_s:
            self._windows[key] = _Window(now, 1, 0, "")
            self._emit(text, window.suppressed if window else 0)
        elif window.logged < self._burst:
            self._windows[key] = window._replace(logged=window.logged + 1)
            self._emit(text, 0)
        else:
            self._windows[key] = window._replace(suppressed=window.suppressed + 1, last=text)

    def remind(self, key: str, text: str) -> None:
        """Log a state that still holds, once per window; further calls in it are dropped."""
        now, window = self._clock(), self._windows.get(key)
        if window is None or now - window.start >= self._window_s:
            self._windows[key] = _Window(now, 1, 0, "")
            self._emit(text, 0)

    def flush(self) -> None:
        """Log the last suppressed line of each key whose window is over; call it often."""
        now = self._clock()
        for key, window in self._windows.items():
            if window.suppressed and now - window.start >= self._window_s:
                self._windows[key] = _Window(now, self._burst, 0, "")
                self._emit(window.last, window.suppressed - 1)

    def _emit(self, text: str, more: int) -> None:
        if len(text) > MAX_TEXT:
            text = f"{text[:MAX_TEXT]}..."
        self._log(f"{text} (and {more} more such lines)" if more else text)
