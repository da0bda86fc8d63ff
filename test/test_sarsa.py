"""SARSA(lambda): the forward view, worked out by hand; every transition is updated once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ember_ros.loop import Loop
from ember_ros.params import LearningParams, Params, replace
from ember_ros.randomness import generator
from ember_ros.run_config import RunConfig
from ember_ros.signals import TDUpdate, Transition
from leg_node import sarsa
from leg_node.sarsa import HORIZON, SarsaLambda
from sim_node.fake import FakeWorld
from support.legs import LEGS
from support.runs import SignalLog

GAMMA, ACTIONS = 0.5, 2
VALUES = [[1.0, 2.0], [3.0, -4.0], [5.0, 0.25], [-2.0, 7.0]]
"""Of the states of a small chain, an action each."""


class Believed:
    """Values that do not change."""

    def q_values(self, tick: int, state: int) -> list[float]:
        """Return a state's row."""
        return list(VALUES[state])


def learner() -> SarsaLambda:
    """Return a learner over the chain."""
    learning_params = LearningParams(gamma=GAMMA)
    return SarsaLambda([Believed()], learning_params, (len(VALUES), ACTIONS), generator(0, 0))


def step(tick: int, state: int, action: int, reward: float, next_state: int) -> Transition:
    """Return a transition."""
    return Transition(tick, state, True, action, (("all", reward),), next_state, True, 0.0)


CHAIN = [step(1, 0, 1, 10.0, 1), step(2, 1, 0, -3.0, 2), step(3, 2, 1, 6.0, 3)]
"""Three ticks; after the last one the best that is believed of state 3 is 7."""


def long_chain(ticks: int) -> list[Transition]:
    """Return a chain of any length through all states and actions."""
    states = [(3 * n + n // 4) % 4 for n in range(ticks + 1)]
    return [step(n + 1, states[n], n % 3 % 2, (-1.0) ** n * n, states[n + 1]) for n in range(ticks)]


def learn(chain: Sequence[Transition], agent: SarsaLambda | None = None) -> list[TDUpdate]:
    """Return all updates of a chain, its end included."""
    agent = agent or learner()
    updates = [update for each in chain for update in agent.learn(each)]
    return [*updates, *agent.flush()]


def by_definition(chain: Sequence[Transition], n: int, weight: float) -> float:
    """Return the lambda return of the nth transition, as a sum over all n-step returns.

    ``(1 - l) * sum of l^(k-1) * G_k``, and the rest of the weight on the last return, which reaches
    to the horizon or to the end of the chain.
    """
    rest = chain[n:]
    ends = len(rest) <= HORIZON
    most = len(rest) if ends else HORIZON
    total, left = 0.0, 1.0
    for k in range(1, most + 1):
        rewards = sum(GAMMA**i * each.reward for i, each in enumerate(rest[:k]))
        if k < len(rest):
            value = VALUES[rest[k].state][rest[k].action]
        else:
            value = max(VALUES[rest[-1].next_state])
        share = (1.0 - weight) * weight ** (k - 1) if k < most else left
        left -= share
        total += share * (rewards + GAMMA**k * value)
    return total


def test_the_return_of_three_ticks_worked_out_by_hand() -> None:
    """0.7 of what is further ahead, 0.3 of what is believed one tick ahead, from the end back."""
    third = 6.0 + 0.5 * 7.0
    second = -3.0 + 0.5 * (0.3 * 0.25 + 0.7 * third)
    first = 10.0 + 0.5 * (0.3 * 3.0 + 0.7 * second)
    assert (third, second, first) == pytest.approx((9.5, 0.3625, 10.576875))
    cells, targets = zip(*[(update.cell, update.target) for update in learn(CHAIN)], strict=True)
    assert cells == (0 * ACTIONS + 1, 1 * ACTIONS + 0, 2 * ACTIONS + 1)
    assert targets == pytest.approx((first, second, third), abs=1e-12)


def test_with_a_lambda_of_0_it_is_one_step_sarsa(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reward and what is believed of the action that was really chosen next, no other."""
    monkeypatch.setattr(sarsa, "LAMBDA", 0.0)
    chain = long_chain(30)
    for update, (transition, then) in zip(learn(chain), itertools.pairwise(chain), strict=False):
        assert update.target == transition.reward + GAMMA * VALUES[then.state][then.action]


def test_with_a_lambda_of_1_only_the_end_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rewards alone up to the end of a short chain."""
    monkeypatch.setattr(sarsa, "LAMBDA", 1.0)
    first = learn(CHAIN)[0].target
    assert first == 10.0 + 0.5 * (-3.0 + 0.5 * (6.0 + 0.5 * 7.0))


@given(ticks=st.integers(1, 3 * HORIZON))
def test_every_transition_is_updated_once_towards_its_return(ticks: int) -> None:
    """In order, each towards what the definition says; nothing is lost at the end."""
    chain = long_chain(ticks)
    updates = learn(chain)
    assert [update.cell for update in updates] == [
        transition.state * ACTIONS + transition.action for transition in chain
    ]
    for n, update in enumerate(updates):
        assert update.target == pytest.approx(by_definition(chain, n, sarsa.LAMBDA), abs=1e-9)


def test_an_update_waits_until_the_horizon_is_known() -> None:
    """Nothing for as many ticks, then one a tick, stamped with the tick that learns."""
    agent, counts = learner(), []
    for transition in long_chain(HORIZON + 5):
        updates = list(agent.learn(transition))
        assert all(update.tick == transition.tick for update in updates)
        counts.append(len(updates))
    assert counts == [0] * HORIZON + [1] * 5
    rest = list(agent.flush())
    assert len(rest) == HORIZON
    assert {update.tick for update in rest} == {HORIZON + 5}


def test_a_reset_empties_it() -> None:
    """A second one has nothing left, and what comes next does not hang on what went before."""
    agent = learner()
    for did in CHAIN:
        agent.learn(did)
    assert len(list(agent.flush())) == 3
    assert list(agent.flush()) == []
    later = [did._replace(tick=did.tick + 100) for did in long_chain(12)]
    assert learn(later, agent) == learn(later)


def test_it_chooses_by_what_it_believes() -> None:
    """Its values are those of its estimate."""
    assert learner().q_values(0, 3) == VALUES[3]


@pytest.mark.parametrize("sync_every", [5, 32])
def test_a_robot_that_learns_by_it_updates_every_transition_once(sync_every: int) -> None:
    """Four legs, falls, epochs shorter than the horizon: all that was credited is in the table."""
    params = replace(
        Params(),
        {"parts.learner": "leg_node.sarsa.SarsaLambda", "walk.sync_every": sync_every},
    )
    loop = Loop(
        RunConfig("walker", 4, params=params, policy="random"),
        FakeWorld(LEGS, params, falls_at={50, 51, 90}),
    )
    received = SignalLog()
    for _ in range(4 * 32 + 3):
        loop.tick(received)
    table = loop.finish()
    actions = len(params.leg.knee_speeds)
    wanted = [0] * len(table)
    for told in received.transitions:
        for transition in told:
            if transition.credited:
                wanted[transition.state * actions + transition.action] += 1
    assert sum(wanted) == 4 * (4 * 32 + 3 - 1 - 3)
    assert table.visits.tolist() == wanted
