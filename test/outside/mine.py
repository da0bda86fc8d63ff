"""Parts of somebody else's, outside of the package: a module that is found by ``PYTHONPATH``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ember_ros.params import LearningParams, Params
from ember_ros.signals import LegSense, TDUpdate, Transition
from leg_node.gait import GaitStep
from leg_node.policy import QValues
from leg_node.table import Table
from leg_node.value import ValueEstimate
from sim_node.fake import FakeWorld


class Reward:
    """Pays for a foot on the ground in stance, and for a quiet knee."""

    names = ("stands", "quiet")

    def __init__(self, params: Params) -> None:
        self._most = params.leg.knee_speeds[-1]

    def terms(self, sense: LegSense, as_stance: bool) -> dict[str, float]:
        terms = {"quiet": 1.0 - abs(sense.knee_speed) / self._most}
        if as_stance and sense.contact:
            terms["stands"] = 1.0
        return terms


class Discretizer:
    """Other features and other bins: knee 7, hip 5, and whether the foot touches."""

    shape = (7, 5, 2)
    neighbours = (True, True, False)

    def __init__(self, params: Params) -> None:
        self._most = params.leg.knee_max

    def index(self, sense: LegSense, stance: bool) -> int:
        knee = min(6, max(0, int(7.0 * sense.knee / self._most)))
        hip = min(4, max(0, int(5.0 * (sense.hip + 0.5))))
        return (knee * 5 + hip) * 2 + sense.contact


class DoubleQ:
    """Double Q-learning: one of two tables says what the best action of the other is worth."""

    tables = 2

    def __init__(
        self,
        estimates: Sequence[ValueEstimate],
        learning_params: LearningParams,
        shape: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        self._estimates, self._shape, self._rng = estimates, shape, rng
        self._gamma = learning_params.gamma

    def q_values(self, tick: int, state: int) -> list[float]:
        one, other = (each.q_values(tick, state) for each in self._estimates)
        return [(a + b) / 2.0 for a, b in zip(one, other, strict=True)]

    def learn(self, transition: Transition) -> Iterable[TDUpdate]:
        which = int(self._rng.integers(2))
        tick, state = transition.tick, transition.next_state
        own = self._estimates[which].q_values(tick, state)
        worth = self._estimates[1 - which].q_values(tick, state)[own.index(max(own))]
        states, actions = self._shape
        cell = (which * states + transition.state) * actions + transition.action
        return (TDUpdate(tick, cell, transition.reward + self._gamma * worth),)

    def flush(self) -> Iterable[TDUpdate]:
        return ()


class Value:
    """Half of what the table says."""

    def __init__(
        self, table: Table, discretizer: Any, learning_params: LearningParams, ticks: int
    ) -> None:
        self._table = table

    def q_values(self, tick: int, state: int) -> list[float]:
        return [value / 2.0 for value in self._table.row(state)]


class Gait:
    """Stance while the phase is in its first half; the hip goes to and fro."""

    def __init__(self, params: Params, offset: float) -> None:
        self._offset = offset

    def step(self, beat: Any, sense: LegSense) -> GaitStep:
        at = (beat.phase + self._offset) % 1.0
        stance = at < 0.5
        return GaitStep(stance, 0.0 if stance else 32.0 * (1.0 - at), 0.5 - abs(2.0 * at - 1.0))


class Policy:
    """The best action, and the first one now and then."""

    def __init__(
        self,
        params: Params,
        learning_params: LearningParams,
        q_values: QValues,
        rng: np.random.Generator,
        start_cycle: int = 0,
    ) -> None:
        self._q_values, self._rng = q_values, rng

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        if self._rng.random() < 0.2:
            return 0
        values = self._q_values(sense.tick, state)
        return values.index(max(values))


class Varying:
    """An oscillator that is slower and slower, then quick again, every 100 ticks."""

    def __init__(self, params: Params) -> None:
        self._ticks = params.gait.ticks

    def step(self, tick: int, feedback: Sequence[LegSense]) -> float:
        assert not feedback
        rounds, rest = divmod(tick, 100)
        return (80.0 * rounds + rest - 0.002 * rest * rest) / self._ticks


class Adaptive:
    """An oscillator that waits while no foot is on the ground: what an adaptive one hears."""

    hears_legs = True

    def __init__(self, params: Params) -> None:
        self._step, self._phase = 1.0 / params.gait.ticks, 0.0

    def step(self, tick: int, feedback: Sequence[LegSense]) -> float:
        if tick == 0:
            self._phase = 0.0
        elif sum(sense.contact for sense in feedback) >= len(feedback) / 2:
            self._phase += self._step
        else:
            self._phase += self._step / 2.0
        return self._phase


class World(FakeWorld):
    """A world without physics, and with legs of its own."""

    stage = "train"

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        super().__init__(self.legs_of(params), params, falls_at={50 + seed})

    @staticmethod
    def legs_of(params: Params) -> tuple[str, ...]:
        return params.robot.legs[:2]
