"""What a world is, and which there are by name; one of your own has a dotted path. Pure.

A world is a class made with ``(params, seed=..., gui=...)`` that does what ``World`` says, to which
``sim_node.contract.check_world`` holds it. It may say which learning parameters hold in it
(``stage``, ``walk`` without) and which legs are mounted there (``legs_of(params)``, those of
``params.robot`` without).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

from ember_ros import parts
from ember_ros.errors import ParameterError, shown
from ember_ros.params import TRAINER_LEG, Params
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense


class World(Protocol):
    """A place where legs are mounted.

    ``legs`` names them in the order of all sequences here. Ticks count from 0 and go on over a
    fall: a world that puts the robot back on its feet marks the next senses with ``first_tick``.
    """

    legs: tuple[str, ...]
    over: bool
    """True when there is no further tick: a recorded world ends, a simulated one never does."""

    work: float
    """Mechanical work of the legs' motors so far, J, for reports only; 0 where nobody knows it."""

    def observe(self) -> tuple[LegSense, ...]:
        """Return what each leg senses at the present tick; calling twice gives the same."""
        ...

    def step(self, beat: Beat, commands: Sequence[LegCommand | None]) -> None:
        """Advance by one tick with these commands; a leg with ``None`` holds its joints still.

        Args:
            beat: of the central pattern generator at the present tick.
            commands: one a leg, in the order of ``legs``.
        """
        ...

    def body(self) -> BodyState:
        """Return the truth about the body, for reports and viewers only."""
        ...

    def reset(self) -> None:
        """Build everything anew, as it was at tick 0."""
        ...

    def close(self) -> None:
        """Let go of what the world holds; safe to call twice."""
        ...


class WorldSpec(NamedTuple):
    """What is known of a world before it is made."""

    path: str
    """Dotted path of its class."""
    stage: str
    """Which learning parameters hold there: ``train`` or ``walk``."""
    legs_of: Callable[[Params], tuple[str, ...]]
    """Returns the names of its legs, in order."""


WORLDS = {
    "trainer": WorldSpec("sim_node.trainer.TrainerWorld", "train", lambda params: (TRAINER_LEG,)),
    "walker": WorldSpec("sim_node.walker.WalkerWorld", "walk", lambda params: params.robot.legs),
}
"""The worlds that come with the package."""


def spec_of(world: str) -> WorldSpec:
    """Return what is known of a world.

    Args:
        world: a name, or the dotted path of a class.

    Raises:
        ParameterError: there is none.
    """
    if world in WORLDS:
        return WORLDS[world]
    if "." not in world:
        raise ParameterError(
            f"there is no world {world!r}; it is {' or '.join(WORLDS)}, or the dotted path of a "
            "class of your own"
        )
    made = parts.find(world, "world")
    legs_of: Callable[[Params], Any] = getattr(made, "legs_of", WORLDS["walker"].legs_of)
    return WorldSpec(world, getattr(made, "stage", "walk"), lambda params: tuple(legs_of(params)))


def legs_of(world: str, params: Params) -> tuple[str, ...]:
    """Return the names of a world's legs, in order."""
    return spec_of(world).legs_of(params)


def stage_of(world: str) -> str:
    """Return which learning parameters hold in a world: ``walk`` or ``train``."""
    return spec_of(world).stage


def make_world(world: str, params: Params, seed: int, *, gui: bool = False) -> World:
    """Build a world; PyBullet is imported only now.

    Raises:
        ParameterError: no such world, or PyBullet is not installed.
    """
    spec = spec_of(world)
    try:
        found = parts.find(spec.path, "world")
    except ParameterError as error:
        why = error.__cause__
        if isinstance(why, ModuleNotFoundError) and why.name == "pybullet":
            raise ParameterError(
                "PyBullet is not installed; `pip install pybullet` (a wheel for Python 3.11, "
                "elsewhere it compiles for minutes)"
            ) from why
        raise
    made: World = parts.build(found, "world", f"world = {shown(world)}", params, seed=seed, gui=gui)
    return made
