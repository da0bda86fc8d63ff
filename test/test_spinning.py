"""The environment that a process of ROS 2 starts with."""

from __future__ import annotations

import os

import pytest

from ember_ros.spinning import TRANSPORT_VARIABLES, prepare_environment

pytestmark = pytest.mark.ros


@pytest.fixture
def no_transports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unset all variables that select transports; restore them afterwards."""
    for name in TRANSPORT_VARIABLES:
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


@pytest.mark.usefixtures("no_transports")
def test_messages_go_by_udp_because_a_killed_process_breaks_shared_memory() -> None:
    """Shared memory is off where the user selected no transports."""
    prepare_environment()
    assert os.environ["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4"


@pytest.mark.usefixtures("no_transports")
@pytest.mark.parametrize("name", TRANSPORT_VARIABLES)
def test_transports_that_the_user_selects_stay(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Neither variable is changed or added if one of them is set."""
    monkeypatch.setenv(name, "DEFAULT")
    before = dict(os.environ)
    prepare_environment()
    after = {key: os.environ.get(key) for key in TRANSPORT_VARIABLES}
    assert after == {key: before.get(key) for key in TRANSPORT_VARIABLES}
