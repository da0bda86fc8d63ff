"""A second implementation of the gait of the paper at a fixed period, as a list of ticks."""

from __future__ import annotations

from ember_ros.params import TRAINER_LEG, Params


class ReferenceGait:
    """Stance, hip target and reward switching of one leg at each tick since the start."""

    def __init__(self, params: Params, leg: str = TRAINER_LEG) -> None:
        """Compute the values of one cycle, which begins with stance."""
        gait, robot = params.gait, params.robot
        offset = 0.0 if leg == TRAINER_LEG else robot.offset[robot.legs.index(leg)]
        self._ticks, self._offset_ticks = gait.ticks, int(offset * gait.ticks)
        stance = round(gait.stance_share * gait.ticks)
        swing, sweep = gait.ticks - stance, gait.hip_rear - gait.hip_front
        self._stance = [True] * stance + [False] * swing
        self._hip = [gait.hip_front + sweep * n / stance for n in range(stance)]
        self._hip += [gait.hip_rear - sweep * n / swing for n in range(swing)]

    def _tick_in_cycle(self, tick: int) -> int:
        return (tick + self._offset_ticks) % self._ticks

    def stance(self, tick: int) -> bool:
        """Return whether a tick is in stance."""
        return self._stance[self._tick_in_cycle(tick)]

    def hip_goal(self, tick: int) -> float:
        """Return the target of the hip angle at the end of a tick, rad."""
        return self._hip[self._tick_in_cycle(tick + 1)]

    def rewarded_as_stance(self, tick: int, lead: int) -> bool:
        """Return whether a tick is in stance, or one of the last ``lead`` ticks of swing."""
        return any(self.stance(tick + n) for n in range(lead + 1))
