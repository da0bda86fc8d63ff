"""The Q-table: one rule for one cell, and a file that is whole, right, or refused with a reason."""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import stat
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros.errors import TableError
from ember_ros.params import Params, Rate, as_dict, cells_sha256, params_sha256, replace
from leg_node.assembly import empty_table
from leg_node.table import Table
from leg_node.table_file import load_table, save_table

RATE = Rate(0.1, 1.0)

# A partition of few cells, so that whole files are small.
PARAMS = replace(
    Params(),
    {
        "state.hip_bins": 3,
        "state.force_edges": (0.5,),
        "state.inclination_edges": (-0.5, 0.0),
        "leg.knee_speeds": (-3.0, 0.0, 3.0),
    },
)
finite = st.floats(allow_nan=False, allow_infinity=False, width=64)


def learnt(params: Params = PARAMS) -> Table:
    """Return a table with something in every cell."""
    table = empty_table(params)
    rng = np.random.default_rng(5)
    for cell in range(len(table)):
        for _ in range(cell % 4):
            table.update(cell, float(rng.normal()), RATE)
    return table


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """Return a whole file."""
    file = tmp_path / "table.npz"
    save_table(file, learnt(), PARAMS, seed=3)
    return file


def refusal(file: Path, params: Params = PARAMS) -> str:
    """Return what is said about a file that must be refused; it always names the file."""
    with pytest.raises(TableError) as error:
        load_table(file, params)
    assert str(file) in str(error.value)
    return str(error.value)


# -- cells -------------------------------------------------------------------------------------


def test_an_empty_table_knows_nothing() -> None:
    """Every value and every count begins at 0, for the partition of the parameters."""
    table = empty_table(Params())
    assert (table.states, table.actions) == (17 * 8 * 8 * 2 * 2, 9)
    assert len(table) == table.states * table.actions == 39_168
    assert not table.values.any()
    assert not table.visits.any()


def test_update_is_a_mean_until_the_floor() -> None:
    """With 1 / N the value is the mean of its targets; from the floor on it forgets the oldest."""
    table = Table(1, 1)
    for n, target in enumerate((4.0, 2.0, 6.0, 8.0), start=1):
        table.update(0, target, Rate(0.0, 1.0))
        assert table.read(0) == ([4.0, 3.0, 4.0, 5.0][n - 1], n)
    table.update(0, 9.0, Rate(0.5, 1.0))
    assert table.read(0) == (7.0, 5)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    targets=st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=30),
    bounds=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)).map(sorted),
)
def test_update_rule_is_exact(targets: list[float], bounds: list[float]) -> None:
    """``N += 1; Q += alpha (target - Q)``, 1 / N in its bounds, bit for bit; all else stays.

    What is returned is the error: the target less the value before.
    """
    table, value, rate = Table(3, 2), 0.0, Rate(*bounds)
    for n, target in enumerate(targets, start=1):
        assert table.update(3, target, rate) == target - value
        value += min(rate.ceiling, max(rate.floor, 1.0 / n)) * (target - value)
        assert table.read(3) == (value, n)
    assert min(0.0, *targets) - 1e-9 <= value <= max(0.0, *targets) + 1e-9
    others = [0, 1, 2, 4, 5]
    assert not table.values[others].any()
    assert not table.visits[others].any()


def test_equal_bounds_are_a_constant_rate() -> None:
    """The paper's rule: every target moves the value by the same share of the way."""
    table = Table(1, 1)
    for value in (0.25, 0.4375, 0.578125):
        table.update(0, 1.0, Rate(0.25, 0.25))
        assert table.read(0)[0] == value


def test_the_first_target_is_taken_whole() -> None:
    """What stood in a cell that nobody visited does not count: 1 / N is 1."""
    table = Table(1, 1)
    table.write(0, 123.0, 0)
    table.update(0, 0.5, RATE)
    assert table.read(0) == (0.5, 1)


def test_rows_cells_and_arrays_are_one_memory() -> None:
    """A row is a copy of plain floats; cells and arrays show the same content."""
    table = Table(2, 3)
    table.write(4, 0.25, 7)
    row = table.row(1)
    assert row == [0.0, 0.25, 0.0]
    assert {type(x) for x in row} == {float}
    assert table.values[4] == 0.25
    assert table.visits[4] == 7
    row[0] = 9.0
    assert table.row(1) == [0.0, 0.25, 0.0]
    table.values[3] = 0.5
    assert table.read(3) == (0.5, 0)


