"""A second, simple implementation of the learning of four legs with one table."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

from ember_ros.params import Params
from ember_ros.signals import Beat, LegCommand, LegSense
from leg_node.assembly import empty_table
from leg_node.discretizer import PaperDiscretizer
from leg_node.reward import PaperReward
from leg_node.table import Table

TickSignals = tuple[Beat, Sequence[LegSense | None], Sequence[LegCommand | None]]
"""Signals of a tick: beat, and the senses and commands of all legs; none may be missing."""


def reward_of(reward: PaperReward, sense: LegSense, stance: bool) -> float:
    """Return the reward, the terms added in order (``sum`` of Python 3.12 rounds differently)."""
    total = 0.0
    for value in reward.terms(sense, stance).values():
        total += value
    return total


def reference_table(runs: Iterable[Sequence[TickSignals]], params: Params) -> Table:
    """Return the table after these runs, updated tick by tick and leg by leg."""
    table, hyperparameters = empty_table(params), params.walk
    discretizer, reward = PaperDiscretizer(params), PaperReward(params)
    share = params.gait.stance_share
    speeds = params.leg.knee_speeds
    for run in runs:
        for (beat, senses, commands), (next_beat, next_senses, _) in itertools.pairwise(run):
            updates = []
            for offset, old, new, command in zip(
                params.robot.offset, senses, next_senses, commands, strict=True
            ):
                assert old is not None
                assert new is not None
                assert command is not None
                if new.first_tick:
                    continue
                old_stance, new_stance = (
                    (each.phase + offset) % 1.0 < share for each in (beat, next_beat)
                )
                old_state = discretizer.index(old, old_stance)
                new_state = discretizer.index(new, new_stance)
                cell = old_state * len(speeds) + speeds.index(command.knee_speed)
                target = reward_of(reward, new, old_stance)
                target += hyperparameters.gamma * max(table.row(new_state))
                updates.append((cell, target))
            for cell, target in updates:
                table.update(cell, target, hyperparameters.rate)
    return table
