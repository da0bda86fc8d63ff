"""Central pattern generators outside of the package, for the parameter ``parts.cpg``."""

from __future__ import annotations

from collections.abc import Sequence

from ember_ros.params import Params
from ember_ros.signals import LegSense


class ContactDrivenCpg:
    """Its frequency increases with the number of feet on the ground."""

    hears_legs = True

    def __init__(self, params: Params) -> None:
        """Start at phase 0."""
        self._min_increment = 0.75 / params.gait.ticks
        self._phase, self._increment = 0.0, 0.0

    def step(self, tick: int, feedback: Sequence[LegSense]) -> float:
        """Return the phase, increased according to the contacts of the previous tick."""
        if tick == 0:
            self._phase = self._increment = 0.0
        self._phase += self._increment
        touching = sum(sense.contact for sense in feedback) / len(feedback)
        self._increment = self._min_increment * (1.0 + 0.5 * touching)
        return self._phase
