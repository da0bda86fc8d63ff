"""What a leg makes of the beat: when it stands, and where its hip should be."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ember_ros.params import Params, replace
from ember_ros.signals import Beat, LegSense
from leg_node.gait import GaitStep, HipRamp
from support.gaits import ReferenceGait
from support.legs import LEGS, beat

PARAMS = Params()
GAIT, OFFSETS = PARAMS.gait, PARAMS.robot.offset
SENSE = LegSense(0, 0.1, 0.5, 0.0, 0.0, 0.0, 0.0, -0.4, 0.0, False, False, False)


def steps(
    offset: float = 0.0, params: Params = PARAMS, ticks: Iterable[int] = range(32)
) -> list[GaitStep]:
    """Return what a leg of an offset makes of some ticks of a fixed period."""
    ramp = HipRamp(params, offset)
    return [ramp.step(beat(tick, params.gait.ticks), SENSE) for tick in ticks]


@pytest.mark.parametrize("offset", [*OFFSETS, 0.25])
def test_three_quarters_of_a_cycle_are_stance(offset: float) -> None:
    """24 ticks of stance, 8 of swing, each in one piece, in every cycle."""
    bits = [step.stance for step in steps(offset)]
    assert sum(bits) == 24
    assert sum(a != b for a, b in zip(bits, bits[1:] + bits[:1], strict=True)) == 2
    assert [step.stance for step in steps(offset, ticks=range(32_000, 32_032))] == bits


def test_stance_begins_with_the_cycle() -> None:
    """Without offset, ticks 0 to 23 are stance and 24 to 31 swing."""
    assert [step.stance for step in steps()] == [True] * 24 + [False] * 8


def test_ramp_ends() -> None:
    """Stance ends at the rear and swing at the front, exactly: the ramp does not creep."""
    goals = [step.hip_goal for step in steps()]
    assert goals[23] == GAIT.hip_rear == min(goals)
    assert goals[31] == GAIT.hip_front == max(goals)


def test_ramp_is_straight() -> None:
    """Slowly back by equal steps in stance, three times as fast forward in swing."""
    goals = [step.hip_goal for step in steps()]
    ways = [b - a for a, b in zip([goals[-1], *goals], goals, strict=False)]
    back, forth = ways[:24], ways[24:]
    assert back == pytest.approx([(GAIT.hip_rear - GAIT.hip_front) / 24] * 24)
    assert forth == pytest.approx([(GAIT.hip_front - GAIT.hip_rear) / 8] * 8)


@pytest.mark.parametrize("leg", LEGS)
def test_the_ramp_is_the_list_of_a_cycle_s_ticks(leg: str) -> None:
    """At a fixed period, to the bit what the gait is when it is written down tick by tick."""
    plain = ReferenceGait(PARAMS, leg)
    for tick, step in enumerate(steps(OFFSETS[LEGS.index(leg)], ticks=range(200))):
        assert step.stance is plain.stance(tick)
        assert step.hip_goal == plain.hip_goal(tick)


def test_diagonal_pairs_are_half_a_cycle_apart() -> None:
    """Front left steps with rear right, front right with rear left, the pairs in turn."""
    fl, fr, rl, rr = (steps(offset) for offset in OFFSETS)
    assert fl == rr
    assert fr == rl == fl[16:] + fl[:16]
    for tick in range(32):
        assert sum(leg[tick].stance for leg in (fl, fr, rl, rr)) >= 2


@pytest.mark.parametrize("offset", [0.0, 0.25, 31 / 32, 1.0])
def test_an_offset_shifts_the_whole_cycle(offset: float) -> None:
    """A leg with an offset does at a phase what one without does later by the offset."""
    late = steps(ticks=range(64))[int(offset * 32) :]
    assert steps(offset) == late[:32]


def test_an_offset_between_ticks_shifts_the_ramp_with_it() -> None:
    """With 0.3 of a cycle (9.6 ticks) the goals lie between those of whole ticks."""
    plain, shifted = steps(ticks=range(64)), steps(0.3)
    for tick, step in enumerate(shifted):
        before, after = plain[tick + 9].hip_goal, plain[tick + 10].hip_goal
        if (tick + 10) % 32 not in (0, 24):  # at its turns the ramp has a corner in between
            assert step.hip_goal == pytest.approx(before + 0.6 * (after - before))
        assert step.stance is plain[tick + 9].stance


@pytest.mark.parametrize(("ticks", "share", "stance"), [(4, 0.5, 2), (64, 0.75, 48), (8, 0.125, 1)])
def test_other_ticks_and_shares(ticks: int, share: float, stance: int) -> None:
    """The share of stance holds for any number of ticks, and the ramp's ends with it."""
    params = replace(
        PARAMS, {"gait.ticks": ticks, "gait.stance_share": share, "gait.period": 0.512}
    )
    found = steps(params=params, ticks=range(ticks))
    assert [step.stance for step in found] == [n < stance for n in range(ticks)]
    assert found[stance - 1].hip_goal == params.gait.hip_rear
    assert found[-1].hip_goal == params.gait.hip_front


