"""The central pattern generator: the one number all legs share (paper, sections II and IV). Pure.

To swap it, write a class with ``step`` and name it as ``parts.cpg``: legs take the gait from the
phase and the time from its stamp, and know nothing of where it comes from.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ember_ros.errors import ParameterError
from ember_ros.params import Params
from ember_ros.signals import Beat, LegSense


class CentralPatternGenerator(Protocol):
    """An oscillator, made with ``(params)``.

    A class that sets ``hears_legs`` to True is given what the legs sense as feedback; one without
    it is given nothing.
    """

    def step(self, tick: int, feedback: Sequence[LegSense]) -> float:
        """Return the phase at a tick: cycles since the start, 0 or more, never less than before.

        Args:
            tick: the present one, in rising order; some may be left out.
            feedback: what each leg senses at it, in the order of legs; empty without
                ``hears_legs``.
        """
        ...


class FixedPeriod:
    """The paper's oscillator: a fixed period, nothing fed back."""

    def __init__(self, params: Params) -> None:
        """Take the number of ticks a cycle from ``params.gait``."""
        self._ticks = params.gait.ticks

    def step(self, tick: int, feedback: Sequence[LegSense]) -> float:
        """Return the cycles done; exact in binary at every tick."""
        return tick / self._ticks


class Beats:
    """The beats of an oscillator, held to what every listener may count on."""

    def __init__(self, cpg: CentralPatternGenerator) -> None:
        """Begin before the first tick."""
        self._cpg = cpg
        self.last = Beat(-1, 0.0)
        """The beat of the last tick."""
        self.hears_legs = bool(getattr(cpg, "hears_legs", False))
        """Whether the oscillator is given what the legs sense."""

    def at(self, tick: int, feedback: Sequence[LegSense] = ()) -> Beat:
        """Return the beat of a tick; a tick before the last one begins time anew.

        Raises:
            ParameterError: the phase is negative, not finite, or runs backwards.
        """
        phase = float(self._cpg.step(tick, feedback if self.hears_legs else ()))
        least = self.last.phase if tick > self.last.tick else 0.0
        if not least <= phase < 2.0**53:
            raise ParameterError(
                f"parts.cpg: {type(self._cpg).__name__} says phase {phase!r} at tick {tick}; "
                f"{least!r} or more, and finite, would be right: a phase never runs backwards"
            )
        self.last = Beat(tick, phase)
        return self.last
