"""The robots as URDF, made from the parameters: the trainer's cantilever and the walker.

One description serves the simulator and every viewer that reads URDF. Frames follow REP 103:
x forward, y left, z up; a positive hip angle swings the thigh forward.
"""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import NamedTuple

from ember_ros.params import TRAINER_LEG, Leg, Params

Vector = Sequence[float]
ORIGIN = (0.0, 0.0, 0.0)
GREY = (0.55, 0.57, 0.60, 1.0)
AMBER = (0.93, 0.55, 0.14, 1.0)
DARK = (0.20, 0.21, 0.24, 1.0)
LYING = (0.0, math.pi / 2, 0.0)
"""Turns an upright cylinder so that it lies along x."""
ACROSS = (0.0, 0.0, math.pi / 2)
"""Turns a leg mounted at the end of a bar along x so that it walks along y."""


class Shape(NamedTuple):
    """A primitive in its link's frame."""

    kind: str
    sizes: dict[str, float]
    at: Vector = ORIGIN
    turned: Vector = ORIGIN
    colour: Vector = GREY


def _text(values: Vector) -> str:
    return " ".join(repr(float(v)) for v in values)


def _link(
    robot: ET.Element,
    name: str,
    mass: float,
    inertia: Vector,
    centre: Vector = ORIGIN,
    visual: Sequence[Shape] = (),
    collision: Sequence[Shape] = (),
) -> None:
    """Add a link: ``inertia`` is the diagonal at its centre of mass, kg m^2."""
    link = ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_text(centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(float(mass)))
    diagonal = {f"i{a}{a}": repr(float(i)) for a, i in zip("xyz", inertia, strict=True)}
    ET.SubElement(inertial, "inertia", {**diagonal, "ixy": "0", "ixz": "0", "iyz": "0"})
    for kind, shapes in (("visual", visual), ("collision", collision)):
        for shape in shapes:
            part = ET.SubElement(link, kind)
            ET.SubElement(part, "origin", xyz=_text(shape.at), rpy=_text(shape.turned))
            sizes = {name: repr(float(size)) for name, size in shape.sizes.items()}
            ET.SubElement(ET.SubElement(part, "geometry"), shape.kind, sizes)
            if kind == "visual":
                material = ET.SubElement(part, "material", name=f"{name}_{shape.kind}")
                ET.SubElement(material, "color", rgba=_text(shape.colour))


def _joint(
    robot: ET.Element,
    name: str,
    parent: str,
    child: str,
    at: Vector,
    *,
    turned: Vector = ORIGIN,
    axis: Vector | None = None,
    limits: tuple[float, float] | None = None,
    effort: float = 0.0,
    speed: float = 0.0,
) -> None:
    """Add a joint: fixed without an axis, continuous without limits (rad)."""
    kind = "fixed" if axis is None else "continuous" if limits is None else "revolute"
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_text(at), rpy=_text(turned))
    if axis is not None:
        ET.SubElement(joint, "axis", xyz=_text(axis))
    if limits is not None:
        low, high, force, rate = (repr(float(v)) for v in (*limits, effort, speed))
        ET.SubElement(joint, "limit", lower=low, upper=high, effort=force, velocity=rate)


def _sphere(radius: float, **rest: Vector) -> Shape:
    return Shape("sphere", {"radius": radius}, **rest)


def _cylinder(radius: float, length: float, **rest: Vector) -> Shape:
    return Shape("cylinder", {"radius": radius, "length": length}, **rest)


def _rod(mass: float, length: float, along: str = "z") -> tuple[float, ...]:
    """Inertia of a slender rod about its middle, kg m^2."""
    across = mass * length**2 / 12.0
    return tuple(0.01 * across if axis == along else across for axis in "xyz")


