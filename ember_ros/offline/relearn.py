"""Learns from recorded senses and actions with other parameters: Q-learning is off-policy.

This is a replay with a policy that returns the recorded actions, and with the same modules,
synchronization and merging of tables. With the parameters of the run the result is the table of the
run; with other parameters it is the table that the same actions give with them. Pure.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ember_ros.bag.reader import Bag
from ember_ros.errors import BagError, ParameterError
from ember_ros.loop import flush, tick_leg
from ember_ros.params import Params, as_dict, cells_sha256, replace
from ember_ros.params_file import dump_params
from ember_ros.signals import LegCommand, LegSense
from leg_node.assembly import empty_table, learning_params_of, make_leg
from leg_node.gait import GaitStep
from leg_node.shared import SharedTable
from leg_node.table import Table
from leg_node.table_file import save_table

TABLE, PARAMS, SUMMARY = "table.npz", "params.yaml", "relearn.json"
OUTPUTS = (TABLE, PARAMS, SUMMARY)
"""The files that ``write`` writes into a folder."""


class Relearnt(NamedTuple):
    """A table learnt from bags."""

    table: Table
    params: Params
    """The parameters of this learning."""
    ticks: int
    updates: int
    """Updates of cells of the table."""
    skipped: int
    """Ticks of one leg without complete senses or without a command."""
    falls: int

    @property
    def visited(self) -> int:
        """Return how many cells of the table were updated."""
        return int((self.table.visits > 0).sum())


class _RecordedPolicy:
    """A policy that returns the recorded action."""

    def __init__(self) -> None:
        self.action = 0

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        """Return the recorded action."""
        return self.action


class _Actions:
    """Maps recorded commands to actions."""

    def __init__(self, bag: Bag) -> None:
        self._path = bag.path
        self._speeds = {speed: n for n, speed in enumerate(bag.params.leg.knee_speeds)}

    def of(self, leg: str, command: LegCommand) -> int:
        """Return the index of the action of a command."""
        try:
            return self._speeds[command.knee_speed]
        except KeyError:
            raise BagError(
                f"{self._path}: tick {command.tick}, {leg}: a knee speed of {command.knee_speed} "
                "rad/s is none of leg.knee_speeds; a bag of legs with these speeds would be right"
            ) from None


def relearn(
    bags: Sequence[Path],
    changes: Mapping[str, Any] | None = None,
    *,
    params: Params | None = None,
    stage: str | None = None,
    table: Table | None = None,
    passes: int = 1,
    namespace: str | None = None,
    go_on: Callable[[int, int], bool] = lambda ticks, falls: True,
) -> Relearnt:
    """Learn from one or more bags, in the order of the list.

    Args:
        bags: folders of the bags.
        changes: full names of parameters (``reward.slip``) and their values, on top of ``params``.
        params: parameters to learn with; None for those of the first bag.
        stage: the learning_params to use, ``train`` or ``walk``; None for those of the bag.
        table: table to start from, changed in place; None for an empty one.
        passes: number of times that all bags are read.
        namespace: namespace of the robot in each bag.
        go_on: called with the number of ticks and of falls so far; returns whether to continue.

    Raises:
        BagError: a bag cannot be read, or was recorded with another leg or gait.
        ParameterError: a change is invalid.
    """
    if not bags:
        raise BagError("there is no bag to learn from; name one or more")
    with Bag(bags[0], namespace=namespace, params=params) as bag:
        new_params = replace(params or bag.params, changes or {})
        stage = stage or bag.stage
    if table is None:
        table = empty_table(new_params)
    learning_params = learning_params_of(new_params, stage)
    shared = SharedTable(
        table,
        legs=len(new_params.robot.legs),
        cells=cells_sha256(new_params),
        rate=learning_params.rate,
    )
    before = int(table.visits.sum())
    ticks = skipped = falls = 0
    for pass_index in range(passes):
        for n, path in enumerate(bags):
            with Bag(path, namespace=namespace, params=new_params) as bag:
                _check(bag, new_params)
                actions, policy = _Actions(bag), _RecordedPolicy()
                legs = [
                    make_leg(new_params, leg, stage=stage, policy=policy, run=f"{pass_index}/{n}")
                    for leg in bag.legs
                ]
                fall_count, last, incomplete = 0, 0, set[tuple[int, str]]()
                for tick in bag.ticks():
                    for leg, sense, command in zip(legs, tick.senses, tick.commands, strict=True):
                        if sense is None or command is None:
                            skipped += 1
                            incomplete.add((tick.tick, leg.leg))
                            continue
                        policy.action = actions.of(leg.leg, command)
                        tick_leg(shared, leg, sense, tick.beat)
                    ticks += 1
                    fall_count, last = tick.body.falls, tick.tick
                    if not go_on(ticks, falls + fall_count):
                        raise BagError("stopped before all bags were learnt from")
                changed = [damage for damage in bag.damages if damage[:2] not in incomplete]
                for damage in changed[:1]:
                    raise BagError(
                        f"{path}: tick {damage.tick}, {damage.leg}: the senses are not the "
                        "recorded ones"
                    )
                for leg in legs:
                    flush(shared, leg, last)
                shared.merge()
                falls += fall_count
    return Relearnt(table, new_params, ticks, int(table.visits.sum()) - before, skipped, falls)


def _check(bag: Bag, params: Params) -> None:
    """Raise a BagError if the bag was recorded with another gait, leg or robot."""
    recorded, new = as_dict(bag.params), as_dict(params)
    for group in ("gait", "leg", "robot"):
        for name, value in recorded[group].items():
            if new[group][name] != value:
                raise BagError(
                    f"{bag.path} was recorded with {group}.{name} = {value}, and cannot be learnt "
                    f"from with {new[group][name]}: its senses and actions would have another "
                    "meaning; reward.*, state.*, train.* and walk.* may be changed"
                )


def short_forms(
    params: Params, stage: str, *, alpha: float | None, gamma: float | None, bins: int | None
) -> dict[str, Any]:
    """Return the parameter changes of the command-line options with short names.

    Args:
        params: parameters before the changes.
        stage: the learning_params to change, ``train`` or ``walk``.
        alpha: minimum learning rate; a constant rate stays constant. None: unchanged.
        gamma: discount factor per tick. None: unchanged.
        bins: number of bins of the hip angle. None: unchanged.
    """
    changes = {f"{stage}.alpha_floor": alpha, f"{stage}.gamma": gamma, "state.hip_bins": bins}
    rate = params.walk.rate if stage == "walk" else params.train.rate
    if alpha is not None and (alpha > rate.ceiling or rate.floor == rate.ceiling):
        changes[f"{stage}.alpha_ceiling"] = alpha
    return {name: value for name, value in changes.items() if value is not None}


def refuse_to_replace(out: Path) -> None:
    """Refuse a folder in which ``write`` would replace a file.

    Raises:
        ParameterError: the folder has such a file.
    """
    existing = [name for name in OUTPUTS if (out / name).exists()]
    if existing:
        raise ParameterError(
            f"{out} has {', '.join(existing)} already; use another --out, or --force to replace it"
        )


def write(learnt: Relearnt, out: Path, request: Mapping[str, Any]) -> None:
    """Write the table, its parameters, and a summary.

    Args:
        learnt: the result.
        out: the folder, created if it does not exist.
        request: the arguments of the command, as plain values, for the summary.
    """
    summary = {
        **request,
        "ticks": learnt.ticks,
        "updates": learnt.updates,
        "skipped": learnt.skipped,
        "falls": learnt.falls,
        "cells_visited": learnt.visited,
        "cells": len(learnt.table),
        "table_sha256": learnt.table.sha256(),
    }
    save_table(out / TABLE, learnt.table, learnt.params, 0, {"relearnt": summary})
    (out / PARAMS).write_text(dump_params(learnt.params), encoding="utf-8")
    (out / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def describe(learnt: Relearnt) -> list[tuple[str, str]]:
    """Return the result as pairs of a name and a text."""
    return [
        ("ticks", f"{learnt.ticks}, with {learnt.falls} falls"),
        ("updates", str(learnt.updates)),
        ("skipped", f"{learnt.skipped} ticks of one leg without senses or command"),
        ("cells visited", f"{learnt.visited} of {len(learnt.table)}"),
        ("table SHA-256", learnt.table.sha256()[:12]),
    ]
