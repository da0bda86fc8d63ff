"""Runs a node as a process: creates it, spins it, finishes it after a signal or when it is done.

``EventsExecutor`` needs a third of the default executor's time per callback and delivers in a fixed
order, but its ``spin`` ignores signals (rclpy 7.1). So it is spun with a short timeout here. The
signal handlers of rclpy are not installed: they would shut the context down before a leg could push
its last updates.
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
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, Protocol, TypeVar

MAX_DOMAIN = 232
"""Greatest ROS_DOMAIN_ID: greater ones give port numbers beyond those of UDP."""
SHUTDOWN_S = 5.0
"""Wall time that a node has to leave the graph after everything is saved, s."""
SPIN_S = 0.1
"""Timeout of one spin, s: the longest time until a signal takes effect."""
FINAL_PUSH_S = 3.0
"""Minimum wall time that a leg that ends waits for the table to acknowledge its last push, s."""
LINGER_S = 4.0
"""Wall time that a stopping node still serves other nodes, s: longer than they wait for it, and
less than the 5 s after which ``ros2 launch`` sends a stronger signal."""


def prepare_environment() -> None:
    """Set default environment variables before rclpy is initialised; variables that are set stay.

    Discovery is limited to this machine, so that two people in one lab do not drive each other's
    robots. Without a writable home, logs go to a temporary folder.

    Raises:
        ParameterError: ROS 2 cannot start in this environment. In some of these cases its C code
            would end the process without a message.
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
                f"ROS_LOG_DIR={logs}: cannot write a log there: {error.strerror}"
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
    """Check in a separate process that ROS starts with the middleware that the user selected.

    Raises:
        ParameterError: it does not.
    """
    from ember_ros.errors import ParameterError

    middleware = os.environ.get("RMW_IMPLEMENTATION", "")
    if middleware in ("", "rmw_fastrtps_cpp"):
        return
    code = "import rclpy; rclpy.init(); rclpy.create_node('probe'); rclpy.try_shutdown()"
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd="/",  # so that nothing in the working directory is imported
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    if result.returncode:
        raise ParameterError(
            f"RMW_IMPLEMENTATION={middleware}: ROS 2 does not start with it; install it, or unset "
            "the variable"
        )


class Spinnable(Protocol):
    """The interface that all nodes of this package have in addition to rclpy's ``Node``."""

    GROUPS: ClassVar[tuple[str, ...]]
    """The groups of parameters that it declares."""
    OPTIONS: ClassVar[tuple[str, ...]]
    """The options that it declares, see ``ember_ros.options``."""
    done: bool
    """True once the node has nothing more to do."""

    def finish(self, spin: Callable[[], None]) -> None:
        """Save what must not be lost; ``spin`` runs the node's callbacks once."""
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


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stop:
    """A flag that is set by ``STOP_SIGNALS``."""

    def __init__(self) -> None:
        """Start with no stop requested."""
        self.requested = False

    def request(self, number: int = 0, frame: FrameType | None = None) -> None:
        """Set the flag; has the signature of a signal handler."""
        self.requested = True
        if number == signal.SIGHUP:
            detach_terminal()


def detach_terminal() -> None:
    """Redirect standard streams to /dev/null if they belong to a terminal that is closed.

    Writing to it would fail, and the table must be saved all the same.
    """
    with open(os.devnull, "r+b", buffering=0) as devnull:
        for each in (0, 1, 2):
            with suppress(OSError):  # closed
                if stat.S_ISCHR(os.fstat(each).st_mode) and not os.isatty(each):
                    os.dup2(devnull.fileno(), each)


