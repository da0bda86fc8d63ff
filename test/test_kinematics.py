"""Geometry of the leg: what height its angles give, and what bend of the knee gives a height."""

from __future__ import annotations

import hashlib
import math
import struct
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros.kinematics import arc_cosine, cosine, height, knee_for_height
from ember_ros.params import Leg

LEG = Leg()
UNEQUAL = Leg(thigh_length=0.31, shank_length=0.22, foot_radius=0.03)
EXACT = 1e-12  # m and rad: rounding of a few sines
EPSILON = sys.float_info.epsilon
GOLDEN = "9e4d0876eb78d0f4ade5653baae8465c7d508a4945719b97eace7707c2a1aef3"


@settings(max_examples=500, deadline=None, derandomize=True)
@given(angle=st.floats(-7.0, 7.0))
def test_the_cosine_is_the_cosine(angle: float) -> None:
    """To the rounding of an angle of this size."""
    assert abs(cosine(angle) - math.cos(angle)) <= 8 * EPSILON


@settings(max_examples=500, deadline=None, derandomize=True)
@given(value=st.floats(-1.0, 1.0))
def test_the_arc_cosine_is_the_arc_cosine(value: float) -> None:
    """To the rounding of an angle of this size."""
    assert abs(arc_cosine(value) - math.acos(value)) <= 8 * EPSILON


def test_cosines_to_the_bit() -> None:
    """On every machine and with every C library: these decide what a leg is paid."""
    angles = [n / 64 - 5.0 for n in range(640)]
    bits = struct.pack("<640d", *map(cosine, angles))
    bits += struct.pack("<640d", *(arc_cosine(n / 320 - 1.0) for n in range(640)))
    assert hashlib.sha256(bits).hexdigest() == GOLDEN


def test_a_straight_leg_is_as_high_as_it_is_long() -> None:
    """Straight down, the height is thigh and shank; the radius of the foot is part of the shank."""
    assert height(LEG, 0.0, 0.0) == pytest.approx(0.5, abs=EXACT)
    assert height(UNEQUAL, 0.0, 0.0) == pytest.approx(0.53, abs=EXACT)


def test_height_of_a_bent_leg() -> None:
    """A shank that is level adds only the foot's radius; the thigh's tilt is inclination + knee."""
    assert height(LEG, math.pi / 2, -math.pi / 2) == pytest.approx(0.25 + 0.02, abs=EXACT)
    assert height(LEG, math.pi / 3, 0.0) == pytest.approx(0.125 + 0.25, abs=EXACT)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    leg=st.sampled_from([LEG, UNEQUAL]),
    thigh=st.floats(-1.2, 1.2),
    bend=st.floats(0.0, 1.5),
)
def test_bend_and_height_invert_each_other(leg: Leg, thigh: float, bend: float) -> None:
    """For a foot behind its knee: the height that a bend gives asks for that very bend."""
    if bend < thigh:
        bend = thigh  # else the foot is ahead of the knee: the other solution
    found = knee_for_height(leg, thigh, height(leg, bend, thigh - bend))
    assert height(leg, found, thigh - found) == pytest.approx(
        height(leg, bend, thigh - bend), abs=EXACT
    )
    # Near an upright shank the height hardly depends on the bend: a square root of the rounding.
    assert found == pytest.approx(bend, abs=1e-6)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(thigh=st.floats(-1.2, 1.2), wanted=st.floats(0.0, 1.0))
def test_a_bend_is_always_one_that_the_knee_has(thigh: float, wanted: float) -> None:
    """Whatever is wanted, the bend is within the knee's limits, and it is right if they allow."""
    found = knee_for_height(LEG, thigh, wanted)
    assert 0.0 <= found <= LEG.knee_max
    if 0.0 < found < LEG.knee_max and wanted <= height(LEG, thigh, 0.0):
        assert height(LEG, found, thigh - found) == pytest.approx(wanted, abs=EXACT)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(thigh=st.floats(-1.2, 1.2), one=st.floats(0.0, 1.0), other=st.floats(0.0, 1.0))
def test_a_higher_hip_needs_no_more_bend(thigh: float, one: float, other: float) -> None:
    """The bend falls as the height wanted rises: a controller that uses it cannot run away."""
    low, high = sorted((one, other))
    assert knee_for_height(LEG, thigh, low) >= knee_for_height(LEG, thigh, high)


def test_too_high_is_the_shank_upright() -> None:
    """Out of reach upward: the bend that puts the shank straight down, or no bend at all."""
    assert knee_for_height(LEG, 0.5, 9.0) == 0.5
    assert knee_for_height(LEG, -0.5, 9.0) == 0.0


def test_too_low_is_the_largest_bend() -> None:
    """Out of reach downward: all the knee has."""
    assert knee_for_height(LEG, 0.0, 0.0) == LEG.knee_max
    assert knee_for_height(LEG, 0.5, -9.0) == LEG.knee_max
