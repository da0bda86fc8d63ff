"""The legs of the default robot, and the beat of the central pattern generator."""

from ember_ros.params import Params
from ember_ros.signals import Beat

LEGS = Params().robot.legs


def beat(tick: int, ticks: int = 32) -> Beat:
    """Return the beat of a tick for a fixed period, in ticks."""
    return Beat(tick, tick / ticks)
