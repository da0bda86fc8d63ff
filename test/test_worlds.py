"""What every world promises (trainer, walker, fake), and what each promises alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from ember_ros import kinematics
from ember_ros.loop import Loop
from ember_ros.params import TRAINER_LEG, Params, replace
from ember_ros.params_file import load_params
from ember_ros.run_config import RunConfig
from ember_ros.signals import BodyState, LegCommand, LegSense
from ember_ros.worlds import World, make_world
from sim_node.contract import check_world
from sim_node.contract import drive as at_random
from sim_node.fake import FakeWorld
from support.configs import changed
from support.legs import LEGS, beat
from support.needs import needs_bullet

PARAMS = Params()
HEXAPOD = load_params("hexapod")
TICKS, LEG = PARAMS.gait.ticks, PARAMS.leg

OVERSHOOT = 0.15
"""How far a knee is driven beyond its limit, rad: one physics step at the largest speed (0.11),
and what the contact solver leaves."""

LANDING = 0.003
"""How far a bar that falls onto its stop passes it for a tick, m: joint limits are soft."""

KINDS = ("trainer", "modulated trainer", "walker", "hexapod walker", "fake")
every_world = pytest.mark.parametrize(
    "kind", [kind if kind == "fake" else pytest.param(kind, marks=needs_bullet) for kind in KINDS]
)

Make = Callable[..., World]
Said = tuple[tuple[LegSense, ...], BodyState]


def params_of(kind: str) -> Params:
    """Return the parameters of a kind of world."""
    if kind == "modulated trainer":
        return replace(PARAMS, {"trainer.modulation": 0.05})
    return HEXAPOD if kind == "hexapod walker" else PARAMS


def build_world(kind: str, params: Params, seed: int = 3) -> World:
    """Build a world; the fake one has a fall now and then."""
    if kind == "fake":
        return FakeWorld(LEGS, params, falls_at={60, 61, 90})
    return make_world(kind.split()[-1], params, seed)


@pytest.fixture
def make() -> Iterator[Make]:
    """Build worlds by their kind, and close them in the end."""
    made: list[World] = []

    def build(kind: str, seed: int = 3, **changes: Any) -> World:
        made.append(build_world(kind, changed(params_of(kind), **changes), seed))
        return made[-1]

    yield build
    for world in made:
        world.close()


def command(tick: int, hip_speed: float = 0.0, knee_speed: float = 0.0) -> LegCommand:
    """Return a command with all the torque there is."""
    return LegCommand(tick, hip_speed, knee_speed, LEG.hip_torque, LEG.knee_torque)


def drive(
    world: World, ticks: range, speeds: Mapping[str, tuple[float, float]]
) -> Iterator[tuple[LegSense, ...]]:
    """Drive some legs at constant (hip, knee) speeds, hold the others; yield senses after ticks."""
    for tick in ticks:
        commands = [command(tick, *speeds[leg]) if leg in speeds else None for leg in world.legs]
        world.step(beat(tick), commands)
        yield world.observe()


# -- the contract --------------------------------------------------------------------------------


@every_world
@pytest.mark.slow
def test_a_world_keeps_its_promises(kind: str) -> None:
    """All that ``check_world`` holds any world to: begun, asked, reset, repeated, closed."""
    params = params_of(kind)
    check_world(lambda: build_world(kind, params), params)


@every_world
def test_a_world_begins_standing(make: Make, kind: str) -> None:
    """At tick 0 each leg stands still at the operating height."""
    world = make(kind)
    assert world.legs == ((TRAINER_LEG,) if "trainer" in kind else params_of(kind).robot.legs)
    for sense in world.observe():
        assert (sense.hip_speed, sense.knee_speed, sense.slip) == (0.0, 0.0, 0.0)
        assert kinematics.height(LEG, sense.knee, sense.inclination) == pytest.approx(
            LEG.operating_height, abs=1e-6
        )
    assert world.body().height == pytest.approx(LEG.operating_height, abs=1e-6)


@every_world
def test_what_the_contract_drives_falls(make: Make, kind: str) -> None:
    """Random commands bring a walker down, so that what is promised over falls is looked at."""
    (*_, (_, body)) = at_random(make(kind), PARAMS, 200)
    assert body.falls >= (0 if "trainer" in kind else 2)


@every_world
def test_two_resets_are_one(make: Make, kind: str) -> None:
    """After a run and two resets in a row everything goes on as from tick 0, to the bit."""
    world = make(kind)
    first = at_random(world, PARAMS, 30)
    world.reset()
    world.reset()
    assert at_random(world, PARAMS, 30) == first


@every_world
@pytest.mark.parametrize("neighbour", ["trainer", "modulated trainer", "walker", "fake"])
def test_two_worlds_do_not_influence_each_other(make: Make, kind: str, neighbour: str) -> None:
    """With another world next to it, built, driven, reset and closed in between: the same bits."""
    if neighbour != "fake" and find_spec("pybullet") is None:
        pytest.skip("pybullet is missing")
    alone = at_random(make(kind), PARAMS, 100)
    world, other = make(kind), make(neighbour, physics__friction=0.5, physics__substeps=3)
    together: list[Said] = [(world.observe(), world.body())]
    rng = np.random.default_rng(1)
    for tick in range(100):
        commands = [
            command(tick, float(rng.uniform(-10.0, 10.0)), float(rng.choice(LEG.knee_speeds)))
            if rng.random() < 0.95
            else None
            for _ in world.legs
        ]
        at_random(other, PARAMS, 1, seed=tick, start=tick)
        if tick == 30:
            other.reset()
        if tick == 60:
            other.close()
            other = make(neighbour)
        world.step(beat(tick), commands)
        together.append((world.observe(), world.body()))
    assert together == alone


@every_world
def test_every_sense_senses(make: Make, kind: str) -> None:
    """Driven at random, no sense of any leg stays the same, but for the restart."""
    said = at_random(make(kind), PARAMS, 300)
    for place in range(len(said[0][0])):
        for name in LegSense._fields:
            seen = {getattr(senses[place], name) for senses, _ in said}
            assert len(seen) > 1 or name == "first_tick", f"{name} is always {seen}"


@every_world
def test_senses_agree_with_each_other(make: Make, kind: str) -> None:
    """More than the contract asks of any world: contact needs force, shanks and knees end."""
    for senses, _ in at_random(make(kind), PARAMS, 300):
        for sense in senses:
            assert (sense.force_mean > 0.0) == (sense.force_peak > 0.0)
            assert abs(sense.inclination) <= math.pi or kind == "fake"
            if sense.contact and not sense.first_tick:
                assert sense.force_mean > 0.0
            assert -OVERSHOOT <= sense.knee <= LEG.knee_max + OVERSHOOT


@every_world
def test_a_leg_goes_where_it_is_told(make: Make, kind: str) -> None:
    """Positive speeds swing the hip forward and bend the knee; the shank turns by both."""
    world = make(kind)
    before = world.observe()
    *_, after = drive(world, range(4), dict.fromkeys(world.legs, (2.0, 8.0)))
    for old, new in zip(before, after, strict=True):
        assert new.hip - old.hip == pytest.approx(4 * 2.0 / 64, rel=0.1)
        assert new.knee - old.knee == pytest.approx(4 * 8.0 / 64, rel=0.1)
        assert new.inclination - old.inclination == pytest.approx(-4 * 6.0 / 64, rel=0.2)
        assert new.hip_speed == pytest.approx(2.0, rel=0.1)
        assert new.knee_speed == pytest.approx(8.0, rel=0.1)


@every_world
def test_a_leg_without_a_command_holds_still(make: Make, kind: str) -> None:
    """From full speed to rest within two ticks; over a cycle, under its load, it creeps little."""
    world = make(kind)
    for _ in drive(world, range(3), dict.fromkeys(world.legs, (5.0, 8.0))):
        pass
    held = list(drive(world, range(3, 3 + TICKS), {}))
    for before, after in zip(held[1], held[-1], strict=True):
        assert abs(before.hip_speed) < 0.3
        assert abs(before.knee_speed) < 0.3
        assert abs(after.hip - before.hip) < 0.1
        assert abs(after.knee - before.knee) < 0.1


@every_world
def test_a_knee_stops_at_its_limits(make: Make, kind: str) -> None:
    """Driven on at full speed, a knee stays at its limit, but for a small overshoot."""
    world = make(kind, walker__fall_height=0.0, walker__fall_angle=3.0)
    for ticks, speed, end in ((range(28), 28.0, LEG.knee_max), (range(28, 56), -28.0, 0.0)):
        knees = [senses[0].knee for senses in drive(world, ticks, {world.legs[0]: (0.0, speed)})]
        assert min(knees) >= -OVERSHOOT
        assert max(knees) <= LEG.knee_max + OVERSHOOT
        assert knees[-1] == pytest.approx(end, abs=OVERSHOOT)


@every_world
def test_the_hair_feels_the_ground_before_the_foot(make: Make, kind: str) -> None:
    """High up neither touches; on the way down the hair is first, and touches as the foot does."""
    world = make(kind)
    first = world.legs[0]
    *_, lifted = drive(world, range(6), {first: (0.0, 28.0)})
    assert not lifted[0].hair
    assert not lifted[0].contact
    down = list(drive(world, range(6, 40), {first: (0.0, -2.8)}))
    hair = next(n for n, senses in enumerate(down) if senses[0].hair)
    foot = next(n for n, senses in enumerate(down) if senses[0].contact)
    assert hair < foot
    assert all(senses[0].hair for senses in down if senses[0].contact)


# -- slip and force ------------------------------------------------------------------------------


def mean_force(world: World) -> float:
    """Return the force on all feet together."""
    return sum(sense.force_mean for sense in world.observe())


def weight(params: Params = PARAMS) -> float:
    """Return the weight of the walker, N."""
    limbs = params.leg.thigh_mass + params.leg.shank_mass + params.leg.foot_mass
    return (params.walker.mass + 4 * limbs) * params.physics.gravity


@needs_bullet
def test_a_foot_that_rests_does_not_slip(make: Make) -> None:
    """Standing without a twist: under 0.02 mm a tick, three hundred times less than matters."""
    world = make("walker", walker__twist_amplitude=0.0)
    settled = list(drive(world, range(64), {}))[32:]
    assert max(sense.slip for senses in settled for sense in senses) < 2e-5


@needs_bullet
@pytest.mark.parametrize("radius", [0.02, 0.1])
def test_a_foot_that_rolls_does_not_slip(make: Make, radius: float) -> None:
    """Legs that carry the body forward roll over their feet: up to 2 mm a tick that is no slip."""
    world = make("walker", walker__twist_amplitude=0.0, leg__foot_radius=radius)
    for _ in drive(world, range(32), {}):
        pass
    *_, before = drive(world, range(32, 40), dict.fromkeys(LEGS, (-1.0, 0.0)))
    for after in drive(world, range(40, 48), dict.fromkeys(LEGS, (-1.0, 0.0))):
        for old, new in zip(before, after, strict=True):
            rolled = radius * abs(new.inclination - old.inclination)
            assert new.slip < 0.1 * rolled
        before = after
    assert world.body().x > 0.05


@needs_bullet
@pytest.mark.parametrize("speed", [3.0, -3.0])
def test_a_foot_that_is_dragged_slips(make: Make, speed: float) -> None:
    """One leg against three that hold: its foot slides by about its own way, theirs rest."""
    world = make("walker", walker__twist_amplitude=0.0)
    for _ in drive(world, range(32), {}):
        pass
    dragged = list(drive(world, range(32, 35), {LEGS[0]: (speed, 0.0)}))
    assert all(senses[0].force_mean > 0.0 for senses in dragged[:2])
    assert dragged[1][0].slip == pytest.approx(0.45 * abs(speed) / 64, rel=0.25)
    assert max(senses[3].slip for senses in dragged) < 1e-4


@needs_bullet
def test_a_foot_that_steps_does_not_slip(make: Make) -> None:
    """Lifted, swung 0.1 m and put down: its way through the air is no slip, nor is its landing."""
    world = make("walker", walker__twist_amplitude=0.0, walker__fall_height=0.0)
    for _ in drive(world, range(16), {}):
        pass
    step = [(0.0, 28.0)] * 3 + [(4.0, 0.0)] * 4 + [(0.0, -8.0)] * 12
    slips, contacts = [], []
    for tick, speeds in enumerate(step, start=16):
        for senses in drive(world, range(tick, tick + 1), {LEGS[0]: speeds}):
            slips.append(senses[0].slip)
            contacts.append(senses[0].force_mean > 0.0)
    landed = contacts.index(True, contacts.index(False))
    assert 3 <= landed < len(step)
    assert slips[landed] < 0.01


def test_the_fake_foot_slips_as_far_as_it_moves_over_the_ground(make: Make) -> None:
    """Slip is the foot's way over the ground: all of it for a leg that is held."""
    world = make("fake")
    before = world.body()
    (senses,) = drive(world, range(1), {})
    assert {sense.slip for sense in senses} == {world.body().x - before.x}


