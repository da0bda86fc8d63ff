"""How a leg chooses: explores as its schedule says, breaks ties at random, or follows a script."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros.kinematics import height
from ember_ros.params import LearningParams, Params, replace
from ember_ros.randomness import WORLD, generator
from ember_ros.signals import LegSense
from leg_node.gait import GaitStep, HipRamp
from leg_node.policy import EpsilonGreedy, Random, Scripted, epsilon_at
from leg_node.table import Table
from support.gaits import ReferenceGait
from support.legs import beat

TICKS = 32
PARAMS = Params()
SPEEDS = PARAMS.leg.knee_speeds
STEP = GaitStep(stance=True, ticks_to_stance=0.0, hip_goal=0.0)
"""For policies that do not look at the gait."""


def nothing(tick: int, state: int) -> list[float]:
    """Return the values for policies that do not ask for any."""
    raise AssertionError(f"the values of state {state} are asked for at tick {tick}")


def sense(tick: int = 0, hip: float = 0.0, knee: float = 0.5, pitch: float = 0.0) -> LegSense:
    """Return the senses of a leg on a body with its nose down by ``pitch``."""
    return LegSense(
        tick, hip, knee, 0.0, 0.0, 0.0, 0.0, hip - knee + pitch, 0.0, False, False, False
    )


def greedy(
    rows: list[list[float]], start: float = 0.0, end: float = 0.0, cycles: int = 10, seed: int = 1
) -> EpsilonGreedy:
    """Return a policy over a table of these rows."""
    table = Table(len(rows), len(rows[0]))
    table.values[:] = np.ravel(rows)
    learning_params = LearningParams(epsilon_start=start, epsilon_end=end, epsilon_cycles=cycles)
    return over(table, learning_params, seed)


def over(
    table: Table, learning_params: LearningParams, seed: int = 1, start_cycle: int = 0
) -> EpsilonGreedy:
    """Return a policy over a table, with as many knee speeds as it has actions."""
    speeds = tuple(float(n) for n in range(table.actions))
    params = replace(PARAMS, {"leg.knee_speeds": speeds})
    return EpsilonGreedy(
        params,
        learning_params,
        lambda tick, state: table.row(state),
        generator(seed, 0),
        start_cycle,
    )


# -- epsilon-greedy ------------------------------------------------------------------------------


def test_epsilon_falls_by_the_cycle_then_stays() -> None:
    """Linear from start to end over the cycles given, in steps of a cycle, constant after."""
    learning_params = LearningParams(epsilon_start=0.5, epsilon_end=0.1, epsilon_cycles=4)
    shares = [epsilon_at(learning_params, cycle) for cycle in range(8)]
    assert shares == pytest.approx([0.5, 0.4, 0.3, 0.2, 0.1, 0.1, 0.1, 0.1])
    assert shares[0] == 0.5
    assert (
        shares[4]
        == shares[7]
        == epsilon_at(learning_params, 10**9)
        == pytest.approx(0.1, abs=1e-16)
    )


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    start=st.floats(0.0, 1.0),
    end=st.floats(0.0, 1.0),
    cycles=st.integers(1, 10**9),
    cycle=st.integers(0, 10**12),
)
def test_epsilon_stays_between_its_ends(start: float, end: float, cycles: int, cycle: int) -> None:
    """Whichever way it goes, it is never under the one or over the other end."""
    epsilon = epsilon_at(
        LearningParams(epsilon_start=start, epsilon_end=end, epsilon_cycles=cycles), cycle
    )
    assert min(start, end) - 1e-15 <= epsilon <= max(start, end) + 1e-15


@settings(max_examples=50, deadline=None, derandomize=True)
@given(row=st.lists(st.floats(-5.0, 5.0), min_size=2, max_size=9, unique=True))
def test_the_best_action_without_exploration(row: list[float]) -> None:
    """With epsilon 0 the largest value of the state's own row is chosen, always."""
    policy = greedy([[0.0] * len(row), row, [9.0] * len(row)])
    assert {policy.choose(sense(tick), STEP, 1) for tick in range(20)} == {row.index(max(row))}


def test_ties_are_broken_at_random() -> None:
    """Equal best actions are chosen equally often; a lesser one never is."""
    policy = greedy([[1.0, 0.0, 1.0, 1.0]])
    count = Counter(policy.choose(sense(tick), STEP, 0) for tick in range(3000))
    assert set(count) == {0, 2, 3}
    assert min(count.values()) > 900


