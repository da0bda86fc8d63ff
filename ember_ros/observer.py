"""Who looks on while a robot runs: records, bags, viewers. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ember_ros.signals import BodyState, LegCommand, LegSense, Phase, Transition


class Observer(Protocol):
    """Somebody who hears every tick and is heard by no one."""

    def tick(
        self,
        phase: Phase,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Take one complete tick.

        Args:
            phase: of the central pattern generator.
            senses: of each leg at the start of the tick.
            commands: of each leg for the tick; None of a leg that did not answer.
            body: at the start of the tick.
            transitions: what each leg was paid for the tick before; None of a leg that did not say.
        """
        ...
