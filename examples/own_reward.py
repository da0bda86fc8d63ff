"""A reward of your own, named by its dotted path.

The reward of the paper, minus a term for the speed of the knee. Its terms are in summary.json, in
bags and in the transitions of the leg, like those of the default reward. Takes half a minute:

    PYTHONPATH=examples ember train --set parts.reward=own_reward.Mine --out out/mine

With nodes: the same PYTHONPATH, and `-p parts.reward:=own_reward.Mine` for every leg_node and the
table_node.
"""

from __future__ import annotations

from ember_ros.signals import LegSense
from leg_node.reward import PaperReward

CALM = -0.005
"""Weight of the absolute speed of the knee, 1/(rad/s)."""


class Mine(PaperReward):
    """The paper's reward, and a term that penalizes knee speed."""

    names = (*PaperReward.names, "calm")

    def terms(self, sense: LegSense, as_stance: bool) -> dict[str, float]:
        """Return the weighted terms that apply, by name; the reward is their sum."""
        return {**super().terms(sense, as_stance), "calm": CALM * abs(sense.knee_speed)}
