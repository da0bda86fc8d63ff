"""What is learnt from a transition: updates of single cells (paper, section VI-C). Pure.

To swap it, write a class with ``q_values``, ``learn`` and ``flush`` and name it as
``parts.learner``; ``leg_node.sarsa`` is an example. A learner decides targets, and never touches
the table: a leg applies its updates at once and shares them, and whoever merges them does the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

from ember_ros.params import LearningParams
from ember_ros.signals import TDUpdate, Transition
from leg_node.value import ValueEstimate


class Learner(Protocol):
    """Turns transitions into updates.

    Made with ``(estimates, learning_params, shape, rng)``: one value estimate for each of its
    tables; the learning parameters of the stage; states and actions of one table; a generator of
    its own. A class that sets ``tables`` to more than 1 (double Q-learning has two) is given so
    many, one behind the other in one table: cell ``(n * states + state) * actions + action``.
    """

    def q_values(self, tick: int, state: int) -> list[float]:
        """Return one value an action, to choose by."""
        ...

    def learn(self, transition: Transition) -> Iterable[TDUpdate]:
        """Return what a transition changes, in order; called once a tick that can be credited.

        It may be about earlier transitions: SARSA knows the next action only one tick later, as
        the timeline of ``leg_node.task`` shows.
        """
        ...

    def flush(self) -> Iterable[TDUpdate]:
        """Return the updates that are left when the chain of transitions breaks, and forget them.

        It breaks where a leg was put down, missed ticks, or ends.
        """
        ...


class QLearning:
    """One-step Q-learning [Watkins 1989], the paper's."""

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

    def learn(self, transition: Transition) -> Iterable[TDUpdate]:
        """Return the update: towards the reward and the best that the next state promises."""
        tick = transition.tick
        best = max(self.q_values(tick, transition.next_state))
        cell = transition.state * self._actions + transition.action
        return (TDUpdate(tick, cell, transition.reward + self._gamma * best),)

    def flush(self) -> Iterable[TDUpdate]:
        """Return nothing: every transition is learnt from at once."""
        return ()
