"""What a leg senses, from contacts that are made up: forces, slip, rolling, hair."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ember_ros.params import Params, replace
from ember_ros.signals import LegSense
from sim_node.sensors import LegSensors

PARAMS = Params()
STEPS, RADIUS = PARAMS.physics.substeps, PARAMS.leg.foot_radius
JOINTS = (0.1, 0.5, -1.0, 2.0)


def turned(pitch: float, yaw: float = 0.0) -> tuple[float, float, float, float]:
    """Return a foot's orientation, shank ahead by ``pitch``, robot headed ``yaw`` to the left."""
    half, way = -pitch / 2.0, yaw / 2.0  # turning about y by less than 0 brings the foot ahead
    return (
        -math.sin(half) * math.sin(way),
        math.sin(half) * math.cos(way),
        math.cos(half) * math.sin(way),
        math.cos(half) * math.cos(way),
    )


class Foot:
    """The sensors of a foot, tick after tick."""

    def __init__(self, params: Params = PARAMS) -> None:
        """Begin in the air, upright."""
        self.sensors, self.step, self.tick = LegSensors(params), 0, 0

    def live(
        self,
        *contacts: list[tuple[float, float, float]],
        pitch: float = 0.0,
        yaw: float = 0.0,
        height: float = RADIUS,
    ) -> LegSense:
        """Return what is sensed after a tick of these contacts (force, x, y), a list a step."""
        self.sensors.begin_tick()
        self.tick += 1
        for points in (*contacts, *[[]] * (STEPS - len(contacts))):
            self.step += 1
            for force, x, y in points:
                self.sensors.touch(self.step, force, x, y)
        foot = turned(pitch, yaw)
        return self.sensors.sense(self.tick, self.step, JOINTS, foot, height, first_tick=False)


def test_forces_are_mean_and_peak_of_the_steps() -> None:
    """Steps without contact count as nothing; points of one step add up."""
    sense = Foot().live([(10.0, 0.0, 0.0)], [], [(20.0, 0.0, 0.0), (12.0, 0.1, 0.0)])
    assert sense.force_mean == 42.0 / STEPS
    assert sense.force_peak == 32.0


def test_what_pulls_is_no_contact() -> None:
    """A point without a force, or with one of less than 0, touches nothing."""
    sense = Foot().live([], [], [], [(0.0, 0.0, 0.0), (-5.0, 1.0, 1.0)])
    assert (sense.force_mean, sense.force_peak, sense.contact, sense.slip) == (0, 0, False, 0)


@pytest.mark.parametrize(("last", "touches"), [(STEPS - 1, False), (STEPS, True)])
def test_contact_is_of_the_last_step(last: int, touches: bool) -> None:
    """A foot that left the ground within the tick has borne a force and touches no more."""
    contacts: list[list[tuple[float, float, float]]] = [[(9.0, 0.0, 0.0)] for _ in range(last)]
    sense = Foot().live(*contacts)
    assert sense.force_mean > 0.0
    assert sense.contact is touches


def test_slip_is_the_way_of_the_contact() -> None:
    """From the last step of one tick to the last of the next, along both axes."""
    foot = Foot()
    first = foot.live(*[[(9.0, 0.3, 0.1)]] * STEPS)
    assert first.slip == 0.0
    second = foot.live(*[[(9.0, 0.3 + 0.003 * n, 0.1 + 0.004 * n)] for n in range(1, STEPS + 1)])
    assert second.slip == pytest.approx(0.005 * STEPS)
    assert foot.live(*[[(9.0, 0.3 + 0.003 * STEPS, 0.1 + 0.004 * STEPS)]] * STEPS).slip < 1e-15


def test_a_step_in_the_air_is_no_slip() -> None:
    """A foot that is put down somewhere else did not slide there."""
    foot = Foot()
    foot.live(*[[(9.0, 0.0, 0.0)]] * STEPS)
    assert foot.live([], [], [(9.0, 0.5, 0.0)], [(9.0, 0.5, 0.0)]).slip == 0.0
    foot.live()
    assert foot.live(*[[(9.0, 0.9, 0.0)]] * STEPS).slip == 0.0


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
@pytest.mark.parametrize("turn", [0.1, -0.2])
def test_a_foot_that_rolls_does_not_slip(yaw: float, turn: float) -> None:
    """Its middle moves on by radius times turn, backward for a shank that comes ahead.

    Whichever way the robot heads.
    """
    foot = Foot()
    foot.live(*[[(9.0, 0.0, 0.0)]] * STEPS, yaw=yaw)
    ways = [-RADIUS * turn * n / STEPS for n in range(1, STEPS + 1)]
    contacts = [[(9.0, way * math.cos(yaw), way * math.sin(yaw))] for way in ways]
    assert foot.live(*contacts, pitch=turn, yaw=yaw).slip < 1e-12
    # The same turn on the spot is a foot that spins.
    assert foot.live(*[contacts[-1]] * STEPS, yaw=yaw).slip == pytest.approx(RADIUS * abs(turn))


@given(pitch=st.floats(-3.1, 3.1), yaw=st.floats(-3.1, 3.1))
def test_inclination_is_of_the_shank_against_gravity(pitch: float, yaw: float) -> None:
    """Foot ahead positive, whichever way the robot heads."""
    assert Foot().live(pitch=pitch, yaw=yaw).inclination == pytest.approx(pitch, abs=1e-9)


def test_the_hair_touches_below_its_length() -> None:
    """Under the sole, not under the foot's middle."""
    hair = PARAMS.leg.hair_length
    assert Foot().live(height=RADIUS + hair - 1e-9).hair
    assert not Foot().live(height=RADIUS + hair + 1e-9).hair
    long = replace(PARAMS, {"leg.hair_length": 0.2})
    assert Foot(long).live(height=RADIUS + 0.1).hair


def test_joints_and_restart_pass_as_they_are() -> None:
    """In the order of ``LegSense``."""
    sensors = LegSensors(PARAMS)
    sense = sensors.sense(7, 28, JOINTS, turned(0.0), 1.0, first_tick=True)
    assert (sense.hip, sense.knee, sense.hip_speed, sense.knee_speed) == JOINTS
    assert (sense.tick, sense.first_tick, sense.contact) == (7, True, False)
