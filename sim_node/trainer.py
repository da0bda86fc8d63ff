"""The cantilever trainer: one leg, stable from the outset (paper, section III, figure 3)."""

from __future__ import annotations

import math

from ember_ros.params import TRAINER_LEG, Params
from ember_ros.randomness import WORLD, generator
from ember_ros.signals import Beat, BodyState
from sim_node import bodies
from sim_node.bullet import BulletWorld, bullet


class TrainerWorld(BulletWorld):
    """A bar on a vertical axle with a hinge in its middle; the leg and its load are at the tip.

    A stop at the hinge keeps the attachment from falling below ``trainer.stop_height``. With
    ``trainer.modulation`` > 0 a new height is drawn every cycle (gaussian, bounded), and the stop
    approaches it by at most ``trainer.stop_slew`` per tick.
    """

    legs: tuple[str, ...] = (TRAINER_LEG,)
    fixed = True
    body_joints = ("axle", "hinge")

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        """Build the trainer; ``seed`` determines the heights of a modulated stop."""
        self._seed = seed
        super().__init__(params, gui=gui)

    def reset(self) -> None:
        """Restore the state of tick 0."""
        self._rng = generator(self._seed, WORLD)
        self._stop = self._goal = self.params.trainer.stop_height
        self._cycle = -1  # cycle of the CPG for which the goal was drawn
        super().reset()

    def body(self) -> BodyState:
        """Return the distance along the circle as ``x``, and the attachment's height; no angles."""
        half = self.params.trainer.bar_length / 2
        way = self._axle * self.params.trainer.bar_length
        height = self._hinge_height + half * math.sin(self._hinge)
        return BodyState(way, 0.0, height, 0.0, 0.0, 0.0, 0)

    def _urdf(self) -> str:
        return bodies.trainer_urdf(self.params)

    @property
    def _hinge_height(self) -> float:
        return self.params.leg.operating_height

    def _place(self) -> tuple[float, float, float]:
        return (0.0, 0.0, self._hinge_height)

    def _heading(self) -> float:
        """Return the bar's angle: the friction axes are along the bar and the leg's direction."""
        return self._axle

    def _prepare(self) -> None:
        trainer, client = self.params.trainer, self._client
        axle, hinge = self._joints["axle"], self._joints["hinge"]
        bullet.changeDynamics(
            self._robot, axle, jointDamping=trainer.axle_damping, physicsClientId=client
        )
        bullet.setJointMotorControl2(  # a motor with target speed 0 acts as dry friction
            self._robot,
            axle,
            bullet.VELOCITY_CONTROL,
            targetVelocity=0.0,
            force=trainer.axle_friction,
            physicsClientId=client,
        )
        self._set_stop(self._stop)
        start = max(self._stop, self.params.leg.operating_height)
        bullet.resetJointState(self._robot, hinge, self._angle(start), physicsClientId=client)

    def _drive(self, beat: Beat) -> None:
        trainer = self.params.trainer
        if trainer.modulation <= 0.0:
            return
        if int(beat.phase) != self._cycle:
            self._cycle = int(beat.phase)
            drawn = self._rng.normal(trainer.stop_height, trainer.modulation)
            self._goal = min(trainer.stop_high, max(trainer.stop_low, drawn))
        way = self._goal - self._stop
        if way != 0.0:
            self._set_stop(self._stop + max(-trainer.stop_slew, min(trainer.stop_slew, way)))

    def _angle(self, height: float) -> float:
        half = self.params.trainer.bar_length / 2
        return math.asin(max(-1.0, min(1.0, (height - self._hinge_height) / half)))

    def _set_stop(self, height: float) -> None:
        self._stop = height
        bullet.changeDynamics(
            self._robot,
            self._joints["hinge"],
            jointLowerLimit=self._angle(height),
            jointUpperLimit=self.params.trainer.hinge_max,
            physicsClientId=self._client,
        )

    def _read_body(self) -> None:
        axle, hinge = self._body_joints
        self._axle: float = axle[0]
        self._hinge: float = hinge[0]

    def _fell(self) -> bool:
        return False  # the stop holds it
