"""The contract of worlds: what breaks a promise is told which, and how it would be right."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from ember_ros.errors import ParameterError
from ember_ros.loop import Loop
from ember_ros.params import TRAINER_LEG, Params
from ember_ros.params_file import load_params
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense
from ember_ros.worlds import legs_of, make_world, spec_of, stage_of
from sim_node.contract import check_world
from sim_node.fake import FakeWorld

PARAMS = Params()
Commands = Sequence[LegCommand | None]


class World(FakeWorld):
    """A world that keeps its promises; those below break one each."""

    def __init__(self, params: Params = PARAMS, *, seed: int = 0, gui: bool = False) -> None:
        """Build it with a fall now and then."""
        super().__init__(None, params, falls_at={70, 130})


class Changed(World):
    """What is sensed is not what there is."""

    def observe(self) -> tuple[LegSense, ...]:
        """Return changed senses."""
        return tuple(self.change(sense) for sense in super().observe())

    def change(self, sense: LegSense) -> LegSense:
        """Return what is sensed instead."""
        return sense


class Legless(World):
    """Nobody is there."""

    def reset(self) -> None:
        """Forget the legs."""
        self.legs = ()
        super().reset()


class Lonely(World):
    """A sense is missing."""

    def observe(self) -> tuple[LegSense, ...]:
        """Return all but one."""
        return super().observe()[1:]


class BeginsLate(Changed):
    """Ticks count from 1."""

    def change(self, sense: LegSense) -> LegSense:
        """Return a later tick."""
        return sense._replace(tick=sense.tick + 1)


class PutDownFirst(Changed):
    """It is marked before anything happened."""

    def change(self, sense: LegSense) -> LegSense:
        """Return a mark at the first tick."""
        return sense._replace(first_tick=sense.first_tick or sense.tick == 0)


class Over(World):
    """It has ended before it began."""

    over = True


class Looked(World):
    """Whoever looks pushes it on."""

    def observe(self) -> tuple[LegSense, ...]:
        """Return other senses each time."""
        senses = super().observe()
        self._senses = tuple(s._replace(hip=s.hip + 0.01) for s in senses)
        return senses


class BeginsAnew(Changed):
    """Ticks begin anew after a fall."""

    def change(self, sense: LegSense) -> LegSense:
        """Return ticks since the fall."""
        return sense._replace(tick=sense.tick % 70)


class Unmarked(Changed):
    """A fall goes unsaid."""

    def change(self, sense: LegSense) -> LegSense:
        """Return no mark."""
        return sense._replace(first_tick=False)


class Forgives(World):
    """Falls are taken back."""

    def body(self) -> BodyState:
        """Return fewer falls in the end."""
        body = super().body()
        return body._replace(falls=body.falls * (self._tick < 100))


class OfNumpy(Changed):
    """Values are numpy's."""

    def change(self, sense: LegSense) -> LegSense:
        """Return a float of numpy's."""
        return sense._replace(hip=np.float64(sense.hip))


class NotFinite(Changed):
    """A value is none."""

    def change(self, sense: LegSense) -> LegSense:
        """Return a speed that is none."""
        return sense._replace(hip_speed=math.nan)


class PeakUnderMean(Changed):
    """The mean is over the peak."""

    def change(self, sense: LegSense) -> LegSense:
        """Return a peak of nothing."""
        return sense._replace(force_peak=0.0)


class SlidesInTheAir(Changed):
    """Slip without contact."""

    def change(self, sense: LegSense) -> LegSense:
        """Return a foot that slides always."""
        return sense._replace(slip=0.01)


class SlidesBack(Changed):
    """Slip has a sign."""

    def change(self, sense: LegSense) -> LegSense:
        """Return slip under 0."""
        return sense._replace(slip=-sense.slip)


class LostBody(World):
    """Nobody knows where the body is."""

    def body(self) -> BodyState:
        """Return no place."""
        return super().body()._replace(x=math.inf)


class ResetHalf(World):
    """A reset leaves the legs where they are."""

    def reset(self) -> None:
        """Reset ticks alone."""
        if not hasattr(self, "_senses"):
            super().reset()
        self._tick = self._falls = 0
        self._senses = tuple(sense._replace(tick=0, first_tick=False) for sense in self._senses)


MADE = itertools.count()


class NeverAlike(Changed):
    """Each one that is made parts from the others in the end."""

    def __init__(self) -> None:
        """Number the worlds."""
        super().__init__()
        self._own = 1e-12 * next(MADE)

    def change(self, sense: LegSense) -> LegSense:
        """Return senses of its own."""
        return sense._replace(inclination=sense.inclination + self._own * (sense.tick > 60))


class Deaf(World):
    """Commands change nothing."""

    def step(self, beat: Beat, commands: Commands) -> None:
        """Step without commands."""
        super().step(beat, [None] * len(commands))


