"""Runs a recorded run again: fresh legs in a world that only shows what was sensed. Pure.

Who runs them is given: the loop, or what knows of nodes (``ember_ros.graph.by_graph``).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ember_ros.bag.reader import Bag, Tick
from ember_ros.errors import BagError
from ember_ros.loop import Loop
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from leg_node.table import Table
from leg_node.table_file import save_table

GoOn = Callable[[int], bool]
"""Told how many ticks are done; says whether to go on."""


class Difference(NamedTuple):
    """The first thing that came out otherwise than it was recorded."""

    tick: int
    leg: str
    field: str
    recorded: object
    replayed: object

    def __str__(self) -> str:
        """Return it as a sentence."""
        return (
            f"tick {self.tick}, {self.leg}: {self.field} was recorded as {self.recorded}, and "
            f"replayed as {self.replayed}"
        )


class ReplayWorld:
    """A world that was: it shows what was sensed, and holds what legs answer against the record.

    Nothing a leg does changes what comes next. It ends where the bag does, or where a leg's senses
    are missing.
    """

    def __init__(self, legs: Sequence[str], ticks: Iterator[Tick], rate: float = 0.0) -> None:
        """Begin at the first tick.

        Args:
            legs: their names, in order.
            ticks: of the bag.
            rate: ticks a second to keep to; as fast as can be for 0.

        Raises:
            BagError: there is no tick.
        """
        self.legs = tuple(legs)
        self.compared = 0
        """Commands that were held against the record."""
        self.paid = 0
        """Transitions that were held against the record."""
        self.unanswered = dict.fromkeys(self.legs, 0)
        """Ticks without a recorded command, by leg."""
        self.difference: Difference | None = None
        self.paid_otherwise: Difference | None = None
        """The first thing that a leg was paid otherwise than it was recorded, or for another."""
        self.missing: str | None = None
        """Why the record ends before the bag does, if it does."""
        self._ticks = ticks
        self._wait = 1.0 / rate if rate else 0.0
        self._due = time.monotonic()
        self._last: Tick | None = None
        self._next: Tick | None = None
        self.work = 0.0  # nobody recorded it
        self.over = False
        """Whether the record has ended."""
        self._advance()
        if self.over:
            raise BagError(f"nothing to replay: {self.missing or 'there is no whole tick'}")

    def _advance(self) -> None:
        """Take the next tick from the bag, if it is whole and follows."""
        self._last, self._next = self._next, next(self._ticks, None)
        if self._next is None:
            self.over = True
            return
        expected = self._last.tick + 1 if self._last else 0
        if self._next.tick != expected:
            self.missing = f"tick {expected} is not in the bag, tick {self._next.tick} follows"
        for leg, sense in zip(self.legs, self._next.senses, strict=True):
            if sense is None and self.missing is None:
                self.missing = f"the senses of {leg} at tick {self._next.tick} are not in the bag"
        if self.missing:
            self._next, self.over = None, True

    def observe(self) -> tuple[LegSense, ...]:
        """Return what was sensed; after the end the last senses, to which nothing is credited."""
        tick = self._next or self._last
        assert tick is not None
        over = self._next is None
        return tuple(
            sense._replace(tick=sense.tick + 1, first_tick=True) if over else sense
            for sense in tick.senses
            if sense is not None
        )

    def step(self, beat: Beat, commands: Sequence[LegCommand | None]) -> None:
        """Hold the commands against those that were recorded, and go on."""
        tick = self._next
        assert tick is not None
        for leg, command, recorded in zip(self.legs, commands, tick.commands, strict=True):
            if recorded is None:
                self.unanswered[leg] += 1
                continue
            self.compared += 1
            if command != recorded and self.difference is None:
                self.difference = _difference(leg, recorded, command)
        if beat != tick.beat and self.difference is None:
            self.difference = Difference(tick.tick, "cpg", "phase", tick.beat.phase, beat.phase)
        if self._wait:
            self._due += self._wait
            time.sleep(max(0.0, self._due - time.monotonic()))
        self._advance()

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Hold what the legs were paid against what was recorded, as an observer of the run."""
        assert self._next is not None
        if self.paid_otherwise is not None:
            return
        for leg, did, recorded in zip(self.legs, transitions, self._next.transitions, strict=True):
            self.paid += recorded is not None
            if recorded is not None and did != recorded:
                self.paid_otherwise = _paid_otherwise(leg, recorded, did)
                return

    def body(self) -> BodyState:
        """Return where the body was."""
        tick = self._next or self._last
        assert tick is not None
        return tick.body

    def reset(self) -> None:
        """Refuse: a record is read from its beginning to its end, once."""
        raise BagError("a recorded world cannot be reset; open the bag again")

    def close(self) -> None:
        """Do nothing: who opened the bag closes it."""


