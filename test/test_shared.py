"""The shared table and a leg's copy: the order never matters, nothing is lost."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros.errors import EmberError, UpdateError
from ember_ros.params import Rate
from ember_ros.signals import TDUpdate
from leg_node import shared as module
from leg_node.shared import LocalCopy, SharedTable, UpdateBatch
from leg_node.table import Table

STATES, ACTIONS, RATE, CELLS = 4, 3, Rate(0.1, 1.0), "cells"
few = settings(max_examples=60, deadline=None, derandomize=True)

targets = st.floats(-10.0, 10.0)
finite = st.floats(allow_nan=False, allow_infinity=False)
some_updates = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, STATES * ACTIONS - 1), targets), max_size=5
)
# (leg, epoch): updates of it, at ticks 4 * epoch to 4 * epoch + 3
histories = st.dictionaries(
    st.tuples(st.integers(0, 3), st.integers(0, 4)), some_updates, max_size=12
)


def shared_table() -> SharedTable:
    """Return an empty shared table."""
    return SharedTable(Table(STATES, ACTIONS), legs=4, cells=CELLS, rate=RATE)


def push(leg: int, epoch: int, *updates: Any, run: str = "run") -> UpdateBatch:
    """Return a push of (tick, cell, target)."""
    return UpdateBatch(leg, run, epoch, CELLS, tuple(TDUpdate(*update) for update in updates))


def pushes_of(history: dict[tuple[int, int], list[tuple[int, int, float]]]) -> list[UpdateBatch]:
    """Return the pushes of a history, by leg and epoch."""
    return [
        push(leg, epoch, *((4 * epoch + tick, *update) for tick, *update in sorted(updates)))
        for (leg, epoch), updates in sorted(history.items())
    ]


def content(table: Table) -> tuple[bytes, bytes]:
    """Return all bits of a table."""
    return table.values.tobytes(), table.visits.tobytes()


def in_order(pushes: list[UpdateBatch]) -> Table:
    """Return what the design asks for: updates one by one in the order (epoch, tick, leg)."""
    table = Table(STATES, ACTIONS)
    every = [
        (p.epoch, update.tick, p.leg, n, update)
        for p in pushes
        for n, update in enumerate(p.updates)
    ]
    for *_, update in sorted(every):
        table.update(update.cell, update.target, RATE)
    return table


# -- order ---------------------------------------------------------------------------------------


@few
@given(history=histories, data=st.data())
def test_order_of_arrival_never_matters(
    history: dict[tuple[int, int], list[tuple[int, int, float]]], data: st.DataObject
) -> None:
    """However the legs' pushes come in between each other, each leg's own in order: one table."""
    pushes = pushes_of(history)
    waiting = {leg: [each for each in pushes if each.leg == leg] for leg in range(4)}
    table = shared_table()
    for leg in data.draw(st.permutations([each.leg for each in pushes])):
        assert table.push(waiting[leg].pop(0))
    table.merge()
    assert content(table.table) == content(in_order(pushes))


def test_pairs_of_one_epoch_merge_by_tick_and_leg() -> None:
    """Within an epoch the tick decides before the leg: as if all had written to one table."""
    table = shared_table()
    table.push(push(1, 0, (0, 5, 2.0), (1, 5, 8.0)))
    table.push(push(0, 0, (0, 5, 4.0), (2, 5, 16.0)))
    table.merge()
    value = 0.0
    for n, target in enumerate((4.0, 2.0, 8.0, 16.0), start=1):
        value += max(RATE.floor, 1.0 / n) * (target - value)
    assert table.table.read(5) == (value, 4)


def test_epochs_merge_one_after_the_other() -> None:
    """An older epoch is merged before a newer one, whichever came first."""
    one, other = shared_table(), shared_table()
    early, late = push(3, 0, (0, 5, 2.0)), push(0, 1, (4, 5, 8.0))
    for each in (early, late):
        one.push(each)
    for each in (late, early):
        other.push(each)
    one.pull(None, 0)
    one.pull(None, 1)
    other.merge()
    assert content(one.table) == content(other.table) == content(in_order([early, late]))


def test_many_visits_of_one_cell_do_not_overshoot() -> None:
    """Four legs with the same target in one epoch bring the cell to it, not beyond."""
    table = shared_table()
    for leg in range(4):
        table.push(push(leg, 0, (leg, 5, 1.0), (3, 5, 1.0)))
    table.merge()
    assert table.table.read(5) == (1.0, 8)


# -- once ----------------------------------------------------------------------------------------


@few
@given(history=histories, data=st.data())
def test_a_repeated_push_changes_nothing(
    history: dict[tuple[int, int], list[tuple[int, int, float]]], data: st.DataObject
) -> None:
    """However often and however late pushes are repeated, each counts once."""
    pushes = sorted(pushes_of(history), key=lambda p: (p.epoch, p.leg))
    table = shared_table()
    for n, each in enumerate(pushes):
        assert table.push(each)
        again = data.draw(st.sampled_from(pushes[: n + 1]))
        assert not table.push(again)
        if data.draw(st.booleans()):
            table.merge(each.epoch - 1)
    table.merge()
    assert not any(table.push(each) for each in pushes)
    assert content(table.table) == content(in_order(pushes))


def test_a_push_is_named_by_leg_run_and_epoch() -> None:
    """Another leg, another life or another epoch is another push; the updates do not name it."""
    table = shared_table()
    assert table.push(push(0, 3, (12, 1, 1.0)))
    assert not table.push(push(0, 3, (12, 2, 2.0)))
    assert table.push(push(1, 3, (12, 1, 1.0)))
    assert table.push(push(0, 3, (12, 1, 1.0), run="another life"))
    assert table.push(push(0, 4, (16, 1, 1.0)))
    table.merge()
    assert table.table.visits.sum() == 4


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "other parameters": ({"cells_sha256": "0123456789abcdef"}, "other parameters"),
    "leg": ({"leg": -1}, "leg -1"),
    "epoch": ({"epoch": -1}, "epoch -1"),
    "run": ({"run": ""}, "run ''"),
    "cell under 0": ({"updates": (TDUpdate(1, 2, 1.0), TDUpdate(1, -1, 1.0))}, "cell -1"),
    "cell beyond": (
        {"updates": (TDUpdate(1, 2, 1.0), TDUpdate(1, STATES * ACTIONS, 1.0))},
        "cell 12",
    ),
    "NaN": ({"updates": (TDUpdate(1, 2, 1.0), TDUpdate(1, 3, float("nan")))}, "cell 3 .* nan"),
    "infinity": ({"updates": (TDUpdate(1, 2, 1.0), TDUpdate(1, 3, float("inf")))}, "cell 3 .* inf"),
    "minus infinity": (
        {"updates": (TDUpdate(1, 2, 1.0), TDUpdate(1, 3, -float("inf")))},
        "cell 3 .* -inf",
    ),
    "tick": ({"updates": (TDUpdate(1, 2, 1.0), TDUpdate(-1, 3, 1.0))}, "tick -1"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_refused_push_changes_nothing(name: str) -> None:
    """One wrong thing in a push: its reason is said, nothing is taken; the right one is."""
    change, reason = WRONG[name]
    table, right = shared_table(), push(0, 0, (0, 1, 3.0))
    table.push(push(1, 0, (0, 1, 5.0)))
    before = repr((table.pending(), table.done(), table.version))
    with pytest.raises(UpdateError, match=reason) as refused:
        table.push(right._replace(**change))
    assert isinstance(refused.value, EmberError)
    assert repr((table.pending(), table.done(), table.version)) == before
    assert content(table.table) == content(Table(STATES, ACTIONS))
    assert table.push(right)
    table.merge()
    assert table.table.read(1)[1] == 2


# -- what changed --------------------------------------------------------------------------------


@few
@given(histories=st.lists(histories, min_size=1, max_size=4), data=st.data())
def test_a_pull_returns_exactly_what_changed(
    histories: list[dict[tuple[int, int], list[tuple[int, int, float]]]], data: st.DataObject
) -> None:
    """Since any version: the cells that were merged into after it, as they are now, no others."""
    table = shared_table()
    versions, merged = [table.version], [set[int]()]
    for n, history in enumerate(histories):
        pushes = [each._replace(run=f"run {n}") for each in pushes_of(history)]
        for each in pushes:
            table.push(each)
        changes = table.pull(table.version, 99)
        versions.append(changes.version)
        merged.append({update.cell for each in pushes for update in each.updates})
        assert set(changes.cells.tolist()) == merged[-1]
        back = data.draw(st.integers(0, len(versions) - 1))
        since = table.pull(versions[back])
        assert set(since.cells.tolist()) == set().union(*merged[back + 1 :])
        assert since.cells.tolist() == sorted(since.cells.tolist())
        assert since.values.tolist() == table.table.values[since.cells].tolist()
        assert since.visits.tolist() == table.table.visits[since.cells].tolist()


def test_a_first_pull_returns_everything() -> None:
    """Whoever has no version gets the whole table, merged up to the epoch asked for."""
    table = shared_table()
    table.push(push(0, 0, (0, 1, 3.0)))
    table.push(push(0, 1, (4, 2, 3.0)))
    changes = table.pull(None, 0)
    assert changes.cells.tolist() == list(range(STATES * ACTIONS))
    assert changes.visits.tolist() == [0, 1, *[0] * 10]


def test_what_was_pulled_does_not_change_afterwards() -> None:
    """A reply is what the table was when it was asked, also if it is read later."""
    table = shared_table()
    whole = table.pull(None)
    table.push(push(0, 0, (0, 1, 3.0)))
    part = table.pull(0, 0)
    table.push(push(0, 1, (4, 1, 5.0)))
    table.merge()
    assert part.visits.tolist() == [1]
    assert not whole.visits.any()


def test_a_pull_stops_at_its_epoch() -> None:
    """What belongs to a later epoch stays where it is: the answer depends on no one's speed."""
    table = shared_table()
    table.push(push(0, 0, (0, 1, 3.0)))
    table.push(push(1, 1, (4, 2, 3.0)))
    assert table.pull(0, -1).cells.tolist() == []
    assert table.pull(0, 0).cells.tolist() == [1]
    assert table.pull(0, 1).cells.tolist() == [1, 2]


