"""A leg's decision process: what it knows at a tick, what a tick was worth, what an action does.

Pure. Everything of a leg but its learner and its policy (paper, sections II, VI-A, VI-B):
``LegModule`` adds these two, and an environment for other learners leaves them to others.

The timeline. Tick t: ``perceive(sense t)`` credits action t-1 and returns state t; ``act`` stores
state t and action t as pending; sense t+1 credits them. So a ``Transition`` stamped t+1 describes
tick t. With a learner that looks back (SARSA), an update's ``tick`` is when it became known, not
the tick of its cell.
"""

from __future__ import annotations

from typing import NamedTuple

from ember_ros.errors import ParameterError
from ember_ros.params import Params
from ember_ros.signals import Beat, LegCommand, LegSense, Transition
from leg_node.discretizer import Discretizer
from leg_node.gait import Gait, GaitStep
from leg_node.reward import RewardFunction


class Perception(NamedTuple):
    """What a leg knows when a tick begins."""

    sense: LegSense
    gait: GaitStep
    state: int
    """As its discretizer says."""
    transition: Transition
    """What happened in the tick that ended; nothing was learnt from it yet."""


class _Pending(NamedTuple):
    """What was done in a tick whose end is not yet sensed."""

    tick: int
    state: int
    stance: bool
    action: int
    rewarded_as_stance: bool


class LegTask:
    """The decision process of one leg; ``leg_node.assembly`` puts it together.

    In every tick ``perceive`` is called once, then ``act``.
    """

    def __init__(
        self,
        leg: str,
        params: Params,
        *,
        gait: Gait,
        discretizer: Discretizer,
        reward: RewardFunction,
    ) -> None:
        """Take the parts.

        Args:
            leg: its name.
            params: of its motors and its tick, and for how long before stance it is rewarded so.
            gait: turns the beat into stance or swing and a goal of the hip.
            discretizer: turns senses into a state.
            reward: tells what a tick was worth.
        """
        self.leg = leg
        self.discretizer = discretizer
        self._gait, self._reward = gait, reward
        self._terms = frozenset(reward.names)
        self._leg = params.leg
        self._lead = params.reward.lead
        self._tick_s = params.gait.tick_s
        self._pending: _Pending | None = None

    def perceive(self, sense: LegSense, beat: Beat) -> Perception:
        """Take the senses and the beat of one tick; return all that the leg makes of them."""
        gait = self._gait.step(beat, sense)
        state = self.discretizer.index(sense, gait.stance)
        return Perception(sense, gait, state, self.credit(sense, state, gait.stance))

    def act(self, perception: Perception, action: int) -> LegCommand:
        """Drive the hip to its goal within the tick and the knee at the chosen speed.

        Args:
            perception: at the beginning of the tick.
            action: position of the knee speed in ``leg.knee_speeds``.
        """
        sense, gait, leg = perception.sense, perception.gait, self._leg
        # ticks_to_stance is 0 in stance, so stance itself is included.
        as_stance = gait.ticks_to_stance <= self._lead
        self._pending = _Pending(sense.tick, perception.state, gait.stance, action, as_stance)
        speed = (gait.hip_goal - sense.hip) / self._tick_s
        most = leg.hip_speed_max
        speed = most if speed > most else -most if speed < -most else speed
        return LegCommand(
            sense.tick, speed, leg.knee_speeds[action], leg.hip_torque, leg.knee_torque
        )

    def reset(self) -> None:
        """Forget what was done: time began anew."""
        self._pending = None

    def nothing_to_credit(self, *, tick: int, state: int, stance: bool) -> Transition:
        """Return the transition of a tick before which nothing was done."""
        terms = tuple((name, 0.0) for name in self._reward.names)
        return Transition(tick, -1, False, -1, terms, state, stance, td_error=0.0)

    def credit(self, sense: LegSense, state: int = -1, stance: bool = False) -> Transition:
        """Return what the tick that ended with ``sense`` was worth.

        Reads only; may be called before ``perceive`` of the same tick.

        Args:
            sense: at the end of the tick.
            state: in which the next tick begins.
            stance: of the next tick.

        Raises:
            ParameterError: the reward gives a term that is none of its names.
        """
        pending = self._pending
        if pending is None or sense.first_tick or pending.tick + 1 != sense.tick:
            return self.nothing_to_credit(tick=sense.tick, state=state, stance=stance)
        applied = self._reward.terms(sense, pending.rewarded_as_stance)
        if not self._terms.issuperset(applied):
            raise ParameterError(
                f"parts.reward: {type(self._reward).__name__} gives the terms "
                f"{', '.join(applied)}; only those of its names, {', '.join(self._reward.names)}, "
                "would be right: others are not paid"
            )
        terms = tuple([(name, applied.get(name, 0.0)) for name in self._reward.names])
        return Transition(
            sense.tick,
            pending.state,
            pending.stance,
            pending.action,
            terms,
            state,
            stance,
            td_error=0.0,
        )
