"""What a leg makes of the beat: stance or swing, and the ramp that its hip follows. Pure.

To swap it, write a class with ``step`` and name it as ``parts.gait``; ``HipRamp`` shows how.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

from ember_ros.params import Params
from ember_ros.phase import PhaseRate
from ember_ros.signals import Beat, LegSense


class GaitStep(NamedTuple):
    """What a gait says of the tick that begins."""

    stance: bool
    """Whether the tick belongs to stance."""
    ticks_to_stance: float
    """Ticks until the next stance begins; 0 in stance, infinite where the phase stands still."""
    hip_goal: float
    """Hip angle at the end of the tick, rad."""


class Gait(Protocol):
    """Turns the beat and the leg's own senses into stance or swing and a goal of the hip.

    Made with ``(params, offset)``: all parameters, and the leg's phase offset in cycles.
    """

    def step(self, beat: Beat, sense: LegSense) -> GaitStep:
        """Return what holds in the tick that begins; called once a tick."""
        ...


class HipRamp:
    """The paper's gait: slowly back in stance, quickly forward in swing (section II).

    Depends on the phase, and on the phase one beat before: where the phase will be at the end of
    the tick is not broadcast, so the growth in the last tick is taken as the growth in this one.
    So it has a state, and is called once per tick.
    """

    def __init__(self, params: Params, offset: float) -> None:
        """Make the ramp of a leg.

        Args:
            params: ``gait`` of them.
            offset: of the leg's phase, cycles.
        """
        gait = params.gait
        self._ticks, self._offset = gait.ticks, offset
        self._stance_ticks = round(gait.stance_share * gait.ticks)
        self._front, self._rear = gait.hip_front, gait.hip_rear
        self._rate = PhaseRate(1.0 / gait.ticks)

    def step(self, beat: Beat, sense: LegSense) -> GaitStep:
        """Return what holds in the tick that begins."""
        # In ticks of the nominal cycle, so that whole ones are exact; 0 where stance begins.
        place = (beat.phase + self._offset) % 1.0 * self._ticks
        ticks_per_tick = self._rate.per_tick(beat) * self._ticks
        stance = place < self._stance_ticks
        if stance:
            ticks_left = 0.0
        elif ticks_per_tick:
            ticks_left = (self._ticks - place) / ticks_per_tick
        else:
            ticks_left = math.inf
        return GaitStep(stance, ticks_left, self._hip((place + ticks_per_tick) % self._ticks))

    def _hip(self, place: float) -> float:
        """Return the hip angle, rad, at a place in the leg's own cycle, in nominal ticks."""
        front_to_rear, stance_ticks = self._rear - self._front, self._stance_ticks
        if place < stance_ticks:
            return self._front + front_to_rear * place / stance_ticks
        return self._rear - front_to_rear * (place - stance_ticks) / (self._ticks - stance_ticks)
