"""A central learner: one table with coarse states and the joint actions of all legs.

With the full states of four legs, ``4352^4`` (3.6e14), and their joint actions, ``9^4`` (6561), a
table would have 2.4e18 cells, too many for any memory. This one has all joint actions but only
coarse states, the tick of the cycle and which feet touch the ground: 32 x 2^4 states, 3.4 million
cells. The reward is the mean of the legs' rewards; the learning rule and its parameters are those
of the legs' own learner.
"""

from __future__ import annotations

import numpy as np

from ember_ros.loop import Loop
from ember_ros.observer import Observer
from ember_ros.params import Params
from ember_ros.randomness import WORLD, generator
from ember_ros.run_config import RunConfig
from ember_ros.signals import LegSense
from leg_node.assembly import learning_params_of, make_leg
from leg_node.gait import GaitStep
from leg_node.policy import epsilon_at
from leg_node.table import Table

CENTRAL_LEARNER = WORLD + 1
"""Spawn key of the central learner's random numbers."""


class _FixedAction:
    """A policy whose action is set from outside."""

    action = 0

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        """Return the action that was set."""
        return self.action


class CentralLoop(Loop):
    """The loop with one learner that chooses the actions of all legs."""

    def __init__(self, config: RunConfig) -> None:
        """Build the configured robot; the table of the configuration is not used."""
        super().__init__(config)
        params: Params = config.params
        learning_params = learning_params_of(params, config.stage)
        self._learning_params, self._ticks = learning_params, params.gait.ticks
        self._speeds = len(params.leg.knee_speeds)
        self._rng = generator(config.seed, CENTRAL_LEARNER)
        count = len(config.legs)
        self.joint = Table(self._ticks * 2**count, self._speeds**count)
        self._policies = [_FixedAction() for _ in config.legs]
        self.legs = [
            make_leg(params, leg, stage=config.stage, policy=policy, learning=False)
            for leg, policy in zip(config.legs, self._policies, strict=True)
        ]
        self._last: tuple[int, int] | None = None

    def _state(self, senses: tuple[LegSense, ...]) -> int:
        """Return the index of the coarse state: tick of the cycle and contacts."""
        bits = sum(sense.contact << n for n, sense in enumerate(senses))
        return (self.now % self._ticks << len(senses)) + bits

    def _learn(self, senses: tuple[LegSense, ...], state: int) -> None:
        """Learn from the mean reward of all legs for the tick that just ended."""
        if self._last is None:
            return
        rewards = [leg.credit(sense) for leg, sense in zip(self.legs, senses, strict=True)]
        if not all(each.credited for each in rewards):
            return
        was, did = self._last
        reward = 0.0
        for each in rewards:
            reward += each.reward
        reward /= len(rewards)
        actions = self.joint.actions
        best = float(self.joint.values[state * actions : (state + 1) * actions].max())
        target = reward + self._learning_params.gamma * best
        self.joint.update(was * actions + did, target, self._learning_params.rate)

    def _choose(self, state: int) -> int:
        """Return a joint action, epsilon-greedy; ties between best actions are broken at random."""
        actions = self.joint.actions
        if self._rng.random() < epsilon_at(self._learning_params, self.now // self._ticks):
            return int(self._rng.integers(actions))
        row = self.joint.values[state * actions : (state + 1) * actions]
        ties = np.flatnonzero(row == row.max())
        return int(ties[self._rng.integers(len(ties))])

    def tick(self, *observers: Observer) -> None:
        """Learn from the last tick, choose the actions of all legs, then run one tick."""
        senses = self.world.observe()
        state = self._state(senses)
        self._learn(senses, state)
        joint = self._choose(state)
        self._last = state, joint
        for policy in self._policies:
            joint, policy.action = divmod(joint, self._speeds)
        super().tick(*observers)
