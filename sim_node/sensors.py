"""What is mounted on a leg and reads there, from what any physics can tell. Pure.

A backend tells, at each physics step, the force between foot and ground and where they touch, and
at each tick the joints and the foot's pose. What a leg senses is worked out here and nowhere else,
the same way on the trainer and on the walker: that is what lets a leg be trained on the one and
used on the other (paper, section I).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ember_ros.params import Params
from ember_ros.signals import LegSense


class LegSensors:
    """The sensors of one leg.

    A foot is a sphere on flat ground: the point of contact moves as the foot's middle does, so its
    way while in contact is how far the foot slid, but for rolling.
    """

    __slots__ = (
        "_force", "_hair", "_inclination", "_last_step", "_peak", "_radius", "_slide_x", "_slide_y",
        "_strength", "_substeps", "_touched", "_x", "_y",
    )  # fmt: skip

    def __init__(self, params: Params) -> None:
        """Begin before any contact."""
        self._substeps = params.physics.substeps
        self._radius, self._hair = params.leg.foot_radius, params.leg.hair_length
        self._last_step = -1  # in which the foot touched the ground last, there at x, y
        self._x = self._y = 0.0
        self._strength = 0.0  # the force in that step, N
        self._inclination = 0.0
        self.begin_tick()

    def begin_tick(self) -> None:
        """Forget what the foot went through in the tick before."""
        self._force = self._peak = self._slide_x = self._slide_y = 0.0
        self._touched = 0

    def touch(self, step: int, force: float, x: float, y: float) -> None:
        """Take in a point of contact between foot and ground.

        Args:
            step: physics steps since the robot was built; several points in one step add up.
            force: vertical, N; nothing is touched where it is not positive.
            x: where, m, in the world.
            y: as well.
        """
        if force <= 0.0:
            return
        self._force += force
        if self._last_step == step:  # a second point, one step in a hundred: only its force counts
            self._strength += force
        else:
            self._strength = force
            if self._last_step == step - 1:
                self._slide_x += x - self._x
                self._slide_y += y - self._y
            self._last_step, self._x, self._y = step, x, y
            self._touched += 1
        if self._strength > self._peak:
            self._peak = self._strength

    def sense(
        self,
        tick: int,
        step: int,
        joints: tuple[float, float, float, float],
        foot: Sequence[float],
        height: float,
        *,
        first_tick: bool,
    ) -> LegSense:
        """Return what the leg senses at the end of a tick.

        Args:
            tick: that begins.
            step: physics steps since the robot was built.
            joints: angles of hip and knee, rad, then their speeds, rad/s.
            foot: orientation of the foot's link in the world, a quaternion x, y, z, w.
            height: of the foot's middle over the ground, m.
            first_tick: whether the leg was put down just now.
        """
        x, y, z, w = foot
        # Gravity in the shank's frame, as an accelerometer there reads it.
        inclination = math.atan2(2.0 * (x * z - w * y), 1.0 - 2.0 * (x * x + y * y))
        slip = 0.0
        if self._touched:
            turned = inclination - self._inclination
            turned = math.remainder(turned, math.tau) * self._touched / self._substeps
            rolled = self._radius * turned
            forward_x, forward_y = 1.0 - 2.0 * (x * x + z * z), 2.0 * (w * z - x * y)
            slip = math.hypot(
                self._slide_x + rolled * forward_x, self._slide_y + rolled * forward_y
            )
        self._inclination = inclination
        hip, knee, hip_speed, knee_speed = joints
        return LegSense(
            tick,
            hip,
            knee,
            hip_speed,
            knee_speed,
            self._force / self._substeps,
            self._peak,
            inclination,
            slip,
            height - self._radius < self._hair,
            self._last_step == step,
            first_tick,
        )