def _difference(leg: str, recorded: LegCommand, command: LegCommand | None) -> Difference:
    if command is None:
        return Difference(recorded.tick, leg, "command", recorded, None)
    for field, was, now in zip(LegCommand._fields, recorded, command, strict=True):
        if was != now:
            return Difference(recorded.tick, leg, field, was, now)
    raise AssertionError(recorded)


def _paid_otherwise(leg: str, recorded: Transition, did: Transition | None) -> Difference:
    if did is None:
        return Difference(recorded.tick, leg, "transition", recorded, None)
    was, now = _flat(recorded), _flat(did)
    for name in dict.fromkeys([*was, *now]):
        if was.get(name) != now.get(name):
            return Difference(recorded.tick, leg, name, was.get(name), now.get(name))
    raise AssertionError(recorded)


def _flat(did: Transition) -> dict[str, object]:
    """Return all of a transition by name."""
    return {**did._asdict(), "terms": None, **{f"reward of {n}": v for n, v in did.terms}}


class Replayed(NamedTuple):
    """What a replay came to."""

    ticks: int
    cycles: float
    compared: int
    """Commands that were held against the record."""
    unanswered: dict[str, int]
    """Ticks in which a leg's command was not recorded, by leg, where there are any."""
    difference: Difference | None
    """The first in what was sensed or commanded, or None."""
    paid_otherwise: Difference | None
    """The first in what a leg was paid, or None."""
    missing: str | None
    """Why the replay ended before the bag, or None."""
    table: Table
    """At the end."""
    recorded_sha256: str | None
    """Of the table at the end, if it was recorded."""
    stopped: bool
    """Whether it was stopped before the end."""
    seconds: float
    """Wall time."""

    parts: Mapping[str, bool | None]
    """Whether senses, commands, rewards and table came out as they were recorded; None of what was
    not, or not to its end."""

    @property
    def equal(self) -> bool:
        """Return whether everything that was recorded came out again."""
        return self.missing is None and False not in self.parts.values()


SENSES = "CRC-32 of the senses"


def verdict(parts: Mapping[str, bool | None], *, whole: bool = True) -> str:
    """Return in one line what is equal, what is not, and what that means.

    Args:
        parts: of ``Replayed``.
        whole: whether the replay came to the end of the bag.
    """
    lists = {
        "equal": [name for name, same in parts.items() if same],
        "different": [name for name, same in parts.items() if same is False],
        "not recorded, or not to its end": [name for name, same in parts.items() if same is None],
    }
    told = "; ".join(f"{how}: {', '.join(names)}" for how, names in lists.items() if names)
    if not lists["different"]:
        means = ". Equal, bit for bit" if whole else ". Equal so far"
        means = "" if lists["equal"] == ["senses"] else means
    elif parts["senses"] is False:
        means = ". The bag was changed after it was recorded"
    elif parts["table"]:
        means = ". What was learnt is the same: the record was altered, or the legs did not learn"
    elif parts["commands"] is False:
        means = ". The legs act otherwise than they did: another version, or another policy"
    elif parts["rewards"] is False:
        means = ". The legs act alike and are paid otherwise: another reward"
    else:
        means = ". The legs act alike and learn otherwise: another version"
    return f"Verdict: {told}{means}."


Runner = Callable[[RunConfig, ReplayWorld, Path, GoOn], tuple[int, Table]]
"""Runs a plan in a recorded world until the record is over or it is told no. It may write into the
folder, and returns how many ticks it ran and the table in the end."""


