"""The store of the shared table: every push that was acknowledged is there once, or it is said."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros.errors import TableError, UpdateError
from ember_ros.params import Rate
from ember_ros.signals import TDUpdate
from leg_node.durable_table import MAX_AHEAD, MAX_PENDING_PUSHES, MAX_RUNS_PER_LEG, DurableTable
from leg_node.shared import UpdateBatch
from leg_node.store import APPLICATION_ID, ENDINGS, MAX_PUSHES, TableStore
from leg_node.table import Table
from support.waiting import DEADLINE_S

STATES, ACTIONS, CELLS = 4, 3, "cells"
SYNC_EVERY = 8
numbers = st.integers(0, 2**62)
finite = st.floats(-1e12, 1e12)


def push(leg: int, epoch: int, *updates: tuple[int, int, float], run: str = "run") -> UpdateBatch:
    """Return a push."""
    return UpdateBatch(leg, run, epoch, CELLS, tuple(TDUpdate(*each) for each in updates))


def store_at(folder: Path, durability: str = "normal") -> TableStore:
    """Open the store of a table in a folder."""
    return TableStore(folder / "table.npz", CELLS, durability)


def durable(table: Table, store: TableStore | None = None, life: int = 1) -> DurableTable:
    """Return a table of four legs."""
    return DurableTable(
        table,
        legs=4,
        cells=CELLS,
        rate=Rate(0.1, 1.0),
        sync_every=SYNC_EVERY,
        life=life,
        store=store,
    )


@pytest.fixture
def store(tmp_path: Path) -> Iterator[TableStore]:
    """Return a store with an empty table."""
    store = store_at(tmp_path)
    store.checkpoint(Table(STATES, ACTIONS), [])
    yield store
    store.close()


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    updates=st.lists(st.tuples(st.integers(0, 2**62), st.integers(0, 2**62), finite), max_size=4)
)
@pytest.mark.parametrize("durability", ["normal", "full"])
def test_a_store_keeps_every_bit(
    updates: list[tuple[int, int, float]],
    durability: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """A push read from a store is the push that was written, its floats to the last bit."""
    folder = tmp_path_factory.mktemp("store")
    written = push(2, 5, *updates, run='a run, "quoted"')
    table = Table(STATES, ACTIONS)
    table.write(3, -0.0, 2)
    with closing(store_at(folder, durability)) as store:
        assert store.load(STATES, ACTIONS) is None
        store.checkpoint(table, [])
        store.add(written)
    with closing(store_at(folder)) as store:
        stored = store.load(STATES, ACTIONS)
        assert stored is not None
        assert store.pushes == 1
    assert stored.pushes == [written]
    assert repr(stored.pushes) == repr([written])  # which tells -0.0 from 0.0
    assert stored.runs == {(2, written.run): 5}
    assert stored.table.sha256() == table.sha256()


def test_a_checkpoint_replaces_pushes_and_keeps_what_waits(store: TableStore) -> None:
    """What is merged is in the table; runs are remembered, so that no push counts twice."""
    pushes = [push(leg, epoch, (epoch, 2, 0.5)) for epoch in (0, 1) for leg in (0, 1)]
    for each in pushes:
        store.add(each)
    table = Table(STATES, ACTIONS)
    table.write(2, 0.5, 2)
    store.checkpoint(table, pushes[2:])
    assert store.pushes == 0
    stored = store.load(STATES, ACTIONS)
    assert stored is not None
    assert (stored.pushes, stored.table.read(2)) == (pushes[2:], (0.5, 2))
    assert stored.runs == {(0, "run"): 1, (1, "run"): 1}


def test_a_store_has_one_owner(store: TableStore, tmp_path: Path) -> None:
    """Another process with the same file would lose half of what is pushed."""
    with pytest.raises(TableError, match=r"table\.npz\.store belongs to another table_node"):
        store_at(tmp_path)
    store.add(push(0, 0))
    store.close()
    store_at(tmp_path).close()


def test_a_removed_store_leaves_nothing(store: TableStore, tmp_path: Path) -> None:
    """After a regular end the table's own file holds everything."""
    store.add(push(0, 0))
    assert list(tmp_path.iterdir())
    store.remove()
    assert list(tmp_path.iterdir()) == []


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
import test_store
store = test_store.store_at(Path(sys.argv[1]))
table = test_store.durable(test_store.Table(4, 3), store)
table.checkpoint()
for n in range(10**9):
    table.push(test_store.push(n % 4, n // 4, (n // 4 * 8, n % 12, n / 7)))
    if n % 40 == 39:
        table.merge(n // 4 - 1)
    if n % 100 == 99:
        table.checkpoint()
    print(n, flush=True)
"""


@pytest.mark.parametrize("after", [0, 1, 57, 99, 100, 331])
def test_what_was_acknowledged_survives_kill_9(tmp_path: Path, after: int) -> None:
    """Killed right after an acknowledgement, in whatever it does next: each push is there once."""
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path), "-", str(Path(__file__).parent)],
        stdout=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdout is not None
        acknowledged = -1
        for line in child.stdout:
            acknowledged = int(line)
            if acknowledged >= after:
                child.send_signal(signal.SIGKILL)
                break
        acknowledged = max([acknowledged, *map(int, child.stdout.read().split())])
        assert child.wait(DEADLINE_S) == -signal.SIGKILL
    with closing(store_at(tmp_path)) as store:
        stored = store.load(STATES, ACTIONS)
        assert stored is not None
        table = durable(stored.table, store)
        table.resume(stored)
        table.merge()
        there = table.table.visits.sum()
        assert acknowledged + 1 <= there <= acknowledged + 2  # the one in hand may be there
        for n in range(there):
            assert not table.push(push(n % 4, n // 4, (n // 4 * 8, n % 12, n / 7)))
    expected = durable(Table(STATES, ACTIONS))
    for n in range(there):
        expected.push(push(n % 4, n // 4, (n // 4 * 8, n % 12, n / 7)))
    expected.merge()
    assert table.table.sha256() == expected.table.sha256()


@pytest.mark.parametrize("size", [0, 1, 100, 4096, 5000])
def test_a_store_cut_off_is_refused_or_new(store: TableStore, tmp_path: Path, size: int) -> None:
    """A file that is not whole is refused with its name; an empty one is a new store."""
    store.add(push(0, 0, (1, 2, 0.5)))
    store.close()
    store.file.write_bytes(store.file.read_bytes()[:size])
    if size == 0:
        with closing(store_at(tmp_path)) as other:
            assert other.load(STATES, ACTIONS) is None
        return
    with (
        pytest.raises(TableError, match=r"table\.npz\.store"),
        closing(store_at(tmp_path)) as other,
    ):
        other.load(STATES, ACTIONS)


def test_a_file_of_somebody_else_is_refused_and_stays(tmp_path: Path) -> None:
    """Text, another database, and one with a trap in its schema."""
    file = tmp_path / f"table.npz{ENDINGS[0]}"
    file.write_text("not a database, but long enough to be taken for one\n" * 100)
    before = file.read_bytes()
    with pytest.raises(TableError, match="is damaged"):
        store_at(tmp_path)
    assert file.read_bytes() == before
    file.unlink()
    for script in (
        "CREATE TABLE bookmarks (url TEXT)",
        f"PRAGMA application_id = {APPLICATION_ID}; CREATE TABLE push (leg INTEGER)",
        f"PRAGMA application_id = {APPLICATION_ID}; CREATE VIEW push AS SELECT 1",
    ):
        with closing(sqlite3.connect(file)) as database:
            database.executescript(script)
        with pytest.raises(TableError, match="is not a database of this package"):
            store_at(tmp_path)
        file.unlink()


def test_a_store_of_other_cells_is_refused(store: TableStore, tmp_path: Path) -> None:
    """Of another meaning, or of another number."""
    store.close()
    for name, states in ((CELLS, 5), ("others", STATES)):
        with (
            closing(TableStore(tmp_path / "table.npz", name)) as other,
            pytest.raises(TableError, match="gave the cells another meaning"),
        ):
            other.load(states, ACTIONS)


# -- disk faults ---------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["removed", "replaced", "folder removed"])
def test_a_push_is_not_acknowledged_into_a_file_that_is_gone(
    store: TableStore, tmp_path: Path, fault: str
) -> None:
    """What is written to a file without a name cannot be found again."""
    table = durable(Table(STATES, ACTIONS), store)
    assert table.push(push(0, 0, (1, 2, 0.5)))
    if fault == "folder removed":
        shutil.rmtree(tmp_path)
    else:
        store.file.unlink()
    if fault == "replaced":
        store.file.write_bytes(b"")
    with pytest.raises(TableError, match=r"cannot write .*table\.npz\.store"):
        table.push(push(1, 0, (1, 3, 0.5)))
    assert [each.leg for each in table.pending()] == [0]


def test_a_full_disk_refuses_a_push_whole_and_takes_it_later(
    store: TableStore, tmp_path: Path
) -> None:
    """The limit of a file's size stands for the disk's: nothing is taken that is not stored."""
    table = durable(Table(STATES, ACTIONS), store)
    table.checkpoint()
    pushes = [
        push(0, epoch, *((epoch * SYNC_EVERY + n, n, 0.5) for n in range(SYNC_EVERY)))
        for epoch in range(2000)
    ]
    store._database.execute("PRAGMA max_page_count = 8").fetchone()
    taken = 0
    with contextlib.suppress(TableError):
        for taken, each in enumerate(pushes):  # noqa: B007  it is where it stops
            table.push(each)
    assert 0 < taken < len(pushes) - 1
    with pytest.raises(TableError, match="full"):
        table.push(pushes[taken])
    assert table.pending() == pushes[:taken]
    store._database.execute("PRAGMA max_page_count = 100000").fetchone()
    assert table.push(pushes[taken])
    store.close()
    with closing(store_at(tmp_path)) as other:
        found = other.load(STATES, ACTIONS)
        assert found is not None
        assert found.pushes == pushes[: taken + 1]


def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    """Before anything is learned that could not be stored."""
    (tmp_path / "file").write_text("")
    with pytest.raises(TableError, match=os.strerror(errno.EEXIST)):
        store_at(tmp_path / "file")
    with pytest.raises(TableError, match="cannot open /proc"):
        store_at(Path("/proc/nope"))


# -- bounds --------------------------------------------------------------------------------------


def test_a_checkpoint_is_made_when_it_is_due(store: TableStore) -> None:
    """The store's size is bounded by that, not by the length of the run."""
    table = durable(Table(STATES, ACTIONS), store)
    for epoch in range(MAX_PUSHES + 1):
        table.push(push(0, epoch, (epoch * SYNC_EVERY, 2, 0.5)))
        table.merge(epoch)
    assert store.pushes == 1
    stored = store.load(STATES, ACTIONS)
    assert stored is not None
    assert stored.table.visits.sum() == MAX_PUSHES
    assert len(stored.pushes) == 1


def test_pushes_that_nobody_pulls_do_not_pile_up() -> None:
    """Many runs push the same epoch: more than the bound are merged before their turn."""
    table = durable(Table(STATES, ACTIONS))
    for n in range(2 * MAX_PENDING_PUSHES):
        table.push(push(n % 4, 0, (1, 2, 0.5), run=str(n)))
    assert len(table.pending()) <= MAX_PENDING_PUSHES
    table.merge()
    assert table.table.visits.sum() == 2 * MAX_PENDING_PUSHES


def test_a_repeated_push_never_counts_twice_whatever_runs_come_between() -> None:
    """Runs are not forgotten; of too many, the further ones are refused."""
    table = durable(Table(STATES, ACTIONS))
    first = push(0, 0, (1, 2, 0.5), run="first")
    assert table.push(first)
    for n in range(MAX_RUNS_PER_LEG - 1):
        table._runs[0, str(n)] = 0
    with pytest.raises(UpdateError, match=f"knows {MAX_RUNS_PER_LEG} runs"):
        table.push(push(0, 0, run="one more"))
    assert table.push(push(1, 0, run="of another leg"))
    assert not table.push(first)


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (push(0, 5 + MAX_AHEAD + 1), "the newest epoch of all legs is 5"),
        (push(0, 2**62), "the newest epoch of all legs is 5"),
        (push(0, 6, *((50, 2, 0.5),) * 129), "129 updates; up to 128 would be right"),
        (push(0, 6, (56, 2, 0.5)), "tick 56 is after this epoch of 8 ticks"),
        (push(0, 6, (50, 2, 1e13)), "the target of cell 2 is 10000000000000.0"),
    ],
)
def test_a_push_beyond_its_bounds_is_refused_and_silences_nobody(
    bad: UpdateBatch, why: str
) -> None:
    """The leg whose name it bears goes on pushing."""
    table = durable(Table(STATES, ACTIONS))
    assert table.push(push(0, 5, (40, 2, 0.5)))
    with pytest.raises(UpdateError, match=why):
        table.push(bad)
    assert table.push(push(0, 6, (48, 2, 0.5)))
    table.merge()
    assert table.table.visits.sum() == 2


def test_a_version_of_another_process_gets_the_whole_table() -> None:
    """Versions are no times: a clock that is set back hides no change from a leg."""
    first, second = (durable(Table(STATES, ACTIONS), life=life) for life in (2**22 - 1, 1))
    for table in (first, second):
        table.push(push(0, 0, (1, 2, 0.5)))
    version = first.pull(None, 0).version
    assert first.is_own(version)
    assert first.pull(version, 1).cells.tolist() == []
    assert second.pull(version, 0).cells.tolist() == list(range(STATES * ACTIONS))
