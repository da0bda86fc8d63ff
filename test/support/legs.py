"""The legs of the default robot, and the beat that they hear."""

from ember_ros.params import Params
from ember_ros.signals import Beat

LEGS = Params().robot.legs


def beat(tick: int, ticks: int = 32) -> Beat:
    """Return the beat of a tick by a fixed period of so many ticks."""
    return Beat(tick, tick / ticks)
