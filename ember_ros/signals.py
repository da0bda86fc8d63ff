"""What passes between the rooms of the house, as plain values: no ROS, no arrays, SI units.

All are named tuples of Python floats (IEEE double), ints and bools: immutable, cheap to make
thousands of times a second, and packed into bytes in one call where a run is hashed.

Frames. A leg moves in one plane. Angles in that plane are measured from the downward vertical,
positive towards the front: ``hip`` and ``knee`` relative to their parent link, ``inclination``
of the shank relative to gravity. The knee bends backward only, so ``knee`` is positive and the
shank's angle relative to the body is ``hip - knee``.
"""

from __future__ import annotations

from typing import NamedTuple


class Beat(NamedTuple):
    """What the central pattern generator broadcasts, and all that it does: a stamped phase.

    The stamp tells the time, the phase tells the gait.
    """

    tick: int
    """Ticks since the start of the run."""
    phase: float
    """Cycles since the start, unwrapped, 0 or more; it never runs backwards."""


class LegSense(NamedTuple):
    """What is mounted on one leg and reads there, at the start of tick ``tick``.

    Force, slip and contact speak of the tick that just ended (paper, section VI-B).
    """

    tick: int
    """Ticks since the start of the run."""
    hip: float
    """Hip angle relative to the body, rad."""
    knee: float
    """Knee angle relative to the thigh, rad, 0 when the leg is straight."""
    hip_speed: float
    """rad/s"""
    knee_speed: float
    """rad/s"""
    force_mean: float
    """Vertical force between ground and foot, mean over the tick, N."""
    force_peak: float
    """The same, largest value within the tick, N."""
    inclination: float
    """Angle of the shank from the vertical in the leg's plane, rad, foot ahead of knee positive."""
    slip: float
    """Distance the foot slid on the ground in the tick, corrected for its rolling, m, never < 0."""
    hair: bool
    """The hair in front of the foot touches the ground."""
    contact: bool
    """The foot touched the ground at the end of the tick."""
    first_tick: bool
    """The leg was picked up and put down just now: what went before is none of its doing."""


class LegCommand(NamedTuple):
    """What one leg asks of its two motors during tick ``tick`` (paper, section II)."""

    tick: int
    hip_speed: float
    """rad/s"""
    knee_speed: float
    """rad/s"""
    hip_torque: float
    """Largest torque the motor may use to reach its speed, N m."""
    knee_torque: float
    """N m"""


class TDUpdate(NamedTuple):
    """One update of one cell, kept so that it can be applied elsewhere in the same order."""

    tick: int
    """The tick at which the target was known, as in the timeline of ``leg_node.task``."""
    cell: int
    """Row-major index of the cell (state, action)."""
    target: float
    """The temporal-difference target; Q-learning's is reward + gamma * max Q(next state)."""


class Transition(NamedTuple):
    """One step of a leg's Markov decision process, known at the start of tick ``tick``.

    State, stance, action and reward are of the tick that just ended, as the force in ``LegSense``
    is; the next state and stance are of the tick that begins. A leg publishes it for records,
    reports and viewers; no other leg hears it. The timeline is in ``leg_node.task``.
    """

    tick: int
    """The tick that begins: one after the tick that is rewarded."""
    state: int
    """In which the action was chosen, 0 or more; -1 where there is nothing to credit: at the first
    tick, after a reset, or after ticks that were missed."""
    stance: bool
    """Whether the leg was in stance, as the gait says, whether or not the tick was rewarded as
    stance; False where there is nothing to credit."""
    action: int
    """Index into ``leg.knee_speeds``; -1 where there is nothing to credit."""
    terms: tuple[tuple[str, float], ...]
    """Every weighted term of the reward by name, always the same names in the same order; 0 for a
    term that did not apply."""
    next_state: int
    """In which the tick begins."""
    next_stance: bool
    """Whether the tick that begins belongs to stance."""
    td_error: float
    """The error of the last update: its target less the value that its cell had before. With a
    learner that looks back, the update is of an earlier transition. 0 where nothing was learnt."""

    @property
    def credited(self) -> bool:
        """Return whether there was a tick to credit."""
        return self.action >= 0

    @property
    def reward(self) -> float:
        """Return the reward: the terms added from the first to the last.

        Not by ``sum``, which since Python 3.12 rounds otherwise than before.
        """
        total = 0.0
        for _, value in self.terms:
            total += value
        return total


class BodyState(NamedTuple):
    """The world's truth about what the legs carry: for reports and viewers, never for a leg."""

    x: float
    """m; on the trainer the distance walked along the circle."""
    y: float
    """m; on the trainer 0."""
    height: float
    """Height of the hips over the ground, m."""
    roll: float
    """rad"""
    pitch: float
    """rad, nose down positive (REP 103)."""
    yaw: float
    """rad"""
    falls: int
    """Falls so far."""
