"""The keyboard, for a command that listens to it while it runs."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def space() -> Iterator[Callable[[], bool]]:
    """Give a function that tells whether the space key was pressed, where there are keys."""
    if not sys.stdin.isatty():
        yield lambda: False
        return
    import termios
    import tty

    keys = sys.stdin.fileno()
    before = termios.tcgetattr(keys)
    tty.setcbreak(keys)

    def pressed() -> bool:
        if not select.select([keys], [], [], 0.0)[0]:
            return False
        with contextlib.suppress(OSError):  # the terminal is gone
            return os.read(keys, 64).count(b" ") % 2 == 1
        return False

    try:
        yield pressed
    finally:
        with contextlib.suppress(termios.error):  # the same
            termios.tcsetattr(keys, termios.TCSADRAIN, before)