def test_a_leg_that_knows_nothing_tries_everything() -> None:
    """The first actions are random ones, not the first of the list."""
    policy = greedy([[0.0] * 9])
    count = Counter(policy.choose(sense(tick), STEP, 0) for tick in range(4500))
    assert set(count) == set(range(9))
    assert min(count.values()) > 400


def test_exploration_has_its_share() -> None:
    """With epsilon 0.3 of 9 actions, the best is chosen in 0.7 + 0.3 / 9 of all ticks."""
    policy = greedy([[0.0] * 8 + [1.0]], start=0.3, end=0.3)
    count = Counter(policy.choose(sense(tick), STEP, 0) for tick in range(9000))
    assert count[8] / 9000 == pytest.approx(0.7 + 0.3 / 9, abs=0.02)
    assert min(count[n] for n in range(8)) > 0.5 * 9000 * 0.3 / 9


def test_the_share_follows_the_tick() -> None:
    """All random in the first cycle and none in the next, as the schedule says."""
    policy = greedy([[0.0, 1.0]], start=1.0, end=0.0, cycles=1)
    chosen = [policy.choose(sense(tick), STEP, 0) for tick in range(4 * TICKS)]
    assert 0 < sum(chosen[:TICKS]) < TICKS
    assert chosen[TICKS:] == [1] * (3 * TICKS)


def test_the_share_follows_the_tick_over_missed_ticks() -> None:
    """A leg that was away at the start of a cycle explores as this cycle says, not as the last."""
    policy = greedy([[0.0, 1.0]], start=1.0, end=0.0, cycles=1)
    policy.choose(sense(0), STEP, 0)
    assert {policy.choose(sense(tick), STEP, 0) for tick in range(TICKS + 1, 2 * TICKS)} == {1}


def test_the_table_is_read_as_it_is_now() -> None:
    """A policy keeps no copy of the values: what was learnt this tick counts this tick."""
    table = Table(1, 2)
    policy = over(table, LearningParams(epsilon_start=0.0, epsilon_end=0.0))
    for best in (0, 1, 0):
        table.write(best, 1.0, 1)
        table.write(1 - best, 0.0, 1)
        assert policy.choose(sense(), STEP, 0) == best


def test_exploration_goes_on_from_the_cycles_that_were_learnt_before() -> None:
    """A leg that starts at cycle 3 of a schedule explores as one that lived through three."""
    table = Table(1, 2)
    learning_params = LearningParams(epsilon_start=1.0, epsilon_end=0.0, epsilon_cycles=3)
    table.write(1, 1.0, 1)
    later = over(table, learning_params, start_cycle=3)
    assert {later.choose(sense(tick), STEP, 0) for tick in range(2 * TICKS)} == {1}
    fresh = over(table, learning_params)
    assert {fresh.choose(sense(tick), STEP, 0) for tick in range(TICKS)} == {0, 1}


# -- random --------------------------------------------------------------------------------------


def test_random_actions_are_uniform() -> None:
    """Each action has its ninth."""
    policy = Random(PARAMS, PARAMS.walk, nothing, generator(3, 0))
    count = Counter(policy.choose(sense(tick), STEP, 0) for tick in range(9000))
    assert set(count) == set(range(9))
    assert all(900 < n < 1100 for n in count.values())


def draws(seed: int, who: int) -> list[int]:
    """Return the first actions of a leg that acts at random."""
    policy = Random(PARAMS, PARAMS.walk, nothing, generator(seed, who))
    return [policy.choose(sense(tick), STEP, 0) for tick in range(40)]


def test_a_seed_decides_everything() -> None:
    """The same seed and leg: the same actions; chosen by a table or at random."""
    assert draws(7, 2) == draws(7, 2)
    for epsilon in (0.0, 0.5, 1.0):
        one, other = (greedy([[0.0] * 9], start=epsilon, end=epsilon, seed=4) for _ in range(2))
        assert [one.choose(sense(n), STEP, 0) for n in range(40)] == [
            other.choose(sense(n), STEP, 0) for n in range(40)
        ]