def test_a_version_grows_only_with_changes() -> None:
    """A merge of nothing is no new version; a merge of something is."""
    table = shared_table()
    assert table.pull(None, 5).version == 0
    table.push(push(0, 6, (24, 1, 1.0)))
    assert table.pull(0, 5).version == 0
    assert table.pull(0, 6).version == 1
    assert table.pull(1, 7).version == 1


def test_a_late_push_is_seen_by_everybody_later() -> None:
    """A leg that was away for epochs pushes them in the end: merged, and pulled by all."""
    table = shared_table()
    table.push(push(0, 7, (28, 1, 3.0)))
    version = table.pull(None, 7).version
    assert table.push(push(1, 2, (8, 2, 5.0)))
    assert table.pull(version).cells.tolist() == []
    changes = table.pull(version, 8)
    assert changes.cells.tolist() == [2]
    assert changes.values.tolist() == [5.0]


# -- bounds --------------------------------------------------------------------------------------


def footprint(table: SharedTable) -> int:
    """Return how many things all containers of a shared table hold, deeply."""

    def count(thing: object) -> int:
        if isinstance(thing, dict):
            return len(thing) + sum(map(count, thing.values()))
        if isinstance(thing, (list, set)) or type(thing) is tuple:
            return len(thing) + sum(map(count, thing))
        return 0

    return sum(count(value) for value in vars(table).values())


