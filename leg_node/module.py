"""One leg module: one tick of sensing, reward, learning and acting (paper, sections V, VI). Pure.

Reading this file and ``leg_node.task`` shows what a leg can know: its own senses, the beat, and its
copy of the table.
"""

from __future__ import annotations

from ember_ros.signals import Beat, LegCommand, LegSense, Transition
from leg_node.learner import Learner
from leg_node.policy import Policy
from leg_node.shared import LocalCopy
from leg_node.task import LegTask


class LegModule:
    """A leg that senses, acts, is rewarded and learns; ``leg_node.assembly`` puts one together."""

    def __init__(
        self,
        task: LegTask,
        *,
        learner: Learner,
        policy: Policy,
        copy: LocalCopy,
        learning: bool,
        shared: bool,
    ) -> None:
        """Take the parts of a leg.

        Args:
            task: what the leg knows, what a tick is worth, what an action does.
            learner: turns transitions into updates.
            policy: chooses an action.
            copy: of the table.
            learning: whether the table changes.
            shared: whether the leg has anything to do with a shared table.
        """
        self.leg = task.leg
        self.copy = copy
        self.learning = learning
        self.shared = shared
        self._task, self._learner, self._policy = task, learner, policy
        self.last_transition = task.nothing_to_credit(tick=-1, state=-1, stance=False)
        """What happened in the tick that ended, as of the last call of ``tick``; none is credited
        before the first call."""

    def tick(self, sense: LegSense, beat: Beat) -> LegCommand:
        """Take the senses and the beat of one tick, learn from the tick before, and act.

        What was learnt from is in ``last_transition`` afterwards.
        """
        perception = self._task.perceive(sense, beat)
        self.last_transition = self._learn(perception.transition)
        return self._task.act(
            perception, self._policy.choose(sense, perception.gait, perception.state)
        )

    def finish(self) -> None:
        """Learn what the learner still keeps; no tick may follow but after ``reset``."""
        self._flush_learner()

    def reset(self, last_tick: int, run: str) -> None:
        """Begin a new life after ``last_tick``: time began anew, what was learnt stays."""
        self._flush_learner()
        self._task.reset()
        self.copy.reset(last_tick, run)

    def credit(self, sense: LegSense) -> Transition:
        """Return what the tick that ended with ``sense`` was worth; nothing is learnt from it.

        Reads only; may be called before ``tick`` of the same tick.
        """
        return self._task.credit(sense)

    def _learn(self, transition: Transition) -> Transition:
        """Learn from a transition; return it with the error of the last update, 0 without any.

        With a learner that looks back, that is the update of an earlier transition.
        """
        if not self.learning:
            return transition
        if not transition.credited:
            # Put down, or ticks missed: the chain of transitions breaks here.
            self._flush_learner()
            return transition
        error = 0.0
        for update in self._learner.learn(transition):
            error = self.copy.learn(update)
        return transition._replace(td_error=error)

    def _flush_learner(self) -> None:
        if self.learning:
            for update in self._learner.flush():
                self.copy.learn(update)
