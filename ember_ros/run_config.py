"""What is to be run: one value that the loop, the graph and the processes all start from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ember_ros.errors import ParameterError
from ember_ros.params import Params
from ember_ros.worlds import legs_of, spec_of, stage_of

MAX_INTEGER = 2**63 - 1
"""The greatest integer that a ROS parameter holds."""


@dataclass(frozen=True)
class RunConfig:
    """What is run: the same configuration gives the same bits on any backend."""

    world: str
    """``trainer``, ``walker``, or the dotted path of a world."""
    cycles: int
    """Cycles of the CPG to run."""
    seed: int = 0
    params: Params = field(default_factory=Params)
    policy: str = "learned"
    """``learned``, ``scripted``, ``random``, or the dotted path of one."""
    learning: bool = True
    table: Path | None = None
    """What was learnt before."""
    start_cycle: int = 0
    """Cycles that were learnt before: exploration goes on from there."""

    def __post_init__(self) -> None:
        spec_of(self.world)
        if self.cycles < 0:
            raise ParameterError(f"cycles = {self.cycles} must be 0 or more")
        if not 0 <= self.seed <= MAX_INTEGER:
            raise ParameterError(
                f"seed = {self.seed}: 0 to {MAX_INTEGER} would be right, as nodes hold it"
            )
        if not 0 <= self.start_cycle <= MAX_INTEGER:
            raise ParameterError(
                f"start_cycle = {self.start_cycle}: 0 to {MAX_INTEGER} would be right"
            )

    @property
    def legs(self) -> tuple[str, ...]:
        """Return the names of the legs, in order."""
        return legs_of(self.world, self.params)

    @property
    def stage(self) -> str:
        """Return which learning parameters hold."""
        return stage_of(self.world)
