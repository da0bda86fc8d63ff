"""Who looks on while a robot runs: records, bags, viewers. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition


class Observer(Protocol):
    """Somebody who hears every tick and is heard by no one."""

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Take one complete tick.

        Args:
            beat: of the central pattern generator.
            senses: of each leg at the start of the tick.
            commands: of each leg for the tick; None of a leg that did not answer.
            body: at the start of the tick.
            transitions: of each leg for the tick before; None of a leg that published none.
        """
        ...
