"""How a leg picks its next knee speed: learned, written by hand, or at random. Pure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from ember_ros import kinematics
from ember_ros.params import LearningParams, Params
from ember_ros.signals import LegSense
from leg_node.gait import GaitStep

QValues = Callable[[int, int], list[float]]
"""``(tick, state) -> one value an action``, as a learner believes them."""


class Policy(Protocol):
    """Chooses an action.

    Made with ``(params, learning_params, q_values, rng, start_cycle)``: all parameters; the
    learning parameters of the stage; what the learner believes; a generator of its own; nominal
    cycles before the first tick. Name one of your own by its dotted path: ``--policy
    my_package.module.Mine``. A nominal cycle is ``gait.ticks`` ticks, whatever the phase does.
    """

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        """Return the position of the knee speed in ``leg.knee_speeds``.

        Args:
            sense: of the leg.
            gait: what its gait says of the tick that begins.
            state: of the leg, as its discretizer says.
        """
        ...


def epsilon_at(learning_params: LearningParams, cycle: int) -> float:
    """Return the share of random actions in a nominal cycle: linear in cycles, then constant."""
    start, end = learning_params.epsilon_start, learning_params.epsilon_end
    done = min(1.0, cycle / learning_params.epsilon_cycles)
    return start + done * (end - start)


class EpsilonGreedy:
    """The best action of the state as the table is read, but now and then any (section VI-C).

    Ties are broken at random: the first actions of a leg that knows nothing are random ones
    (section III), not the first of the list.
    """

    def __init__(
        self,
        params: Params,
        learning_params: LearningParams,
        q_values: QValues,
        rng: np.random.Generator,
        start_cycle: int = 0,
    ) -> None:
        """Choose by ``q_values``, explore by ``epsilon_at``; ``rng`` also breaks ties."""
        self._q_values, self._learning_params, self._rng = q_values, learning_params, rng
        self._actions, self._ticks = len(params.leg.knee_speeds), params.gait.ticks
        self._start_cycle = start_cycle
        self._cycle, self._epsilon = -1, 0.0  # epsilon is worked out once a nominal cycle

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        """Return the best action, or any with probability epsilon."""
        rng = self._rng
        cycle = sense.tick // self._ticks
        if cycle != self._cycle:
            self._cycle = cycle
            self._epsilon = epsilon_at(self._learning_params, self._start_cycle + cycle)
        if rng.random() < self._epsilon:
            return int(rng.integers(self._actions))
        row = self._q_values(sense.tick, state)
        best = max(row)
        if row.count(best) == 1:
            return row.index(best)
        ties = [n for n, value in enumerate(row) if value == best]
        return ties[int(rng.integers(len(ties)))]


class Random:
    """Any action, always: what a leg is worth that learns nothing."""

    def __init__(
        self,
        params: Params,
        learning_params: LearningParams,
        q_values: QValues,
        rng: np.random.Generator,
        start_cycle: int = 0,
    ) -> None:
        """Draw among the actions of ``params`` from ``rng``."""
        self._actions, self._rng = len(params.leg.knee_speeds), rng

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        """Return any action."""
        return int(self._rng.integers(self._actions))


class Scripted:
    """A knee written by hand: constant height in stance, drawn up and put down in swing.

    It uses what the learning leg uses, the same nine speeds included: the nearest to the one
    wanted. It shows that a body can be walked at all.
    """

    def __init__(
        self,
        params: Params,
        learning_params: LearningParams,
        q_values: QValues,
        rng: np.random.Generator,
        start_cycle: int = 0,
    ) -> None:
        """Take geometry and speeds from ``params``."""
        self._leg, self._script = params.leg, params.script
        self._tick_s = params.gait.tick_s
        self._front = params.gait.hip_front

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        """Return the speed nearest to what brings the knee where it should be in a tick."""
        # The body's inclination in the leg's plane, rad, nose up: the opposite of BodyState.pitch.
        nose_up = sense.inclination + sense.knee - sense.hip
        height = self._leg.operating_height
        if gait.stance:
            goal = kinematics.knee_for_height(self._leg, gait.hip_goal + nose_up, height)
        elif gait.ticks_to_stance <= self._script.reach_ticks:
            goal = kinematics.knee_for_height(self._leg, self._front + nose_up, height)
        else:
            goal = self._script.swing_bend
        wanted = (goal - sense.knee) / self._tick_s
        speeds = self._leg.knee_speeds
        return min(range(len(speeds)), key=lambda n: abs(speeds[n] - wanted))


POLICIES = {"learned": EpsilonGreedy, "scripted": Scripted, "random": Random}
"""The policies that have a name."""