def test_a_copy_is_a_copy() -> None:
    """After ``copy_from`` the two tables are equal and independent."""
    one, other = learnt(), empty_table(PARAMS)
    other.copy_from(one)
    assert other.sha256() == one.sha256()
    other.update(1, 5.0, RATE)
    assert other.sha256() != one.sha256() == learnt().sha256()


def test_hash_sees_every_bit() -> None:
    """One last bit of a value, one visit, or another shape of the same cells: another hash."""
    hashes = {learnt().sha256()}
    for change in range(4):
        table = learnt()
        if change == 0:
            table.values[7] = np.nextafter(table.values[7], 9.0)
        elif change == 1:
            table.visits[7] += 1
        elif change == 2:
            table.values[0] = -0.0
        else:
            other = Table(table.actions, table.states)
            other.copy_from(table)
            table = other
        hashes.add(table.sha256())
    assert len(hashes) == 5


# -- a whole file --------------------------------------------------------------------------------


def test_round_trip_is_exact(saved: Path) -> None:
    """What is read is what was written, to the last bit, and again writable."""
    table, _ = load_table(saved, PARAMS)
    assert table.values.tobytes() == learnt().values.tobytes()
    assert table.visits.tobytes() == learnt().visits.tobytes()
    assert table.sha256() == learnt().sha256()
    table.update(0, 1.0, RATE)
    assert table.read(0) == (1.0, 1)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(values=st.lists(finite, min_size=216, max_size=216), visits=st.integers(0, 2**62))
def test_round_trip_of_any_finite_values(
    values: list[float], visits: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Negative zeros, subnormals and the largest doubles come back as they were."""
    table = empty_table(PARAMS)
    table.values[:] = values
    table.visits[:] = visits
    file = tmp_path_factory.mktemp("any") / "table.npz"
    save_table(file, table, PARAMS, seed=0)
    assert load_table(file, PARAMS)[0].values.tobytes() == table.values.tobytes()


def test_a_file_says_where_it_came_from(saved: Path) -> None:
    """Parameters, seed, version and hashes are in the file, beside the notes given."""
    save_table(saved, learnt(), PARAMS, seed=3, notes={"cycles": 20})
    _, about = load_table(saved, PARAMS)
    assert about["seed"] == 3
    assert about["cycles"] == 20
    assert about["params"] == as_dict(PARAMS)
    assert about["params_sha256"] == params_sha256(PARAMS)
    assert about["cells_sha256"] == cells_sha256(PARAMS)
    assert about["table_sha256"] == learnt().sha256()
    assert about["version"]


def test_notes_cannot_overwrite_what_is_known(saved: Path) -> None:
    """A note named like a fact does not stand in for it."""
    save_table(saved, learnt(), PARAMS, seed=3, notes={"seed": 99, "table_sha256": "0"})
    assert load_table(saved, PARAMS)[1]["seed"] == 3


def test_a_file_is_readable_without_this_package(saved: Path) -> None:
    """It is plain numpy: (states, actions) arrays and a JSON text; others may read it."""
    with np.load(saved, allow_pickle=False) as content:
        assert set(content) == {"values", "visits", "about"}
        assert content["values"].shape == content["visits"].shape == (72, 3)
        json.loads(str(content["about"]))
    assert stat.S_IMODE(saved.stat().st_mode) == 0o644


def test_folders_are_made(tmp_path: Path) -> None:
    """The place to save to need not be there yet."""
    file = tmp_path / "a" / "b" / "table.npz"
    save_table(file, learnt(), PARAMS, seed=0)
    assert load_table(file, PARAMS)[0].sha256() == learnt().sha256()
    assert list(file.parent.iterdir()) == [file]


def test_numbers_that_define_no_cell_may_differ(saved: Path) -> None:
    """A table learnt on the trainer is used with another body: only cells must mean the same."""
    other = replace(PARAMS, {"walker.mass": 7.0, "walk.gamma": 0.5, "gait.hip_front": 0.6})
    assert load_table(saved, other)[0].sha256() == learnt().sha256()


# -- whole or not at all -------------------------------------------------------------------------


def fail(error: BaseException) -> Callable[..., None]:
    """Return a function that raises, after it has written a little where it was asked to."""

    def half(out: Any, *_: Any, **__: Any) -> None:
        if hasattr(out, "write"):
            out.write(b"PK half of a file")
        raise error

    return half


@pytest.mark.parametrize("where", ["savez_compressed", "fsync", "replace", "chmod"])
def test_an_error_while_writing_leaves_the_old_file(
    saved: Path, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk at any point: a TableError with file and reason, the old table, no litter."""
    before = saved.read_bytes()
    target = "numpy" if where == "savez_compressed" else "os"
    monkeypatch.setattr(f"{target}.{where}", fail(OSError(28, "No space left on device")))
    with pytest.raises(TableError, match=rf"{re.escape(str(saved))}.*No space left"):
        save_table(saved, empty_table(PARAMS), PARAMS, seed=4)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError()])