@needs_bullet
def test_standing_feet_bear_the_weight(make: Make) -> None:
    """At rest the forces on the feet sum to the weight, within half a percent."""
    world = make("walker", walker__twist_amplitude=0.0)
    forces = [mean_force(world) for _ in drive(world, range(96), {})][32:]
    assert sum(forces) / len(forces) == pytest.approx(weight(), rel=0.005)


@needs_bullet
def test_walking_feet_bear_the_weight() -> None:
    """Over cycles of walking the mean force is the weight: nothing is missed between ticks."""
    loop = Loop(RunConfig("walker", 12, policy="scripted"))
    forces = []
    for _ in range(12 * TICKS):
        loop.tick()
        forces.append(mean_force(loop.world))
    loop.close()
    walking = forces[2 * TICKS :]
    assert sum(walking) / len(walking) == pytest.approx(weight(), rel=0.03)


# -- the walker ----------------------------------------------------------------------------------


def until_fall(world: World, speeds: Mapping[str, tuple[float, float]]) -> list[Any]:
    """Drive legs until the first fall; return the body before each tick and after the last."""
    bodies = [world.body()]
    for tick in range(300):
        for _ in drive(world, range(tick, tick + 1), speeds):
            bodies.append(world.body())
        if bodies[-1].falls:
            return bodies
    raise AssertionError(f"no fall: {bodies[-1]}")


