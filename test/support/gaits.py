"""The paper's gait at a fixed period, written a second time: a list of a cycle's ticks."""

from __future__ import annotations

from ember_ros.params import TRAINER_LEG, Params


class PlainGait:
    """Stance, hip ramp and reward of one leg at each tick since the start of the run."""

    def __init__(self, params: Params, leg: str = TRAINER_LEG) -> None:
        """Write the cycle of a leg down, from the start of its stance on."""
        gait, robot = params.gait, params.robot
        offset = 0.0 if leg == TRAINER_LEG else robot.offset[robot.legs.index(leg)]
        self._ticks, self._ahead = gait.ticks, int(offset * gait.ticks)
        stance = round(gait.stance_share * gait.ticks)
        swing, way = gait.ticks - stance, gait.hip_rear - gait.hip_front
        self._stance = [True] * stance + [False] * swing
        self._hip = [gait.hip_front + way * n / stance for n in range(stance)]
        self._hip += [gait.hip_rear - way * n / swing for n in range(swing)]

    def _slot(self, tick: int) -> int:
        return (tick + self._ahead) % self._ticks

    def stance(self, tick: int) -> bool:
        """Return whether a tick belongs to stance."""
        return self._stance[self._slot(tick)]

    def hip_goal(self, tick: int) -> float:
        """Return the hip angle at the end of a tick, rad."""
        return self._hip[self._slot(tick + 1)]

    def rewarded_as_stance(self, tick: int, lead: int) -> bool:
        """Return whether a tick is stance, or one of the last ``lead`` ticks of swing."""
        return any(self.stance(tick + n) for n in range(lead + 1))
