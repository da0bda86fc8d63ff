"""Central pattern generators that are none of the package's, named as ``parts.cpg``."""

from __future__ import annotations

from collections.abc import Sequence

from ember_ros.params import Params
from ember_ros.signals import LegSense


class Hurrying:
    """Hears the legs: the more feet touch the ground, the faster the phase grows."""

    hears_legs = True

    def __init__(self, params: Params) -> None:
        """Begin at phase 0."""
        self._least = 0.75 / params.gait.ticks
        self._phase, self._growth = 0.0, 0.0

    def step(self, tick: int, feedback: Sequence[LegSense]) -> float:
        """Return the phase; it grows by what was felt at the tick before."""
        if tick == 0:
            self._phase = self._growth = 0.0
        self._phase += self._growth
        touching = sum(sense.contact for sense in feedback) / len(feedback)
        self._growth = self._least * (1.0 + 0.5 * touching)
        return self._phase
