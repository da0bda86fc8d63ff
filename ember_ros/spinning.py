"""How a node lives: made, spun, stopped by a signal or by itself, and left in good order.

``EventsExecutor`` costs a third of the default executor's time a callback and delivers in one
order, but its ``spin`` ignores signals (rclpy 7.1): so it is spun in short turns here, and rclpy's
own signal handlers, which would shut the context down before a leg could hand in what it has
learnt, are left out.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, TypeVar

TURN_S = 0.1  # the longest time until a signal is heard
HAND_IN_S = 3.0
"""Least wall time that a leg that ends waits for the table to take what it learnt last."""
LINGER_S = 4.0
"""Wall time that a node which is asked to stop serves those that still need it: longer than they
wait for it, and less than the 5 s after which ``ros2 launch`` sends a stronger signal."""


def prepare_environment() -> None:
    """Set sane defaults before rclpy is initialised; what the user set stands.

    Discovery stays on this machine: two people in one lab do not drive each other's robots. Logs
    go to a folder of our own where there is no home that could hold them.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    home = Path(os.environ.get("HOME", ""))
    if "ROS_LOG_DIR" not in os.environ and not (
        os.environ.get("HOME") and home.is_dir() and os.access(home, os.W_OK)
    ):
        os.environ["ROS_LOG_DIR"] = str(Path(tempfile.gettempdir()) / "ember_ros_log")


class Spinnable(Protocol):
    """What every node here has besides being an rclpy node."""

    done: bool
    """True once the node has nothing more to do."""

    def finish(self, spin: Callable[[], None]) -> None:
        """Bring home what must not be lost; ``spin`` lets the node's callbacks run for a turn."""
        ...

    def destroy_node(self) -> Any:
        """Destroy the node."""
        ...


def _init(args: list[str] | None) -> None:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from ember_ros.errors import ParameterError

    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy's own error is not public
        raise ParameterError(f"these ROS arguments cannot be used: {error}") from error


class Stop:
    """Whether SIGINT or SIGTERM came."""

    def __init__(self) -> None:
        """Begin unasked."""
        self.asked = False

    def ask(self, number: int = 0, frame: FrameType | None = None) -> None:
        """Ask everybody who looks to come to an end."""
        self.asked = True


@contextmanager
def stop_signals() -> Iterator[Stop]:
    """Turn SIGINT and SIGTERM into a flag for as long as the block lasts."""
    stop = Stop()
    before = {s: signal.signal(s, stop.ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


N = TypeVar("N", bound=Spinnable)


def main_of(
    make: Callable[..., N],
    args: list[str] | None = None,
    needed: Callable[[N], bool] = lambda node: False,
) -> int:
    """Run one node as a process: the body of every ``main``.

    Args:
        make: the node's class.
        args: as ``rclpy.init`` takes them.
        needed: whether others still need the node that is asked to stop. Ctrl-C in ``ros2 launch``
            reaches all nodes at once; who is needed goes on for at most ``LINGER_S``.

    Returns:
        0 after a signal or when the node is done, 2 for a mistake of the user's, said in one line.
    """
    prepare_environment()
    import rclpy
    from rclpy.experimental.events_executor import EventsExecutor

    from ember_ros.errors import EmberError

    with stop_signals() as stop:
        node: N | None = None
        try:
            _init(args)
            node = make()
            executor = EventsExecutor()
            executor.add_node(node)
            while not stop.asked and not node.done:
                executor.spin_once(timeout_sec=TURN_S)
            deadline = time.monotonic() + LINGER_S
            while needed(node) and time.monotonic() < deadline:
                executor.spin_once(timeout_sec=TURN_S)
            node.finish(lambda: executor.spin_once(timeout_sec=TURN_S))
            return 0
        except EmberError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