def by_loop(config: RunConfig, world: ReplayWorld, folder: Path, go_on: GoOn) -> tuple[int, Table]:
    """Run a plan in a recorded world without ROS; a ``Runner``."""
    loop = Loop(config, world)
    while not world.over and go_on(loop.now):
        loop.tick(world)
    return loop.now, loop.finish()


def replay(
    bag: Bag,
    *,
    run: Runner = by_loop,
    rate: float = 0.0,
    go_on: GoOn = lambda ticks: True,
) -> Replayed:
    """Replay a bag.

    Args:
        bag: an open one.
        run: who runs it.
        rate: times real time; as fast as can be for 0.
        go_on: told how many ticks are done; says whether to go on.

    Raises:
        BagError: the bag does not hold what determines the run; the message says what.
    """
    if bag.run_metadata is None and bag.path.is_file():
        raise BagError(
            f"{bag.path} does not say what determined the run; the bag's folder would be right, "
            "of which this is one file"
        )
    if bag.run_metadata is None:
        raise BagError(
            f"{bag.path} does not say what determined the run (no {bag.namespace}/run/card): it "
            "was made by another recorder; `ember bag info`, `ember play` and `ember relearn` "
            "work with it"
        )
    bag.run_metadata.config(0, None)  # says in words what cannot be replayed
    if bag.table is None:
        raise BagError(f"{bag.path}: the table at its start is not in the bag")
    ticks_a_cycle = bag.params.gait.ticks
    world = ReplayWorld(bag.legs, bag.ticks(), rate / bag.params.gait.tick_s)
    with tempfile.TemporaryDirectory(prefix="ember_ros_replay_") as name:
        folder = Path(name)
        start = folder / "start.npz"
        save_table(start, bag.table, bag.params, 0)
        # The world ends where the record does; there are no more cycles than phases.
        config = bag.run_metadata.config(bag.phases(), start)
        began = time.perf_counter()
        done, table = run(config, world, folder, go_on)
        seconds = time.perf_counter() - began
    damages = [each for each in bag.damages if each.tick < done]
    recorded_sha256 = bag.table_sha256 if world.over and not world.missing else None
    parts = {
        "senses": not damages,
        "commands": world.difference is None if world.compared else None,
        "rewards": world.paid_otherwise is None if world.paid else None,
        "table": recorded_sha256 == table.sha256() if recorded_sha256 else None,
    }
    difference = world.difference
    for damage in damages[:1]:
        if difference is None or damage.tick <= difference.tick:
            difference = Difference(
                damage.tick,
                damage.leg,
                SENSES,
                f"{damage.recorded:08x}",
                f"{damage.found:08x}",
            )
    return Replayed(
        ticks=done,
        cycles=done / ticks_a_cycle,
        compared=world.compared,
        unanswered={leg: n for leg, n in world.unanswered.items() if n},
        difference=difference,
        paid_otherwise=world.paid_otherwise,
        missing=world.missing,
        table=table,
        recorded_sha256=recorded_sha256,
        stopped=not world.over,
        seconds=seconds,
        parts=parts,
    )


def told(done: Replayed, tick_s: float) -> list[tuple[str, str]]:
    """Return what a replay came to as pairs of a name and what is to be said of it.

    Args:
        done: the replay.
        tick_s: of the gait, s.
    """
    faster = done.ticks * tick_s / done.seconds if done.seconds else 0.0
    lines = [
        ("ticks", f"{done.ticks} ({done.cycles:g} cycles), {faster:.0f} times real time"),
        ("commands", f"{done.compared} held against the record"),
    ]
    lines += [(leg, f"{n} ticks without a recorded command") for leg, n in done.unanswered.items()]
    sha256 = done.table.sha256()
    if done.stopped:
        known = "not compared: stopped before the end"
    elif done.recorded_sha256 is None:
        known = "the run's own was not recorded"
    elif done.recorded_sha256 == sha256:
        known = "as recorded"
    else:
        known = f"recorded was {done.recorded_sha256[:12]}"
    lines.append(("table SHA-256", f"{sha256[:12]}, {known}"))
    return lines
