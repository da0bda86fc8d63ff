"""Learns again from what legs once sensed and did, with other numbers: Q-learning is off-policy.

It is a replay in which the legs are told what to do: the same modules, the same sync, the same
merge, one action after the other as it was recorded. So with the numbers of the run itself the
table comes out that was learnt then, and with others the one that would have been. Pure.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ember_ros.bag.reader import Bag
from ember_ros.errors import BagError, ParameterError
from ember_ros.loop import act, flush
from ember_ros.params import Params, as_dict, cells_sha256, replace
from ember_ros.params_file import dump_params
from ember_ros.signals import LegCommand, LegSense
from leg_node.assembly import empty_table, make_leg, numbers_of
from leg_node.gait import GaitStep
from leg_node.shared import SharedTable
from leg_node.table import Table
from leg_node.table_file import save_table

TABLE, PARAMS, TOLD = "table.npz", "params.yaml", "relearn.json"
LEFT = (TABLE, PARAMS, TOLD)
"""What is written into a folder, and replaced by the next one there."""


class Relearnt(NamedTuple):
    """A table learnt from bags."""

    table: Table
    params: Params
    """That it was learnt with."""
    ticks: int
    updates: int
    """Of cells of the table."""
    skipped: int
    """Ticks of single legs that had no whole senses, or no command."""
    falls: int

    @property
    def visited(self) -> int:
        """Return how many cells of the table were updated."""
        return int((self.table.visits > 0).sum())


class _Told:
    """A policy that does as it is told."""

    def __init__(self) -> None:
        self.action = 0

    def choose(self, sense: LegSense, gait: GaitStep, state: int) -> int:
        """Return what was done."""
        return self.action


class _Actions:
    """Which action a recorded command was."""

    def __init__(self, bag: Bag) -> None:
        self._path = bag.path
        self._speeds = {speed: n for n, speed in enumerate(bag.params.leg.knee_speeds)}

    def of(self, leg: str, command: LegCommand) -> int:
        """Return the action."""
        try:
            return self._speeds[command.knee_speed]
        except KeyError:
            raise BagError(
                f"{self._path}: tick {command.tick}, {leg}: a knee speed of {command.knee_speed} "
                "rad/s is none of leg.knee_speeds; learnt from can be what legs of these speeds "
                "did"
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
    """Learn from bags, one after the other, in the order given.

    Args:
        bags: folders.
        changes: full names of parameters (``reward.slip``) and their values, on top of ``params``.
        params: to learn with; those of the first bag for None.
        stage: which learning numbers hold, ``train`` or ``walk``; the bag's own for None.
        table: to start from, owned from now on; empty for None.
        passes: how often all bags are gone through.
        namespace: of the robot in each bag.
        go_on: told how many ticks and falls are done; says whether to go on.

    Raises:
        BagError: a bag cannot be used, or was recorded by another leg or gait.
        ParameterError: a change is none.
    """
    if not bags:
        raise BagError("there is no bag to learn from; name one or more")
    with Bag(bags[0], namespace=namespace, params=params) as bag:
        own = replace(params or bag.params, changes or {})
        stage = stage or bag.stage
    if table is None:
        table = empty_table(own)
    numbers = numbers_of(own, stage)
    shared = SharedTable(
        table, legs=len(own.robot.legs), cells=cells_sha256(own), rate=numbers.rate
    )
    before = int(table.visits.sum())
    ticks = skipped = falls = 0
    for turn in range(passes):
        for n, path in enumerate(bags):
            with Bag(path, namespace=namespace, params=own) as bag:
                _check(bag, own)
                actions, told = _Actions(bag), _Told()
                legs = [
                    make_leg(own, leg, stage=stage, policy=told, run=f"{turn}/{n}")
                    for leg in bag.legs
                ]
                fallen, last, blind = 0, 0, set[tuple[int, str]]()
                for tick in bag.ticks():
                    for leg, sense, command in zip(legs, tick.senses, tick.commands, strict=True):
                        if sense is None or command is None:
                            skipped += 1
                            blind.add((tick.tick, leg.leg))
                            continue
                        told.action = actions.of(leg.leg, command)
                        act(shared, leg, sense, tick.beat)
                    ticks += 1
                    fallen, last = tick.body.falls, tick.tick
                    if not go_on(ticks, falls + fallen):
                        raise BagError("stopped before all bags were learnt from")
                changed = [each for each in bag.damages if each[:2] not in blind]
                for damage in changed[:1]:
                    raise BagError(
                        f"{path}: tick {damage.tick}, {damage.leg}: senses are not those that "
                        "were recorded"
                    )
                for leg in legs:
                    flush(shared, leg, last)
                shared.merge()
                falls += fallen
    return Relearnt(table, own, ticks, int(table.visits.sum()) - before, skipped, falls)


def _check(bag: Bag, params: Params) -> None:
    """Raise a BagError if the bag's legs are not those that the parameters speak of."""
    was, now = as_dict(bag.params), as_dict(params)
    for group in ("gait", "leg", "robot"):
        for name, value in was[group].items():
            if now[group][name] != value:
                raise BagError(
                    f"{bag.path} was recorded with {group}.{name} = {value}, and is to be learnt "
                    f"from with {now[group][name]}: what was sensed and done would mean something "
                    "else; reward.*, state.*, train.* and walk.* may be changed"
                )


