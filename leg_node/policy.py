"""How a leg picks its next knee speed: learned, written by hand, or at random. Pure."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ember_ros import kinematics
from ember_ros.params import Learning, Params
from ember_ros.signals import LegSense, Phase
from leg_node.gait import LegGait
from leg_node.reading import Reading

POLICIES = ("learned", "scripted", "random")


class Policy(Protocol):
    """Chooses an action."""

    def choose(self, sense: LegSense, phase: Phase, state: int) -> int:
        """Return the position of the knee speed in ``leg.knee_speeds``."""
        ...


def epsilon_at(learning: Learning, cycle: int) -> float:
    """Return the share of random actions in a cycle: linear in cycles, then constant."""
    done = min(1.0, cycle / learning.epsilon_cycles)
    return learning.epsilon_start + done * (learning.epsilon_end - learning.epsilon_start)


class EpsilonGreedy:
    """The best action of the state as the table is read, but now and then any (section VI-C).

    Ties are broken at random: the first actions of a leg that knows nothing are random ones
    (section III), not the first of the list.
    """

    def __init__(
        self,
        reading: Reading,
        learning: Learning,
        actions: int,
        ticks: int,
        rng: np.random.Generator,
        start_cycle: int = 0,
    ) -> None:
        """Choose among ``actions`` by ``reading``, exploring as ``learning`` says.

        Args:
            reading: of the table.
            learning: how the share of random actions falls.
            actions: how many there are.
            ticks: of a cycle.
            rng: for random actions and ties.
            start_cycle: cycles that went before the first tick.
        """
        self._start_cycle = start_cycle
        self._reading, self._learning, self._rng = reading, learning, rng
        self._actions, self._ticks = actions, ticks
        self._cycle, self._epsilon = -1, 0.0  # epsilon is worked out once a cycle

    def choose(self, sense: LegSense, phase: Phase, state: int) -> int:
        """Return the best action, or any with probability epsilon."""
        rng = self._rng
        cycle = sense.tick // self._ticks
        if cycle != self._cycle:
            self._cycle, self._epsilon = (
                cycle,
                epsilon_at(self._learning, self._start_cycle + cycle),
            )
        if rng.random() < self._epsilon:
            return int(rng.integers(self._actions))
        row = self._reading.row(sense.tick, state)
        best = max(row)
        if row.count(best) == 1:
            return row.index(best)
        ties = [n for n, value in enumerate(row) if value == best]
        return ties[int(rng.integers(len(ties)))]


class Random:
    """Any action, always: what a leg is worth that learns nothing."""

    def __init__(self, actions: int, rng: np.random.Generator) -> None:
        """Draw among ``actions`` from ``rng``."""
        self._actions, self._rng = actions, rng

    def choose(self, sense: LegSense, phase: Phase, state: int) -> int:
        """Return any action."""
        return int(self._rng.integers(self._actions))


class Scripted:
    """A knee written by hand: constant height in stance, drawn up and put down in swing.

    It uses what the learning leg uses, the same nine speeds included: the nearest to the one
    wanted. It shows that a body can be walked at all.
    """

    SWING_BEND = 1.4  # rad: nearly all the knee has
    REACH_TICKS = 3  # ticks before stance in which the knee is put down

    def __init__(self, params: Params, gait: LegGait) -> None:
        """Take geometry and speeds from ``params``."""
        self._leg, self._gait = params.leg, gait
        self._tick_s = params.gait.tick_s
        self._ahead = self.REACH_TICKS / params.gait.ticks
        self._front = params.gait.hip_front

    def choose(self, sense: LegSense, phase: Phase, state: int) -> int:
        """Return the speed nearest to what brings the knee where it should be in a tick."""
        pitch = sense.inclination + sense.knee - sense.hip
        height = self._leg.operating_height
        if self._gait.stance(phase):
            thigh = self._gait.hip_goal(phase) + pitch
            goal = kinematics.knee_for_height(self._leg, thigh, height)
        elif self._gait.stance(phase + self._ahead):
            goal = kinematics.knee_for_height(self._leg, self._front + pitch, height)
        else:
            goal = self.SWING_BEND
        wanted = (goal - sense.knee) / self._tick_s
        speeds = self._leg.knee_speeds
        return min(range(len(speeds)), key=lambda n: abs(speeds[n] - wanted))
