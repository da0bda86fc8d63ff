"""Fixtures that several test files share, and the marks that no test has to carry itself."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import pytest
from hypothesis import settings

from ember_ros.plan import Plan
from support import ros as own
from support import runs
from support.ros import Ros
from support.runs import Bits

ROS = find_spec("rclpy") is not None
SIM = find_spec("pybullet") is not None

# The pure tests run without ROS; these cannot even be imported.
collect_ignore = (
    []
    if ROS and SIM
    else [
        "test_wire.py",
        "test_nodes.py",
        "test_graph.py",
        "test_processes.py",
        "test_bag_nodes.py",
        "test_installed.py",
        "test_seat.py",
    ]
)

# The same examples every time; a slow machine fails no test.
settings.register_profile("ember", deadline=None, derandomize=True)
settings.load_profile("ember")


def pytest_report_header() -> list[str]:
    """Say which tests are left out, and why."""
    return [f"left out, rclpy or pybullet is missing: {', '.join(collect_ignore)}"] * (
        not (ROS and SIM)
    )


@pytest.fixture(scope="session", autouse=True)
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep discovery on this machine, and logs out of the user's home.

    Below ``nohup`` a SIGHUP is ignored, and by all that is started here too.
    """
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("log")))
        patch.delenv("ROS_LOCALHOST_ONLY", raising=False)
        patch.delenv("ROS_STATIC_PEERS", raising=False)
        yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def by_loop() -> Callable[[Plan], Bits]:
    """Run a plan in the loop, the specification, once a session."""
    return runs.by_loop


@pytest.fixture
def by_graph() -> Callable[[Any], Bits]:
    """Return the bits of a ``Graph`` that has run."""
    return runs.by_graph


@pytest.fixture
def ros() -> Iterator[Ros]:
    """Give a test an rclpy context in a domain of its own, and its processes that domain."""
    with own.ros_in_own_domain() as ros, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(ros.domain))
        yield ros


@pytest.fixture(scope="module")
def ros_of_module() -> Iterator[Ros]:
    """Give the tests of a module one context in one domain, and their processes that domain."""
    with own.ros_in_own_domain() as ros, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(ros.domain))
        yield ros


@pytest.fixture
def free_domain() -> Iterator[int]:
    """Reserve a domain id for a test that starts a whole graph itself."""
    with own.reserved_domain() as domain:
        yield domain