def short_forms(
    params: Params, stage: str, *, alpha: float | None, gamma: float | None, bins: int | None
) -> dict[str, Any]:
    """Return the changes that stand behind short names.

    Args:
        params: that they are changes to.
        stage: which learning numbers hold.
        alpha: least learning rate; a constant rate stays one. Unchanged for None, as all here.
        gamma: discount a tick.
        bins: of the hip's range.
    """
    changes = {f"{stage}.alpha_floor": alpha, f"{stage}.gamma": gamma, "state.hip_bins": bins}
    rate = params.walk.rate if stage == "walk" else params.train.rate
    if alpha is not None and (alpha > rate.ceiling or rate.floor == rate.ceiling):
        changes[f"{stage}.alpha_ceiling"] = alpha
    return {name: value for name, value in changes.items() if value is not None}


def refuse_to_replace(out: Path) -> None:
    """Hold that ``write`` would replace nothing in a folder, of which there may be none yet.

    Raises:
        ParameterError: it holds what an earlier one left.
    """
    kept = [name for name in LEFT if (out / name).exists()]
    if kept:
        raise ParameterError(
            f"{out} holds {', '.join(kept)} already; give another --out, or --force to replace it"
        )


def write(learnt: Relearnt, out: Path, asked: Mapping[str, Any]) -> None:
    """Write the table, its parameters, and what was asked for with what came of it.

    Args:
        learnt: what was learnt.
        out: a folder, made if need be.
        asked: what was asked for, as plain values.
    """
    found = {
        **asked,
        "ticks": learnt.ticks,
        "updates": learnt.updates,
        "skipped": learnt.skipped,
        "falls": learnt.falls,
        "cells_visited": learnt.visited,
        "cells": len(learnt.table),
        "table_sha256": learnt.table.sha256(),
    }
    save_table(out / TABLE, learnt.table, learnt.params, 0, {"relearnt": found})
    (out / PARAMS).write_text(dump_params(learnt.params), encoding="utf-8")
    (out / TOLD).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


def told(learnt: Relearnt) -> list[tuple[str, str]]:
    """Return what was learnt as pairs of a name and what is to be said of it."""
    return [
        ("ticks", f"{learnt.ticks}, {learnt.falls} falls among them"),
        ("updates", str(learnt.updates)),
        ("skipped", f"{learnt.skipped} ticks of single legs without senses or command"),
        ("cells visited", f"{learnt.visited} of {len(learnt.table)}"),
        ("table SHA-256", learnt.table.sha256()[:12]),
    ]
