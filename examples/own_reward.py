"""A reward of your own, named by its dotted path.

A leg is paid as in the paper, and less the faster its knee moves. Its terms are in
summary.json, bags and the leg's transitions, like all others. Runs for half a minute:

    PYTHONPATH=examples ember train --set parts.reward=own_reward.Mine --out out/mine

As nodes: the same PYTHONPATH, and `-p parts.reward:=own_reward.Mine` for every leg_node and the
table_node.
"""

from __future__ import annotations

from ember_ros.signals import LegSense
from leg_node.reward import PaperReward

CALM = -0.005
"""Weight of the knee's speed, 1/(rad/s)."""


class Mine(PaperReward):
    """The paper's reward, and a term for a calm knee."""

    names = (*PaperReward.names, "calm")

    def terms(self, sense: LegSense, as_stance: bool) -> dict[str, float]:
        """Return the weighted terms that apply, by name; the reward is their sum."""
        return {**super().terms(sense, as_stance), "calm": CALM * abs(sense.knee_speed)}
