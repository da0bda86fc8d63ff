"""Bags that lie, in the ways that were thought of; and mutants of every file that is read."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import sqlite3
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

if any(find_spec(name) is None for name in ("rosbags", "mcap")):
    pytest.skip("mcap or rosbags is missing", allow_module_level=True)

import yaml
import zstandard

import mutate
from ember_ros import cdr
from ember_ros.bag import guard
from ember_ros.bag.guard import load_yaml
from ember_ros.bag.reader import Bag
from ember_ros.bag.repair import repair
from ember_ros.bag.storage import INFORMATION, METADATA
from ember_ros.errors import BagError, EmberError, SignalError, shown
from support.command import child

MUTATE = Path(__file__).parent / "mutate.py"
MUTANTS = 400
DEADLINE_S = 300.0
"""Wall time after which all mutants together are said to hang; they need a twentieth."""

# -- mutants -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_no_mutant_harms_a_reader(tmp_path: Path) -> None:
    """Every mutant is read or refused in one line, in bounded time and memory; both happen."""
    words = [sys.executable, MUTATE, "--count", MUTANTS, "--out", tmp_path]
    done = child(words, deadline_s=DEADLINE_S)
    assert done.returncode == 0, done.stderr[-3000:]
    rows = json.loads((tmp_path / "mutants.json").read_text())
    assert [row["reader"] for row in rows] == list(mutate.READERS)
    assert sum(row["mutants"] for row in rows) >= MUTANTS
    assert all(row["read"] + row["refused"] == row["mutants"] for row in rows)
    assert all(row["most_mb"] < mutate.LIMIT_MB for row in rows)
    assert all(row["slowest_s"] < mutate.LIMIT_S for row in rows)
    assert sum(row["read"] for row in rows) > MUTANTS / 10
    assert sum(row["refused"] for row in rows) > MUTANTS / 4


def test_the_campaign_sees_what_goes_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A traceback, a hang, a long message and too much memory are each a failure."""

    def long(_: Path) -> None:
        raise BagError("two\nlines")

    def slow(_: Path) -> None:
        while True:
            pass

    bad: dict[str, tuple[Callable[[Path], object], str]] = {
        "traceback": (lambda f: {"": f}["x"], "KeyError"),
        "lines": (long, "a message of 9 characters"),
        "hang": (slow, "more than 0.5 s"),
        "memory": (lambda _: b"x" * (64 << 20), "MB"),
    }
    source = tmp_path / "corpus" / "file"
    source.parent.mkdir()
    source.write_text("whole")
    monkeypatch.setattr(mutate, "LIMIT_S", 0.5)
    monkeypatch.setattr(mutate, "LIMIT_MB", 30.0)
    before = signal.signal(signal.SIGPROF, mutate._too_slow)
    try:
        for name, (read, reason) in bad.items():
            reader = mutate.Reader("file", lambda *_: None, read)
            monkeypatch.setitem(mutate.READERS, name, reader)
            (tmp_path / name).mkdir()
            outcome, _, said = mutate.one(name, 0, source.parent, tmp_path / name)
            assert (outcome, reason in said) == ("failed", True), said
    finally:
        signal.signal(signal.SIGPROF, before)


# -- whole bags ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a whole file of every kind."""
    folder = tmp_path_factory.mktemp("corpus")
    mutate.make_corpus(folder)
    return folder


