"""Tests of isotropy: sliding bodies and walkers behave the same in all directions."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from ember_ros.experiments.reproduction import RESULTS
from ember_ros.params import Params
from support.command import ember
from support.legs import beat
from support.needs import needs_bullet

pytestmark = needs_bullet

PARAMS = Params()
CYCLES = 20


def spread(values: list[float]) -> float:
    """Return the difference of the largest and the smallest value."""
    return max(values) - min(values)


def test_a_body_slides_equally_far_and_straight_in_all_directions() -> None:
    """With axes of the robot distances are equal except for rounding; of the world, within 15 %."""
    from ember_ros.experiments.isotropy import slide

    directions = [n * math.tau / 24 for n in range(24)]
    distances, angles = zip(
        *[slide(PARAMS, heading, "robot") for heading in directions], strict=True
    )
    assert spread(list(distances)) < 1e-3 * min(distances)
    assert max(map(abs, angles)) < 1e-3
    assert min(distances) == pytest.approx(
        1.0 / (2 * PARAMS.physics.gravity), rel=0.05
    )  # v^2 / 2 mu g
    distances, _ = zip(*[slide(PARAMS, heading, "world") for heading in directions], strict=True)
    assert spread(list(distances)) > 0.1 * min(distances)


@pytest.mark.slow
def test_walkers_turn_equally_from_all_headings() -> None:
    """With axes of the robot all walks are equal; with axes of the world headings diverge."""
    from ember_ros.experiments.isotropy import headings, walk

    assert len(headings()) == 8
    walks = [walk(PARAMS, heading, "robot", CYCLES) for heading in headings()]
    assert spread([each["turned_rad"][-1] for each in walks]) < 0.01
    assert spread([each["distance_m"] for each in walks]) < 0.005
    assert {each["falls"] for each in walks} == {0}
    walks = [walk(PARAMS, heading, "world", CYCLES) for heading in headings()]
    assert spread([each["turned_rad"][-1] for each in walks]) > 0.3


def test_a_walker_keeps_its_heading_when_it_falls() -> None:
    """It is put back on its feet at the same place and with the same heading."""
    from ember_ros.params import replace
    from sim_node.walker import WalkerWorld

    world = WalkerWorld(replace(PARAMS, {"walker.fall_height": 0.9}), heading=2.0)
    try:
        for tick in range(PARAMS.gait.ticks):
            world.step(beat(tick), [None] * 4)
        assert world.body().falls == 1
        world.step(beat(32), [None] * 4)
        # It stands for one tick, and the twist of the body turns it a little.
        assert world.body().yaw == pytest.approx(2.0, abs=0.05)
    finally:
        world.close()


@pytest.mark.slow
def test_the_experiment_writes_its_page(tmp_path: Path) -> None:
    """The command runs with a small size, and ``--redraw`` writes the same page again."""
    arguments = ("experiment", "isotropy", "--out", tmp_path, "--trials", tmp_path / "trials")
    assert ember(*arguments, "--cycles", 4, "--walk-cycles", 4) == 0
    results = json.loads((tmp_path / RESULTS / "isotropy.json").read_text())
    assert [len(results["walks"][f"{walker}/robot"]) for walker in ("scripted", "trained")] == [
        8,
        8,
    ]
    page = tmp_path / RESULTS / "isotropy.md"
    before = page.read_text()
    page.write_text("")
    assert ember(*arguments, "--redraw") == 0
    assert page.read_text() == before
