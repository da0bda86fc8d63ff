"""What a leg makes of the phase: when it stands, where its hip should be, and the phase itself."""

from __future__ import annotations

import pytest

from cpg_node.cpg import FixedPeriod
from ember_ros.params import TRAINER_LEG, Gait, Params, replace
from leg_node.gait import HipRamp
from support.legs import LEGS

GAIT = Gait()
CYCLE = [n / 32 for n in range(32)]


def test_phase_is_exact_at_every_tick() -> None:
    """A phase is tick / 32 with no rounding, over years of ticks: it names its tick."""
    cpg = FixedPeriod(GAIT)
    for tick in (*range(1000), 10**9 + 7, 2**40 + 1):
        assert cpg.phase(tick * GAIT.tick_ns) == tick / 32
        assert cpg.phase(tick * GAIT.tick_ns) * 32 == tick


def test_phase_stays_within_a_tick() -> None:
    """The phase changes at ticks only, wherever between two of them the clock is read."""
    cpg = FixedPeriod(GAIT)
    assert cpg.phase(5 * GAIT.tick_ns - 1) == 4 / 32
    assert cpg.phase(6 * GAIT.tick_ns - 1) == cpg.phase(5 * GAIT.tick_ns) == 5 / 32


@pytest.mark.parametrize("leg", [*LEGS, TRAINER_LEG])
def test_three_quarters_of_a_cycle_are_stance(leg: str) -> None:
    """24 ticks of stance, 8 of swing, each in one piece, in every cycle."""
    gait = HipRamp(GAIT, leg)
    bits = [gait.stance(phase) for phase in CYCLE]
    assert sum(bits) == 24
    assert sum(a != b for a, b in zip(bits, bits[1:] + bits[:1], strict=True)) == 2
    assert [gait.stance(1000 + phase) for phase in CYCLE] == bits


def test_stance_begins_with_the_cycle() -> None:
    """Without offset, ticks 0 to 23 are stance and 24 to 31 swing."""
    gait = HipRamp(GAIT, TRAINER_LEG)
    assert [gait.stance(phase) for phase in CYCLE] == [True] * 24 + [False] * 8


def test_ramp_ends() -> None:
    """Stance ends at the rear and swing at the front, exactly: the ramp does not creep."""
    gait = HipRamp(GAIT, TRAINER_LEG)
    goals = [gait.hip_goal(phase) for phase in CYCLE]
    assert goals[23] == GAIT.hip_rear == min(goals)
    assert goals[31] == GAIT.hip_front == max(goals)


def test_ramp_is_straight() -> None:
    """Slowly back by equal steps in stance, three times as fast forward in swing."""
    gait = HipRamp(GAIT, TRAINER_LEG)
    goals = [gait.hip_goal(phase) for phase in CYCLE]
    steps = [b - a for a, b in zip([goals[-1], *goals], goals, strict=False)]
    back, forth = steps[:24], steps[24:]
    assert back == pytest.approx([(GAIT.hip_rear - GAIT.hip_front) / 24] * 24)
    assert forth == pytest.approx([(GAIT.hip_front - GAIT.hip_rear) / 8] * 8)


def test_diagonal_pairs_are_half_a_cycle_apart() -> None:
    """Front left steps with rear right, front right with rear left, the pairs in turn."""
    fl, fr, rl, rr = (HipRamp(GAIT, leg) for leg in LEGS)
    for phase in CYCLE:
        assert fl.stance(phase) == rr.stance(phase) == fr.stance(phase + 0.5)
        assert fr.stance(phase) == rl.stance(phase) == fl.stance(phase + 0.5)
        assert fl.hip_goal(phase) == rr.hip_goal(phase) == fr.hip_goal(phase + 0.5)
        assert fr.hip_goal(phase) == rl.hip_goal(phase)
        assert sum(gait.stance(phase) for gait in (fl, fr, rl, rr)) >= 2


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.3, 31 / 32, 1.0])
def test_an_offset_shifts_the_whole_cycle(offset: float) -> None:
    """A leg with an offset does at a phase what one without does later by the offset."""
    gait = replace(Params(), {"gait.offset_front_left": offset}).gait
    shifted, plain = HipRamp(gait, "front_left"), HipRamp(gait, TRAINER_LEG)
    for phase in CYCLE:
        later = int((phase + offset) * 32) / 32
        assert shifted.stance(phase) == plain.stance(later)
        assert shifted.hip_goal(phase) == plain.hip_goal(later)


@pytest.mark.parametrize(("ticks", "share", "stance"), [(4, 0.5, 2), (64, 0.75, 48), (8, 0.125, 1)])
def test_other_ticks_and_shares(ticks: int, share: float, stance: int) -> None:
    """The share of stance holds for any number of ticks, and the ramp's ends with it."""
    gait = replace(
        Params(), {"gait.ticks": ticks, "gait.stance_share": share, "gait.period": 0.512}
    ).gait
    leg = HipRamp(gait, TRAINER_LEG)
    phases = [n / ticks for n in range(ticks)]
    assert [leg.stance(phase) for phase in phases] == [n < stance for n in range(ticks)]
    assert leg.hip_goal(phases[stance - 1]) == gait.hip_rear
    assert leg.hip_goal(phases[-1]) == gait.hip_front


@pytest.mark.parametrize("lead", [0, 1, 2, 7])
def test_the_reward_may_lead_the_hip(lead: int) -> None:
    """The last ``lead`` ticks of swing are rewarded as stance; all of stance is, at any lead."""
    gait = HipRamp(GAIT, TRAINER_LEG)
    paid = [gait.rewarded_as_stance(phase, lead) for phase in CYCLE]
    assert paid == [True] * 24 + [False] * (8 - lead) + [True] * lead
    assert [gait.rewarded_as_stance(40 + phase, lead) for phase in CYCLE] == paid