class Restless(World):
    """A leg without a command goes on."""

    def step(self, beat: Beat, commands: Commands) -> None:
        """Swing where nothing is said."""
        swing = LegCommand(beat.tick, math.cos(beat.tick), 0.0, 1.0, 1.0)
        super().step(beat, [command or swing for command in commands])


class ClosedOnce(World):
    """What is let go of cannot be let go of again."""

    closed = False

    def close(self) -> None:
        """Refuse the second time."""
        assert not self.closed, "closed already"
        self.closed = True


BROKEN: dict[type[World], str] = {
    Legless: "legs is empty; a name for each leg would be right",
    Lonely: "3 senses of 4 legs; one per leg would be right",
    BeginsLate: "the first senses are not of tick 0",
    PutDownFirst: "first_tick is set at tick 0",
    Over: "over is set before the first tick",
    Looked: r"observe\(\) twice at tick 0 differs",
    BeginsAnew: r"senses of tick 70 have the ticks \[0\]",
    Unmarked: r"tick 70: falls went from 0 to 1, first_tick is \{False\}",
    Forgives: "the number of falls decreases at tick 100",
    OfNumpy: r"front_left at tick 0: values of types .*float64",
    NotFinite: "front_left at tick 0: not finite",
    PeakUnderMean: "force_peak 0.0; 0 or more, and a mean that is not above the peak, would",
    SlidesInTheAir: "slip 0.01 of a foot that touches nothing",
    SlidesBack: "slip -.*; 0 or more would be right",
    LostBody: "body at tick 0: not finite",
    ResetHalf: r"after reset\(\) the world differs, first at tick 0",
    NeverAlike: "the same commands give other bits, first at tick 61",
    Deaf: "other commands do not change any sense",
    Restless: "still moves after a cycle without a command",
    ClosedOnce: "closed already",
}


def test_a_world_that_keeps_its_promises_passes() -> None:
    """With other parameters too."""
    check_world(World)
    params = load_params("hexapod")
    check_world(lambda: World(params), params)


@pytest.mark.parametrize("kind", BROKEN, ids=lambda kind: kind.__name__)
def test_a_broken_promise_is_told(kind: type[World]) -> None:
    """Which one, where, and what would be right."""
    with pytest.raises(AssertionError, match=BROKEN[kind]):
        check_world(kind)


# -- the list of worlds --------------------------------------------------------------------------


class OneLegged(FakeWorld):
    """A world of one's own, with legs and learning parameters of its own."""

    stage = "train"

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        """Build it."""
        self.seed = seed
        super().__init__(self.legs_of(params), params)

    @staticmethod
    def legs_of(params: Params) -> list[str]:
        """Return the first leg of the robot."""
        return [params.robot.legs[0]]


OWN: Callable[[str], str] = f"{__name__}.{{}}".format


def test_the_worlds_that_come_with_the_package() -> None:
    """The trainer has one leg and trains it, the walker has the robot's and they walk."""
    hexapod = load_params("hexapod")
    assert (stage_of("trainer"), legs_of("trainer", hexapod)) == ("train", (TRAINER_LEG,))
    assert (stage_of("walker"), legs_of("walker", hexapod)) == ("walk", hexapod.robot.legs)


def test_a_world_of_one_s_own_says_what_it_is() -> None:
    """By its class: stage and legs; without, it is like the walker."""
    assert (stage_of(OWN("OneLegged")), legs_of(OWN("OneLegged"), PARAMS)) == (
        "train", ("front_left",),
    )  # fmt: skip
    assert (stage_of(OWN("World")), legs_of(OWN("World"), PARAMS)) == ("walk", PARAMS.robot.legs)
    made: Any = make_world(OWN("OneLegged"), PARAMS, 5)
    assert (type(made).__name__, made.seed) == ("OneLegged", 5)


def test_a_robot_runs_in_a_world_of_one_s_own() -> None:
    """Planned by its dotted path, with its legs and its stage."""
    config = RunConfig(OWN("OneLegged"), 2)
    assert (config.legs, config.stage) == (("front_left",), "train")
    loop = Loop(config)
    for _ in range(64):
        loop.tick()
    assert loop.finish().visits.sum() == 63


@pytest.mark.parametrize(
    ("world", "reason"),
    [
        ("moon", "no world 'moon'; it is trainer or walker, or the dotted path of a class"),
        ("moon.World", "world = 'moon.World': there is no module 'moon' to be imported here"),
        (OWN("Nothing"), "world = .* cannot be used: .*no attribute 'Nothing'"),
    ],
)
def test_a_world_that_is_not_is_told(world: str, reason: str) -> None:
    """Before anything is built, by plans too."""
    with pytest.raises(ParameterError, match=reason):
        spec_of(world)
    with pytest.raises(ParameterError, match=reason):
        RunConfig(world, 1)