@needs_bullet
def test_hips_too_low_for_a_cycle_are_a_fall(make: Make) -> None:
    """Legs that fold: 32 ticks under the height are a fall, 31 are not."""
    *before, after = until_fall(make("walker"), dict.fromkeys(LEGS, (0.0, 28.0)))
    low = [body.height < PARAMS.walker.fall_height for body in before]
    assert low[-31:] == [True] * 31
    assert low[-32] is False
    assert after.falls == 1


@needs_bullet
def test_a_dip_is_no_fall(make: Make) -> None:
    """A body that is low for less than a cycle and gets up again has not fallen."""
    world = make("walker")
    heights = []
    for ticks, knee in ((range(5), 28.0), (range(5, 15), 0.0), (range(15, 60), -2.8)):
        for _ in drive(world, ticks, dict.fromkeys(LEGS, (0.0, knee))):
            heights.append(world.body().height)
    assert 5 < sum(height < PARAMS.walker.fall_height for height in heights) < 32
    assert world.body().falls == 0


@needs_bullet
def test_a_tipped_body_is_a_fall(make: Make) -> None:
    """Left legs that fold: the body rolls to the left until it is beyond the angle."""
    world = make("walker", walker__fall_height=0.0, walker__fall_angle=0.2)
    *before, after = until_fall(world, {"front_left": (0.0, 28.0), "rear_left": (0.0, 28.0)})
    assert all(abs(body.roll) <= 0.2 for body in before)
    assert before[-1].roll < -0.15
    assert after.falls == 1


