"""Geometry of the two-joint leg in its own plane. Pure.

With a cosine and an arc cosine of its own: those of the C library end in other bits on another CPU
or with another version of it, and what a leg learns from its senses must not. Square roots, unlike
those, are exact everywhere.
"""

from __future__ import annotations

import math

from ember_ros.params import Leg

_SINE = tuple((-1) ** n / math.factorial(2 * n + 1) for n in reversed(range(12)))
"""The series of sin(x) / x in x^2, from the last term on: to 1e-18 for a quarter of a turn."""
_ARC = tuple((-1) ** n / (2 * n + 1) for n in reversed(range(9)))
"""The series of atan(x) / x in x^2, from the last term on: to 1e-19 for what is left of an eighth
of a turn when it is halved three times."""


def cosine(angle: float) -> float:
    """Return the cosine of an angle in rad, to the rounding of the angle."""
    half = math.remainder(angle, math.tau) / 2.0
    square, sine = half * half, 0.0
    for term in _SINE:
        sine = sine * square + term
    sine *= half
    return 1.0 - 2.0 * sine * sine


def arc_cosine(cosine: float) -> float:
    """Return the angle, 0 to pi rad, that has a cosine of -1 to 1."""
    size = abs(cosine)
    tangent = math.sqrt((1.0 - size) / (1.0 + size))  # of half the angle
    for _ in range(3):
        tangent /= 1.0 + math.sqrt(1.0 + tangent * tangent)
    square, arc = tangent * tangent, 0.0
    for term in _ARC:
        arc = arc * square + term
    angle = 16.0 * arc * tangent
    return angle if cosine >= 0.0 else math.pi - angle


def height(leg: Leg, knee: float, inclination: float) -> float:
    """Return the hip's height over the sole, m, from what the leg itself can sense.

    Args:
        leg: the leg's links.
        knee: bend of the knee, rad.
        inclination: of the shank from the vertical, rad; the thigh's is ``inclination + knee``.
    """
    thigh = leg.thigh_length * cosine(inclination + knee)
    shank = (leg.shank_length - leg.foot_radius) * cosine(inclination)
    return thigh + shank + leg.foot_radius


def knee_for_height(leg: Leg, thigh_inclination: float, wanted: float) -> float:
    """Return the bend of the knee, rad, that holds the hip ``wanted`` m over the sole.

    Where no bend reaches, the nearest one: straight shank down for too high, ``knee_max`` for too
    low. Of the two solutions the one whose foot is behind the knee is taken, for a knee that bends
    backward, unless that needs a negative bend.
    """
    shank = leg.shank_length - leg.foot_radius
    rest = wanted - leg.foot_radius - leg.thigh_length * cosine(thigh_inclination)
    tilt = arc_cosine(max(-1.0, min(1.0, rest / shank)))
    bend = thigh_inclination + tilt
    return max(0.0, min(leg.knee_max, bend))