@pytest.mark.parametrize("merging", [True, False], ids=["pulled", "never pulled"])
def test_memory_is_bounded(merging: bool) -> None:
    """10,000 epochs of four legs, pulled or not: what is kept does not grow with them."""
    table, sizes = shared_table(), []
    for epoch in range(10_000):
        for leg in range(4):
            table.push(push(leg, epoch, (4 * epoch, epoch % 12, 1.0)))
        if merging:
            table.pull(table.version, epoch - 1)
        if epoch in (999, 9_999):
            sizes.append(footprint(table))
    assert sizes[0] == sizes[1] <= 8 * 4 * (module.MAX_PENDING + 1)
    table.merge()
    assert table.table.visits.sum() == 40_000


def test_memory_is_bounded_over_many_lives() -> None:
    """A leg that is restarted a thousand times is remembered by its last runs only."""
    table, sizes = shared_table(), []
    for life in range(1_000):
        table.push(push(0, 5, (20, 1, 1.0), run=f"run {life}"))
        table.merge()
        if life in (99, 999):
            sizes.append(footprint(table))
    assert sizes[0] == sizes[1]
    assert not table.push(push(0, 5, (20, 1, 1.0), run="run 999"))
    assert table.table.visits.sum() == 1_000


def test_a_run_that_goes_on_is_not_forgotten() -> None:
    """The run that pushed last is kept, however many others of the leg there were before."""
    table = shared_table()
    for epoch in range(40):
        table.push(push(0, epoch, run="long"))
        table.push(push(0, 0, run=f"short {epoch}"))
    assert not table.push(push(0, 39, (156, 1, 1.0), run="long"))


