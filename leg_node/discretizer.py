"""From a leg's senses to a state of its Q-table (paper, section VI-B). Pure.

To swap it, write a class with ``shape``, ``neighbours`` and ``index`` and name it as
``parts.discretizer``: the table has the size that it asks for.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import Protocol

from ember_ros.params import Params
from ember_ros.signals import LegSense


class Discretizer(Protocol):
    """A partition of what a leg senses, made with ``(params)``.

    A class may set ``names``, one for each axis: whoever shows the table uses them.
    """

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the number of bins along each axis; their product is the number of states."""
        ...

    @property
    def neighbours(self) -> tuple[bool, ...]:
        """Return, for each axis, whether bins side by side mean similar things."""
        ...

    def index(self, sense: LegSense, stance: bool) -> int:
        """Return the state, row-major in ``shape``, of any finite sense.

        Args:
            sense: of the leg.
            stance: as its gait says.
        """
        ...


def states_of(discretizer: Discretizer) -> int:
    """Return the number of states of a discretizer."""
    return math.prod(discretizer.shape)


class PaperDiscretizer:
    """Hip 17 x force 8 x inclination 8 x stance or swing x hair, as one index.

    Total: any finite sense has exactly one state, since the outer bins are open.
    """

    names = ("hip", "force", "inclination", "swing", "hair")
    """Of the axes; along swing, 0 is stance and 1 is swing."""
    neighbours = (True, True, True, False, True)
    """Of hip, force, inclination, swing and hair: stance and swing are not alike."""

    def __init__(self, params: Params) -> None:
        """Take the edges from ``params.state``; forces are in units of ``leg.load``."""
        state = params.state
        self._bins = state.hip_bins
        self._low = state.hip_low
        self._per_rad = state.hip_bins / (state.hip_high - state.hip_low)
        self._force = [edge * params.leg.load for edge in state.force_edges]
        self._inclination = list(state.inclination_edges)
        self.shape = (state.hip_bins, len(self._force) + 1, len(self._inclination) + 1, 2, 2)
        """Bins of hip, force, inclination, swing and hair."""

    def index(self, sense: LegSense, stance: bool) -> int:
        """Return the state, 0 to the product of ``shape`` less 1."""
        # Clipped before it is made whole: an int of a huge float would be exact but slow.
        place = (sense.hip - self._low) * self._per_rad
        hip = 0 if place < 0.0 else self._bins - 1 if place >= self._bins else int(place)
        _, forces, inclinations, _, _ = self.shape
        n = hip * forces + bisect_right(self._force, sense.force_mean)
        n = n * inclinations + bisect_right(self._inclination, sense.inclination)
        return 4 * n + 2 * (not stance) + sense.hair