@pytest.fixture(params=["bag", "sqlite"])
def bag(corpus: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Return a bag of its own, MCAP or SQLite."""
    return Path(shutil.copytree(corpus / request.param, tmp_path / "bag"))


@pytest.fixture
def mcap(corpus: Path, tmp_path: Path) -> Path:
    """Return a file of MCAP."""
    return Path(shutil.copytree(corpus / "bag", tmp_path / "bag"), "bag_0.mcap")


@pytest.fixture
def database(corpus: Path, tmp_path: Path) -> Iterator[sqlite3.Connection]:
    """Open a bag of SQLite for changes."""
    shutil.copytree(corpus / "sqlite", tmp_path / "bag")
    with contextlib.closing(sqlite3.connect(tmp_path / "bag" / "bag_0.db3")) as opened:
        yield opened
        opened.commit()


def refusal(bag: Path) -> str:
    """Return what is said of a bag that is refused."""
    with pytest.raises(BagError) as error:
        mutate.read_bag(bag)
    text = str(error.value)
    assert str(bag) in text
    assert "\n" not in text
    assert len(text) <= EmberError.MAX_LENGTH
    return text


def file_of(bag: Path) -> Path:
    """Return the file of a bag."""
    (file,) = bag.glob("bag_0.*")
    return file


def ticks_of(bag: Path) -> int:
    """Return how many ticks are read."""
    with Bag(bag) as opened:
        return len(list(opened.ticks()))


# -- places --------------------------------------------------------------------------------------

PLACES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a pipe": (os.mkfifo, "no regular file"),
    "a device": (lambda file: file.symlink_to("/dev/zero"), "no regular file"),
    "a ring": (lambda file: file.symlink_to(file), ""),
    "a folder": (lambda file: file.mkdir(), "no regular file"),
    "a link out": (lambda file: file.symlink_to("/etc/passwd"), "leads out of the folder"),
    "a link up": (lambda file: file.symlink_to("../../../../../../../etc/passwd"), "leads out of"),
}


@pytest.mark.parametrize("name", PLACES)
def test_what_is_no_file_of_the_folder_is_refused(bag: Path, name: str) -> None:
    """Nothing is opened that may never end, or that is somebody else's."""
    make, reason = PLACES[name]
    file = file_of(bag)
    file.unlink()
    make(file)
    assert reason in refusal(bag)
    with pytest.raises(BagError):
        repair(bag)
    assert os.path.lexists(file)


@pytest.mark.parametrize("name", PLACES)
def test_metadata_that_are_no_file_are_refused(bag: Path, name: str) -> None:
    """The same of `metadata.yaml`."""
    (bag / METADATA).unlink()
    PLACES[name][0](bag / METADATA)
    refusal(bag)


def test_a_link_within_the_folder_is_followed(bag: Path) -> None:
    """And so is one to the folder itself."""
    file = file_of(bag)
    file.rename(bag / "data")
    file.symlink_to("data")
    (bag.parent / "link").symlink_to(bag)
    assert ticks_of(bag.parent / "link") == mutate.TICKS


@pytest.mark.parametrize("name", ["../{}", "/etc/{}", "../../../../etc/{}", "./x/../{}"])
def test_a_path_in_metadata_leaves_no_folder(bag: Path, name: str) -> None:
    """Only its last part counts, as of bags that were recorded under another name."""
    told = yaml.safe_load((bag / METADATA).read_text())
    file = file_of(bag)
    told[INFORMATION]["relative_file_paths"] = [name.format(file.name)]
    (bag / METADATA).write_text(yaml.safe_dump(told))
    assert ticks_of(bag) == mutate.TICKS
    shutil.copy(file, bag.parent / "passwd")
    told[INFORMATION]["relative_file_paths"] = [name.format("passwd")]
    (bag / METADATA).write_text(yaml.safe_dump(told))
    assert "missing" in refusal(bag)


# -- YAML ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", mutate.YAML_LIES[:8])
def test_yaml_that_grows_or_goes_deep_is_refused(bag: Path, text: str) -> None:
    """Before anything is made of it, be it by aliases, merges or brackets."""
    with pytest.raises(ValueError, match=r"aliases|has no anchor|depth"):
        load_yaml(text)
    (bag / METADATA).write_text(f"{INFORMATION}: 1\n{text}")
    assert "no metadata" in refusal(bag)


def test_aliases_that_stay_small_are_read(bag: Path) -> None:
    """Some tools write what is said twice once."""
    told = yaml.safe_load((bag / METADATA).read_text())
    topics = told[INFORMATION]["topics_with_message_count"]
    for each in topics:
        each["topic_metadata"]["offered_qos_profiles"] = topics[0]["topic_metadata"][
            "offered_qos_profiles"
        ]
    text = yaml.safe_dump(told)
    assert "*id001" in text
    (bag / METADATA).write_text(text)
    assert ticks_of(bag) == mutate.TICKS


# -- SQLite --------------------------------------------------------------------------------------

COMPUTED = [
    *mutate.SQL_LIES[:2],
    mutate.SQL_LIES[6],
    "DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
    "UPDATE messages SET data = zeroblob(60000000) WHERE id = 9",
    "UPDATE topics SET name = hex(zeroblob(5000))",
    "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n LIMIT 6000) INSERT INTO topics "
    "SELECT x + 100, '/t' || x, 'std_msgs/msg/String', 'cdr', '', '' FROM n",
    "PRAGMA writable_schema=ON; UPDATE sqlite_master SET rootpage = 3 WHERE name = 'messages'",
]


@pytest.mark.parametrize("sql", COMPUTED, ids=range(len(COMPUTED)))
def test_a_database_that_computes_or_swells_is_refused(
    database: sqlite3.Connection, tmp_path: Path, sql: str
) -> None:
    """Nothing of it is run: a view of endless rows would never come back from C."""
    database.executescript(sql)
    database.commit()
    refusal(tmp_path / "bag")


@pytest.mark.parametrize(
    "sql", [mutate.SQL_LIES[5], mutate.SQL_LIES[7], "DROP INDEX timestamp_idx"]
)
def test_what_nobody_reads_does_no_harm(
    database: sqlite3.Connection, tmp_path: Path, sql: str
) -> None:
    """A view beside the tables, a costly constraint, a missing index: the bag is read."""
    database.executescript(sql)
    database.commit()
    assert ticks_of(tmp_path / "bag") == mutate.TICKS


def test_pages_that_lie_in_each_other_are_refused(
    database: sqlite3.Connection, tmp_path: Path
) -> None:
    """A tree whose branches are one and the same would be as wide as it is deep."""
    (root,) = database.execute(
        "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
    ).fetchone()
    file = tmp_path / "bag" / "bag_0.db3"
    data = bytearray(file.read_bytes())
    at = (root - 1) * 4096
    assert data[at] == 5, "an inner page"
    count = struct.unpack_from(">H", data, at + 3)[0]
    cells = [struct.unpack_from(">H", data, at + 12 + 2 * n)[0] for n in range(count)]
    for cell in cells[1:]:
        data[at + cell : at + cell + 4] = data[at + cells[0] : at + cells[0] + 4]
    file.write_bytes(data)
    assert "damaged" in refusal(tmp_path / "bag")


# -- MCAP ----------------------------------------------------------------------------------------


def chunk_of(inside: bytes, told: int | None = None, first: int = 0) -> bytes:
    """Return the record of a chunk, before a file's others."""
    coded = zstandard.compress(inside)
    head = struct.pack("<QQQI", first, 0, len(inside) if told is None else told, zlib.crc32(inside))
    data = head + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(coded)) + coded
    return struct.pack("<BQ", 6, len(data)) + data


