"""What a world is: five verbs. The trainer, the walker and the fake for tests keep to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ember_ros.signals import Beat, BodyState, LegCommand, LegSense


class World(Protocol):
    """A place where legs are mounted.

    ``legs`` names them in the order of all sequences here. Ticks count from 0 and go on over a
    fall: a world that puts the robot back on its feet marks the next senses with ``restart``.
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
