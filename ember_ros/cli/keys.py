"""Keyboard input of a running command."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def space() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether the space key was pressed since its last call.

    Without a terminal it always returns False.
    """
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
        with contextlib.suppress(OSError):  # the terminal is closed
            return os.read(keys, 64).count(b" ") % 2 == 1
        return False

    try:
        yield pressed
    finally:
        with contextlib.suppress(termios.error):  # the terminal is closed
            termios.tcsetattr(keys, termios.TCSADRAIN, before)