def test_seeds_and_legs_are_independent() -> None:
    """Every leg, the world, and every seed draws something else, though all spawn from one."""
    runs = [tuple(draws(seed, who)) for seed in range(5) for who in (0, 1, 2, 3, WORLD)]
    assert len(set(runs)) == len(runs)


def test_a_leg_s_numbers_do_not_depend_on_other_legs() -> None:
    """What one leg drew before does not move what another draws."""
    first = generator(1, 0)
    first.random(1000)
    assert generator(1, 1).random(5).tolist() == generator(1, 1).random(5).tolist()
    one = generator(1, 1)
    first.random(3)
    assert one.random(5).tolist() == generator(1, 1).random(5).tolist()


# -- scripted ------------------------------------------------------------------------------------


def script(params: Params = PARAMS) -> Scripted:
    """Return the script, and let no number be drawn by it."""
    return Scripted(params, params.walk, nothing, None)  # type: ignore[arg-type]


def follow(
    cycles: int, pitch: float = 0.0, params: Params = PARAMS
) -> list[tuple[int, float, float]]:
    """Return (tick of the cycle, knee, height) after each tick of a leg that obeys at once."""
    policy, ramp, plain = script(params), HipRamp(params, 0.0), ReferenceGait(params)
    tick_s, leg = PARAMS.gait.tick_s, PARAMS.leg
    hip, knee, out = PARAMS.gait.hip_front, 0.5, []
    for tick in range(cycles * TICKS):
        sensed = sense(tick, hip, knee, pitch)
        action = policy.choose(sensed, ramp.step(beat(tick), sensed), 0)
        assert 0 <= action < len(SPEEDS)
        knee = max(0.0, min(leg.knee_max, knee + SPEEDS[action] * tick_s))
        hip = plain.hip_goal(tick)
        out.append((tick % TICKS, knee, height(leg, knee, hip - knee + pitch)))
    return out


def test_the_script_keeps_the_height_in_stance() -> None:
    """After it has put its foot down, the height stays within 3 cm of the one wanted."""
    heights = [h for n, _, h in follow(3)[TICKS:] if 2 <= n < 24]
    wanted = PARAMS.leg.operating_height
    assert max(abs(h - wanted) for h in heights) < 0.03


def test_the_script_draws_the_knee_up_in_swing() -> None:
    """In the middle of swing the knee has nearly all its bend and the foot is off the ground."""
    ticks = follow(3)[TICKS:]
    knees = [knee for n, knee, _ in ticks if n in (26, 27)]
    assert min(knees) > 1.2
    clearances = [PARAMS.leg.operating_height - h for n, _, h in ticks if n in (26, 27)]
    assert min(clearances) > 0.05


def test_the_script_puts_the_foot_down_in_time() -> None:
    """When stance begins the knee is stretched again for the height wanted."""
    knees = {n: knee for n, knee, _ in follow(3)}
    assert knees[31] < knees[27] - 0.4


@pytest.mark.parametrize("pitch", [-0.15, 0.15])
def test_the_script_feels_the_body_s_pitch(pitch: float) -> None:
    """On a tilted body the same senses say so, and the height is kept as well."""
    heights = [h for n, _, h in follow(3, pitch)[TICKS:] if 4 <= n < 20]
    wanted = PARAMS.leg.operating_height
    assert max(abs(h - wanted) for h in heights) < 0.04


def test_the_script_draws_no_numbers() -> None:
    """Same senses, same step of the gait: the same action, whatever the state."""
    policy, sensed = script(), sense(3, 0.1, 0.4)
    step = HipRamp(PARAMS, 0.0).step(beat(3), sensed)
    assert len({policy.choose(sensed, step, state) for state in range(50)}) == 1


def test_the_script_has_numbers_of_its_own() -> None:
    """It bends the knee in swing as far as it is told, and puts it down as early as it is told."""
    less = replace(PARAMS, {"script.swing_bend": 0.9})
    assert max(knee for n, knee, _ in follow(3, params=less) if n in (26, 27)) < 1.1
    never = replace(PARAMS, {"script.reach_ticks": 0})
    knees = {n: knee for n, knee, _ in follow(3, params=never)}
    assert knees[31] == pytest.approx(knees[27], abs=0.25)
    early = replace(PARAMS, {"script.reach_ticks": 6})
    knees, usual = ({n: knee for n, knee, _ in follow(3, params=each)} for each in (early, PARAMS))
    assert knees[27] < usual[27] - 0.3
