"""What every world promises, as checks that hold one of your own to it. Pure.

    from sim_node.contract import check_world
    check_world(lambda: MyWorld(Params(), seed=0))

Each check builds worlds with the function it is given, drives them with random commands and raises
an ``AssertionError`` that says what was found and what would be right.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ember_ros.params import Params
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense
from ember_ros.worlds import World

Make = Callable[[], World]
Step = tuple[tuple[LegSense, ...], BodyState]
TICKS = 200
"""For which a world is driven by each check: some six cycles."""
KINDS = (int, *[float] * 8, *[bool] * 3)
"""Of a sense's values."""


def check_world(make: Make, params: Params | None = None) -> None:
    """Hold a world to all that others count on.

    Args:
        make: builds the world, at tick 0, always alike.
        params: that it was built with; the defaults for None.

    Raises:
        AssertionError: the world breaks a promise.
    """
    own = params or Params()
    for check in (
        check_beginning, check_observing, check_ticks, check_values, check_reset, check_repeats,
        check_silence, check_closing,
    ):  # fmt: skip
        check(make, own)


def drive(world: World, params: Params, ticks: int, seed: int = 1, begin: int = 0) -> list[Step]:
    """Drive a world with random commands, one in twenty missing; return what it showed.

    Args:
        world: at tick ``begin``.
        params: of motors and gait.
        ticks: to drive.
        seed: of the commands.
        begin: the present tick.

    Returns:
        Senses and body at each tick, ``ticks + 1`` of them.
    """
    rng, leg, ticks_a_cycle = np.random.default_rng(seed), params.leg, params.gait.ticks
    steps: list[Step] = [(world.observe(), world.body())]
    for tick in range(begin, begin + ticks):
        commands = [
            LegCommand(
                tick,
                float(rng.uniform(-leg.hip_speed_max, leg.hip_speed_max)),
                float(rng.choice(leg.knee_speeds)),
                leg.hip_torque,
                leg.knee_torque,
            )
            if rng.random() < 0.95
            else None
            for _ in world.legs
        ]
        world.step(Beat(tick, tick / ticks_a_cycle), commands)
        steps.append((world.observe(), world.body()))
    return steps


def _hold(right: bool, why: str) -> None:
    if not right:
        raise AssertionError(why)


def check_beginning(make: Make, params: Params) -> None:
    """Hold that a world begins at tick 0, with a sense a leg, put down by nobody, without falls."""
    world = make()
    senses = world.observe()
    _hold(len(world.legs) > 0, "legs is empty; a name for each leg would be right")
    _hold(
        len(senses) == len(world.legs),
        f"{len(senses)} senses of {len(world.legs)} legs; one a leg would be right",
    )
    _hold({sense.tick for sense in senses} == {0}, "the first senses are not of tick 0")
    _hold(
        not any(sense.first_tick for sense in senses),
        "first_tick is set at tick 0, before any fall",
    )
    _hold(world.body().falls == 0, "falls are counted before the first tick")
    _hold(not world.over, "over is set before the first tick")
    world.close()


def check_observing(make: Make, params: Params) -> None:
    """Hold that observing changes nothing: called twice it gives the same."""
    asked, other = make(), make()
    for tick in range(TICKS // 4):
        _hold(asked.observe() == asked.observe(), f"observe() twice at tick {tick} differs")
        _hold(asked.body() == asked.body(), f"body() twice at tick {tick} differs")
        for world in (asked, other):
            world.step(Beat(tick, tick / params.gait.ticks), [None] * len(world.legs))
    _hold(asked.observe() == other.observe(), "a world that is observed twice goes on otherwise")
    asked.close()
    other.close()


def check_ticks(make: Make, params: Params) -> None:
    """Hold that ticks count on over falls, and that a fall marks the next senses ``first_tick``."""
    world = make()
    steps = drive(world, params, TICKS)
    for tick, (senses, _) in enumerate(steps):
        found = sorted({sense.tick for sense in senses})
        _hold(found == [tick], f"senses of tick {tick} say {found}")
    for (_, before), (senses, after) in pairwise(steps):
        tick = senses[0].tick
        _hold(after.falls >= before.falls, f"falls become fewer at tick {tick}")
        marked = {sense.first_tick for sense in senses}
        _hold(
            marked == {after.falls > before.falls},
            f"tick {tick}: falls went from {before.falls} to {after.falls}, first_tick is "
            f"{marked}; it is set on all legs after a fall, and on none otherwise",
        )
    world.close()


def check_values(make: Make, params: Params) -> None:
    """Hold that senses are plain, finite, in range, of one story, and keep what they said."""
    world = make()
    kept = drive(world, params, TICKS)
    before = repr(kept)
    drive(world, params, 20, begin=TICKS)
    _hold(repr(kept) == before, "senses change after they were given; tuples would be right")
    for senses, body in kept:
        for leg, sense in zip(world.legs, senses, strict=True):
            where = f"{leg} at tick {sense.tick}"
            kinds = tuple(type(value) for value in sense)
            _hold(kinds == KINDS, f"{where}: values of types {kinds}; {KINDS} would be right")
            _hold(all(map(math.isfinite, sense)), f"{where}: not finite: {sense}")
            _hold(
                0.0 <= sense.force_mean <= sense.force_peak,
                f"{where}: force_mean {sense.force_mean}, force_peak {sense.force_peak}; 0 or "
                "more, and the mean not over the peak, would be right",
            )
            _hold(sense.slip >= 0.0, f"{where}: slip {sense.slip}; 0 or more would be right")
            _hold(
                sense.slip == 0.0 or sense.force_mean > 0.0,
                f"{where}: slip {sense.slip} of a foot that touches nothing",
            )
        _hold(all(map(math.isfinite, body)), f"body at tick {senses[0].tick}: not finite: {body}")


def check_reset(make: Make, params: Params) -> None:
    """Hold that after ``reset`` everything is as at tick 0, and goes on as it did, to the bit."""
    world = make()
    first = drive(world, params, TICKS // 2)
    world.reset()
    again = drive(world, params, TICKS // 2)
    _hold(again == first, f"after reset() it goes on otherwise, first {_where(first, again)}")
    world.close()


def check_repeats(make: Make, params: Params) -> None:
    """Hold that two worlds given the same commands do the same, to the bit, and others not."""
    one, other, third = make(), make(), make()
    first, second = drive(one, params, TICKS), drive(other, params, TICKS)
    _hold(first == second, f"the same commands end otherwise, first {_where(first, second)}")
    _hold(
        drive(third, params, TICKS, seed=2) != first, "other commands change nothing that is sensed"
    )
    for world in (one, other, third):
        world.close()


def check_silence(make: Make, params: Params) -> None:
    """Hold that a leg without a command comes to rest and stays where it is, as far as can be."""
    world = make()
    for tick in range(params.gait.ticks):
        world.step(Beat(tick, tick / params.gait.ticks), [None] * len(world.legs))
    for leg, sense in zip(world.legs, world.observe(), strict=True):
        _hold(
            abs(sense.hip_speed) < 0.5 and abs(sense.knee_speed) < 0.5,
            f"{leg} still moves after a cycle without a command: hip {sense.hip_speed} rad/s, "
            f"knee {sense.knee_speed} rad/s",
        )
    world.close()


def check_closing(make: Make, params: Params) -> None:
    """Hold that ``close`` may be called twice."""
    world = make()
    world.close()
    world.close()


def _where(first: list[Step], second: list[Step]) -> str:
    for tick, (one, other) in enumerate(zip(first, second, strict=True)):
        if one != other:
            return f"at tick {tick}: {one} and {other}"
    return "in length"
