"""The command that attacks a robot, in short: every kind of fault is injected and measured."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ember_ros import chaos
from ember_ros.run_config import RunConfig
from ember_ros.spinning import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.slow]


def test_a_robot_recovers_from_faults_and_loses_nothing(tmp_path: Path, free_domain: int) -> None:
    """A few faults of an order drawn from the seed; the report has what was measured."""
    prepare_environment()
    results = chaos.chaos(
        RunConfig("walker", 1, seed=1),
        tmp_path / "robot",
        minutes=0.4,
        seed=4,
        go_on=lambda share, text: True,
        command="of a test",
    )
    kinds = results["kinds"]
    assert results["faults"] == sum(each["faults"] for each in kinds.values()) > 0
    assert results["freezes"] == 0
    assert results["ended_by_themselves"] == []
    assert results["cells_with_fewer_visits"] == 0
    assert 0 < results["learned"] <= results["learned_at_most"]
    names = chaos.write(results, tmp_path)
    assert json.loads((tmp_path / names[0]).read_text()) == results
    page = (tmp_path / names[1]).read_text()
    assert all(f"| {kind} |" in page for kind in kinds)
