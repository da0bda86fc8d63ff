"""How a Python of our own is started: with our modules, and with none of the working directory.

``python -m`` puts the working directory before the installed packages, so that a user's own
``yaml.py`` or ``leg_node`` there would be imported in their place. ``python -P``, which does not,
came with Python 3.11.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

STOP_S = 20.0
"""Wall time a process may take to stop before it is killed."""
AGAIN_S = 1.0
_ROOM = str(Path(__file__).resolve().parents[1])  # last: it may be a bare checkout


def module_command(module: str, *, begin: str = "") -> list[str]:
    """Return the command that runs a module of ours; arguments for it come behind.

    Args:
        module: its dotted name.
        begin: Python that is run before it.
    """
    code = (
        f"import sys; sys.path[:] = [*filter(None, sys.path), {_ROOM!r}]; {begin}import runpy; "
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code]


def child_command(module: str) -> list[str]:
    """Return the same for a child that ends when its standard input does.

    Its parent holds the other end, and never writes: it ends when the parent is gone, however that
    ended.
    """
    return module_command(
        module, begin=f"from {__name__} import end_with_input; end_with_input(); "
    )


def end_with_input() -> None:
    """Have this process end as by Ctrl-C when there is no more standard input."""
    threading.Thread(target=_end_with_input, daemon=True).start()


def _end_with_input() -> None:
    while os.read(0, 1024):
        pass
    deadline = time.monotonic() + STOP_S
    while time.monotonic() < deadline:
        # Again and again: at first nobody may be listening yet.
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(AGAIN_S)
    os._exit(1)
