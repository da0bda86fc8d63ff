"""The two forms of observation of an agent: all senses of its leg, or its discrete state. Pure.

Both are local: they contain nothing about other legs, the body or the world.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ember_ros.errors import ParameterError, shown
from ember_ros.params import Params
from leg_node.assembly import make_discretizer
from leg_node.discretizer import states_of
from leg_node.task import Perception

KNEE_MARGIN = 0.5
"""Bound of the knee angle beyond its stops, rad: joint limits in Bullet are soft."""
MAX_SPEED = 200.0
"""Bound of joint speeds, rad/s: the largest value that ``leg.knee_speeds`` allows."""
MAX_LOADS = 100.0
"""Bound of the force of a foot, in units of ``leg.load``."""
MAX_SLIP = 1.0
"""Bound of the slip per tick, m."""


class Sensor(NamedTuple):
    """One element of an observation."""

    name: str
    """Field of ``signals.LegSense`` or ``leg_node.gait.GaitStep``; they define the frames."""
    unit: str
    low: float
    high: float


def sensors_of(params: Params) -> tuple[Sensor, ...]:
    """Return the elements of a ``senses`` observation in order, with units and bounds."""
    load = MAX_LOADS * params.leg.load
    return (
        Sensor("hip", "rad", -math.pi, math.pi),
        Sensor("knee", "rad", -KNEE_MARGIN, params.leg.knee_max + KNEE_MARGIN),
        Sensor("hip_speed", "rad/s", -MAX_SPEED, MAX_SPEED),
        Sensor("knee_speed", "rad/s", -MAX_SPEED, MAX_SPEED),
        Sensor("force_mean", "N", 0.0, load),
        Sensor("force_peak", "N", 0.0, load),
        Sensor("inclination", "rad", -math.pi, math.pi),
        Sensor("slip", "m", 0.0, MAX_SLIP),
        Sensor("hair", "0 or 1", 0.0, 1.0),
        Sensor("contact", "0 or 1", 0.0, 1.0),
        Sensor("stance", "0 or 1", 0.0, 1.0),
        Sensor("ticks_to_stance", "tick", 0.0, float(params.gait.ticks)),
    )


class Observation(Protocol):
    """A form of observation and its Gymnasium space."""

    space: spaces.Space[Any]

    def of(self, perception: Perception) -> Any:
        """Return the observation for a perception, as a new object."""
        ...


class Senses:
    """The elements of ``sensors_of``, float64, not normalized; values are clipped to the bounds."""

    def __init__(self, params: Params) -> None:
        """Make the space, with bounds from ``params``."""
        sensors = sensors_of(params)
        self._low = np.array([sensor.low for sensor in sensors])
        self._high = np.array([sensor.high for sensor in sensors])
        self.space = spaces.Box(self._low, self._high, dtype=np.float64)

    def of(self, perception: Perception) -> NDArray[np.float64]:
        """Return the elements, float64 of shape ``(12,)``."""
        sense, gait = perception.sense, perception.gait
        values = (
            sense.hip, sense.knee, sense.hip_speed, sense.knee_speed,
            sense.force_mean, sense.force_peak, sense.inclination, sense.slip,
            sense.hair, sense.contact, gait.stance, gait.ticks_to_stance,
        )  # fmt: skip
        return np.clip(np.array(values, dtype=np.float64), self._low, self._high)


class State:
    """The leg's state by ``parts.discretizer``: one integer, the row of a Q-table."""

    def __init__(self, params: Params) -> None:
        """Make the space, with as many states as the discretizer of ``params`` has."""
        self.space = spaces.Discrete(states_of(make_discretizer(params)))

    def of(self, perception: Perception) -> int:
        """Return the index of the state."""
        return int(perception.state)


OBSERVATIONS: dict[str, Callable[[Params], Observation]] = {"senses": Senses, "state": State}
"""Forms of observation by name."""


def make_observation(form: str, params: Params) -> Observation:
    """Return a new form of observation, with a new space.

    Raises:
        ParameterError: there is no form with that name.
    """
    if form not in OBSERVATIONS:
        raise ParameterError(
            f"observation = {shown(form)}; {' or '.join(map(repr, OBSERVATIONS))} would be right"
        )
    return OBSERVATIONS[form](params)
