"""Replays a recorded run: new legs in a world that returns the recorded senses. Pure.

The caller chooses the runner: the loop, or a graph of nodes (``ember_ros.graph.by_graph``).
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
"""Called with the number of ticks so far; returns whether to continue."""


class Difference(NamedTuple):
    """The first value that differs from the record."""

    tick: int
    leg: str
    field: str
    recorded: object
    replayed: object

    def __str__(self) -> str:
        """Return the difference as a sentence."""
        return (
            f"tick {self.tick}, {self.leg}: {self.field} was recorded as {self.recorded}, and "
            f"replayed as {self.replayed}"
        )


class ReplayWorld:
    """A world that returns the recorded senses, and compares the legs' commands with the record.

    Commands do not influence the senses. The world ends at the end of the bag, or at the first tick
    whose senses are incomplete.
    """

    def __init__(self, legs: Sequence[str], ticks: Iterator[Tick], rate: float = 0.0) -> None:
        """Start at the first tick.

        Args:
            legs: names of the legs, in order.
            ticks: the ticks of the bag.
            rate: ticks per second of wall time; 0 for no limit.

        Raises:
            BagError: there is no tick.
        """
        self.legs = tuple(legs)
        self.compared = 0
        """Number of commands that were compared with the record."""
        self.transitions_compared = 0
        """Number of transitions that were compared with the record."""
        self.unanswered = dict.fromkeys(self.legs, 0)
        """Number of ticks without a recorded command, by leg."""
        self.difference: Difference | None = None
        """The first difference in a command or in the phase."""
        self.transition_difference: Difference | None = None
        """The first difference in a transition."""
        self.missing: str | None = None
        """Why the replay ends before the end of the bag; None if it does not."""
        self._ticks = ticks
        self._wait = 1.0 / rate if rate else 0.0
        self._due = time.monotonic()
        self._last: Tick | None = None
        self._next: Tick | None = None
        # A bag does not contain the mechanical work of the motors.
        self.work = 0.0
        self.over = False
        """Whether the record has ended."""
        self._advance()
        if self.over:
            raise BagError(f"nothing to replay: {self.missing or 'there is no complete tick'}")

    def _advance(self) -> None:
        """Read the next tick of the bag; end if it is incomplete or not the expected one."""
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
        """Return the recorded senses; after the end the last ones, marked as a first tick.

        A leg learns nothing from a transition to a first tick.
        """
        tick = self._next or self._last
        assert tick is not None
        over = self._next is None
        return tuple(
            sense._replace(tick=sense.tick + 1, first_tick=True) if over else sense
            for sense in tick.senses
            if sense is not None
        )

    def step(self, beat: Beat, commands: Sequence[LegCommand | None]) -> None:
        """Compare the commands with the record, and advance to the next tick."""
        tick = self._next
        assert tick is not None
        for leg, command, recorded in zip(self.legs, commands, tick.commands, strict=True):
            if recorded is None:
                self.unanswered[leg] += 1
                continue
            self.compared += 1
            if command != recorded and self.difference is None:
                self.difference = _command_difference(leg, recorded, command)
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
        """Compare the transitions with the record, as an observer of the run."""
        assert self._next is not None
        if self.transition_difference is not None:
            return
        for leg, transition, recorded in zip(
            self.legs, transitions, self._next.transitions, strict=True
        ):
            self.transitions_compared += recorded is not None
            if recorded is not None and transition != recorded:
                self.transition_difference = _transition_difference(leg, recorded, transition)
                return

    def body(self) -> BodyState:
        """Return the recorded state of the body."""
        tick = self._next or self._last
        assert tick is not None
        return tick.body

    def reset(self) -> None:
        """Raise a BagError: a bag is read only once, from its start to its end."""
        raise BagError("a recorded world cannot be reset; open the bag again")

    def close(self) -> None:
        """Do nothing: the caller closes the bag."""


def _command_difference(leg: str, recorded: LegCommand, command: LegCommand | None) -> Difference:
    if command is None:
        return Difference(recorded.tick, leg, "command", recorded, None)
    for field, recorded_value, value in zip(LegCommand._fields, recorded, command, strict=True):
        if value != recorded_value:
            return Difference(recorded.tick, leg, field, recorded_value, value)
    raise AssertionError(recorded)


def _transition_difference(
    leg: str, recorded: Transition, transition: Transition | None
) -> Difference:
    if transition is None:
        return Difference(recorded.tick, leg, "transition", recorded, None)
    old, new = _flat(recorded), _flat(transition)
    for name in dict.fromkeys([*old, *new]):
        if old.get(name) != new.get(name):
            return Difference(recorded.tick, leg, name, old.get(name), new.get(name))
    raise AssertionError(recorded)


def _flat(transition: Transition) -> dict[str, object]:
    """Return the values of a transition by name, with one entry per reward term."""
    terms = {f"reward of {name}": value for name, value in transition.terms}
    return {**transition._asdict(), "terms": None, **terms}


class Replayed(NamedTuple):
    """The result of a replay."""

    ticks: int
    cycles: float
    compared: int
    """Number of commands that were compared with the record."""
    unanswered: dict[str, int]
    """Number of ticks without a recorded command, by leg, if any."""
    difference: Difference | None
    """The first difference in the senses, the commands or the phase, or None."""
    transition_difference: Difference | None
    """The first difference in a transition, or None."""
    missing: str | None
    """Why the replay ended before the end of the bag, or None."""
    table: Table
    """The table at the end."""
    recorded_sha256: str | None
    """SHA-256 of the recorded table at the end; None if it was not recorded."""
    stopped: bool
    """Whether the replay was stopped before the end."""
    seconds: float
    """Wall time, s."""

    parts: Mapping[str, bool | None]
    """Whether senses, commands, rewards and table are equal to the recorded ones. The value is None
    for a part that was not recorded completely."""

    @property
    def equal(self) -> bool:
        """Return whether the replay is complete and all recorded parts are equal."""
        return self.missing is None and False not in self.parts.values()


SENSES = "CRC-32 of the senses"


def conclusion_of(parts: Mapping[str, bool | None], *, complete: bool = True) -> str:
    """Return one line that lists equal and different parts, with a conclusion.

    Args:
        parts: the field of ``Replayed``.
        complete: whether the replay reached the end of the bag.
    """
    lists = {
        "equal": [name for name, same in parts.items() if same],
        "different": [name for name, same in parts.items() if same is False],
        "not recorded, or not to its end": [name for name, same in parts.items() if same is None],
    }
    compared = "; ".join(f"{how}: {', '.join(names)}" for how, names in lists.items() if names)
    if not lists["different"]:
        conclusion = ". Equal, bit for bit" if complete else ". Equal so far"
        conclusion = "" if lists["equal"] == ["senses"] else conclusion
    elif parts["senses"] is False:
        conclusion = ". The bag was changed after it was recorded"
    elif parts["table"]:
        conclusion = (
            ". The learned table is equal: the record was modified, or the legs did not learn"
        )
    elif parts["commands"] is False:
        conclusion = ". The legs choose other actions: another version, or another policy"
    elif parts["rewards"] is False:
        conclusion = (
            ". The legs choose the same actions and receive other rewards: another reward function"
        )
    else:
        conclusion = ". The legs choose the same actions and learn another table: another version"
    return f"Result: {compared}{conclusion}."


Runner = Callable[[RunConfig, ReplayWorld, Path, GoOn], tuple[int, Table]]
"""Runs a configuration in a recorded world until the end of the record, or until ``GoOn`` returns
False. It may write into the folder. It returns the number of ticks and the table at the end."""


def by_loop(config: RunConfig, world: ReplayWorld, folder: Path, go_on: GoOn) -> tuple[int, Table]:
    """Run a configuration in a recorded world without ROS; a ``Runner``."""
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
        bag: an open bag.
        run: the function that runs the configuration.
        rate: speed as a multiple of real time; 0 for no limit.
        go_on: called with the number of ticks so far; returns whether to continue.

    Raises:
        BagError: the bag does not contain everything that determines the run.
    """
    if bag.run_metadata is None and bag.path.is_file():
        raise BagError(
            f"{bag.path} does not say what determined the run: it is one file of a bag; the bag's "
            "folder would be right"
        )
    if bag.run_metadata is None:
        raise BagError(
            f"{bag.path} does not say what determined the run (no {bag.namespace}/run/card): it "
            "was made by another recorder; `ember bag info`, `ember play` and `ember relearn` "
            "work with it"
        )
    bag.run_metadata.config(0, None)  # raises if it cannot be replayed
    if bag.table is None:
        raise BagError(f"{bag.path}: the table at its start is not in the bag")
    ticks_per_cycle = bag.params.gait.ticks
    world = ReplayWorld(bag.legs, bag.ticks(), rate / bag.params.gait.tick_s)
    with tempfile.TemporaryDirectory(prefix="ember_ros_replay_") as name:
        folder = Path(name)
        table_file = folder / "start.npz"
        save_table(table_file, bag.table, bag.params, 0)
        # The number of phases is an upper bound of the cycles; the world ends with the record.
        config = bag.run_metadata.config(bag.phases(), table_file)
        start = time.perf_counter()
        done, table = run(config, world, folder, go_on)
        seconds = time.perf_counter() - start
    damages = [damage for damage in bag.damages if damage.tick < done]
    recorded_sha256 = bag.table_sha256 if world.over and not world.missing else None
    parts = {
        "senses": not damages,
        "commands": world.difference is None if world.compared else None,
        "rewards": world.transition_difference is None if world.transitions_compared else None,
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
        cycles=done / ticks_per_cycle,
        compared=world.compared,
        unanswered={leg: n for leg, n in world.unanswered.items() if n},
        difference=difference,
        transition_difference=world.transition_difference,
        missing=world.missing,
        table=table,
        recorded_sha256=recorded_sha256,
        stopped=not world.over,
        seconds=seconds,
        parts=parts,
    )


def describe(done: Replayed, tick_s: float) -> list[tuple[str, str]]:
    """Return the result of a replay as pairs of a name and a text.

    Args:
        done: the result of the replay.
        tick_s: duration of a tick, s.
    """
    speed = done.ticks * tick_s / done.seconds if done.seconds else 0.0
    lines = [
        ("ticks", f"{done.ticks} ({done.cycles:g} cycles), {speed:.0f} times real time"),
        ("commands", f"{done.compared} compared with the record"),
    ]
    lines += [(leg, f"{n} ticks without a recorded command") for leg, n in done.unanswered.items()]
    sha256 = done.table.sha256()
    if done.stopped:
        comparison = "not compared: stopped before the end"
    elif done.recorded_sha256 is None:
        comparison = "not compared: the bag has none"
    elif done.recorded_sha256 == sha256:
        comparison = "equal to the recorded one"
    else:
        comparison = f"the recorded one is {done.recorded_sha256[:12]}"
    lines.append(("table SHA-256", f"{sha256[:12]}, {comparison}"))
    return lines