def test_epochs_that_nobody_pulls_still_count() -> None:
    """The oldest of too many pending epochs is merged early, in order; nothing is dropped."""
    pushes = [push(0, epoch, (4 * epoch, 1, float(epoch))) for epoch in range(200)]
    table = shared_table()
    for each in pushes:
        table.push(each)
    assert 0 < table.table.read(1)[1] < 200
    table.merge()
    assert content(table.table) == content(in_order(pushes))


# -- learning off, and another life of the table -------------------------------------------------


def test_learning_off_drops_what_is_pushed() -> None:
    """Pushes are acknowledged and named as taken, and change nothing, now or later."""
    table = shared_table()
    table.merges_pushes = False
    assert table.push(push(0, 0, (0, 1, 3.0)))
    table.merges_pushes = True
    assert not table.push(push(0, 0, (0, 1, 3.0)))
    assert table.pull(0, 0).cells.tolist() == []
    table.push(push(0, 1, (4, 1, 3.0)))
    assert table.pull(0, 1).cells.tolist() == [1]


def test_learning_off_keeps_refusing_what_is_wrong() -> None:
    """A malformed push is told so whether or not it would count."""
    table = shared_table()
    table.merges_pushes = False
    with pytest.raises(UpdateError):
        table.push(push(0, 0, (0, 99, 3.0)))


@few
@given(history=histories, split=st.integers(0, 12), upto=st.integers(-1, 4))
def test_a_restored_table_goes_on_as_if_it_had_lived(
    history: dict[tuple[int, int], list[tuple[int, int, float]]], split: int, upto: int
) -> None:
    """Table, pending pushes and what was taken: with these three a new life equals the old one."""
    pushes = sorted(pushes_of(history), key=lambda p: (p.epoch, p.leg))
    lived, died = shared_table(), shared_table()
    for table in (lived, died):
        for each in pushes[:split]:
            table.push(each)
        table.merge(upto)
    again = Table(STATES, ACTIONS)
    again.copy_from(died.table)
    reborn = SharedTable(again, legs=4, cells=CELLS, rate=RATE, version=died.version + 1)
    reborn.restore(died.done(), died.pending())
    for each in pushes:
        assert reborn.push(each) == lived.push(each)
    lived.merge()
    reborn.merge()
    assert content(reborn.table) == content(lived.table)
    assert len(reborn.pull(died.version).cells) == len(again)