@needs_bullet
def test_a_body_on_the_ground_is_a_fall(make: Make) -> None:
    """Legs that swing up: the body comes down, and its touch is a fall."""
    world = make("walker", walker__fall_height=0.0, walker__fall_angle=3.0)
    *before, after = until_fall(world, dict.fromkeys(LEGS, (10.0, 0.0)))
    assert PARAMS.walker.radius < before[-1].height < 0.3
    assert after.falls == 1


@needs_bullet
def test_after_a_fall_the_walker_stands_where_it_fell(make: Make) -> None:
    """The next senses are marked, count on, and are of a robot on its feet at the same place."""
    world = make("walker")
    fresh = world.observe()
    bodies = until_fall(world, dict.fromkeys(LEGS, (0.0, 28.0)))
    fallen, body = bodies[-2], bodies[-1]
    for old, new in zip(fresh, world.observe(), strict=True):
        assert new.first_tick
        assert new.tick == len(bodies) - 1
        assert new.hip == old.hip
        assert new.knee == old.knee
        assert (new.hip_speed, new.force_mean, new.slip) == (0.0, 0.0, 0.0)
    assert body.height == pytest.approx(LEG.operating_height, abs=1e-6)
    assert (body.roll, body.pitch) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert math.hypot(body.x - fallen.x, body.y - fallen.y) < 0.02
    (after,) = drive(world, range(len(bodies) - 1, len(bodies)), {})
    assert [sense.tick for sense in after] == [len(bodies)] * 4
    assert not any(sense.first_tick for sense in after)
    assert world.body().falls == 1


