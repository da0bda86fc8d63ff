"""The central pattern generator: the one number all legs share (paper, sections II and IV). Pure.

To swap it, write a class with the same ``phase`` and give it to the loop or to the node: a leg
sees a phase that grows by ``1 / ticks`` a tick and knows nothing of where it comes from.
"""

from __future__ import annotations

from ember_ros.params import Gait
from ember_ros.signals import Phase


class FixedPeriod:
    """The paper's oscillator: a fixed period, nothing fed back."""

    def __init__(self, gait: Gait) -> None:
        """Take the period and the number of ticks from ``gait``."""
        self._ticks = gait.ticks
        self._tick_ns = gait.tick_ns

    def phase(self, clock_ns: int) -> Phase:
        """Return the cycles done at a time of the clock; exact in binary at every tick.

        Args:
            clock_ns: simulated time since the start, ns.
        """
        return (clock_ns // self._tick_ns) / self._ticks
