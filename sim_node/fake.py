"""A world without physics, for tests: fast, exact, and every sensor responds. Pure.

Nothing has mass. The hips of all legs move forward together at the operating height, at the speed
of the gait's ramp, whatever the legs do. Each joint follows the commanded speed without delay and
stops at its limit; torques are ignored. All other sensors of a leg follow from the position of its
own foot: a spring presses on a foot that would be under the ground, and the foot slips by the
distance that it moves over the ground. No leg influences another.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

from ember_ros import kinematics
from ember_ros.params import Params
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense

SINK_A_LOAD = 0.01
"""Depth under the ground at which the force on a foot is one load, m."""
MAX_LOADS = 4.0
"""Maximum force on a foot, in loads."""


class _Foot(NamedTuple):
    """Position of a leg's foot in the plane of the leg, relative to its hip."""

    ahead: float
    """m"""
    depth: float
    """m under the ground; negative in the air"""


class FakeWorld:
    """Legs at a fixed height over ground that passes under them."""

    over = False
    work = 0.0

    def __init__(
        self,
        legs: Sequence[str] | None = None,
        params: Params | None = None,
        *,
        falls_at: Collection[int] = (),
    ) -> None:
        """Build the world at tick 0.

        Args:
            legs: names of the legs, in the order of all sequences; those of ``params.robot`` for
                None.
            params: geometry, load and gait; the defaults for None.
            falls_at: ticks at whose start the robot stands again after a fall in the tick before.
        """
        self.params = params or Params()
        self.legs = tuple(legs or self.params.robot.legs)
        self._falls_at = frozenset(falls_at)
        gait, leg = self.params.gait, self.params.leg
        front, rear = (
            self._foot(hip, kinematics.knee_for_height(leg, hip, leg.operating_height))
            for hip in (gait.hip_front, gait.hip_rear)
        )
        self._m_per_tick = (front.ahead - rear.ahead) / round(gait.stance_share * gait.ticks)
        # Stand as in the other worlds, each foot about under its hip.
        reach = leg.thigh_length + leg.shank_length - leg.foot_radius
        hip = math.acos((leg.operating_height - leg.foot_radius) / reach)
        self._standing = (hip, kinematics.knee_for_height(leg, hip, leg.operating_height))
        self.reset()

    def reset(self) -> None:
        """Restore the state of tick 0."""
        self._tick = self._falls = 0
        self._senses = self._stand(first_tick=False)

    def close(self) -> None:
        """Do nothing: there are no resources to release."""

    def observe(self) -> tuple[LegSense, ...]:
        """Return each leg's senses at the present tick; a second call returns the same."""
        return self._senses

    def body(self) -> BodyState:
        """Return a body that moves along x at constant speed and never turns."""
        height = self.params.leg.operating_height
        return BodyState(self._tick * self._m_per_tick, 0.0, height, 0.0, 0.0, 0.0, self._falls)

    def step(self, beat: Beat, commands: Sequence[LegCommand | None]) -> None:
        """Advance by one tick; a leg with ``None`` holds both its joints still."""
        self._tick += 1
        self._senses = tuple(
            self._move(sense, command)
            for sense, command in zip(self._senses, commands, strict=True)
        )
        if self._tick in self._falls_at:
            self._falls += 1
            self._senses = self._stand(first_tick=True)

    def _stand(self, *, first_tick: bool) -> tuple[LegSense, ...]:
        """Return the senses of legs that stand at rest."""
        hip, knee = self._standing
        foot = self._foot(hip, knee)
        sense = self._sense(hip, knee, 0.0, 0.0, foot, foot, slip=0.0)
        return (sense._replace(first_tick=first_tick),) * len(self.legs)

    def _move(self, sense: LegSense, command: LegCommand | None) -> LegSense:
        """Return a leg's senses after a tick with a command."""
        tick_s, leg = self.params.gait.tick_s, self.params.leg
        hip, knee = sense.hip, sense.knee
        if command is not None:
            hip = max(-math.pi, min(math.pi, hip + command.hip_speed * tick_s))
            knee = max(0.0, min(leg.knee_max, knee + command.knee_speed * tick_s))
        before, after = self._foot(sense.hip, sense.knee), self._foot(hip, knee)
        slip = 0.0
        if before.depth > 0.0 and after.depth > 0.0:
            slip = abs(after.ahead - before.ahead + self._m_per_tick)
        hip_speed, knee_speed = (hip - sense.hip) / tick_s, (knee - sense.knee) / tick_s
        return self._sense(hip, knee, hip_speed, knee_speed, before, after, slip=slip)

    def _sense(
        self,
        hip: float,
        knee: float,
        hip_speed: float,
        knee_speed: float,
        before: _Foot,
        after: _Foot,
        *,
        slip: float,
    ) -> LegSense:
        """Return a leg's senses; the tick moved the foot from ``before`` to ``after``."""
        first, last = self._force(before), self._force(after)
        return LegSense(
            self._tick,
            hip,
            knee,
            hip_speed,
            knee_speed,
            (first + last) / 2.0,
            max(first, last),
            hip - knee,
            slip,
            -after.depth < self.params.leg.hair_length,
            after.depth > 0.0,
            False,
        )

    def _foot(self, hip: float, knee: float) -> _Foot:
        leg, inclination = self.params.leg, hip - knee
        shank = leg.shank_length - leg.foot_radius
        ahead = leg.thigh_length * math.sin(hip) + shank * math.sin(inclination)
        # At the operating height the depth is one load, so a standing foot carries its share.
        depth = kinematics.height(leg, knee, inclination) - leg.operating_height + SINK_A_LOAD
        return _Foot(ahead, depth)

    def _force(self, foot: _Foot) -> float:
        return self.params.leg.load * min(MAX_LOADS, max(0.0, foot.depth / SINK_A_LOAD))