@needs_bullet
def test_a_walker_that_stands_does_not_fall(make: Make) -> None:
    """Held for two cycles it is upright and about where it was."""
    world = make("walker")
    for _ in drive(world, range(64), {}):
        pass
    body = world.body()
    assert body.falls == 0
    assert abs(body.roll) < 0.05
    assert abs(body.pitch) < 0.05
    assert math.hypot(body.x, body.y) < 0.15


@needs_bullet
def test_the_twist_raises_swinging_legs_in_turn(make: Make) -> None:
    """The body's front and rear halves turn against each other by the amplitude, with the phase."""
    still = make("walker", walker__twist_amplitude=0.0)
    twisting = make("walker", walker__twist_amplitude=0.2)
    differ = 0.0
    for tick in range(TICKS):
        for world in (still, twisting):
            world.step(beat(tick), [None] * 4)
        for one, other in zip(still.observe(), twisting.observe(), strict=True):
            differ = max(differ, abs(one.force_mean - other.force_mean))
    assert differ > 0.5 * LEG.load
    assert still.body() != twisting.body()


# -- the trainer ---------------------------------------------------------------------------------


def heights(world: World, ticks: int, knee_speed: float = 28.0) -> list[float]:
    """Return the attachment's height at each tick of a leg drawn up (or stretched)."""
    speeds = {TRAINER_LEG: (0.0, knee_speed)}
    return [world.body().height for _ in drive(world, range(ticks), speeds)]


@needs_bullet
def test_the_stop_holds_the_attachment(make: Make) -> None:
    """With the leg in the air the bar rests on its stop; a leg lifts it off, never below."""
    stop = PARAMS.trainer.stop_height
    resting = heights(make("trainer"), 200)
    assert min(resting) > stop - LANDING
    assert min(resting[8:]) > stop - 0.001
    assert resting[100:] == pytest.approx([stop] * 100, abs=0.001)
    lifted = heights(make("trainer"), 60, knee_speed=-2.8)
    assert min(lifted) > stop - LANDING
    assert max(lifted) > stop + 0.03


@needs_bullet
@pytest.mark.parametrize("stop_height", [0.40, 0.44])
def test_the_stop_is_where_it_is_put(make: Make, stop_height: float) -> None:
    """Another height of the stop is another height of a bar at rest."""
    resting = heights(make("trainer", trainer__stop_height=stop_height), 150)
    assert resting[-1] == pytest.approx(stop_height, abs=0.001)


def modulated(world: World, ticks: int) -> list[tuple[float, float]]:
    """Return the heights of a modulated stop, and of the attachment that rests on it."""
    speeds = {TRAINER_LEG: (0.0, 28.0)}
    return [
        (world._stop, world.body().height)  # type: ignore[attr-defined]
        for _ in drive(world, range(ticks), speeds)
    ]


@needs_bullet
def test_a_modulated_stop_stays_in_bounds_and_slews(make: Make) -> None:
    """Twenty cycles: never beyond its bounds, never faster than it may, and it does move."""
    trainer = PARAMS.trainer
    stops, resting = zip(*modulated(make("modulated trainer"), 20 * TICKS), strict=True)
    assert min(stops) >= trainer.stop_low
    assert max(stops) <= trainer.stop_high
    steps = [abs(b - a) for a, b in pairwise(stops)]
    assert max(steps) == pytest.approx(trainer.stop_slew)
    assert len({round(stop, 6) for stop in stops}) > 50
    # Where the bar rests; it follows a stop that goes down by its own weight, a little later.
    assert max(abs(a - b) for a, b in zip(resting[TICKS:], stops[TICKS:], strict=True)) < 0.005


