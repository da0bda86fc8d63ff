"""The reward: each term's bounds, and which terms count when."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros import kinematics
from ember_ros.params import Params, Reward, replace
from ember_ros.signals import LegSense
from leg_node.reward import PaperReward, force_term, height_term, slip_term

PARAMS = Params()
REWARD, LEG = PARAMS.reward, PARAMS.leg
REWARDER = PaperReward(PARAMS)

THIGH = 0.3
KNEE = kinematics.knee_for_height(LEG, THIGH, LEG.operating_height)
# At the operating height, standing on its load, not sliding: the best there is.
STANDING = LegSense(
    7, THIGH, KNEE, 0.0, 0.0, LEG.load, LEG.load, THIGH - KNEE, 0.0, False, True, False
)
# Straight and level: 2 cm of height are left.
LOW = STANDING._replace(knee=0.0, inclination=math.pi / 2)
IN_THE_AIR: dict[str, Any] = {"force_mean": 0.0, "force_peak": 0.0, "slip": 0.0, "contact": False}

distance = st.floats(0.0, 10.0)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(one=distance, other=distance)
def test_slip_term(one: float, other: float) -> None:
    """1 at rest, 0 at the scale, never under the floor, and less the farther the foot slides."""
    assert slip_term(REWARD, 0.0) == 1.0
    assert slip_term(REWARD, REWARD.slip_scale) == 0.0
    assert REWARD.term_low <= slip_term(REWARD, one) <= 1.0
    near, far = sorted((one, other))
    assert slip_term(REWARD, near) >= slip_term(REWARD, far)
    assert slip_term(REWARD, 1e9) == REWARD.term_low


@settings(max_examples=100, deadline=None, derandomize=True)
@given(one=distance, other=distance)
def test_height_term(one: float, other: float) -> None:
    """1 at the operating height, 0 at the scale, the same either way, never under the floor."""
    assert height_term(REWARD, 0.0) == 1.0
    assert height_term(REWARD, REWARD.height_scale) == 0.0
    assert height_term(REWARD, -one) == height_term(REWARD, one)
    assert REWARD.term_low <= height_term(REWARD, one) <= 1.0
    near, far = sorted((one, other))
    assert height_term(REWARD, near) >= height_term(REWARD, far)
    assert height_term(REWARD, 1e9) == REWARD.term_low


@settings(max_examples=100, deadline=None, derandomize=True)
@given(one=distance, other=distance)
def test_force_term(one: float, other: float) -> None:
    """Nothing up to the limit, then the excess in loads, bounded: one blow is not everything."""
    assert force_term(REWARD, REWARD.force_limit) == 0.0
    assert force_term(REWARD, 0.0) == 0.0
    assert force_term(REWARD, REWARD.force_limit + 0.5) == pytest.approx(0.5)
    assert 0.0 <= force_term(REWARD, one) <= REWARD.force_most
    low, high = sorted((one, other))
    assert force_term(REWARD, low) <= force_term(REWARD, high)
    assert force_term(REWARD, 1e9) == REWARD.force_most


def test_the_best_tick_of_stance() -> None:
    """A foot that rests at the right height under its load earns both weights, nothing else."""
    terms = REWARDER.terms(STANDING, True)
    assert set(terms) == {"slip", "height", "force"}
    assert terms["slip"] == REWARD.slip
    assert terms["height"] == pytest.approx(REWARD.height)
    assert terms["force"] == 0.0


def test_lost_contact() -> None:
    """In the air during stance: the height still counts, the slip does not, and contact is lost."""
    terms = REWARDER.terms(STANDING._replace(**IN_THE_AIR), True)
    assert set(terms) == {"height", "lost_contact"}
    assert terms["lost_contact"] == REWARD.lost_contact < 0.0


def test_swing_is_free_in_the_air() -> None:
    """In the air during swing: a constant, whatever the height."""
    for sense in (STANDING, LOW):
        assert REWARDER.terms(sense._replace(**IN_THE_AIR), False) == {
            "swing_free": REWARD.swing_free
        }


def test_swing_strikes_on_the_ground() -> None:
    """On the ground during swing: a strike and its force; sliding and height do not count."""
    for sense in (STANDING, LOW, STANDING._replace(slip=1.0)):
        terms = REWARDER.terms(sense._replace(force_peak=100.0 * LEG.load), False)
        assert terms == {
            "swing_strike": REWARD.swing_strike,
            "force": REWARD.force * REWARD.force_most,
        }


def test_stance_bit_switches_everything() -> None:
    """The same senses in stance and in swing share no term but that of the force."""
    for sense in (STANDING, STANDING._replace(**IN_THE_AIR)):
        stance, swing = REWARDER.terms(sense, True), REWARDER.terms(sense, False)
        assert set(stance) & set(swing) <= {"force"}


def test_contact_is_force_within_the_tick() -> None:
    """A foot that touched and left again has touched: the mean decides, not the tick's end."""
    left = STANDING._replace(contact=False)
    assert REWARDER.terms(left, True) == REWARDER.terms(STANDING, True)
    landed = STANDING._replace(**{**IN_THE_AIR, "contact": True})
    assert "lost_contact" in REWARDER.terms(landed, True)


