"""What a leg is rewarded for, from its own senses (paper, section VI-A). Pure.

Each term is a function of its own; ``PaperReward`` weighs them, one set for stance and another for
swing; the reward is their sum. The switch between the two is synchronous with the hip, but may lead
it by ``reward.lead`` ticks: a foot that comes down just before it has to carry does what it should.
To swap a reward, write a class with ``names`` and ``terms`` and name it as ``parts.reward``:
whoever reports a reward reads it from the leg's ``Transition``.
"""

from __future__ import annotations

from typing import Protocol

from ember_ros import kinematics
from ember_ros.params import Params, Reward
from ember_ros.signals import LegSense


def slip_term(reward: Reward, slip: float) -> float:
    """Return 1 for a foot that rests, falling to ``term_low`` as it slides."""
    return max(reward.term_low, 1.0 - slip / reward.slip_scale)


def height_term(reward: Reward, error: float) -> float:
    """Return 1 at the operating height, falling to ``term_low`` away from it."""
    return max(reward.term_low, 1.0 - abs(error) / reward.height_scale)


def force_term(reward: Reward, loads: float) -> float:
    """Return how far the peak force, in loads, is over the limit, bounded."""
    return min(max(0.0, loads - reward.force_limit), reward.force_most)


class RewardFunction(Protocol):
    """What a tick is worth, as named terms; made with ``(params)``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all terms, in the order in which they are added."""
        ...

    def terms(self, sense: LegSense, as_stance: bool) -> dict[str, float]:
        """Return the weighted terms that apply, by name; the reward is their sum.

        Args:
            sense: at the end of the tick that is rewarded.
            as_stance: whether that tick is rewarded as stance: in stance, and ``reward.lead`` ticks
                before it.
        """
        ...


class PaperReward:
    """The paper's reward of one tick.

    Stance, in contact: slip + height - excess force; without contact: lost contact + height.
    Swing: free, or strike - excess force. ``force``: its weight is negative.
    """

    names: tuple[str, ...] = (
        "height", "slip", "lost_contact", "swing_strike", "swing_free", "force",
    )  # fmt: skip
    """Of all terms, in the order in which they are added."""

    def __init__(self, params: Params) -> None:
        """Take the weights from ``params.reward``."""
        self._reward = params.reward
        self._leg = params.leg

    def terms(self, sense: LegSense, as_stance: bool) -> dict[str, float]:
        """Return the weighted terms that apply, by name; the reward is their sum.

        Args:
            sense: at the end of the tick that is rewarded.
            as_stance: whether that tick is rewarded as stance: in stance, and ``reward.lead`` ticks
                before it.
        """
        reward, leg = self._reward, self._leg
        # At any moment of the tick; sense.contact is only its end.
        touched = sense.force_mean > 0.0
        terms: dict[str, float] = {}
        if as_stance:
            error = kinematics.height(leg, sense.knee, sense.inclination) - leg.operating_height
            terms["height"] = reward.height * height_term(reward, error)
            if touched:
                terms["slip"] = reward.slip * slip_term(reward, sense.slip)
            else:
                terms["lost_contact"] = reward.lost_contact
        elif touched:
            terms["swing_strike"] = reward.swing_strike
        else:
            terms["swing_free"] = reward.swing_free
        if touched:
            terms["force"] = reward.force * force_term(reward, sense.force_peak / leg.load)
        return terms