def test_an_interruption_while_writing_leaves_the_old_file(
    saved: Path, error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the middle goes on as it is, and leaves the old table and no litter."""
    before = saved.read_bytes()
    monkeypatch.setattr("numpy.savez_compressed", fail(error))
    with pytest.raises(type(error)):
        save_table(saved, empty_table(PARAMS), PARAMS, seed=4)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_notes_that_are_no_json_leave_the_old_file(saved: Path) -> None:
    """A note that cannot be written down is refused before the old table is touched."""
    before = saved.read_bytes()
    with pytest.raises((TableError, TypeError)):
        save_table(saved, empty_table(PARAMS), PARAMS, seed=4, notes={"wrong": object()})
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_a_place_that_cannot_be_written_to(tmp_path: Path) -> None:
    """A file where a folder should be, or a folder where the file should be: a TableError."""
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file" / "table.npz", tmp_path):
        with pytest.raises(TableError, match=re.escape(str(place))):
            save_table(place, learnt(), PARAMS, seed=0)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# -- what is no whole table ----------------------------------------------------------------------


class Content(NamedTuple):
    """What a file may hold instead of a table."""

    values: Any
    visits: Any
    about: Any


def rewrite(file: Path, change: Callable[[Content], Content]) -> None:
    """Write a file anew with something of its content changed."""
    with np.load(file, allow_pickle=False) as content:
        old = Content(content["values"], content["visits"], json.loads(str(content["about"])))
    values, visits, about = change(old)
    text = about if isinstance(about, np.ndarray) else np.array(json.dumps(about))
    np.savez_compressed(file, values=values, visits=visits, about=text)


def test_rewriting_alone_changes_nothing(saved: Path) -> None:
    """The tests below fail for what they change, not for how they change it."""
    rewrite(saved, lambda content: content)
    assert load_table(saved, PARAMS)[0].sha256() == learnt().sha256()


def test_missing(tmp_path: Path) -> None:
    """Somebody who has not trained yet is told how to."""
    assert "ember train" in refusal(tmp_path / "none.npz")


def test_a_folder_is_no_table(tmp_path: Path) -> None:
    """A folder's name instead of a file's is refused like any other wrong file."""
    refusal(tmp_path)


def test_truncated(saved: Path) -> None:
    """A file cut off anywhere, from empty to its last byte, is refused with a reason."""
    whole = saved.read_bytes()
    for length in (*range(0, len(whole), max(1, len(whole) // 60)), len(whole) - 1):
        saved.write_bytes(whole[:length])
        assert "not a whole" in refusal(saved)


def test_flipped_bit(saved: Path) -> None:
    """One bit wrong anywhere: refused, or it was in a place that means nothing. Never wrong."""
    whole = saved.read_bytes()
    refused = 0
    for place in range(0, len(whole), max(1, len(whole) // 400)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        saved.write_bytes(damaged)
        try:
            table, _ = load_table(saved, PARAMS)
        except TableError as error:
            message = str(error)
            refused += 1
        else:
            message = str(saved)
            assert table.sha256() == learnt().sha256()
        assert str(saved) in message
    assert refused > 200


@pytest.mark.parametrize(
    "content",
    [b"not a table", pickle.dumps({"values": 1}), b"\x93NUMPY", b"PK\x03\x04", bytes(1000), b"{}"],
    ids=["text", "pickle", "npy", "zip", "zeros", "json"],
)
def test_foreign_bytes(tmp_path: Path, content: bytes) -> None:
    """A file of another kind under the right name is refused."""
    file = tmp_path / "table.npz"
    file.write_bytes(content)
    assert "not a whole" in refusal(file)


def test_a_single_array_is_no_table(tmp_path: Path) -> None:
    """A file that numpy reads, but as one array, is refused."""
    file = tmp_path / "table.npz"
    with file.open("wb") as out:
        np.save(out, learnt().values)
    assert "not a whole" in refusal(file)


def test_a_foreign_npz(tmp_path: Path) -> None:
    """An .npz of somebody else, or of a part of a table, is refused by what it lacks."""
    file = tmp_path / "table.npz"
    np.savez(file, weights=np.zeros(3))
    assert "values" in refusal(file)
    np.savez(file, values=learnt().values.reshape(72, 3), visits=learnt().visits.reshape(72, 3))
    assert "about" in refusal(file)


def test_a_zip_of_other_files(tmp_path: Path) -> None:
    """Members that are no arrays are refused."""
    file = tmp_path / "table.npz"
    with zipfile.ZipFile(file, "w") as archive:
        for name in Content._fields:
            archive.writestr(name, b"text")
    refusal(file)


class Bomb:
    """An object whose unpickling would be noticed."""

    went_off = False

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        """Tell pickle to call ``explode``."""
        return explode, ()


def explode() -> None:
    """Note that pickled code was run."""
    Bomb.went_off = True


def pickled(*, alone: bool) -> bytes:
    """Return an array of objects as numpy writes it, alone or as the values of a table."""
    bomb = np.empty(1, dtype=object)
    bomb[0] = Bomb()
    out = io.BytesIO()
    if alone:
        np.save(out, bomb, allow_pickle=True)
    else:
        np.savez(out, values=bomb, visits=bomb, about=bomb)
    return out.getvalue()


@pytest.mark.parametrize(
    "content",
    [pickle.dumps(Bomb()), pickled(alone=True), pickled(alone=False)],
    ids=["pickle", "npy", "npz"],
)
def test_pickled_content_is_never_run(tmp_path: Path, content: bytes) -> None:
    """A table from a stranger cannot run code: ``allow_pickle`` stays off."""
    file = tmp_path / "table.npz"
    file.write_bytes(content)
    Bomb.went_off = False
    refusal(file)
    assert not Bomb.went_off


WRONG: dict[str, tuple[Callable[[Content], Content], str]] = {
    "values turned": (lambda c: c._replace(values=c.values.T), "values (3, 72)"),
    "values flat": (lambda c: c._replace(values=c.values.reshape(-1)), "values (216,)"),
    "visits short": (lambda c: c._replace(visits=c.visits[:-1]), "visits (71, 3)"),
    "visits a number": (lambda c: c._replace(visits=np.zeros(())), "visits ()"),
    "values single": (lambda c: c._replace(values=c.values.astype(np.float32)), "float32"),
    "values complex": (lambda c: c._replace(values=c.values.astype(complex)), "complex128"),
    "values text": (lambda c: c._replace(values=c.values.astype(str)), "<U"),
    "visits floats": (lambda c: c._replace(visits=c.visits * 1.0), "float64 and float64"),
    "visits unsigned": (lambda c: c._replace(visits=c.visits.astype(np.uint64)), "uint64"),
    "visits negative": (lambda c: c._replace(visits=c.visits - 1), "negative visits"),
    "a NaN": (lambda c: c._replace(values=np.where(c.visits, c.values, np.nan)), "not finite"),
    "an infinity": (lambda c: c._replace(values=c.values / c.visits.min()), "not finite"),
    "a last bit": (lambda c: c._replace(values=np.nextafter(c.values, 9.0)), "damaged"),
    "rows reversed": (lambda c: c._replace(values=c.values[::-1]), "damaged"),
    "other visits": (lambda c: c._replace(visits=c.visits + 1), "damaged"),
    "other hash": (lambda c: c._replace(about={**c.about, "table_sha256": "0"}), "damaged"),
    "other cells": (lambda c: c._replace(about={**c.about, "cells_sha256": "0"}), "another part"),
    "about nothing": (lambda c: c._replace(about={}), "another partition"),
    "about no JSON": (lambda c: c._replace(about=np.array("no JSON")), "not a whole"),
    "about empty": (lambda c: c._replace(about=np.array("")), "not a whole"),
    "about numbers": (lambda c: c._replace(about=np.zeros(3)), "not a whole"),
    "about a number": (lambda c: c._replace(about=5), "not a whole"),
    "about a list": (lambda c: c._replace(about=["cells_sha256"]), "not a whole"),
    "about null": (lambda c: c._replace(about=None), "not a whole"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_content_is_refused_with_its_reason(saved: Path, name: str) -> None:
    """Whatever part of a table is not as it should be, the message says which."""
    change, reason = WRONG[name]
    with np.errstate(all="ignore"):
        rewrite(saved, change)
    assert reason in refusal(saved)


@pytest.mark.parametrize(
    "change",
    [
        {"state.hip_low": -0.51},
        {"state.force_edges": (0.51,)},
        {"leg.load": 24.0},
        {"leg.knee_speeds": (-3.0, 0.0, 4.0)},
        {"gait.stance_share": 0.5},
    ],
)
def test_another_meaning_of_the_cells(saved: Path, change: dict[str, Any]) -> None:
    """A table of the same size but learnt with other edges, load or speeds is refused."""
    assert "another partition" in refusal(saved, replace(PARAMS, change))


@pytest.mark.parametrize(
    "change",
    [
        {"parts.reward": "mine.Reward"},
        {"parts.learner": "leg_node.sarsa.SarsaLambda"},
        {"parts.value": "leg_node.value.TableValues"},
        {"parts.gait": "mine.Gait"},
    ],
)
def test_another_part_is_told(saved: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    """What another reward or learner has learnt is refused, and the message says of what."""
    assert "other parts" in refusal(saved, replace(PARAMS, change))
    params = replace(PARAMS, change)
    file = tmp_path / "other.npz"
    save_table(file, learnt(), params, 3)
    assert "other parts" in refusal(file)
    assert load_table(file, params)[0].sha256() == learnt().sha256()


def test_another_oscillator_reads_the_same_table(saved: Path) -> None:
    """A table says what to do at a phase, whoever makes it."""
    params = replace(PARAMS, {"parts.cpg": "mine.Hopf"})
    assert load_table(saved, params)[0].sha256() == learnt().sha256()


def test_another_number_of_cells(saved: Path) -> None:
    """A table of another size is refused with both sizes."""
    reason = refusal(saved, replace(PARAMS, {"state.hip_bins": 4}))
    assert "(72, 3)" in reason
    assert "(96, 3)" in reason


# -- files that lie ------------------------------------------------------------------------------


def npy(descr: str, shape: str, data: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    """Return an array's file that says what it is told to say."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + data


def packed(file: Path, name: str, data: bytes, how: int = zipfile.ZIP_DEFLATED) -> None:
    """Put other bytes in the place of one member of a table's file."""
    with zipfile.ZipFile(file) as old:
        members = {each: old.read(each) for each in old.namelist()}
    members[f"{name}.npy"] = data
    with zipfile.ZipFile(file, "w", how) as new:
        for each, content in members.items():
            new.writestr(each, content)


def declare(file: Path, name: str, size: int) -> None:
    """Let the zip directory name another size for a member than it has."""
    data = bytearray(file.read_bytes())
    at = data.rindex(f"{name}.npy".encode()) - 46
    assert data[at : at + 4] == b"PK\x01\x02"
    data[at + 24 : at + 28] = struct.pack("<I", size)
    file.write_bytes(data)


def bomb(file: Path, size: int, shape: str) -> None:
    """Let much more be packed as values than the directory and the header name."""
    packed(file, "values", npy("'<f8'", shape, bytes(HUGE)))
    declare(file, "values", size)


def instead(file: Path, make: Callable[[Path], object]) -> None:
    """Put something else in a file's place."""
    file.unlink()
    make(file)


HUGE = 64 << 20
LIES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a bomb": (lambda f: packed(f, "values", npy("'<f8'", f"({HUGE // 8},)", bytes(HUGE))), "need"),
    "a bomb that says so": (
        lambda f: packed(f, "about", npy(f"'<U{HUGE // 4}'", "()", bytes(HUGE))), "up to 1048576"
    ),
    "a bomb said to be small": (lambda f: bomb(f, 100, "(9, 9)"), "Bad CRC-32"),
    "a bomb in the right shape": (
        lambda f: bomb(f, 72 * 3 * 8 + len(npy("'<f8'", "(72, 3)")), "(72, 3)"), "Bad CRC-32"
    ),
    "packed by bzip2": (lambda f: packed(f, "values", bytes(HUGE), zipfile.ZIP_BZIP2), "deflate"),
    "packed by lzma": (lambda f: packed(f, "values", bytes(HUGE), zipfile.ZIP_LZMA), "deflate"),
    "a shape beyond all memory": (
        lambda f: packed(f, "values", npy("'<f8'", f"({10**15}, 9)")), "but its header states"
    ),
    "an item beyond all memory": (
        lambda f: packed(f, "about", npy("'<U99999999'", "()")), "but its header states"
    ),
    "digits": (lambda f: packed(f, "values", npy("'<f8'", f"({'9' * 9000},)")), "not a whole"),
    "Python": (lambda f: packed(f, "values", npy("'<f8'", "(" * 9000)), "not a plain array"),
    "a record": (
        lambda f: packed(f, "values", npy("[('a', '<f8')]", "(9,)", bytes(72))), "not a plain array"
    ),
    "objects": (lambda f: packed(f, "values", npy("'|O'", "()", bytes(8))), "Python objects"),
    "a version with a long header": (
        lambda f: packed(f, "values", npy("'<f8'", "()", bytes(8), b"\x02\x00")),
        "not a plain array",
    ),
    "deep JSON": (
        lambda f: rewrite(f, lambda c: c._replace(about=np.array("[" * 100_000))), "too deeply"
    ),
    "a number of many digits": (
        lambda f: rewrite(f, lambda c: c._replace(about=np.array("9" * 100_000))), "not a whole"
    ),
    "a long file": (lambda f: f.write_bytes(f.read_bytes() + bytes(HUGE)), "bytes; up to"),
    "a long file of nothing": (lambda f: os.truncate(f, 1 << 40), "bytes; up to"),
    "a pipe": (lambda f: instead(f, os.mkfifo), "not a regular file"),
    "a device": (lambda f: instead(f, lambda f: f.symlink_to("/dev/zero")), "not a regular file"),
    "a link to itself": (lambda f: instead(f, lambda f: f.symlink_to(f)), "not a whole"),
}  # fmt: skip


@pytest.mark.parametrize("name", LIES)
@pytest.mark.slow
def test_a_file_that_lies_is_refused_before_it_is_unpacked(saved: Path, name: str) -> None:
    """Whatever a file says of its size: it costs neither time nor memory, and has one line."""
    spoil, reason = LIES[name]
    spoil(saved)
    tracemalloc.start()
    try:
        said = refusal(saved)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert reason in said
    assert len(said) < 500
    assert "\n" not in said
    assert most < HUGE / 8


def test_a_member_that_is_there_twice_is_refused(saved: Path) -> None:
    """Which of the two were the table?"""
    with zipfile.ZipFile(saved, "a") as content, pytest.warns(UserWarning, match="Duplicate"):
        content.writestr("values.npy", content.read("values.npy"))
    assert "2 members values" in refusal(saved)


def test_a_table_that_was_packed_again_is_read(saved: Path) -> None:
    """Other zip tools, other orders of an array and a link to the file are as good."""
    rewrite(saved, lambda c: c._replace(values=np.asfortranarray(c.values)))
    with zipfile.ZipFile(saved) as old:
        members = {each: old.read(each) for each in reversed(old.namelist())}
    link = saved.with_name("link.npz")
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_STORED) as new:
        for each, content in members.items():
            new.writestr(each, content)
    link.symlink_to(saved)
    assert load_table(link, PARAMS)[0].sha256() == learnt().sha256()