def test_forces_are_seen_in_loads() -> None:
    """A peak of twice the load is over the limit by 2 - limit loads, whatever the load."""
    for load in (LEG.load, 10.0):
        rewarder = PaperReward(replace(PARAMS, {"leg.load": load}))
        terms = rewarder.terms(STANDING._replace(force_peak=2.0 * load), True)
        assert terms["force"] == pytest.approx(REWARD.force * (2.0 - REWARD.force_limit))


def test_height_is_what_the_leg_itself_can_sense() -> None:
    """Height follows from knee and inclination: a leg without a look at its body knows it."""
    bent = STANDING._replace(knee=KNEE + 0.1)
    error = kinematics.height(LEG, bent.knee, bent.inclination) - LEG.operating_height
    assert REWARDER.terms(bent, True)["height"] == REWARD.height * height_term(REWARD, error)
    other = STANDING._replace(
        tick=3, hip=3.0, hip_speed=3.0, knee_speed=3.0, hair=True, first_tick=True
    )
    assert REWARDER.terms(other, True) == REWARDER.terms(STANDING, True)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    knee=st.floats(-0.2, 1.7),
    inclination=st.floats(-3.2, 3.2),
    force=st.floats(0.0, 1e4),
    slip=st.floats(0.0, 1.0),
    stance=st.booleans(),
)
def test_the_sum_of_the_terms_is_bounded(
    knee: float, inclination: float, force: float, slip: float, stance: bool
) -> None:
    """All terms are named, and no tick is worth more or less than they allow."""
    sense = STANDING._replace(
        knee=knee, inclination=inclination, force_mean=force, force_peak=2.0 * force, slip=slip
    )
    terms = REWARDER.terms(sense, stance)
    assert terms.keys() <= set(REWARDER.names)
    reward = sum(terms.values())
    least = min(2.0 * REWARD.term_low, REWARD.term_low + REWARD.lost_contact, REWARD.swing_strike)
    assert least + REWARD.force * REWARD.force_most <= reward <= REWARD.slip + REWARD.height


@pytest.mark.parametrize(
    ("name", "sense", "stance"),
    [
        ("slip", STANDING, True),
        ("height", STANDING, True),
        ("lost_contact", STANDING._replace(**IN_THE_AIR), True),
        ("swing_free", STANDING._replace(**IN_THE_AIR), False),
        ("swing_strike", STANDING, False),
        ("force", STANDING._replace(force_peak=99.0 * LEG.load), True),
    ],
)
def test_each_weight_is_its_term_s(name: str, sense: LegSense, stance: bool) -> None:
    """A weight changes the term of its name, in proportion, and no other."""
    before = REWARDER.terms(sense, stance)
    weight = getattr(Reward(), name)
    after = PaperReward(replace(PARAMS, {f"reward.{name}": 3.0 * weight})).terms(sense, stance)
    assert after == {**before, name: pytest.approx(3.0 * before[name])}
