"""A central learner: one table over all legs, as far as such a table fits.

The legs' own states side by side would be ``4352^4`` (3.6e14) and the joint actions ``9^4``
(6561): 2.4e18 cells. What fits in memory is all joint actions over a coarse state: the tick of the
cycle and which feet touch the ground, 32 x 2^4 states, 3.4 million cells. It is rewarded with the
mean of the legs' rewards, and learns by the same rule, with the same numbers.
"""

from __future__ import annotations

import numpy as np

from ember_ros.loop import Loop
from ember_ros.observer import Observer
from ember_ros.params import Params
from ember_ros.randomness import WORLD, generator
from ember_ros.run_config import RunConfig
from ember_ros.signals import LegSense
from leg_node.assembly import make_leg, numbers_of
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
    """The loop, with one learner that tells all legs what to do."""

    def __init__(self, config: RunConfig) -> None:
        """Build the configured robot; its table is not used."""
        super().__init__(config)
        params: Params = config.params
        numbers = numbers_of(params, config.stage)
        self._numbers, self._ticks = numbers, params.gait.ticks
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
        target = reward + self._numbers.gamma * best
        self.joint.update(was * actions + did, target, self._numbers.rate)

    def _choose(self, state: int) -> int:
        actions = self.joint.actions
        if self._rng.random() < epsilon_at(self._numbers, self.now // self._ticks):
            return int(self._rng.integers(actions))
        row = self.joint.values[state * actions : (state + 1) * actions]
        ties = np.flatnonzero(row == row.max())
        return int(ties[self._rng.integers(len(ties))])

    def tick(self, *observers: Observer) -> None:
        """Decide for all legs at once, then run one tick of the whole machine."""
        senses = self.world.observe()
        state = self._state(senses)
        self._learn(senses, state)
        joint = self._choose(state)
        self._last = state, joint
        for policy in self._policies:
            joint, policy.action = divmod(joint, self._speeds)
        super().tick(*observers)
