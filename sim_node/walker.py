"""The walker: a body in segments, joined by twist motors, on its legs (paper, section IV)."""

from __future__ import annotations

import math

from ember_ros.params import Params
from ember_ros.phase import PhaseRate
from ember_ros.signals import Beat, BodyState
from sim_node import bodies
from sim_node.bullet import BulletWorld, bullet


class WalkerWorld(BulletWorld):
    """Legs on a body that can fall.

    A fall is roll or pitch beyond ``walker.fall_angle``, the body on the ground, or hips under
    ``walker.fall_height`` for a whole cycle. Falls are counted. After a fall the robot is put back
    on its feet at the same place with the same heading, and the next senses are ``first_tick``.
    """

    def __init__(
        self, params: Params, *, seed: int = 0, heading: float = 0.0, gui: bool = False
    ) -> None:
        """Build the walker.

        Args:
            params: of the robot and the physics.
            seed: not used: nothing in this world is random.
            heading: angle to the left of the x axis, rad.
            gui: whether to show PyBullet's window.
        """
        behind = params.robot.segments[1:]
        self.legs = params.robot.legs
        self.body_joints = tuple(bodies.twist_of(name) for name in behind)
        self.body_links = behind
        self._first_heading = heading
        super().__init__(params, gui=gui)

    def reset(self) -> None:
        """Restore the state of tick 0."""
        self._falls = 0
        self._start, self._start_heading = (0.0, 0.0), self._first_heading
        self._rate = PhaseRate(1.0 / self.params.gait.ticks)
        super().reset()

    def body(self) -> BodyState:
        """Return the pose of the body, averaged over its segments."""
        return self._body

    def _urdf(self) -> str:
        return bodies.walker_urdf(self.params)

    def _place(self) -> tuple[float, float, float]:
        return (*self._start, self.params.leg.operating_height)

    def _heading(self) -> float:
        return self._body.yaw

    def _prepare(self) -> None:
        self._low = 0  # consecutive ticks with the hips too low

    def _drive(self, beat: Beat) -> None:
        """Twist the body in synchrony with the phase, so that the swinging legs are raised.

        At ``twist_phase`` the left side of the first segment is highest relative to the second. The
        second is highest relative to the third half a cycle later, and so on, because neighbouring
        legs of one side swing in turn.
        """
        walker, gait = self.params.walker, self.params.gait
        after = beat.phase + self._rate.per_tick(beat) - walker.twist_phase
        angle = -walker.twist_amplitude * math.cos(math.tau * after)
        for name, (turn, *_) in zip(self.body_joints, self._body_joints, strict=True):
            bullet.setJointMotorControl2(
                self._robot,
                self._joints[name],
                bullet.VELOCITY_CONTROL,
                targetVelocity=(angle - turn) / gait.tick_s,
                force=walker.twist_torque,
                physicsClientId=self._client,
            )
            angle = -angle

    def _read_body(self) -> None:
        (ahead, aside, height), (x, y, z, w) = bullet.getBasePositionAndOrientation(
            self._robot, self._client
        )
        for link in self._body_links:
            ahead += link[0][0]
            aside += link[0][1]
            height += link[0][2]
        turned = turns = 0.0  # angle of a segment relative to the first one; sum over all segments
        for turn, *_ in self._body_joints:
            turned += turn
            turns += turned
        count = 1 + len(self._body_links)
        roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)) + turns / count
        pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        self._body = BodyState(
            ahead / count,
            aside / count,
            height / count,
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
