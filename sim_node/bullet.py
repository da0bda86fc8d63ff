"""Legs mounted on something in Bullet, for both worlds: the physics, and their motors.

What a leg senses is worked out in ``sim_node.sensors``, from what is read here.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ember_ros import kinematics
from ember_ros.errors import ParameterError
from ember_ros.params import Params, Physics
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense
from sim_node.sensors import LegSensors


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Send what C code prints to nowhere: importing pybullet announces its build time."""
    with open(os.devnull, "wb") as nowhere:
        sys.stderr.flush()
        saved = os.dup(2)
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)


with _quiet():
    import pybullet as bullet


EYE = (2.5, 50.0, -20.0)
"""Where the camera is, as seen from the robot: distance, m; yaw and pitch, degrees."""

__all__ = ["BulletWorld", "Ground", "bullet", "set_contact", "set_up"]


def set_up(client: int, params: Params) -> None:
    """Set gravity, the length of a physics step and the solver of an empty physics server."""
    bullet.setGravity(0, 0, -params.physics.gravity, client)
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=params.gait.tick_s / params.physics.substeps,
        numSolverIterations=params.physics.iterations,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )


def set_contact(client: int, body: int, link: int, physics: Physics) -> None:
    """Give a link the friction and the softness of a foot, and nothing that brakes it."""
    bullet.changeDynamics(
        body,
        link,
        lateralFriction=physics.friction,
        restitution=0.0,
        linearDamping=0.0,
        angularDamping=0.0,
        jointDamping=0.0,
        contactStiffness=physics.contact_stiffness,
        contactDamping=physics.contact_damping,
        physicsClientId=client,
    )


class Ground:
    """Flat ground without end, the same in every direction for a robot that it is turned with.

    Bullet works friction out along two axes, and where a foot is harder to move along one than
    along the other, the force does not point straight against its slip. The axes are the world's:
    what slides at 45 degrees to them is held less, and a walker turns until it heads there. Its
    anisotropic friction of (1, -1, 1) mirrors these axes in the ground's own x, so on ground that
    is turned by half a heading they lie along that heading and across it, whatever it is.
    """

    def __init__(self, client: int) -> None:
        """Lay the ground at height 0, for the heading 0."""
        self._client = client
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client)
        visual = bullet.createVisualShape(
            bullet.GEOM_BOX,
            halfExtents=(50, 50, 0.001),
            rgbaColor=(0.93, 0.94, 0.92, 1),
            physicsClientId=client,
        )
        self._body = bullet.createMultiBody(0, plane, visual, physicsClientId=client)
        bullet.changeDynamics(
            self._body,
            -1,
            lateralFriction=1.0,
            restitution=0.0,
            anisotropicFriction=(1.0, -1.0, 1.0),
            physicsClientId=client,
        )

    def turn(self, heading: float) -> None:
        """Turn the axes of friction to a heading, rad; before every tick, as the robot turns."""
        half = heading / 4.0  # a quaternion holds half of the angle, which is half of the heading
        bullet.resetBasePositionAndOrientation(
            self._body, (0.0, 0.0, 0.0), (0.0, 0.0, math.sin(half), math.cos(half)), self._client
        )


class _Mount:
    """One leg in Bullet: its indices there, and its sensors."""

    __slots__ = ("foot", "held", "hip", "knee", "sensors")

    def __init__(self, hip: int, knee: int, foot: int, sensors: LegSensors) -> None:
        self.hip, self.knee, self.foot, self.sensors = hip, knee, foot, sensors
        self.held: tuple[float, float] | None = None
        """Where hip and knee are held while the leg gets no command, rad."""


