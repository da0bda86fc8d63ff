"""One leg module: one tick of sensing, reward, learning and acting (paper, sections V, VI). Pure.

Reading this file shows what a leg can know: its own senses, the phase, and its copy of the table.
"""

from __future__ import annotations

from typing import NamedTuple

from ember_ros.errors import ParameterError
from ember_ros.params import Learning, Params, cells_sha256
from ember_ros.randomness import generator
from ember_ros.signals import LEGS, TRAINER_LEG, LegCommand, LegSense, Pair, Phase, Transition
from leg_node.gait import LegGait
from leg_node.policy import POLICIES, EpsilonGreedy, Policy, Random, Scripted
from leg_node.reading import PlainReading, Reading, SmoothReading
from leg_node.reward import Rewarder, RewardFunction
from leg_node.shared import LocalCopy
from leg_node.state import Partition
from leg_node.table import Table, empty_table


class _Pending(NamedTuple):
    """What was done in a tick whose end is not yet sensed."""

    tick: int
    state: int
    action: int
    stance: bool
    """Whether it is rewarded as stance is."""


class LegModule:
    """A leg that senses, acts, is rewarded and learns."""

    def __init__(
        self,
        params: Params,
        leg: str,
        *,
        stage: str = "walk",
        seed: int = 0,
        policy: str | Policy = "learned",
        learning: bool = True,
        shared: bool = True,
        table: Table | None = None,
        run: str = "run",
        start_cycle: int = 0,
        partition: Partition | None = None,
        rewarder: RewardFunction | None = None,
    ) -> None:
        """Make a leg.

        Args:
            params: every number.
            leg: one of ``LEGS``, or ``TRAINER_LEG``.
            stage: which learning numbers hold, ``train`` or ``walk``.
            seed: of the run; each leg draws from its own generator.
            policy: ``learned``, ``scripted`` or ``random``, or one of your own.
            learning: whether the table changes.
            shared: whether the table is shared with other legs, or this leg's own.
            table: what was learnt before, owned by this leg from now on; empty for None.
            run: names this life of the leg for the shared table.
            start_cycle: cycles that were learnt before: exploration goes on from there.
            partition: of the state; the paper's for None.
            rewarder: what a tick is worth; the paper's for None.

        Raises:
            ParameterError: no such leg, stage or policy.
        """
        if leg not in (*LEGS, TRAINER_LEG):
            raise ParameterError(
                f"there is no leg {leg!r}; it is one of {', '.join(LEGS)} on the "
                f"walker, {TRAINER_LEG} on the trainer"
            )
        if stage not in ("train", "walk"):
            raise ParameterError(f"there is no stage {stage!r}; it is train or walk")
        if isinstance(policy, str) and policy not in POLICIES:
            raise ParameterError(f"there is no policy {policy!r}; it is {', '.join(POLICIES)}")
        self.leg = leg
        self.position = LEGS.index(leg) if leg in LEGS else 0
        self.learning = learning
        self.shared = shared and (learning or policy == "learned")
        """Whether this leg has anything to do with the shared table."""
        self._params, self._leg = params, params.leg
        numbers: Learning = params.train if stage == "train" else params.walk
        self._gamma = numbers.gamma
        self._gait = LegGait(params.gait, leg)
        self._lead = params.reward.lead
        self._partition = partition or Partition(params)
        self._rewarder: RewardFunction = rewarder or Rewarder(params)
        self.copy = LocalCopy(
            table if table is not None else empty_table(params),
            leg=self.position,
            run=run,
            cells=cells_sha256(params),
            rate=numbers.rate,
            sync_every=numbers.sync_every if self.shared else 0,
        )
        self._reading: Reading = PlainReading(self.copy.table)
        if numbers.smooth > 0.0 or numbers.prior > 0.0:
            shape, ticks = self._partition.shape, params.gait.ticks
            self._reading = SmoothReading(self.copy.table, shape, numbers, ticks)
        self._policy = self._make_policy(policy, numbers, seed, start_cycle)
        self._actions = len(params.leg.knee_speeds)
        self._tick_s = params.gait.tick_s
        self._pending: _Pending | None = None
        self.transition = self._nothing_to_credit(-1)
        """What the last tick that ended was worth, as of the last call of ``tick``."""

    def _make_policy(
        self, name: str | Policy, numbers: Learning, seed: int, start_cycle: int
    ) -> Policy:
        if not isinstance(name, str):
            return name
        rng = generator(seed, self.position)
        actions = len(self._params.leg.knee_speeds)
        if name == "scripted":
            return Scripted(self._params, self._gait)
        if name == "random":
            return Random(actions, rng)
        ticks = self._params.gait.ticks
        return EpsilonGreedy(self._reading, numbers, actions, ticks, rng, start_cycle)

    def tick(self, sense: LegSense, phase: Phase) -> LegCommand:
        """Take the senses and the phase of one tick, learn from the tick before, and act.

        What was learnt from is in ``transition`` afterwards.
        """
        stance = self._gait.stance(phase)
        state = self._partition.index(sense, stance)
        self.transition = self.credit(sense)
        if self.learning and self.transition.credited:
            self._learn(self.transition, state)
        action = self._policy.choose(sense, phase, state)
        stance = self._gait.rewarded_as_stance(phase, self._lead)
        self._pending = _Pending(sense.tick, state, action, stance)
        return self._command(sense, phase, action)

    def restart(self, last_tick: int, run: str) -> None:
        """Begin a new life after ``last_tick``: time began anew, what was learnt stays."""
        self._pending = None
        self.copy.restart(last_tick, run)

    def credit(self, sense: LegSense) -> Transition:
        """Return what the tick that ended with ``sense`` was worth; nothing is learnt from it."""
        did = self._pending
        if did is None or sense.restart or did.tick + 1 != sense.tick:
            return self._nothing_to_credit(sense.tick)
        terms = self._rewarder.terms(sense, did.stance)
        paid = tuple([(name, terms.get(name, 0.0)) for name in self._rewarder.names])
        return Transition(sense.tick, did.stance, did.state, did.action, paid)

    def _nothing_to_credit(self, tick: int) -> Transition:
        return Transition(tick, False, -1, -1, tuple((n, 0.0) for n in self._rewarder.names))

    def _learn(self, did: Transition, state: int) -> None:
        """Learn from a tick that led to ``state``: one step of Q-learning [Watkins 1989]."""
        target = did.reward + self._gamma * max(self._reading.row(did.tick, state))
        self.copy.learn(Pair(did.tick, did.state * self._actions + did.action, target))

    def _command(self, sense: LegSense, phase: Phase, action: int) -> LegCommand:
        """Drive the hip to the ramp's end of this tick and the knee at the chosen speed."""
        leg = self._leg
        speed = (self._gait.hip_goal(phase) - sense.hip) / self._tick_s
        most = leg.hip_speed_max
        speed = most if speed > most else -most if speed < -most else speed
        return LegCommand(
            sense.tick, speed, leg.knee_speeds[action], leg.hip_torque, leg.knee_torque
        )
