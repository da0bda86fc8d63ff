"""One leg module: one tick of sensing, reward, learning and acting (paper, sections V, VI). Pure.

Reading this file shows what a leg can know: its own senses, the beat, and its copy of the table.
"""

from __future__ import annotations

from typing import NamedTuple

from ember_ros.params import Params
from ember_ros.signals import Beat, LegCommand, LegSense, Transition
from leg_node.discretizer import Discretizer
from leg_node.gait import Gait, GaitStep
from leg_node.learner import Learner
from leg_node.policy import Policy
from leg_node.reward import RewardFunction
from leg_node.shared import LocalCopy


class _Pending(NamedTuple):
    """What was done in a tick whose end is not yet sensed."""

    tick: int
    state: int
    stance: bool
    action: int
    rewarded_as_stance: bool


class LegModule:
    """A leg that senses, acts, is rewarded and learns; ``leg_node.assembly`` puts one together."""

    def __init__(
        self,
        leg: str,
        params: Params,
        *,
        gait: Gait,
        discretizer: Discretizer,
        reward: RewardFunction,
        learner: Learner,
        policy: Policy,
        copy: LocalCopy,
        learning: bool,
        shared: bool,
    ) -> None:
        """Take the parts of a leg.

        Args:
            leg: its name.
            params: of its motors and its tick, and for how long before stance it is rewarded so.
            gait: turns the beat into stance or swing and a goal of the hip.
            discretizer: turns senses into a state.
            reward: tells what a tick was worth.
            learner: turns transitions into updates.
            policy: chooses an action.
            copy: of the table.
            learning: whether the table changes.
            shared: whether the leg has anything to do with a shared table.
        """
        self.leg = leg
        self.copy = copy
        self.learning = learning
        self.shared = shared
        self._gait, self._discretizer, self._reward = gait, discretizer, reward
        self._learner, self._policy = learner, policy
        self._leg = params.leg
        self._lead = params.reward.lead
        self._tick_s = params.gait.tick_s
        self._pending: _Pending | None = None
        self.transition = self._nothing_to_credit(-1, -1, False)
        """What happened in the tick that ended, as of the last call of ``tick``."""

    def tick(self, sense: LegSense, beat: Beat) -> LegCommand:
        """Take the senses and the beat of one tick, learn from the tick before, and act.

        What was learnt from is in ``transition`` afterwards.
        """
        gait = self._gait.step(beat, sense)
        state = self._discretizer.index(sense, gait.stance)
        self.transition = self._learn(self.credit(sense, state, gait.stance))
        action = self._policy.choose(sense, gait, state)
        as_stance = gait.ticks_to_stance <= self._lead
        self._pending = _Pending(sense.tick, state, gait.stance, action, as_stance)
        return self._command(sense, gait, action)

    def finish(self) -> None:
        """Learn what the learner still keeps; no tick may follow but after ``reset``."""
        self._apply_rest()

    def reset(self, last_tick: int, run: str) -> None:
        """Begin a new life after ``last_tick``: time began anew, what was learnt stays."""
        self._apply_rest()
        self._pending = None
        self.copy.restart(last_tick, run)

    def credit(self, sense: LegSense, state: int = -1, stance: bool = False) -> Transition:
        """Return what the tick that ended with ``sense`` was worth; nothing is learnt from it.

        Args:
            sense: at the end of the tick.
            state: in which the next tick begins.
            stance: of the next tick.
        """
        did = self._pending
        if did is None or sense.restart or did.tick + 1 != sense.tick:
            return self._nothing_to_credit(sense.tick, state, stance)
        applied = self._reward.terms(sense, did.rewarded_as_stance)
        terms = tuple([(name, applied.get(name, 0.0)) for name in self._reward.names])
        return Transition(
            sense.tick, did.state, did.stance, did.action, terms, state, stance, td_error=0.0
        )

    def _nothing_to_credit(self, tick: int, state: int, stance: bool) -> Transition:
        terms = tuple((name, 0.0) for name in self._reward.names)
        return Transition(tick, -1, False, -1, terms, state, stance, td_error=0.0)

    def _learn(self, transition: Transition) -> Transition:
        """Learn from a transition; return it with the error of its update."""
        if not self.learning:
            return transition
        if not transition.credited:
            self._apply_rest()
            return transition
        error = 0.0
        for update in self._learner.learn(transition):
            error = self.copy.learn(update)
        return transition._replace(td_error=error)

    def _apply_rest(self) -> None:
        if self.learning:
            for update in self._learner.reset():
                self.copy.learn(update)

    def _command(self, sense: LegSense, gait: GaitStep, action: int) -> LegCommand:
        """Drive the hip to its goal within the tick and the knee at the chosen speed."""
        leg = self._leg
        speed = (gait.hip_goal - sense.hip) / self._tick_s
        most = leg.hip_speed_max
        speed = most if speed > most else -most if speed < -most else speed
        return LegCommand(
            sense.tick, speed, leg.knee_speeds[action], leg.hip_torque, leg.knee_torque
        )