@few
@given(history=histories, upto=st.integers(-1, 4))
def test_a_preview_merges_nothing(
    history: dict[tuple[int, int], list[tuple[int, int, float]]], upto: int
) -> None:
    """A look at what the table will be: exactly that, and the table goes on as if none had been."""
    table = shared_table()
    for each in pushes_of(history):
        table.push(each)
    table.merge(upto)
    before = repr((table.pending(), table.version, content(table.table)))
    preview = content(table.preview())
    assert repr((table.pending(), table.version, content(table.table))) == before
    table.merge()
    assert content(table.table) == preview


# -- a leg's copy --------------------------------------------------------------------------------


class Machine:
    """Legs with their copies and the table they share, without senses: only the protocol."""

    def __init__(self, legs: int, sync_every: int) -> None:
        self.sync_every = sync_every
        self.shared = shared_table()
        self.copies = [
            LocalCopy(
                Table(STATES, ACTIONS),
                leg=leg,
                run="run",
                cells=CELLS,
                rate=RATE,
                sync_every=sync_every,
            )
            for leg in range(legs)
        ]

    def begin(self, copy: LocalCopy, tick: int) -> None:
        """Let a copy pull what is due at a tick."""
        upto = copy.epoch_to_pull(tick)
        if upto is not None:
            copy.apply(self.shared.pull(copy.version, upto), upto)

    def end(self, copy: LocalCopy, tick: int, *, early: bool = False) -> None:
        """Let a copy push what is due after a tick."""
        copy.close_epoch(tick, early=early)
        while (due := copy.oldest_unacknowledged()) is not None:
            self.shared.push(due)
            copy.acknowledged(due)


# One target a tick and leg, or none where nothing could be learnt.
learnt = st.lists(
    st.lists(
        st.none() | st.tuples(st.integers(0, STATES * ACTIONS - 1), targets), min_size=3, max_size=3
    ),
    max_size=24,
)