@pytest.mark.parametrize("lead", [0, 1, 2, 7])
def test_the_reward_may_lead_the_hip(lead: int) -> None:
    """``ticks_to_stance`` counts swing down, so that its last ``lead`` ticks can be paid so."""
    for begin in (0, 40 * 32):
        found = [step.ticks_to_stance for step in steps(ticks=range(begin, begin + 32))]
        assert found == [0] * 24 + [8, 7, 6, 5, 4, 3, 2, 1]
        paid = [left <= lead for left in found]
        assert paid == [True] * 24 + [False] * (8 - lead) + [True] * lead


# -- another rate --------------------------------------------------------------------------------


def at_rate(rate: float, ticks: int, offset: float = 0.0, begin: float = 0.0) -> list[GaitStep]:
    """Return what a leg makes of a phase that grows by ``rate`` nominal ticks a tick."""
    ramp = HipRamp(PARAMS, offset)
    return [ramp.step(Beat(n, begin + rate * n / 32), SENSE) for n in range(ticks)]


@pytest.mark.parametrize("rate", [0.25, 0.5, 2.0])
def test_the_gait_follows_the_phase_not_the_clock(rate: float) -> None:
    """At another rate stance keeps its share of the phase, and the hip is where the phase goes."""
    plain = ReferenceGait(PARAMS)
    found = at_rate(rate, 160)
    for tick, step in enumerate(found):
        assert step.stance is plain.stance(int(rate * tick))
        if not step.stance:
            assert step.ticks_to_stance == (32 - rate * tick % 32) / rate
        end = rate * (tick + 1)
        if tick and end == int(end):  # the first beat tells no rate yet
            assert step.hip_goal == plain.hip_goal(int(end) - 1)
    share = sum(step.stance for step in found[:128]) / 128
    assert share == 0.75


def test_the_reward_leads_by_ticks_not_by_phase() -> None:
    """A phase of half the rate has twice as many ticks of swing, counted down one by one."""
    swing = [step.ticks_to_stance for step in at_rate(0.5, 64) if not step.stance]
    assert swing == list(range(16, 0, -1))


def test_a_phase_that_stands_still_holds_the_hip() -> None:
    """In stance and in swing: the goal is where the ramp is, and stance is never near."""
    for slot, stance in ((10, True), (28, False)):
        ramp = HipRamp(PARAMS, 0.0)
        ramp.step(Beat(0, (slot - 1) / 32), SENSE)
        ramp.step(Beat(1, slot / 32), SENSE)
        for tick in range(2, 6):
            step = ramp.step(Beat(tick, slot / 32), SENSE)
            assert step.stance is stance
            assert step.hip_goal == ReferenceGait(PARAMS).hip_goal(slot - 1)
            assert step.ticks_to_stance == (0.0 if stance else math.inf)


def test_a_phase_that_stood_still_goes_on() -> None:
    """After a pause the ramp goes on from where it was, one tick late by what was not foreseen."""
    ramp = HipRamp(PARAMS, 0.0)
    slots = [4, 5, 6, 6, 6, 7, 8, 9]
    goals = [ramp.step(Beat(tick, slot / 32), SENSE).hip_goal for tick, slot in enumerate(slots)]
    plain = ReferenceGait(PARAMS)
    assert goals == [plain.hip_goal(end - 1) for end in (5, 6, 7, 6, 6, 8, 9, 10)]


def test_missed_ticks_do_not_hurry_the_hip() -> None:
    """A leg that was away is told of a phase that jumped, and goes on at its rate a tick."""
    found = steps(ticks=[0, 1, 9, 10])
    plain = ReferenceGait(PARAMS)
    assert [step.hip_goal for step in found] == [plain.hip_goal(tick) for tick in (0, 1, 9, 10)]


@given(growths=st.lists(st.floats(0.0, 0.5), min_size=1, max_size=50), offset=st.floats(0.0, 1.0))
def test_any_lawful_phase_gives_a_lawful_step(growths: list[float], offset: float) -> None:
    """Whatever the growth: a goal between the ends, 0 to stance in stance and more in swing."""
    ramp, phase = HipRamp(PARAMS, offset), 0.0
    for tick, growth in enumerate(growths):
        step = ramp.step(Beat(tick, phase), SENSE)
        assert GAIT.hip_rear - 1e-12 <= step.hip_goal <= GAIT.hip_front + 1e-12
        assert (step.ticks_to_stance == 0.0) is step.stance
        assert step.ticks_to_stance >= 0.0
        phase += growth
