"""What four legs learn, written a second time: plainly, and into one table."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

from ember_ros.params import Params
from ember_ros.signals import Beat, LegCommand, LegSense
from leg_node.assembly import empty_table
from leg_node.discretizer import PaperDiscretizer
from leg_node.reward import PaperReward
from leg_node.table import Table

BagStatistics = tuple[Beat, Sequence[LegSense | None], Sequence[LegCommand | None]]
"""A tick: its beat, and the senses and commands of all legs, of which none may be missing."""


def paid(rewarder: PaperReward, sense: LegSense, stance: bool) -> float:
    """Return the reward: its terms added one after the other, as no ``sum`` of Python 3.12 does."""
    total = 0.0
    for value in rewarder.terms(sense, stance).values():
        total += value
    return total


def literally(runs: Iterable[Sequence[BagStatistics]], params: Params) -> Table:
    """Return what four legs write into one table in these runs, tick by tick and leg by leg."""
    table, learning = empty_table(params), params.walk
    partition, rewarder = PaperDiscretizer(params), PaperReward(params)
    share = params.gait.stance_share
    speeds = params.leg.knee_speeds
    for run in runs:
        for (beat, senses, commands), (next_beat, next_senses, _) in itertools.pairwise(run):
            updates = []
            for offset, old, new, did in zip(
                params.robot.offset, senses, next_senses, commands, strict=True
            ):
                assert old is not None
                assert new is not None
                assert did is not None
                if new.first_tick:
                    continue
                was, now = ((each.phase + offset) % 1.0 < share for each in (beat, next_beat))
                cell = partition.index(old, was) * len(speeds) + speeds.index(did.knee_speed)
                best = max(table.row(partition.index(new, now)))
                updates.append((cell, paid(rewarder, new, was) + learning.gamma * best))
            for cell, target in updates:
                table.update(cell, target, learning.rate)
    return table