@few
@given(ticks=learnt, sync_every=st.sampled_from([1, 2, 7, 32]))
def test_a_copy_is_the_shared_table_and_one_s_own_pairs(
    ticks: list[list[tuple[int, float] | None]], sync_every: int
) -> None:
    """At any time: all updates of the epochs pulled, then one's own since, and no others."""
    machine = Machine(3, sync_every)
    done: dict[int, list[TDUpdate]] = defaultdict(list)
    pushed: list[UpdateBatch] = []
    for tick, updates in enumerate(ticks):
        epoch = tick // sync_every
        for leg, (copy, content_of) in enumerate(zip(machine.copies, updates, strict=True)):
            machine.begin(copy, tick)
            if content_of is not None:
                update = TDUpdate(tick, *content_of)
                copy.learn(update)
                done[leg].append(update)
            wanted = in_order([each for each in pushed if each.epoch < epoch])
            for update in done[leg]:
                if update.tick >= epoch * sync_every:
                    wanted.update(update.cell, update.target, RATE)
            assert content(copy.table) == content(wanted)
            if (tick + 1) % sync_every == 0:
                own = [p for p in done[leg] if p.tick // sync_every == epoch]
                pushed.append(UpdateBatch(leg, "run", epoch, CELLS, tuple(own)))
            machine.end(copy, tick)


@few
@given(
    ticks=st.lists(st.tuples(st.integers(0, STATES * ACTIONS - 1), targets), max_size=40),
    sync_every=st.sampled_from([1, 3, 32]),
)
def test_one_leg_alone_is_plain_q_learning(ticks: list[tuple[int, float]], sync_every: int) -> None:
    """With one leg, sharing changes not a bit: one sequence of updates."""
    machine, plain = Machine(1, sync_every), Table(STATES, ACTIONS)
    (copy,) = machine.copies
    for tick, update in enumerate(ticks):
        machine.begin(copy, tick)
        copy.learn(TDUpdate(tick, *update))
        plain.update(*update, RATE)
        assert content(copy.table) == content(plain)
        machine.end(copy, tick)
    machine.end(copy, len(ticks), early=True)
    machine.shared.merge()
    assert content(machine.shared.table) == content(plain)


@few
@given(ticks=learnt)
def test_every_tick_s_sync_is_one_table(ticks: list[list[tuple[int, float] | None]]) -> None:
    """With ``sync_every = 1`` all legs begin each tick with one table that all have written to."""
    machine, one = Machine(3, 1), Table(STATES, ACTIONS)
    for tick, updates in enumerate(ticks):
        for copy in machine.copies:
            machine.begin(copy, tick)
            assert content(copy.table) == content(one)
        for copy, update in zip(machine.copies, updates, strict=True):
            if update is not None:
                copy.learn(TDUpdate(tick, *update))
                one.update(*update, RATE)
        for copy in machine.copies:
            machine.end(copy, tick)


def test_a_copy_of_its_own_never_syncs() -> None:
    """With ``sync_every = 0`` nothing is due, ever, and updates are plain."""
    copy = LocalCopy(Table(STATES, ACTIONS), leg=0, run="run", cells=CELLS, rate=RATE, sync_every=0)
    plain = Table(STATES, ACTIONS)
    for tick in range(50):
        assert copy.epoch_to_pull(tick) is None
        copy.learn(TDUpdate(tick, tick % 5, float(tick)))
        plain.update(tick % 5, float(tick), RATE)
        copy.close_epoch(tick, early=True)
        assert copy.oldest_unacknowledged() is None
    assert content(copy.table) == content(plain)


def test_a_pull_is_due_once_an_epoch() -> None:
    """Before the first tick, and with the first tick of each epoch that a leg lives to see."""
    machine = Machine(1, 4)
    (copy,) = machine.copies
    due = []
    for tick in (0, 1, 3, 4, 5, 14, 15, 16):
        due.append(copy.epoch_to_pull(tick))
        machine.begin(copy, tick)
    assert due == [-1, None, None, 0, None, 2, None, 3]


def test_a_push_stays_due_until_it_is_acknowledged() -> None:
    """A lost acknowledgement means the same push again, oldest first; others count for nothing."""
    machine = Machine(1, 1)
    (copy,) = machine.copies
    for tick in range(2):
        copy.learn(TDUpdate(tick, 1, 1.0))
        copy.close_epoch(tick)
    first = copy.oldest_unacknowledged()
    assert first == push(0, 0, (0, 1, 1.0))
    assert copy.oldest_unacknowledged() is first
    copy.acknowledged(push(3, 0))
    assert copy.oldest_unacknowledged() is first
    copy.acknowledged(first)
    second = copy.oldest_unacknowledged()
    assert second == push(0, 1, (1, 1, 1.0))
    copy.acknowledged(second)
    assert copy.oldest_unacknowledged() is None


def test_what_is_not_acknowledged_is_kept_over_pulls() -> None:
    """While the table takes no pushes, a leg's own learning stays on top of what it pulls."""
    machine, plain = Machine(1, 1), Table(STATES, ACTIONS)
    (copy,) = machine.copies
    for tick in range(6):
        machine.begin(copy, tick)
        copy.learn(TDUpdate(tick, 1, float(tick)))
        plain.update(1, float(tick), RATE)
        copy.close_epoch(tick)  # and is not sent
        assert content(copy.table) == content(plain)
    machine.end(copy, 6)
    machine.begin(copy, 7)
    assert content(copy.table) == content(machine.shared.table) == content(plain)
    assert copy.oldest_unacknowledged() is None


def test_an_epoch_without_pairs_is_not_pushed() -> None:
    """A leg that learns nothing says nothing."""
    machine = Machine(1, 4)
    (copy,) = machine.copies
    for tick in range(12):
        machine.begin(copy, tick)
        copy.close_epoch(tick)
        assert copy.oldest_unacknowledged() is None


def test_what_the_table_dropped_is_gone_from_the_copy() -> None:
    """With learning off at the table, a leg's copy returns to it with the next pull."""
    machine = Machine(1, 2)
    machine.shared.merges_pushes = False
    (copy,) = machine.copies
    for tick in range(2):
        machine.begin(copy, tick)
        copy.learn(TDUpdate(tick, 1, 5.0))
        machine.end(copy, tick)
    assert copy.table.read(1) == (5.0, 2)
    machine.begin(copy, 2)
    assert content(copy.table) == content(Table(STATES, ACTIONS))


def test_an_epoch_whose_last_tick_was_missed_is_not_lost() -> None:
    """A leg that is away when its epoch ends keeps the updates, over a pull, for its next push."""
    machine, plain = Machine(1, 4), Table(STATES, ACTIONS)
    (copy,) = machine.copies
    for tick in (0, 1, 2, 4, 5, 6, 7, 8, 13):
        machine.begin(copy, tick)
        copy.learn(TDUpdate(tick, tick % 2, float(tick)))
        plain.update(tick % 2, float(tick), RATE)
        assert content(copy.table) == content(plain)
        machine.end(copy, tick)
    machine.end(copy, 13, early=True)
    machine.shared.merge()
    assert content(machine.shared.table) == content(plain)


def test_an_epoch_without_an_answer_is_made_up_for() -> None:
    """A leg that goes on without a pull asks again with the next epoch, and misses nothing."""
    machine, plain = Machine(2, 2), Table(STATES, ACTIONS)
    one, other = machine.copies
    for tick in range(8):
        if tick == 4:
            other.skip_sync(1)
            assert other.epoch_to_pull(5) is None
        for copy in machine.copies:
            machine.begin(copy, tick)
        for copy in machine.copies:
            copy.learn(TDUpdate(tick, 1, float(tick)))
            plain.update(1, float(tick), RATE)
        assert one.table.read(1)[1] == 2 * (tick // 2 * 2) + tick % 2 + 1
        assert other.table.read(1)[1] == one.table.read(1)[1] - (2 if tick in (4, 5) else 0)
        for copy in machine.copies:
            machine.end(copy, tick)
    machine.shared.merge()
    assert content(machine.shared.table) == content(plain)


@pytest.mark.parametrize("first_life", [1, 5, 6, 11])
def test_nothing_is_lost_or_doubled_when_time_begins_anew(first_life: int) -> None:
    """After a restart of the world: the copy is the shared table and what is not yet in it."""
    machine, plain = Machine(1, 2), Table(STATES, ACTIONS)
    (copy,) = machine.copies

    def live(ticks: int) -> None:
        for tick in range(ticks):
            machine.begin(copy, tick)
            copy.learn(TDUpdate(tick, 1, float(tick)))
            plain.update(1, float(tick), RATE)
            assert copy.table.read(1)[1] == plain.read(1)[1]
            machine.end(copy, tick)

    live(first_life)
    copy.reset(first_life - 1, "another life")
    live(14)
    machine.end(copy, 14, early=True)
    machine.shared.merge()
    assert machine.shared.table.read(1)[1] == plain.read(1)[1]


def test_memory_of_a_copy_is_bounded() -> None:
    """10,000 epochs: a copy keeps what is not merged yet, and nothing else."""
    machine, sizes = Machine(2, 2), []
    for tick in range(20_000):
        for copy in machine.copies:
            machine.begin(copy, tick)
            copy.learn(TDUpdate(tick, tick % 12, 1.0))
            machine.end(copy, tick)
        if tick in (1_999, 19_999):
            sizes.append(
                [len(value) for value in vars(copy).values() if isinstance(value, (list, dict))]
            )
    assert sizes[0] == sizes[1]
    assert int(np.sum(machine.shared.table.visits)) >= 39_996
