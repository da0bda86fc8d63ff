"""Fixtures that several test files share, and the marks that no test has to carry itself."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import pytest
from hypothesis import settings

from ember_ros.run_config import RunConfig
from support import runs
from support.needs import ROS
from support.ros import Ros, reserved_domain, ros_in
from support.runs import Bits

SIM = find_spec("pybullet") is not None

ROS_FILES = (
    "test_bag_nodes.py",
    "test_graph.py",
    "test_installed.py",
    "test_nodes.py",
    "test_processes.py",
    "test_name_lock.py",
    "test_wire.py",
)
"""All tests in these need ROS: without rclpy they cannot even be imported."""
ROS_FIXTURES = {"free_domain", "ros", "ros_of_module"}
ROS_WAYS = {"graph", "processes"}
"""Parameters of tests that name a way to run which needs ROS."""

collect_ignore = [] if ROS and SIM else [*ROS_FILES]

# The same examples every time; a slow machine fails no test.
settings.register_profile("ember", deadline=None, derandomize=True)
settings.load_profile("ember")


def pytest_report_header() -> list[str]:
    """Say which tests are left out, and why."""
    return [f"left out, rclpy or pybullet is missing: {', '.join(collect_ignore)}"] * (
        not (ROS and SIM)
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what needs ROS by its file, fixtures and parameters; skip it where rclpy is missing."""
    for item in items:
        assert isinstance(item, pytest.Function)
        given = item.callspec.params.values() if hasattr(item, "callspec") else ()
        if (
            item.path.name in ROS_FILES
            or not ROS_FIXTURES.isdisjoint(item.fixturenames)
            or any(isinstance(each, str) and each in ROS_WAYS for each in given)
        ):
            item.add_marker(pytest.mark.ros)
        if item.get_closest_marker("ros") and not ROS:
            item.add_marker(pytest.mark.skip(reason="rclpy is missing"))


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
def by_loop() -> Callable[[RunConfig], Bits]:
    """Run a plan in the loop, the specification, once a session."""
    return runs.by_loop


@pytest.fixture
def by_graph() -> Callable[[Any], Bits]:
    """Return the bits of a ``Graph`` that has run."""
    return runs.by_graph


@pytest.fixture
def free_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Give a test and its processes a domain of their own."""
    with reserved_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield domain


@pytest.fixture
def ros(free_domain: int) -> Iterator[Ros]:
    """Give a test an rclpy context in its domain."""
    with ros_in(free_domain) as ros:
        yield ros


@pytest.fixture(scope="module")
def ros_of_module() -> Iterator[Ros]:
    """Give the tests of a module one context in one domain, and their processes that domain."""
    with reserved_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        with ros_in(domain) as ros:
            yield ros


@pytest.fixture(autouse=True)
def domain(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give every test that is marked ``ros`` a domain of its own, and let no other start ROS."""
    if request.node.get_closest_marker("ros") is None:
        # No number: rclpy and ember refuse it, and say it.
        monkeypatch.setenv("ROS_DOMAIN_ID", "this test is not marked ros")
    elif "ros_of_module" not in request.fixturenames:
        request.getfixturevalue("free_domain")
