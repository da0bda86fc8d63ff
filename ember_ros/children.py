"""Commands that start a module of this package in another Python process.

``python -m`` searches the working directory before the installed packages, so a user's own
``yaml.py`` or ``leg_node`` there would be imported instead. ``python -P`` avoids this, but needs
Python 3.11.
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
RESEND_S = 1.0  # wall time between two signals
_ROOT = str(Path(__file__).resolve().parents[1])  # appended last: it may be a bare checkout


def module_command(module: str, *, first: str = "") -> list[str]:
    """Return the command that runs a module of this package; append its arguments.

    Args:
        module: its dotted name.
        first: Python code that runs before the module.
    """
    code = (
        f"import sys; sys.path[:] = [*filter(None, sys.path), {_ROOT!r}]; {first}import runpy; "
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code]


def child_command(module: str) -> list[str]:
    """Return the command for a child process that ends when its standard input is closed.

    Its parent holds the other end of the pipe and never writes, so the child ends when the parent
    ends, however the parent ends.
    """
    return module_command(
        module, first=f"from {__name__} import end_with_stdin; end_with_stdin(); "
    )


def end_with_stdin() -> None:
    """End this process, as Ctrl-C would, when its standard input is closed."""
    threading.Thread(target=_end_with_stdin, daemon=True).start()


def _end_with_stdin() -> None:
    while os.read(0, 1024):
        pass
    deadline = time.monotonic() + STOP_S
    while time.monotonic() < deadline:
        # Repeated, because the handler may not be installed yet.
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(RESEND_S)
    os._exit(1)
