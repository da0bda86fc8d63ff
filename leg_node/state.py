"""The partition of a leg's senses into states (paper, section VI-B). Pure.

To swap it, write a class with ``size`` and ``index`` and give it to the leg module.
"""

from __future__ import annotations

from bisect import bisect_right

from ember_ros.params import Params
from ember_ros.signals import LegSense


class Partition:
    """Hip 17 x force 8 x inclination 8 x stance or swing x hair, as one index.

    Total: any finite sense has exactly one state, since the outer bins are open.
    """

    def __init__(self, params: Params) -> None:
        """Take the edges from ``params.state``; forces are seen in units of ``leg.load``."""
        state = params.state
        self._bins = state.hip_bins
        self._low = state.hip_low
        self._per_rad = state.hip_bins / (state.hip_high - state.hip_low)
        self._force = [edge * params.leg.load for edge in state.force_edges]
        self._inclination = list(state.inclination_edges)
        self.shape = (state.hip_bins, len(self._force) + 1, len(self._inclination) + 1, 2, 2)
        """Bins of hip, force, inclination, swing and hair."""
        self.size = self.shape[0] * self.shape[1] * self.shape[2] * 4
        """Number of states."""

    def index(self, sense: LegSense, stance: bool) -> int:
        """Return the state, 0 to ``size - 1``, row-major in ``shape``."""
        # Clipped before it is made whole: an int of a huge float would be exact but slow.
        place = (sense.hip - self._low) * self._per_rad
        hip = 0 if place < 0.0 else self._bins - 1 if place >= self._bins else int(place)
        _, forces, inclinations, _, _ = self.shape
        n = hip * forces + bisect_right(self._force, sense.force_mean)
        n = n * inclinations + bisect_right(self._inclination, sense.inclination)
        return 4 * n + 2 * (not stance) + sense.hair
