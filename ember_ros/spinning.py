"""How a node lives: made, spun, stopped by a signal or by itself, and left in good order.

``EventsExecutor`` costs a third of the default executor's time a callback and delivers in one
order, but its ``spin`` ignores signals (rclpy 7.1): so it is spun in short turns here, and rclpy's
own signal handlers, which would shut the context down before a leg could hand in what it has
learnt, are left out.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, Protocol, TypeVar

MAX_DOMAIN = 232
"""Of ROS_DOMAIN_ID: with a greater one, ports are beyond what UDP has."""
TURN_S = 0.1  # the longest time until a signal is heard
FINAL_PUSH_S = 3.0
"""Least wall time that a leg that ends waits for the table to take what it learnt last."""
LINGER_S = 4.0
"""Wall time that a node which is asked to stop serves those that still need it: longer than they
wait for it, and less than the 5 s after which ``ros2 launch`` sends a stronger signal."""


def prepare_environment() -> None:
    """Set sane defaults before rclpy is initialised; what the user set stands.

    Discovery stays on this machine: two people in one lab do not drive each other's robots. Logs
    go to a folder of our own where there is no home that could hold them.

    Raises:
        ParameterError: ROS 2 cannot start in this environment. Its C code ends the process for some
            of this without a word.
    """
    from ember_ros.errors import ParameterError

    domain = os.environ.get("ROS_DOMAIN_ID", "")
    if domain and not (domain.isdecimal() and int(domain) <= MAX_DOMAIN):
        raise ParameterError(f"ROS_DOMAIN_ID={domain}: 0 to {MAX_DOMAIN} would be right")
    logs = os.environ.get("ROS_LOG_DIR", "")
    if logs:
        try:
            os.makedirs(logs, exist_ok=True)
            tempfile.TemporaryFile(dir=logs).close()
        except OSError as error:
            raise ParameterError(
                f"ROS_LOG_DIR={logs}: no log can be written there: {error.strerror}"
            ) from error
    _check_middleware()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    home = Path(os.environ.get("HOME", ""))
    if "ROS_LOG_DIR" not in os.environ and not (
        os.environ.get("HOME") and home.is_dir() and os.access(home, os.W_OK)
    ):
        os.environ["ROS_LOG_DIR"] = str(Path(tempfile.gettempdir()) / "ember_ros_log")


@functools.cache
def _check_middleware() -> None:
    """Start ROS in a process of its own with the middleware that the user asks for.

    Raises:
        ParameterError: it is not here.
    """
    from ember_ros.errors import ParameterError

    asked = os.environ.get("RMW_IMPLEMENTATION", "")
    if asked in ("", "rmw_fastrtps_cpp"):
        return
    code = "import rclpy; rclpy.init(); rclpy.create_node('probe'); rclpy.try_shutdown()"
    tried = subprocess.run(
        [sys.executable, "-c", code],
        cwd="/",  # nothing of the working directory is imported
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    if tried.returncode:
        raise ParameterError(
            f"RMW_IMPLEMENTATION={asked}: ROS 2 does not start with it; install it, or unset the "
            "variable"
        )


class Spinnable(Protocol):
    """What every node here has besides being an rclpy node."""

    GROUPS: ClassVar[tuple[str, ...]]
    """The groups of parameters that it has."""
    OPTIONS: ClassVar[tuple[str, ...]]
    """Its parameters besides."""
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


STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stop:
    """Whether one of ``STOPS`` came."""

    def __init__(self) -> None:
        """Begin unasked."""
        self.requested = False

    def request(self, number: int = 0, frame: FrameType | None = None) -> None:
        """Ask everybody who looks to come to an end."""
        self.requested = True
        if number == signal.SIGHUP:
            detach_terminal()


def detach_terminal() -> None:
    """Have what is said go nowhere, where it went to a terminal that is gone.

    It could not be written, and what is learnt must be saved all the same.
    """
    with open(os.devnull, "r+b", buffering=0) as nowhere:
        for each in (0, 1, 2):
            with suppress(OSError):  # closed
                if stat.S_ISCHR(os.fstat(each).st_mode) and not os.isatty(each):
                    os.dup2(nowhere.fileno(), each)


@contextmanager
def stop_signals() -> Iterator[Stop]:
    """Turn SIGINT, SIGTERM and SIGHUP into a flag for as long as the block lasts.

    A SIGHUP that is ignored, as below ``nohup``, stays ignored.
    """
    stop = Stop()
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    before = {
        s: signal.signal(s, stop.request) for s in STOPS if not (ignored and s == signal.SIGHUP)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


N = TypeVar("N", bound=Spinnable)


def _own(args: Sequence[str]) -> list[str]:
    """Return the arguments that are not for ROS: those do not stand behind ``--ros-args``."""
    own, for_ros = [], False
    for each in args:
        if each == "--ros-args":
            for_ros = True
        elif for_ros and each == "--":
            for_ros = False
        elif not for_ros:
            own.append(each)
    return own


def _executable(make: type[Spinnable]) -> str:
    """Return the name that the node's executable has: LegNode is in leg_node."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", make.__name__).lower()


def usage(make: type[Spinnable]) -> str:
    """Return what ``--help`` says of a node: what it is and which parameters it has."""
    from ember_ros.options import OPTIONS

    name = _executable(make)
    lines = [
        f"usage: {name} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r __ns:=/NAMESPACE]"
        " [-r __node:=NAME]]",
        "",
        inspect.cleandoc(make.__doc__ or "").replace("``", ""),
    ]
    if make.OPTIONS:
        lines += ["", "with these defaults:"]
    for option in make.OPTIONS:
        default, doc, choices = OPTIONS[option][:3]
        told = f" ({', '.join(choices)})" if choices else ""
        lines.append(f"  {option + ':=' + _yaml(default):24} {doc}{told}")
    if make.GROUPS:
        groups = ", ".join(f"{group}.*" for group in make.GROUPS)
        lines += ["", f"`ember params --describe` tells unit, range and meaning of {groups}."]
    return "\n".join(lines)


def _yaml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value) or "''"


def node_main(
    make: type[N],
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
        0 after a signal or when the node is done, 2 for a mistake of the user's, 3 where another
        node is already what this one was to be; both are said in one line.
    """
    own = _own(sys.argv[1:] if args is None else args)
    if not {"-h", "--help"}.isdisjoint(own):
        print(usage(make))
        return 0
    if own:  # rcl would take world:=trainer for a remap rule, and go on without it
        print(
            f"error: {_executable(make)} has no argument {own[0]!r}; --ros-args -p NAME:=VALUE "
            "sets a parameter, --ros-args -r NAME:=NAME remaps, and --help tells more",
            file=sys.stderr,
        )
        return 2
    import rclpy
    from rclpy.experimental.events_executor import EventsExecutor

    from ember_ros.errors import EmberError
    from ember_ros.name_lock import NAME_TAKEN, NameTakenError, wait_until_alone

    with stop_signals() as stop:
        node: N | None = None
        try:
            prepare_environment()
            _init(args)
            node = make()
            wait_until_alone([node], lambda: not stop.requested)
            executor = EventsExecutor()
            executor.add_node(node)
            while not stop.requested and not node.done:
                executor.spin_once(timeout_sec=TURN_S)
            deadline = time.monotonic() + LINGER_S
            while needed(node) and time.monotonic() < deadline:
                executor.spin_once(timeout_sec=TURN_S)
            node.finish(lambda: executor.spin_once(timeout_sec=TURN_S))
            return 0
        except EmberError as error:
            print(f"error: {error}", file=sys.stderr)
            return NAME_TAKEN if isinstance(error, NameTakenError) else 2
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