def _add_leg(
    robot: ET.Element, leg: Leg, name: str, parent: str, at: Vector, turned: Vector = ORIGIN
) -> None:
    """Hang a leg at ``at`` of its parent (paper, figure 1)."""
    thigh, shank, foot = f"{name}_thigh", f"{name}_shank", f"{name}_foot"
    reach = leg.shank_length - leg.foot_radius
    middle, down = (0.0, 0.0, -leg.thigh_length / 2), (0.0, 0.0, -reach / 2)
    thickness = 0.7 * leg.foot_radius
    _joint(
        robot,
        f"{name}_hip",
        parent,
        thigh,
        at,
        turned=turned,
        axis=(0, -1, 0),
        limits=(-math.pi, math.pi),
        effort=leg.hip_torque,
        speed=leg.hip_speed_max,
    )
    rod = _cylinder(thickness, leg.thigh_length, at=middle, colour=AMBER)
    _link(robot, thigh, leg.thigh_mass, _rod(leg.thigh_mass, leg.thigh_length), middle, [rod])
    _joint(
        robot,
        f"{name}_knee",
        thigh,
        shank,
        (0, 0, -leg.thigh_length),
        axis=(0, 1, 0),
        limits=(0.0, leg.knee_max),
        effort=leg.knee_torque,
        speed=max(abs(v) for v in leg.knee_speeds),
    )
    knee = _sphere(leg.foot_radius, colour=DARK)
    rod = _cylinder(thickness, reach, at=down, colour=AMBER)
    _link(robot, shank, leg.shank_mass, _rod(leg.shank_mass, reach), down, [rod, knee], [knee])
    _joint(robot, f"{name}_ankle", shank, foot, (0, 0, -reach))
    ball = 0.4 * leg.foot_mass * leg.foot_radius**2
    _link(robot, foot, leg.foot_mass, (ball,) * 3, visual=[knee], collision=[knee])


def _to_xml(robot: ET.Element) -> str:
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode") + "\n"


def twist_of(segment: str) -> str:
    """Return the name of the joint that turns a segment against the one before it."""
    return f"{segment}_twist"


def walker_urdf(params: Params) -> str:
    """Return the walker: a cylinder in segments with twist joints between, and its legs (figure 4).

    The root link is the first segment. All segments have their frames in the middle of the body, at
    the height of the hips.
    """
    walker, described = params.walker, params.robot
    robot = ET.Element("robot", name="ember_walker")
    count = len(described.segments)
    mass, length, radius = walker.mass / count, walker.length / count, walker.radius
    across = mass * (3 * radius**2 + length**2) / 12
    inertia = (mass * radius**2 / 2, across, across)
    for n, name in enumerate(described.segments):
        centre = (((count - 1) / 2 - n) * length, 0.0, 0.0)
        part = _cylinder(radius, length, at=centre, turned=LYING, colour=(*GREY[:3], 0.6))
        _link(robot, name, mass, inertia, centre, [part], [part])
    for before, name in itertools.pairwise(described.segments):
        _joint(robot, twist_of(name), before, name, ORIGIN, axis=(1, 0, 0))
    for name, segment, mount, side in zip(
        described.legs, described.segment, described.mount, described.side, strict=True
    ):
        x = walker.hip_forward + mount * walker.length
        _add_leg(robot, params.leg, name, segment, (x, side * walker.hip_half_width, 0.0))
    return _to_xml(robot)


def trainer_urdf(params: Params) -> str:
    """Return the cantilever trainer with its one leg (paper, section III, figure 3).

    The root link ``stand`` is the foot of the axle, at the height of the hinge.
    """
    trainer = params.trainer
    robot = ET.Element("robot", name="ember_trainer")
    half = trainer.bar_length / 2
    bar = _cylinder(0.02, half, at=(half / 2, 0.0, 0.0), turned=LYING)
    weight = _sphere(trainer.tip_radius, at=(half, 0.0, 0.0), colour=GREY)
    _link(robot, "stand", 1.0, (1.0, 1.0, 1.0))
    _joint(robot, "axle", "stand", "inner", ORIGIN, axis=(0, 0, 1))
    inner = _rod(trainer.inner_mass, half, "x")
    _link(robot, "inner", trainer.inner_mass, inner, (half / 2, 0.0, 0.0), [bar])
    limits = (-trainer.hinge_max, trainer.hinge_max)
    _joint(robot, "hinge", "inner", "outer", (half, 0.0, 0.0), axis=(0, -1, 0), limits=limits)
    ball = (0.4 * trainer.tip_mass * trainer.tip_radius**2,) * 3
    _link(robot, "outer", trainer.tip_mass, ball, (half, 0.0, 0.0), [bar, weight])
    _add_leg(robot, params.leg, TRAINER_LEG, "outer", (half, 0.0, 0.0), ACROSS)
    return _to_xml(robot)
