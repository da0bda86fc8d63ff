"""The robots as URDF: one tree each, with the masses, lengths and limits of the parameters."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import pytest

from ember_ros.params import TRAINER_LEG, replace
from ember_ros.params_file import load_params
from sim_node.bodies import trainer_urdf, walker_urdf
from support.legs import LEGS

PARAMS = load_params()
HEXAPOD = load_params("hexapod")
ROBOTS = {
    "walker": (walker_urdf, LEGS, PARAMS),
    "hexapod": (walker_urdf, HEXAPOD.robot.legs, HEXAPOD),
    "trainer": (trainer_urdf, (TRAINER_LEG,), PARAMS),
}
robots = pytest.mark.parametrize("name", ROBOTS)


def parse(name: str) -> ET.Element:
    """Return a robot."""
    make, _, params = ROBOTS[name]
    return ET.fromstring(make(params))


def joint(robot: ET.Element, name: str) -> ET.Element:
    """Return the one joint of a name."""
    (found,) = robot.findall(f"joint[@name='{name}']")
    return found


def numbers(element: ET.Element, tag: str, key: str) -> list[float]:
    """Return the numbers in an attribute of the one child with a tag."""
    (child,) = element.findall(tag)
    return [float(x) for x in child.attrib[key].split()]


def place(robot: ET.Element, link: str) -> tuple[float, float, float]:
    """Return where a link is when all joints are at 0 and nothing is turned."""
    x = y = z = 0.0
    while (above := robot.find(f"joint/child[@link='{link}']/..")) is not None:
        dx, dy, dz = numbers(above, "origin", "xyz")
        x, y, z = x + dx, y + dy, z + dz
        (parent,) = above.findall("parent")
        link = parent.attrib["link"]
    return x, y, z


def mass(robot: ET.Element, link: str) -> float:
    """Return the mass of a link."""
    (found,) = robot.findall(f"link[@name='{link}']/inertial/mass")
    return float(found.attrib["value"])


@robots
def test_it_is_one_tree(name: str) -> None:
    """Every link but one hangs from another by one joint, and none is named that is not there."""
    robot = parse(name)
    links = [link.attrib["name"] for link in robot.findall("link")]
    children = [child.attrib["link"] for child in robot.findall("joint/child")]
    parents = [parent.attrib["link"] for parent in robot.findall("joint/parent")]
    assert len(set(links)) == len(links)
    assert len(set(children)) == len(children) == len(links) - 1
    (root,) = set(links) - set(children)
    assert root == ("stand" if name == "trainer" else "front")
    assert set(parents) <= set(links)
    names = [each.attrib["name"] for each in robot.findall("joint")]
    assert len(set(names)) == len(names)


@robots
def test_the_same_parameters_give_the_same_text(name: str) -> None:
    """Nothing of the moment is in it, and another number gives another text."""
    assert ET.tostring(parse(name)) == ET.tostring(parse(name))
    make, _, params = ROBOTS[name]
    assert make(replace(params, {"leg.thigh_length": 0.26})) != make(params)


@robots
def test_every_link_can_move(name: str) -> None:
    """Masses and inertias are positive, and each inertia is one that a body can have."""
    for link in parse(name).findall("link"):
        (inertia,) = link.findall("inertial/inertia")
        x, y, z = (float(inertia.attrib[key]) for key in ("ixx", "iyy", "izz"))
        assert min(x, y, z) > 0.0
        assert max(x, y, z) <= x + y + z - max(x, y, z) + 1e-12
        assert mass(parse(name), link.attrib["name"]) > 0.0


@robots
def test_legs_are_as_the_parameters_say(name: str) -> None:
    """Lengths, masses, limits, torques and directions of each leg's joints."""
    robot, leg = parse(name), PARAMS.leg
    for each in ROBOTS[name][1]:
        hip, knee = joint(robot, f"{each}_hip"), joint(robot, f"{each}_knee")
        assert hip.attrib["type"] == knee.attrib["type"] == "revolute"
        # Turning about -y swings the thigh forward; the knee bends the shank backward.
        assert numbers(hip, "axis", "xyz") == [0.0, -1.0, 0.0]
        assert numbers(knee, "axis", "xyz") == [0.0, 1.0, 0.0]
        assert numbers(knee, "limit", "lower") == [0.0]
        assert numbers(knee, "limit", "upper") == [leg.knee_max]
        assert numbers(hip, "limit", "effort") == [leg.hip_torque]
        assert numbers(knee, "limit", "effort") == [leg.knee_torque]
        assert numbers(knee, "limit", "velocity") == [28.0]
        assert [mass(robot, f"{each}_{part}") for part in ("thigh", "shank", "foot")] == [
            leg.thigh_mass,
            leg.shank_mass,
            leg.foot_mass,
        ]
        top, foot = place(robot, f"{each}_thigh"), place(robot, f"{each}_foot")
        assert foot[:2] == pytest.approx(top[:2])
        assert top[2] - foot[2] == pytest.approx(
            leg.thigh_length + leg.shank_length - leg.foot_radius
        )