@contextmanager
def stop_signals() -> Iterator[Stop]:
    """Turn SIGINT, SIGTERM and SIGHUP into a flag while the block runs.

    A SIGHUP that is ignored, as under ``nohup``, stays ignored.
    """
    stop = Stop()
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    before = {
        s: signal.signal(s, stop.request)
        for s in STOP_SIGNALS
        if not (ignored and s == signal.SIGHUP)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


N = TypeVar("N", bound=Spinnable)


def _without_ros_args(args: Sequence[str]) -> list[str]:
    """Return the arguments that are not ROS arguments, which follow ``--ros-args``."""
    own, for_ros = [], False
    for each in args:
        if each == "--ros-args":
            for_ros = True
        elif for_ros and each == "--":
            for_ros = False
        elif not for_ros:
            own.append(each)
    return own


def _executable(node_class: type[Spinnable]) -> str:
    """Return the name of a node's executable: leg_node for LegNode."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", node_class.__name__).lower()


def usage(node_class: type[Spinnable]) -> str:
    """Return the ``--help`` text of a node: its docstring, its options and its parameters."""
    from ember_ros.options import OPTIONS

    name = _executable(node_class)
    lines = [
        f"usage: {name} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r __ns:=/NAMESPACE]"
        " [-r __node:=NAME]]",
        "",
        inspect.cleandoc(node_class.__doc__ or "").replace("``", ""),
    ]
    if node_class.OPTIONS:
        lines += ["", "Options and their defaults:"]
    for option in node_class.OPTIONS:
        default, doc, choices = OPTIONS[option][:3]
        allowed = f" ({', '.join(choices)})" if choices else ""
        lines.append(f"  {option + ':=' + _yaml(default):24} {doc}{allowed}")
    if node_class.GROUPS:
        groups = ", ".join(f"{group}.*" for group in node_class.GROUPS)
        lines += ["", f"`ember params --describe` lists unit, range and meaning of {groups}."]
    return "\n".join(lines)


def _yaml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value) or "''"


def node_main(
    node_class: type[N],
    args: list[str] | None = None,
    is_needed: Callable[[N], bool] = lambda node: False,
) -> int:
    """Run one node as a process: the body of every ``main``.

    Args:
        node_class: the node's class.
        args: command-line arguments, as for ``rclpy.init``; ``sys.argv`` for None.
        is_needed: whether other nodes still need a node that has to stop. Ctrl-C in ``ros2 launch``
            reaches all nodes at once; a node that is needed continues for at most ``LINGER_S``.

    Returns:
        The exit code: 0 after a signal or when the node is done, or its ``exit_code`` if it has
        one; 2 after an error; 3 if another node holds the name. Errors are printed in one line.
    """
    own_args = _without_ros_args(sys.argv[1:] if args is None else args)
    if not {"-h", "--help"}.isdisjoint(own_args):
        print(usage(node_class))
        return 0
    if own_args:  # rcl would treat world:=trainer as a remap rule and ignore it
        print(
            f"error: {_executable(node_class)} has no argument {own_args[0]!r}; --ros-args -p "
            "NAME:=VALUE sets a parameter, --ros-args -r NAME:=NAME remaps a name, --help lists "
            "the parameters",
            file=sys.stderr,
        )
        return 2
    import rclpy
    from rclpy.experimental.events_executor import EventsExecutor

    from ember_ros.errors import EmberError
    from ember_ros.name_lock import NAME_TAKEN, NameTakenError, wait_until_alone

    with stop_signals() as stop:
        node: N | None = None
        exit_code = 0
        try:
            prepare_environment()
            _init(args)
            node = node_class()
            wait_until_alone([node], lambda: not stop.requested)
            executor = EventsExecutor()
            executor.add_node(node)
            while not stop.requested and not node.done:
                executor.spin_once(timeout_sec=SPIN_S)
            deadline = time.monotonic() + LINGER_S
            while is_needed(node) and time.monotonic() < deadline:
                executor.spin_once(timeout_sec=SPIN_S)
            node.finish(lambda: executor.spin_once(timeout_sec=SPIN_S))
            exit_code = getattr(node, "exit_code", 0)
        except EmberError as error:
            print(f"error: {error}", file=sys.stderr)
            exit_code = NAME_TAKEN if isinstance(error, NameTakenError) else 2
        finally:
            if args is None:  # this process has nothing else to do
                _exit_if_stuck(exit_code)
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown()
        return exit_code


def _exit_if_stuck(exit_code: int) -> None:
    """End this process if it has not ended by itself after ``SHUTDOWN_S``.

    A process that was killed while it used the shared memory of Fast DDS can leave a lock behind on
    which others wait for ever when they leave (eProsima/Fast-DDS issues 5053 and 5469).
    """
    watchdog = threading.Timer(SHUTDOWN_S, os._exit, [exit_code])
    watchdog.daemon = True
    watchdog.start()
