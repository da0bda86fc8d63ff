"""The walker: a body in two halves, joined by a twist motor, on four legs (paper, section IV)."""

from __future__ import annotations

import math

from ember_ros.params import Params
from ember_ros.signals import LEGS, BodyState, Phase
from sim_node import bodies
from sim_node.bullet import BulletWorld, bullet


class WalkerWorld(BulletWorld):
    """Four legs on a body that can fall.

    A fall is roll or pitch beyond ``walker.fall_angle``, the body on the ground, or hips under
    ``walker.fall_height`` for a whole cycle. It is counted; the robot is put back on its feet
    where it fell, heading where it headed, and the senses of the next tick are marked ``restart``.
    """

    legs: tuple[str, ...] = LEGS
    body_joints = ("twist",)
    body_links = ("rear",)

    def __init__(self, params: Params, *, heading: float = 0.0, gui: bool = False) -> None:
        """Build the walker, heading ``heading`` rad to the left of x."""
        self._first_heading = heading
        super().__init__(params, gui=gui)

    def reset(self) -> None:
        """Build everything anew, as it was at tick 0."""
        self._falls = 0
        self._start, self._start_heading = (0.0, 0.0), self._first_heading
        super().reset()

    def body(self) -> BodyState:
        """Return the pose of the body's middle, its halves averaged."""
        return self._body

    def _urdf(self) -> str:
        return bodies.walker_urdf(self.params)

    def _place(self) -> tuple[float, float, float]:
        return (*self._start, self.params.leg.operating_height)

    def _heading(self) -> float:
        return self._body.yaw

    def _prepare(self) -> None:
        self._low = 0  # ticks on end with the hips too low

    def _drive(self, phase: Phase) -> None:
        """Twist in synchrony with the phase, so that the swinging legs are raised.

        At ``twist_phase`` the front half's left side is highest: the front left leg and the rear
        right one, half a turn of the body away, are then in the middle of their swing.
        """
        walker, gait = self.params.walker, self.params.gait
        after = phase + 1.0 / gait.ticks - walker.twist_phase
        angle = -walker.twist_amplitude * math.cos(math.tau * after)
        joint = self._joints["twist"]
        turn = bullet.getJointState(self._robot, joint, self._client)[0]
        bullet.setJointMotorControl2(
            self._robot,
            joint,
            bullet.VELOCITY_CONTROL,
            targetVelocity=(angle - turn) / gait.tick_s,
            force=walker.twist_torque,
            physicsClientId=self._client,
        )

    def _read_body(self) -> None:
        front, (x, y, z, w) = bullet.getBasePositionAndOrientation(self._robot, self._client)
        rear, turn = self._body_links[0][0], self._body_joints[0][0]
        roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)) + turn / 2.0
        pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        self._body = BodyState(
            (front[0] + rear[0]) / 2.0,
            (front[1] + rear[1]) / 2.0,
            (front[2] + rear[2]) / 2.0,
            roll,
            pitch,
            yaw,
            self._falls,
        )

    def _fell(self) -> bool:
        walker, body = self.params.walker, self._body
        self._low = self._low + 1 if body.height < walker.fall_height else 0
        if (
            abs(body.roll) <= walker.fall_angle
            and abs(body.pitch) <= walker.fall_angle
            and not self._body_touched
            and self._low < self.params.gait.ticks
        ):
            return False
        self._falls += 1
        self._start, self._start_heading = (body.x, body.y), body.yaw
        return True