@needs_bullet
def test_a_modulated_stop_changes_with_the_cycle_only(make: Make) -> None:
    """One height is drawn a cycle: within it the stop goes one way or rests."""
    stops = [stop for stop, _ in modulated(make("modulated trainer"), 20 * TICKS)]
    for cycle in range(20):
        part = stops[cycle * TICKS : (cycle + 1) * TICKS]
        ways = {math.copysign(1.0, b - a) for a, b in pairwise(part) if a != b}
        assert len(ways) <= 1


@needs_bullet
def test_the_seed_decides_the_stops(make: Make) -> None:
    """The same seed draws the same heights, another one others; a fixed stop has no seed."""
    runs = [heights(make("modulated trainer", seed=seed), 3 * TICKS) for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]
    fixed = [heights(make("trainer", seed=seed), TICKS) for seed in (1, 2)]
    assert fixed[0] == fixed[1]


@needs_bullet
def test_the_trainer_never_falls(make: Make) -> None:
    """It is stable from the outset, whatever the leg does: no falls, no tilt, no restart."""
    for senses, body in at_random(make("trainer"), PARAMS, 300):
        assert (body.falls, body.roll, body.pitch, body.y) == (0, 0.0, 0.0, 0.0)
        assert not senses[0].first_tick


@needs_bullet
def test_the_trainer_goes_forward() -> None:
    """A leg that walks carries its bar around, and x counts the way along the circle."""
    loop = Loop(RunConfig("trainer", 10, policy="scripted"))
    for _ in range(10 * TICKS):
        loop.tick()
    assert loop.world.body().x > 0.5
    loop.close()


# -- the fake ------------------------------------------------------------------------------------


def test_the_fake_takes_any_legs() -> None:
    """Any number, any names: each leg the same as alone."""
    one, three = FakeWorld(("alone",)), FakeWorld(("a", "b", "c"))
    for tick in range(50):
        each = command(tick, 3.0 * math.sin(tick), 8.0 * math.cos(tick))
        one.step(beat(tick), [each])
        three.step(beat(tick), [None, each, command(tick, 1.0)])
        assert three.observe()[1] == one.observe()[0]


def test_the_fake_refuses_a_wrong_number_of_commands() -> None:
    """A test that forgets a leg is told so."""
    with pytest.raises(ValueError, match="shorter"):
        FakeWorld(LEGS).step(beat(0), [None] * 3)


def test_the_fake_stands_on_its_load() -> None:
    """At the operating height a foot bears one load; higher up it bears none."""
    world = FakeWorld((TRAINER_LEG,))
    (senses,) = drive(world, range(1), {})
    assert senses[0].force_mean == pytest.approx(LEG.load)
    *_, senses = drive(world, range(1, 5), {TRAINER_LEG: (0.0, 28.0)})
    assert (senses[0].force_mean, senses[0].contact, senses[0].hair) == (0.0, False, False)


def test_the_fake_falls_when_it_is_told() -> None:
    """At the ticks given, all legs are back on their feet, marked, and counted."""
    world = FakeWorld(LEGS, falls_at={5})
    standing = world.observe()
    marked = [
        senses[0].tick
        for senses in drive(world, range(9), dict.fromkeys(LEGS, (2.0, 3.0)))
        if senses[0].first_tick
    ]
    assert marked == [5]
    assert world.body().falls == 1
    world.reset()
    assert world.observe() == standing
    assert world.body().falls == 0


def test_the_script_walks_in_the_fake() -> None:
    """A written knee is on the ground in stance and off it in swing: the senses respond rightly."""
    loop = Loop(RunConfig("walker", 4, policy="scripted"), FakeWorld(LEGS))
    for _ in range(2 * TICKS):
        loop.tick()
    for _ in range(2 * TICKS):
        for leg, sense in zip(loop.legs, loop.world.observe(), strict=True):
            slot = (loop.now / TICKS + 0.5 * (leg.leg in ("front_right", "rear_left"))) * TICKS % 32
            if 3 <= slot <= 24:
                assert sense.force_mean > 0.0
            if 27 <= slot <= 29:
                assert sense.force_mean == 0.0
        loop.tick()
