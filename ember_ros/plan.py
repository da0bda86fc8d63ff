"""What is to be run: one value that the loop, the graph and the processes all start from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ember_ros.errors import ParameterError
from ember_ros.params import Params
from ember_ros.signals import LEGS, TRAINER_LEG

if TYPE_CHECKING:
    from sim_node.world import World

WORLDS = ("trainer", "walker")
MOST = 2**63 - 1
"""The greatest integer that a ROS parameter holds."""


@dataclass(frozen=True)
class Plan:
    """A run, whole: the same plan gives the same bits whichever way it is run."""

    world: str
    """``trainer`` or ``walker``."""
    cycles: int
    """Cycles of the CPG to run."""
    seed: int = 0
    params: Params = field(default_factory=Params)
    policy: str = "learned"
    learning: bool = True
    table: Path | None = None
    """What was learnt before."""
    start_cycle: int = 0
    """Cycles that were learnt before: exploration goes on from there."""

    def __post_init__(self) -> None:
        check_world(self.world)
        if self.cycles < 0:
            raise ParameterError(f"cycles = {self.cycles} must be 0 or more")
        if not 0 <= self.seed <= MOST:
            raise ParameterError(
                f"seed = {self.seed}: 0 to {MOST} would be right, as nodes hold it"
            )
        if not 0 <= self.start_cycle <= MOST:
            raise ParameterError(f"start_cycle = {self.start_cycle}: 0 to {MOST} would be right")

    @property
    def legs(self) -> tuple[str, ...]:
        """Return the names of the legs, in order."""
        return legs_of(self.world)

    @property
    def stage(self) -> str:
        """Return which learning numbers hold."""
        return stage_of(self.world)


def check_world(world: str) -> None:
    """Raise a ParameterError for a world that does not exist."""
    if world not in WORLDS:
        raise ParameterError(f"there is no world {world!r}; it is {' or '.join(WORLDS)}")


def legs_of(world: str) -> tuple[str, ...]:
    """Return the names of a world's legs, in order."""
    return LEGS if world == "walker" else (TRAINER_LEG,)


def stage_of(world: str) -> str:
    """Return which learning numbers hold in a world: ``walk`` or ``train``."""
    return "walk" if world == "walker" else "train"


def make_world(world: str, params: Params, seed: int, *, gui: bool = False) -> World:
    """Build a world; PyBullet is imported only now.

    Raises:
        ParameterError: no such world, or PyBullet is not installed.
    """
    check_world(world)
    try:
        from sim_node.trainer import TrainerWorld
        from sim_node.walker import WalkerWorld
    except ModuleNotFoundError as error:
        if error.name != "pybullet":
            raise
        raise ParameterError(
            "PyBullet is not installed; `pip install pybullet` (a wheel for Python 3.11, "
            "elsewhere it compiles for minutes)"
        ) from error
    if world == "walker":
        return WalkerWorld(params, gui=gui)
    return TrainerWorld(params, seed=seed, gui=gui)