@robots
def test_feet_and_knees_can_be_felt(name: str) -> None:
    """Foot and knee are balls of the foot's radius; a thigh passes through the ground unfelt."""
    robot = parse(name)
    for each in ROBOTS[name][1]:
        for part in ("shank", "foot"):
            (ball,) = robot.findall(f"link[@name='{each}_{part}']/collision/geometry/sphere")
            assert float(ball.attrib["radius"]) == PARAMS.leg.foot_radius
        assert not robot.findall(f"link[@name='{each}_thigh']/collision")


def test_the_walker_weighs_what_it_should() -> None:
    """Body and four legs; a leg's share is what the trainer's tip puts on its one leg."""
    robot, leg = parse("walker"), PARAMS.leg
    total = sum(float(each.attrib["value"]) for each in robot.findall("link/inertial/mass"))
    limbs = leg.thigh_mass + leg.shank_mass + leg.foot_mass
    assert total == pytest.approx(PARAMS.walker.mass + 4 * limbs)
    assert mass(robot, "front") == mass(robot, "rear") == PARAMS.walker.mass / 2
    assert PARAMS.leg.load == pytest.approx(PARAMS.trainer.tip_mass * PARAMS.physics.gravity)
    assert PARAMS.walker.mass == 2.0 * PARAMS.trainer.tip_mass


def test_the_walker_s_legs_are_at_its_ends() -> None:
    """Front legs ahead of rear ones, left at positive y (REP 103), each pair on its own half."""
    robot, walker = parse("walker"), PARAMS.walker
    for each in LEGS:
        end, hand = each.split("_")
        x, y, z = place(robot, f"{each}_thigh")
        side = walker.length / 2 if end == "front" else -walker.length / 2
        assert x == pytest.approx(side + walker.hip_forward)
        assert y == (walker.hip_half_width if hand == "left" else -walker.hip_half_width)
        assert z == 0.0
        (parent,) = joint(robot, f"{each}_hip").findall("parent")
        assert parent.attrib["link"] == end


def test_the_walker_twists_about_its_length() -> None:
    """One joint between the halves, along x, without an end."""
    twist = joint(parse("walker"), "rear_twist")
    assert twist.attrib["type"] == "continuous"
    assert numbers(twist, "axis", "xyz") == [1.0, 0.0, 0.0]


def test_the_hexapod_s_segments_hang_one_on_the_other() -> None:
    """Three of equal mass in line, a twist joint between each two, legs where they are described.

    The body ends at the front and the rear legs, and its segments fill it without a gap.
    """
    robot, described, walker = parse("hexapod"), HEXAPOD.robot, HEXAPOD.walker
    for name, before in (("middle_twist", "front"), ("rear_twist", "middle")):
        twist = joint(robot, name)
        assert twist.attrib["type"] == "continuous"
        assert numbers(twist, "axis", "xyz") == [1.0, 0.0, 0.0]
        (parent,) = twist.findall("parent")
        assert parent.attrib["link"] == before
    middles = []
    for segment in described.segments:
        assert mass(robot, segment) == pytest.approx(walker.mass / 3)
        (link,) = robot.findall(f"link[@name='{segment}']")
        (inertial,) = link.findall("inertial")
        middles.append(numbers(inertial, "origin", "xyz")[0])
        (body,) = link.findall("collision/geometry/cylinder")
        assert float(body.attrib["length"]) == pytest.approx(walker.length / 3)
    assert middles == pytest.approx([walker.length / 3, 0.0, -walker.length / 3])
    for each in described.legs:
        end, hand = each.split("_")
        x, y, _ = place(robot, f"{each}_thigh")
        ahead = {"front": 0.5, "middle": 0.0, "rear": -0.5}[end] * walker.length
        assert x == pytest.approx(ahead + walker.hip_forward)
        assert y == (walker.hip_half_width if hand == "left" else -walker.hip_half_width)
        (parent,) = joint(robot, f"{each}_hip").findall("parent")
        assert parent.attrib["link"] == end


def test_a_body_of_one_segment_has_no_twist() -> None:
    """All legs on one stiff body."""
    params = replace(PARAMS, {"robot.segments": ["front"], "robot.segment": ["front"] * 4})
    robot = ET.fromstring(walker_urdf(params))
    assert mass(robot, "front") == params.walker.mass
    assert not [each for each in robot.findall("joint") if "twist" in each.attrib["name"]]
    assert len(robot.findall("joint")) == 4 * 3


def test_the_trainer_s_cantilever() -> None:
    """Axle upright, hinge level in the middle of the bar, the leg at the tip, walking around."""
    robot, trainer = parse("trainer"), PARAMS.trainer
    assert numbers(joint(robot, "axle"), "axis", "xyz") == [0.0, 0.0, 1.0]
    assert place(robot, "outer") == (trainer.bar_length / 2, 0.0, 0.0)
    assert place(robot, "leg_thigh") == (trainer.bar_length, 0.0, 0.0)
    hip = joint(robot, "leg_hip")
    assert numbers(hip, "origin", "rpy") == [0.0, 0.0, pytest.approx(math.pi / 2)]
    assert mass(robot, "outer") == trainer.tip_mass
    # A positive angle of the hinge lifts the tip.
    assert numbers(joint(robot, "hinge"), "axis", "xyz") == [0.0, -1.0, 0.0]