class BulletWorld(ABC):
    """A physics server of its own, one robot on flat ground, legs that sense and are driven.

    Rebuilding (``resetSimulation``, then loading anew) is the only way back to a known state:
    restoring a saved one does not restore Bullet's contact caches, and runs part ways.

    Bullet's joint limits are soft: a knee that is driven against its stop at full speed passes it
    by up to 0.15 rad for a tick.
    """

    legs: tuple[str, ...]
    over = False
    _start_heading = 0.0
    """Where the robot heads when it is built, rad."""
    work = 0.0
    """What the legs' motors have put into their joints so far, J: the positive part of torque times
    speed, read at the end of each tick. What they take out of them again is not given back."""
    body_joints: tuple[str, ...] = ()
    """Joints that no leg owns, read with the legs' joints in one call into ``_body_joints``."""
    body_links: tuple[str, ...] = ()
    """Links that no leg owns, read with the feet in one call into ``_body_links``."""

    def __init__(self, params: Params, *, gui: bool = False) -> None:
        """Build the world at tick 0.

        Args:
            params: all physical numbers.
            gui: show Bullet's window.
        """
        self.params = params
        if gui and not os.environ.get("DISPLAY"):
            raise ParameterError("gui = True needs a display, and DISPLAY is not set")
        self._client = bullet.connect(bullet.GUI if gui else bullet.DIRECT)
        if self._client < 0:
            raise ParameterError("Bullet could not open its window; gui = False needs none")
        self._gui = gui
        self.reset()

    # -- what each world adds --------------------------------------------------------------

    @abstractmethod
    def _urdf(self) -> str:
        """Return the robot."""

    @abstractmethod
    def _place(self) -> tuple[float, float, float]:
        """Return where the robot's root link starts, m."""

    @abstractmethod
    def _heading(self) -> float:
        """Return where the robot heads, rad."""

    @abstractmethod
    def _prepare(self) -> None:
        """Finish the freshly loaded robot: joints that no leg owns, friction, the body's pose."""

    @abstractmethod
    def _drive(self, beat: Beat) -> None:
        """Set the motors that no leg owns for the coming tick."""

    @abstractmethod
    def _read_body(self) -> None:
        """Read the body, its joints and links having been sensed."""

    @abstractmethod
    def _fell(self) -> bool:
        """Return whether the robot fell in this tick, and count it; it is then built anew."""

    @abstractmethod
    def body(self) -> BodyState:
        """Return the truth about the body, for reports and viewers only."""

    def _turn_camera(self) -> None:
        """Turn the window's camera, if there is one, to where the legs are."""
        bullet.resetDebugVisualizerCamera(*EYE, self._middle(), physicsClientId=self._client)

    def _middle(self) -> tuple[float, float, float]:
        """Return the middle between the feet, at half the operating height, m."""
        feet = self._read_links[: len(self.legs)]
        at = [state[0] for state in bullet.getLinkStates(self._robot, feet, 0, 0, self._client)]
        x, y = (sum(place[axis] for place in at) / len(at) for axis in (0, 1))
        return (x, y, self.params.leg.operating_height / 2)

    # -- the verbs ----------------------------------------------------------------------

    def reset(self) -> None:
        """Build everything anew, as it was at tick 0."""
        self._tick = 0
        self.work = 0.0
        self._build()

    def close(self) -> None:
        """Let go of the physics server."""
        if self._client >= 0:
            bullet.disconnect(self._client)
            self._client = -1

    def observe(self) -> tuple[LegSense, ...]:
        """Return what each leg senses at the present tick; calling twice gives the same."""
        return self._senses

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """Return what a camera sees that follows the robot: ``(height, width, 3)``, RGB.

        Drawn without a window and without OpenGL; it changes nothing that is simulated.
        """
        near, far = 0.1, 20.0
        view = bullet.computeViewMatrixFromYawPitchRoll(self._middle(), *EYE, 0.0, 2)
        lens = bullet.computeProjectionMatrixFOV(50.0, width / height, near, far)
        pixels = bullet.getCameraImage(
            width,
            height,
            view,
            lens,
            renderer=bullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )[2]
        return np.array(pixels, dtype=np.uint8).reshape(height, width, 4)[:, :, :3].copy()

    def coast(self, beat: Beat, commands: Sequence[LegCommand | None]) -> None:
        """Advance by one tick and sense nothing: what physics alone costs, for benchmarks."""
        self._ground.turn(self._heading())
        self._set_motors(commands)
        self._drive(beat)
        for _ in range(self.params.physics.substeps):
            bullet.stepSimulation(self._client)

    def step(self, beat: Beat, commands: Sequence[LegCommand | None]) -> None:
        """Advance by one tick; a leg with ``None`` holds both its joints still."""
        self._ground.turn(self._heading())
        self._set_motors(commands)
        self._drive(beat)
        for mount in self._mounts:
            mount.sensors.begin_tick()
        self._body_touched = False
        client, robot = self._client, self._robot
        for _ in range(self.params.physics.substeps):
            bullet.stepSimulation(client)
            # -1, -2: with anything.
            self._read_contacts(bullet.getContactPoints(robot, -1, -2, -2, client))
        self._tick += 1
        self._senses = self._sense(first_tick=False)
        self.work += self._worked
        self._read_body()
        if self._fell():
            self._build()
        if self._gui:
            self._turn_camera()

    # -- building ----------------------------------------------------------------------------

    def _build(self) -> None:
        """Load ground and robot anew and put the feet on the ground; the tick stays."""
        client, physics, leg = self._client, self.params.physics, self.params.leg
        bullet.resetSimulation(physicsClientId=client)
        set_up(client, self.params)
        with tempfile.TemporaryDirectory(prefix="ember_ros_") as folder:
            file = Path(folder) / "robot.urdf"
            file.write_text(self._urdf(), encoding="utf-8")
            self._robot = bullet.loadURDF(
                str(file),
                self._place(),
                bullet.getQuaternionFromEuler((0.0, 0.0, self._start_heading)),
                useFixedBase=self.fixed,
                flags=bullet.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=client,
            )
        self._ground = Ground(client)
        self._joints: dict[str, int] = {}
        links = {"": -1}
        for joint in range(bullet.getNumJoints(self._robot, client)):
            info = bullet.getJointInfo(self._robot, joint, client)
            self._joints[info[1].decode()] = joint
            links[info[12].decode()] = joint
            # Bullet gives every joint a motor that brakes it: all off, then ours on.
            bullet.setJointMotorControl2(
                self._robot, joint, bullet.VELOCITY_CONTROL, force=0, physicsClientId=client
            )
        for link in links.values():
            set_contact(client, self._robot, link, physics)
        self._mounts = [
            _Mount(
                self._joints[f"{n}_hip"],
                self._joints[f"{n}_knee"],
                links[f"{n}_foot"],
                LegSensors(self.params),
            )
            for n in self.legs
        ]
        self._by_link = {mount.foot: mount for mount in self._mounts}
        self._motors = [j for mount in self._mounts for j in (mount.hip, mount.knee)]
        self._read_joints = self._motors + [self._joints[name] for name in self.body_joints]
        own = [links[name] for name in self.body_links]
        self._read_links = [mount.foot for mount in self._mounts] + own
        self._trunk = frozenset({-1, *own})  # links that must not touch the ground
        # Stand with each foot under its hip, at the operating height.
        hip = math.acos((leg.operating_height - leg.foot_radius) / (self._reach - leg.foot_radius))
        knee = kinematics.knee_for_height(leg, hip, leg.operating_height)
        for mount in self._mounts:
            bullet.resetJointState(self._robot, mount.hip, hip, physicsClientId=client)
            bullet.resetJointState(self._robot, mount.knee, knee, physicsClientId=client)
        self._prepare()
        self._body_touched = False
        self._steps = 0
        self._senses = self._sense(first_tick=self._tick > 0)
        self._read_body()

    @property
    def fixed(self) -> bool:
        """Whether the robot's root link is fixed to the ground."""
        return False

    @property
    def _reach(self) -> float:
        return self.params.leg.thigh_length + self.params.leg.shank_length

    # -- motors ------------------------------------------------------------------------------

    def _set_motors(self, commands: Sequence[LegCommand | None]) -> None:
        leg, tick_s = self.params.leg, self.params.gait.tick_s
        speeds: list[float] = []
        torques: list[float] = []
        for mount, sense, command in zip(self._mounts, self._senses, commands, strict=True):
            if command is None:
                if mount.held is None:
                    mount.held = (sense.hip, sense.knee)
                # Not simply zero speed: under load a motor that wants rest creeps.
                speeds += (
                    (mount.held[0] - sense.hip) / tick_s,
                    (mount.held[1] - sense.knee) / tick_s,
                )
                torques += (leg.hip_torque, leg.knee_torque)
            else:
                mount.held = None
                speeds += (command.hip_speed, command.knee_speed)
                torques += (
                    min(leg.hip_torque, command.hip_torque),  # a motor has no more than it has
                    min(leg.knee_torque, command.knee_torque),
                )
        bullet.setJointMotorControlArray(
            self._robot,
            self._motors,
            bullet.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=torques,
            physicsClientId=self._client,
        )

    # -- senses ------------------------------------------------------------------------------

    def _read_contacts(self, contacts: Sequence[tuple[Any, ...]]) -> None:
        """Take in the contacts of one physics step."""
        now = self._steps = self._steps + 1
        by_link = self._by_link
        for contact in contacts:
            mount = by_link.get(contact[3])
            if mount is not None:
                x, y, _ = contact[5]
                mount.sensors.touch(now, contact[9], x, y)
            elif contact[3] in self._trunk:
                self._body_touched = True

    def _sense(self, *, first_tick: bool) -> tuple[LegSense, ...]:
        """Read all sensors."""
        client = self._client
        joints = bullet.getJointStates(self._robot, self._read_joints, client)
        feet = bullet.getLinkStates(
            self._robot, self._read_links, computeForwardKinematics=1, physicsClientId=client
        )
        self._body_joints, self._body_links = joints[len(self._motors) :], feet[len(self.legs) :]
        senses = []
        power = 0.0
        for n, mount in enumerate(self._mounts):
            hip, knee, foot = joints[2 * n], joints[2 * n + 1], feet[n]
            power += max(0.0, hip[1] * hip[3]) + max(0.0, knee[1] * knee[3])
            senses.append(
                mount.sensors.sense(
                    self._tick,
                    self._steps,
                    (hip[0], knee[0], hip[1], knee[1]),
                    foot[5],
                    foot[4][2],
                    first_tick=first_tick,
                )
            )
        self._worked = power * self.params.gait.tick_s
        return tuple(senses)
