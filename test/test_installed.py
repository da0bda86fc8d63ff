"""Installed, each node is found as ``ros2 run`` finds it, and is started and stopped like any."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ember_ros import topics
from ember_ros.bag.reader import Bag
from ember_ros.entry_points import NODES
from support.ros import Ros, reserved_domain

ARGUMENTS = {
    "sim_node": ("-p", "world:=trainer"),
    "leg_node": ("-p", "leg:=leg", "-p", "stage:=train"),
    "cpg_node": ("-p", "gait.period:=0.5"),
    "table_node": ("-p", "stage:=train"),
    "recorder_node": ("-p", "split_s:=1.0"),
}
STOP_S = 30.0


@pytest.fixture(scope="module")
def prefix() -> Iterator[Path]:
    """Find the package as ``ros2 run`` does."""
    ament = pytest.importorskip("ament_index_python", reason="ament_index_python is not installed")
    with pytest.MonkeyPatch.context() as patch:
        # The wheels' index does not look at Python's own prefix.
        patch.setenv("AMENT_PREFIX_PATH", sys.prefix, prepend=os.pathsep)
        try:
            found = Path(ament.get_package_prefix("ember_ros"))
        except ament.PackageNotFoundError:
            pytest.skip("ember_ros is not installed in this environment: pip install -e .")
        yield found


def executables(prefix: Path) -> dict[str, Path]:
    """Return what ``ros2 run ember_ros`` offers: files with the execute bit."""
    return {
        file.name: file
        for file in sorted((prefix / "lib" / "ember_ros").iterdir())
        if file.is_file() and os.access(file, os.X_OK)
    }


def test_ros2_run_offers_the_nodes_and_nothing_else(prefix: Path) -> None:
    """The marker, package.xml, launch files and five executables lie where ROS looks for them."""
    assert sorted(executables(prefix)) == sorted(NODES)
    share = prefix / "share" / "ember_ros"
    assert (share / "package.xml").is_file()
    assert sorted(file.name for file in (share / "launch").glob("*.launch.py"))


class Ended(NamedTuple):
    """How a process ended."""

    code: int
    out: str
    error: str


def start(file: Path, *arguments: str, **environment: str | None) -> subprocess.Popen[str]:
    """Start an executable; an environment variable of None is taken away."""
    env = {k: v for k, v in {**os.environ, **environment}.items() if v is not None}
    return subprocess.Popen(
        [str(file), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=env,
    )


def ended(process: subprocess.Popen[str]) -> Ended:
    """Wait for the end of a process."""
    try:
        out, error = process.communicate(timeout=STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate(timeout=STOP_S)
        raise
    return Ended(process.returncode, out, error)


@pytest.mark.slow
@pytest.mark.parametrize("homeless", [False, True], ids=["at home", "without a home"])
def test_nodes_walk_as_one_robot_and_stop_with_a_signal(
    ros: Ros, prefix: Path, tmp_path: Path, homeless: bool
) -> None:
    """Started with parameters and a namespace they are a robot; stopped, all end with 0 in silence.

    With SIGINT and with SIGTERM, at home and without one. The recorder's bag is closed well.
    """
    files = executables(prefix)
    number = signal.SIGTERM if homeless else signal.SIGINT
    namespace = "robot_2" if homeless else "robot_1"
    home: dict[str, Any] = {"HOME": None, "ROS_LOG_DIR": None, "ROS_HOME": None} if homeless else {}
    home["TMPDIR"] = str(tmp_path)
    bag = tmp_path / "bag"
    arguments = ARGUMENTS | {"recorder_node": (*ARGUMENTS["recorder_node"], "-p", f"bag:={bag}")}
    running = {
        name: start(
            files[name], "--ros-args", *arguments[name], "-r", f"__ns:=/{namespace}", **home
        )
        for name in NODES
    }
    try:
        clock = ros.messages(topics.CLOCK._replace(name=f"{namespace}/clock"), matched=False)
        # Discovery may take the recorder longer than the robot: it must have ticks of its own.
        told = ros.messages(
            topics.RECORDED._replace(name=f"{namespace}/recorder/tick"), matched=False
        )
        names = {f"/{namespace}/{name}" for name in NODES}
        ros.spin_until(
            lambda: (
                (len(clock) > 20 and sum(m.data >= 0 for m in told) > 4 and names <= ros.alive())
                or any(process.poll() is not None for process in running.values())
            ),
            "the robot walks",
        )
        for name in NODES:
            running[name].send_signal(number)
        ends = {name: ended(process) for name, process in running.items()}
    finally:
        for process in running.values():
            if process.poll() is None:
                process.kill()
            process.communicate(timeout=STOP_S)
    for name, end in ends.items():
        assert end.code == 0, f"{name}: {end.error}"
        for word in ("Traceback", "KeyboardInterrupt", "Exception"):
            assert word not in end.error + end.out, f"{name}: {end.error}"
    with Bag(bag) as recorded:
        assert recorded.robots() == [namespace]
        assert sum(1 for _ in recorded.ticks()) > 0


WRONG = {
    "out of range": ("cpg_node", ("-p", "gait.period:=-1.0"), "gait.period = -1.0 is out of range"),
    "unknown": ("table_node", ("-p", "gait.perod:=0.5"), "did you mean gait.period"),
    "wrong type": ("sim_node", ("-p", "world:=7"), "world = 7 must be"),
    "no bag": ("recorder_node", (), "-p bag:=DIR"),
    "no leg": ("leg_node", (), "front_left"),
    "no table": ("table_node", ("-p", "table:=/no/such.npz"), "/no/such.npz"),
    "no ROS argument": ("cpg_node", ("-p", "gait.period"), "gait.period"),
    "no parameter file": ("cpg_node", ("--params-file", "/no/such.yaml"), "/no/such.yaml"),
}


@pytest.fixture(scope="module")
def mistakes(prefix: Path) -> dict[str, Ended]:
    """Start a node with each mistake, all at once: most of it is waiting for imports."""
    files = executables(prefix)
    with reserved_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        running = {
            what: start(files[name], "--ros-args", *arguments)
            for what, (name, arguments, _) in WRONG.items()
        }
        return {what: ended(process) for what, process in running.items()}


@pytest.mark.slow
@pytest.mark.parametrize("what", WRONG)
def test_a_mistake_is_one_line_and_code_2(mistakes: dict[str, Ended], what: str) -> None:
    """No traceback: one line that begins with ``error:`` and names what was wrong.

    Where rcl itself does not understand its arguments it says so in a line of its own, before.
    """
    code, out, error = mistakes[what]
    lines = [line for line in error.splitlines() if "[rcl]" not in line]
    assert code == 2, error
    assert len(lines) == 1, error
    assert lines[0].startswith("error: ")
    assert WRONG[what][2] in lines[0]
    assert not out
