"""What a leg makes of the phase: stance or swing, and the ramp its hip follows. Pure."""

from __future__ import annotations

from ember_ros.params import Gait
from ember_ros.signals import Phase


class LegGait:
    """The hip ramp of one leg: slowly back in stance, quickly forward in swing (section II).

    Precomputed for each tick of the cycle, since the phase only ever takes these values.
    """

    def __init__(self, gait: Gait, leg: str) -> None:
        """Make the ramp of a leg.

        Args:
            gait: ramp and offsets.
            leg: its name; the offset is ``gait.offset_<leg>``.
        """
        self._ticks = gait.ticks
        self._offset = getattr(gait, f"offset_{leg}")
        stance_ticks = round(gait.stance_share * gait.ticks)
        self._stance = [n < stance_ticks for n in range(gait.ticks)]
        swing = gait.hip_rear - gait.hip_front
        self._ramp = [
            gait.hip_front + swing * n / stance_ticks
            if n < stance_ticks
            else gait.hip_rear - swing * (n - stance_ticks) / (gait.ticks - stance_ticks)
            for n in range(gait.ticks)
        ]

    def slot(self, phase: Phase, ahead: int = 0) -> int:
        """Return the tick of the leg's own cycle, 0 at the start of stance, ``ahead`` ticks on."""
        return (int((phase + self._offset) * self._ticks) + ahead) % self._ticks

    def stance(self, phase: Phase) -> bool:
        """Return whether the tick that begins at ``phase`` belongs to stance."""
        return self._stance[self.slot(phase)]

    def rewarded_as_stance(self, phase: Phase, lead: int) -> bool:
        """Return whether the tick that begins at ``phase`` is rewarded as stance.

        That is stance itself and, before it, the last ``lead`` ticks of swing: a foot that comes
        down just before it has to carry does what it should.
        """
        return self.stance(phase) or self._stance[self.slot(phase, lead)]

    def hip_goal(self, phase: Phase) -> float:
        """Return the hip angle, rad, that the ramp has at the end of the tick."""
        return self._ramp[self.slot(phase, ahead=1)]
