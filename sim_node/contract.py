"""Checks that a world of your own keeps the contract of all worlds. Pure.

    from sim_node.contract import check_world
    check_world(lambda: MyWorld(Params(), seed=0))

Each check creates worlds with a function, drives them with random commands and raises an
``AssertionError`` that states what is wrong and what would be right.
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
"""Ticks for which each check drives a world: about six cycles."""
KINDS = (int, *[float] * 8, *[bool] * 3)
"""Types of the fields of a ``LegSense``."""


def check_world(make: Make, params: Params | None = None) -> None:
    """Run all checks on a world.

    Args:
        make: creates the world at tick 0, the same at each call.
        params: the parameters of the world; the defaults for None.

    Raises:
        AssertionError: the world breaks the contract.
    """
    own = params or Params()
    for check in (
        check_start, check_observe, check_ticks, check_values, check_reset, check_repeats,
        check_no_command, check_close,
    ):  # fmt: skip
        check(make, own)


def drive(world: World, params: Params, ticks: int, seed: int = 1, start: int = 0) -> list[Step]:
    """Drive a world with random commands, of which one in twenty is missing.

    Args:
        world: at tick ``start``.
        params: of motors and gait.
        ticks: number of ticks to drive.
        seed: of the commands.
        start: the present tick.

    Returns:
        Senses and body at each tick, ``ticks + 1`` of them.
    """
    rng, leg, ticks_a_cycle = np.random.default_rng(seed), params.leg, params.gait.ticks
    steps: list[Step] = [(world.observe(), world.body())]
    for tick in range(start, start + ticks):
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


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)


def check_start(make: Make, params: Params) -> None:
    """Check that a world starts at tick 0 with one sense per leg and without falls."""
    world = make()
    senses = world.observe()
    _require(len(world.legs) > 0, "legs is empty; a name for each leg would be right")
    _require(
        len(senses) == len(world.legs),
        f"{len(senses)} senses of {len(world.legs)} legs; one per leg would be right",
    )
    _require({sense.tick for sense in senses} == {0}, "the first senses are not of tick 0")
    _require(
        not any(sense.first_tick for sense in senses),
        "first_tick is set at tick 0, before any fall",
    )
    _require(world.body().falls == 0, "falls are counted before the first tick")
    _require(not world.over, "over is set before the first tick")
    world.close()


def check_observe(make: Make, params: Params) -> None:
    """Check that ``observe`` and ``body`` change nothing: a second call returns the same."""
    observed, other = make(), make()
    for tick in range(TICKS // 4):
        _require(
            observed.observe() == observed.observe(), f"observe() twice at tick {tick} differs"
        )
        _require(observed.body() == observed.body(), f"body() twice at tick {tick} differs")
        for world in (observed, other):
            world.step(Beat(tick, tick / params.gait.ticks), [None] * len(world.legs))
    _require(observed.observe() == other.observe(), "observing a world changes its later ticks")
    observed.close()
    other.close()


def check_ticks(make: Make, params: Params) -> None:
    """Check that ticks continue after a fall, and that the next senses are ``first_tick``."""
    world = make()
    steps = drive(world, params, TICKS)
    for tick, (senses, _) in enumerate(steps):
        stamps = sorted({sense.tick for sense in senses})
        _require(stamps == [tick], f"senses of tick {tick} have the ticks {stamps}")
    for (_, before), (senses, after) in pairwise(steps):
        tick = senses[0].tick
        _require(after.falls >= before.falls, f"the number of falls decreases at tick {tick}")
        marked = {sense.first_tick for sense in senses}
        _require(
            marked == {after.falls > before.falls},
            f"tick {tick}: falls went from {before.falls} to {after.falls}, first_tick is "
            f"{marked}; true for all legs after a fall, and for none otherwise, would be right",
        )
    world.close()


def check_values(make: Make, params: Params) -> None:
    """Check that senses have plain types, are finite, in range and consistent, and never change."""
    world = make()
    steps = drive(world, params, TICKS)
    before = repr(steps)
    drive(world, params, 20, start=TICKS)
    _require(repr(steps) == before, "senses change after they were returned; tuples would be right")
    for senses, body in steps:
        for leg, sense in zip(world.legs, senses, strict=True):
            where = f"{leg} at tick {sense.tick}"
            kinds = tuple(type(value) for value in sense)
            _require(kinds == KINDS, f"{where}: values of types {kinds}; {KINDS} would be right")
            _require(all(map(math.isfinite, sense)), f"{where}: not finite: {sense}")
            _require(
                0.0 <= sense.force_mean <= sense.force_peak,
                f"{where}: force_mean {sense.force_mean}, force_peak {sense.force_peak}; 0 or "
                "more, and a mean that is not above the peak, would be right",
            )
            _require(sense.slip >= 0.0, f"{where}: slip {sense.slip}; 0 or more would be right")
            _require(
                sense.slip == 0.0 or sense.force_mean > 0.0,
                f"{where}: slip {sense.slip} of a foot that touches nothing",
            )
        _require(
            all(map(math.isfinite, body)), f"body at tick {senses[0].tick}: not finite: {body}"
        )


def check_reset(make: Make, params: Params) -> None:
    """Check that a world repeats the same bits from tick 0 on after ``reset``."""
    world = make()
    first = drive(world, params, TICKS // 2)
    world.reset()
    again = drive(world, params, TICKS // 2)
    _require(again == first, f"after reset() the world differs, first {_where(first, again)}")
    world.close()


def check_repeats(make: Make, params: Params) -> None:
    """Check that two worlds with the same commands give the same bits, and other commands not."""
    one, other, third = make(), make(), make()
    first, second = drive(one, params, TICKS), drive(other, params, TICKS)
    _require(first == second, f"the same commands give other bits, first {_where(first, second)}")
    _require(drive(third, params, TICKS, seed=2) != first, "other commands do not change any sense")
    for world in (one, other, third):
        world.close()


def check_no_command(make: Make, params: Params) -> None:
    """Check that a leg without a command comes to rest."""
    world = make()
    for tick in range(params.gait.ticks):
        world.step(Beat(tick, tick / params.gait.ticks), [None] * len(world.legs))
    for leg, sense in zip(world.legs, world.observe(), strict=True):
        _require(
            abs(sense.hip_speed) < 0.5 and abs(sense.knee_speed) < 0.5,
            f"{leg} still moves after a cycle without a command: hip {sense.hip_speed} rad/s, "
            f"knee {sense.knee_speed} rad/s",
        )
    world.close()


def check_close(make: Make, params: Params) -> None:
    """Check that ``close`` may be called twice."""
    world = make()
    world.close()
    world.close()


def _where(first: list[Step], second: list[Step]) -> str:
    for tick, (one, other) in enumerate(zip(first, second, strict=True)):
        if one != other:
            return f"at tick {tick}: {one} and {other}"
    return "in length"
