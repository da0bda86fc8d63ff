"""Waiting for a condition, with a deadline."""

from __future__ import annotations

import time
from collections.abc import Callable

DEADLINE_S = 180.0
"""Wall time after which a condition is said not to come true. No test that passes waits for it."""


def until(condition: Callable[[], object], what: str, deadline_s: float = DEADLINE_S) -> None:
    """Wait until a condition holds; ``what`` describes it in the error message."""
    deadline = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < deadline, f"did not come true: {what}"
        time.sleep(0.01)


def in_time(deadline_s: float = DEADLINE_S) -> Callable[..., bool]:
    """Return a ``go_on`` function that fails after a deadline."""
    deadline = time.monotonic() + deadline_s

    def go_on(*_: object) -> bool:
        assert time.monotonic() < deadline, "did not end in time"
        return True

    return go_on
