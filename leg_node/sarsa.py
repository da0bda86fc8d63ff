"""SARSA(lambda), an example of a learner: ``parts.learner: leg_node.sarsa.SarsaLambda``. Pure.

The forward view [Sutton and Barto 2018, 12.1 to 12.3], cut off after ``HORIZON`` ticks: a
transition waits until what followed it is known, and is then updated once, towards its lambda
return. So one update still is one cell and one target, and the table is shared and merged as ever.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from ember_ros.params import LearningParams
from ember_ros.signals import TDUpdate, Transition
from leg_node.value import ValueEstimate

LAMBDA = 0.7
"""Weight of what is one tick further ahead; 0 gives one-step SARSA."""
HORIZON = 8
"""Ticks after which a return is cut off: a quarter of a cycle; 0.7^8 is 6 %."""


class SarsaLambda:
    """On-policy: the values are those of what the leg does, exploration included."""

    def __init__(
        self,
        estimates: Sequence[ValueEstimate],
        learning_params: LearningParams,
        shape: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        """Learn by the discount ``learning_params.gamma``."""
        (estimate,) = estimates
        self.q_values = estimate.q_values
        self._gamma = learning_params.gamma
        self._actions = shape[1]
        self._waiting: deque[Transition] = deque()
        """Transitions without their update, the oldest first, each following the one before."""

    def learn(self, transition: Transition) -> Iterable[TDUpdate]:
        """Return the update of the transition of ``HORIZON`` ticks ago."""
        self._waiting.append(transition)
        if len(self._waiting) <= HORIZON:
            return ()
        last = self._waiting[-1]
        return (self._update(self.q_values(last.tick, last.state)[last.action], HORIZON),)

    def flush(self) -> Iterable[TDUpdate]:
        """Return the updates of all that wait; after the last one its best action is taken."""
        updates = []
        while self._waiting:
            last = self._waiting[-1]
            best = max(self.q_values(last.tick, last.next_state))
            ends = last.reward + self._gamma * best
            updates.append(self._update(ends, len(self._waiting) - 1))
        return updates

    def _update(self, value: float, steps: int) -> TDUpdate:
        """Return the update of the oldest transition, and forget it.

        Args:
            value: the return from the transition on that is ``steps`` later.
            steps: so many rewards come before it.
        """
        tick, gamma = self._waiting[-1].tick, self._gamma
        for n in range(steps - 1, -1, -1):
            later = self._waiting[n + 1]
            # What is believed there, and the return from there on, by their weights.
            believed = self.q_values(tick, later.state)[later.action]
            value = (1.0 - LAMBDA) * believed + LAMBDA * value
            value = self._waiting[n].reward + gamma * value
        first = self._waiting.popleft()
        return TDUpdate(tick, first.state * self._actions + first.action, value)