def with_chunks(file: Path, *chunks: bytes) -> None:
    """Put chunks in front of a file's own."""
    data = file.read_bytes()
    (length,) = struct.unpack_from("<Q", data, 9)
    at = 17 + length  # behind the header
    file.write_bytes(data[:at] + b"".join(chunks) + data[at:])


def filled(size: int) -> bytes:
    """Return one record of a chunk, of so many bytes."""
    return struct.pack("<BQ", 9, size - 9) + bytes(size - 9)


BOMBS: dict[str, tuple[list[bytes], str]] = {
    "that says so": ([chunk_of(filled(guard.MAX_BYTES + 99))], "up to 33554432 are unpacked"),
    "said to be small": ([chunk_of(filled(guard.MAX_BYTES * 4), 100)], "unpacked instead of 100"),
    "said to be huge": ([chunk_of(b"", 2**63)], "grows to more than 100 times"),
    "many": ([chunk_of(filled(guard.MAX_BYTES))] * 9, "grows to more than 100 times"),
    "of records": ([chunk_of(filled(9) * (guard.MAX_RECORDS + 1))], "records in one chunk"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_chunk_that_grows_is_not_unpacked(mcap: Path, name: str) -> None:
    """Its size is compared before, and while, it is unpacked; and repair leaves it out."""
    chunks, reason = BOMBS[name]
    with_chunks(mcap, *chunks)
    assert reason in refusal(mcap)
    assert reason in refusal(mcap.parent)
    repaired = repair(mcap.parent)
    assert repaired.damaged == max(1, len(chunks) - 1)
    assert ticks_of(mcap.parent) == mutate.TICKS


def test_a_chunk_within_the_bounds_is_read(mcap: Path) -> None:
    """Up to the very byte."""
    with_chunks(mcap, chunk_of(filled(guard.MAX_BYTES)))
    assert ticks_of(mcap) == mutate.TICKS


def test_not_all_chunks_are_open_at_one_time(mcap: Path) -> None:
    """Whatever they say of their times."""
    noise = filled(9) + struct.pack("<BQ", 9, 1 << 18) + os.urandom(1 << 18)
    chunk = chunk_of(noise + filled(guard.MAX_BYTES // 2 + 1 - len(noise)))
    message = struct.pack("<HIQQ", 1, 0, 2**60, 0) + cdr.pack_clock(2**60)
    late = chunk_of(noise + struct.pack("<BQ", 5, len(message)) + message, first=2**60)
    with_chunks(mcap, *[chunk] * 3)
    assert ticks_of(mcap) == mutate.TICKS
    with_chunks(mcap, *[late] * 200)  # of one and the same time: one after the other
    assert ticks_of(mcap) == mutate.TICKS
    full = noise + struct.pack("<BQ", 5, len(message)) + message
    full += filled(guard.MAX_BYTES // 2 + 1 - len(full))
    with_chunks(mcap, *[chunk_of(full)] * 3, late)
    assert "have the same times" in refusal(mcap)


# -- what is in the messages ---------------------------------------------------------------------


def test_an_array_of_many_dimensions_is_refused() -> None:
    """Before its sizes are multiplied."""
    dimension = struct.pack("<III", 0, 2**32 - 1, 0)
    data = cdr.ENCAPSULATION + struct.pack("<I", 100_000) + dimension * 100_000 + bytes(8)
    with pytest.raises(SignalError, match="100000 dimensions"):
        cdr.read_array(data, "I", "here")


def test_a_message_of_an_error_is_short_and_can_be_printed() -> None:
    """Whatever a name in a bag would have made of it, or of the terminal."""
    text = str(BagError("begin\x1b[2J\ud800" + "x" * 10**6 + "end"))
    assert len(text) < EmberError.MAX_LENGTH + 20
    assert text.startswith("begin\\x1b[2J\\ud800xxx")
    assert text.endswith("xend")
    text.encode()
    assert str(BagError("short, with an é")) == "short, with an é"


LONG = {"digits": 10**5000, "text": "x" * 10**6, "deep": [[[[1] * 99] * 99] * 99] * 99}


@pytest.mark.parametrize("name", LONG)
def test_a_value_is_shown_in_few_words(name: str) -> None:
    """However long, deep or large it is."""
    assert len(shown(LONG[name])) < 400
