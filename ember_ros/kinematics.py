"""Geometry of the two-joint leg in its own plane. Pure."""

from __future__ import annotations

import math

from ember_ros.params import Leg


def height(leg: Leg, knee: float, inclination: float) -> float:
    """Return the hip's height over the sole, m, from what the leg itself can sense.

    Args:
        leg: the leg's links.
        knee: bend of the knee, rad.
        inclination: of the shank from the vertical, rad; the thigh's is ``inclination + knee``.
    """
    thigh = leg.thigh_length * math.cos(inclination + knee)
    shank = (leg.shank_length - leg.foot_radius) * math.cos(inclination)
    return thigh + shank + leg.foot_radius


def knee_for_height(leg: Leg, thigh_inclination: float, wanted: float) -> float:
    """Return the bend of the knee, rad, that holds the hip ``wanted`` m over the sole.

    Where no bend reaches, the nearest one: straight shank down for too high, ``knee_max`` for too
    low. Of the two solutions the one whose foot is behind the knee is taken, for a knee that bends
    backward, unless that needs a negative bend.
    """
    shank = leg.shank_length - leg.foot_radius
    rest = wanted - leg.foot_radius - leg.thigh_length * math.cos(thigh_inclination)
    tilt = math.acos(max(-1.0, min(1.0, rest / shank)))
    bend = thigh_inclination + tilt
    return max(0.0, min(leg.knee_max, bend))
