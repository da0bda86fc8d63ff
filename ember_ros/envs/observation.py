"""What an agent is given of what its leg knows: all senses as numbers, or the leg's state. Pure.

Both are local: nothing of another leg, of the body or of the world is in them.
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

KNEE_PLAY = 0.5
"""Beyond its stops to which a knee is sensed, rad: Bullet's are soft."""
MAX_SPEED = 200.0
"""Of a joint, rad/s: the most that ``leg.knee_speeds`` can ask for."""
MAX_LOADS = 100.0
"""Force of a foot, in ``leg.load``."""
MAX_SLIP = 1.0
"""In a tick, m."""


class Sensor(NamedTuple):
    """One number of an observation."""

    name: str
    """As in ``signals.LegSense`` and ``leg_node.gait.GaitStep``, where its frame stands as well."""
    unit: str
    low: float
    high: float


def sensors_of(params: Params) -> tuple[Sensor, ...]:
    """Return the numbers of a senses observation in their order, with units and bounds."""
    load = MAX_LOADS * params.leg.load
    return (
        Sensor("hip", "rad", -math.pi, math.pi),
        Sensor("knee", "rad", -KNEE_PLAY, params.leg.knee_max + KNEE_PLAY),
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
    """A form of observation, with a Gymnasium space of its own."""

    space: spaces.Space[Any]

    def of(self, seen: Perception) -> Any:
        """Return a new observation of what a leg knows."""
        ...


class Senses:
    """The numbers of ``sensors_of``, float64, as they are; a sensor saturates at its bounds."""

    def __init__(self, params: Params) -> None:
        """Take the bounds from ``params``."""
        sensors = sensors_of(params)
        self._low = np.array([sensor.low for sensor in sensors])
        self._high = np.array([sensor.high for sensor in sensors])
        self.space = spaces.Box(self._low, self._high, dtype=np.float64)

    def of(self, seen: Perception) -> NDArray[np.float64]:
        """Return the numbers, ``(12,)``."""
        sense, gait = seen.sense, seen.gait
        values = (
            sense.hip, sense.knee, sense.hip_speed, sense.knee_speed,
            sense.force_mean, sense.force_peak, sense.inclination, sense.slip,
            sense.hair, sense.contact, gait.stance, gait.ticks_to_stance,
        )  # fmt: skip
        return np.clip(np.array(values, dtype=np.float64), self._low, self._high)


class State:
    """The leg's state as ``parts.discretizer`` says: one whole number, the row of a Q-table."""

    def __init__(self, params: Params) -> None:
        """Take the number of states from the discretizer of ``params``."""
        self.space = spaces.Discrete(states_of(make_discretizer(params)))

    def of(self, seen: Perception) -> int:
        """Return the state."""
        return int(seen.state)


OBSERVATIONS: dict[str, Callable[[Params], Observation]] = {"senses": Senses, "state": State}
"""The forms that there are."""


def make_observation(form: str, params: Params) -> Observation:
    """Return a form of observation with a space of its own.

    Raises:
        ParameterError: there is none of that name.
    """
    if form not in OBSERVATIONS:
        raise ParameterError(
            f"observation = {shown(form)}; {' or '.join(map(repr, OBSERVATIONS))} would be right"
        )
    return OBSERVATIONS[form](params)
