"""Gives every reader files that lie: ``python test/mutate.py --count 6000 --out docs/results``.

Each mutant is made from a whole file by one or two changes and read in this process. A reader may
read it or refuse it with an `EmberError`; anything else that leaves it, a longer time than LIMIT_S
or more memory than LIMIT_MB is a failure. The same count makes the same mutants.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import faulthandler
import json
import math
import os
import random
import resource
import shutil
import signal
import sqlite3
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import yaml
import zstandard

from ember_ros import cdr, topics
from ember_ros.bag.inspection import info
from ember_ros.bag.reader import Bag
from ember_ros.bag.repair import repair
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.run_writer import RunWriter
from ember_ros.bag.storage import INFORMATION, METADATA, BagOptions, McapWriter
from ember_ros.errors import EmberError
from ember_ros.loop import Loop
from ember_ros.params import Params, cells_sha256, params_sha256, replace
from ember_ros.params_file import dump_params, load_params
from ember_ros.run_config import RunConfig
from ember_ros.signals import TDUpdate
from leg_node.assembly import empty_table
from leg_node.durable_table import DurableTable
from leg_node.shared import UpdateBatch
from leg_node.store import TableStore
from leg_node.table_file import load_table, save_table
from sim_node.fake import FakeWorld
from support.configs import TINY as PARAMS

LIMIT_S, LIMIT_MB = 10.0, 300.0
"""What one mutant may cost: CPU time, whatever else the machine does, and growth of the resident
memory."""
STUCK_S = 300.0
"""Wall time after which a reader that does nothing is given up, and the campaign with it."""
ADDRESS_SPACE = 4 << 30
"""Bytes more than at the start, so that a bomb kills this process and not the machine."""
MAX_MESSAGE = 2500
"""Characters of a message."""
TICKS = 48

Rng = random.Random


# -- what is mutated -----------------------------------------------------------------------------


def make_corpus(folder: Path) -> None:
    """Make one whole file of every kind."""
    config = RunConfig("trainer", 1, params=PARAMS, policy="random")
    loop = Loop(config, FakeWorld(config.legs, PARAMS))
    writer = McapWriter(BagOptions(folder / "bag"))
    try:
        run_metadata = RunMetadata.of_config(config, loop.shared.table, {"ember_ros": "of a test"})
        recording = RunWriter(writer, run_metadata, loop.shared.table)
        for _ in range(TICKS):
            loop.tick(recording)
        recording.finish()
        writer.close({"table_sha256": loop.shared.table.sha256()})
    finally:
        writer.abandon()
    table = empty_table(PARAMS)
    table.values[::3], table.visits[::3] = 0.25, 3
    save_table(folder / "table.npz", table, PARAMS, seed=3)
    (folder / "params.yaml").write_text(dump_params(PARAMS))
    loop.close()
    store = TableStore(folder / "table.npz", cells_sha256(PARAMS))
    store.checkpoint(table, [])
    for n in range(9):
        store.add(UpdateBatch(0, "run", n, cells_sha256(PARAMS), (TDUpdate(n, n, 0.5),)))
    store.close()
    (folder / "sqlite").mkdir()
    in_sqlite(folder / "bag", folder / "sqlite")


SCHEMA = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER, metadata TEXT);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,
  encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
  timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema VALUES (4, 'jazzy');
"""
"""As rosbag2 of Jazzy makes it."""


def in_sqlite(bag: Path, folder: Path) -> None:
    """Write a bag again as SQLite."""
    numbers: dict[str, int] = {}
    with Bag(bag) as opened, contextlib.closing(sqlite3.connect(folder / "bag_0.db3")) as database:
        database.executescript(SCHEMA)
        for raw in opened.raw():
            if raw.topic not in numbers:
                numbers[raw.topic] = len(numbers) + 1
                database.execute(
                    "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '', '')",
                    (numbers[raw.topic], raw.topic, raw.kind),
                )
            database.execute(
                "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)",
                (numbers[raw.topic], raw.ns, raw.data),
            )
        database.commit()
    told = yaml.safe_load((bag / METADATA).read_text())
    told[INFORMATION].update(storage_identifier="sqlite3", relative_file_paths=["bag_0.db3"])
    (folder / METADATA).write_text(yaml.safe_dump(told))


# -- bytes ---------------------------------------------------------------------------------------

SIZES = [0, 1, 2, 7, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1,
         2**63, 2**64 - 1]  # fmt: skip


def change_bytes(data: bytes, rng: Rng) -> bytes:
    """Return bytes of which some are others, or elsewhere, or gone."""
    changed = bytearray(data)
    if not changed:
        return bytes(rng.randrange(1, 100))
    at, to = rng.randrange(len(changed)), rng.randrange(len(changed))
    length = min(rng.choice([1, 4, 8, 64, 512, 4096]), len(changed))
    how = rng.randrange(9)
    if how == 0:
        del changed[at:]
    elif how == 1:
        for _ in range(rng.choice([1, 1, 2, 8, 32])):
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    elif how == 2:
        changed[at : at + length] = bytes(len(changed[at : at + length]))
    elif how == 3:
        changed[to:to] = changed[at : at + length]
    elif how == 4:
        changed[at : at + length], changed[to : to + length] = (
            changed[to : to + length],
            changed[at : at + length],
        )
    elif how == 5:
        del changed[at : at + length]
    elif how == 6:
        changed[at : at + length] = rng.randbytes(len(changed[at : at + length]))
    else:
        form = rng.choice(["<I", ">I", "<Q", ">Q", "<H"])
        size = struct.calcsize(form)
        wrong = rng.choice([*SIZES, rng.randrange(len(changed) * 2)]) % (1 << 8 * size)
        changed[at : at + size] = struct.pack(form, wrong)
    return bytes(changed)


def change_file(file: Path, rng: Rng) -> None:
    """Change the bytes of a file once or twice."""
    data = file.read_bytes()
    for _ in range(rng.choice([1, 1, 2])):
        data = change_bytes(data, rng)
    file.write_bytes(data)


def change_place(file: Path, rng: Rng) -> None:
    """Put something into a file's place that is none, or lies elsewhere."""
    how = rng.randrange(8)
    if how == 0:
        os.truncate(file, 1 << rng.choice([0, 20, 30, 40]))
        return
    old = file.read_bytes()
    file.unlink()
    if how == 1:
        os.mkfifo(file)
    elif how == 2:
        file.symlink_to("/dev/zero")
    elif how == 3:
        file.symlink_to(file)
    elif how == 4:
        file.mkdir()
    elif how == 5:
        file.symlink_to("/etc/passwd")
    elif how == 6:
        elsewhere = file.parent.parent / "elsewhere"
        elsewhere.write_bytes(old)
        file.symlink_to(elsewhere)


# -- what is said in YAML and JSON ---------------------------------------------------------------


def weird(rng: Rng) -> Any:
    """Return a value that nobody expects."""
    return rng.choice([
        None, True, False, -1, 0, 1, 2**31, 2**63, -(2**63) - 1, 10**30, 10**400, 1e308, -1e308,
        1e-320, 0.5, math.nan, math.inf, -math.inf, "", "5", "nan", "x" * 100_000, "a\nb\0c",
        "\ud800", "../../etc/passwd", "/etc/passwd", "..", ".", "bag_0.mcap/", [], {}, [[]],
        [1] * 1000, ["x"] * 1000, {"a": {"b": {}}}, {"x" * 1000: 1}, [{"nanoseconds": "5"}],
        2**53, 4096, 1000, [0.0], [-1.0, 0.0, 1.0], [0.0] * 5, "train", "walk", "walker",
    ])  # fmt: skip


def change_content(content: Any, rng: Rng) -> Any:
    """Return plain content of which one place is another's, gone, doubled, or strange."""
    content = copy.deepcopy(content)
    places: list[tuple[Any, Any]] = []

    def walk(part: Any) -> None:
        for key in list(part) if isinstance(part, dict) else range(len(part)):
            places.append((part, key))
            if isinstance(part[key], (dict, list)):
                walk(part[key])

    if isinstance(content, (dict, list)):
        walk(content)
    if not places:
        return weird(rng)
    part, key = rng.choice(places)
    how = rng.randrange(6)
    if how == 0:
        del part[key]
    elif how == 1:
        other, of = rng.choice(places)
        part[key] = copy.deepcopy(other[of])
    elif how == 2 and isinstance(part, dict):
        part[rng.choice(["x", "", "train", "y" * 1000])] = weird(rng)
    elif how == 3 and isinstance(part[key], (int, float)):
        part[key] = rng.choice([str(part[key]), -part[key], part[key] * 10**9, [part[key]]])
    else:
        part[key] = weird(rng)
    return content


ALIASES = "".join(
    f"{one}: &{one} [{', '.join(['*' + other] * 9)}]\n"
    for one, other in zip("bcdefghi", "abcdefgh", strict=True)
)
YAML_LIES = [
    "a: &a [x, x, x]\n" + ALIASES,
    "a: &a {k: 1}\n" + ALIASES.replace("[", "{<<: [").replace("]", "]}"),
    "a: &a [*a]\n", "a: *b\n", "[" * 3000, "{a: " * 3000, "- " * 3000 + "x", "? " * 2000,
    "x: !!python/object/apply:os.system ['false']\n", "x: !!int abc\n", "x: !!float abc\n",
    "x: !!timestamp abc\n", "x: 2024-13-45\n", "x: 0000-00-00\n", "x: 2001-99-99 99:99:99\n",
    "x: " + "9" * 5000, "x: 0x" + "f" * 100_000, "x: 1:30\n", "x: 3_000\n", "x: .nan\n",
    "x: !!binary '===='\n", "x: !!set {a, b}\n", "x: !!omap [a]\n", "x: !!pairs [1]\n", "\t",
    "x: |\n" + " y\n" * 10_000, "&a : *a", "--- a\n--- b\n", "%YAML 9.9\n---\n", "x: 'a", "\0",
    "? [a]\n: b\n", "? {a: b}\n: c\n", "x: " + "1:" * 3000 + "1", "<<: 1\n", "<<: [1]\n", "=: 1\n",
    "x: 1e400\n", "x: -.inf\n", "\ufeff", "x: '\\ud800'\n", 'x: "\\ud800"\n', "k: v\n" * 20_000,
    "x: !!python/name:os.system\n", "!!map [1]", "!!seq {}", "!!str {}", "x: !<!> 1", "*",
]  # fmt: skip


def change_yaml(file: Path, rng: Rng) -> None:
    """Change what a YAML file says, or how it says it."""
    text = file.read_text()
    how = rng.randrange(4)
    if how == 0:
        change_file(file, rng)
    elif how == 1:
        lie = rng.choice(YAML_LIES)
        lines = text.splitlines(keepends=True)
        place = rng.choice([0, rng.randrange(len(lines) + 1), len(lines)])
        inside = rng.random() < 0.5 and 0 < place < len(lines)
        if inside:  # in the place of a value, with the depth that it had
            begin = lines[place].split(":")[0]
            lines[place] = begin + ": " + lie.removeprefix("x: ").rstrip("\n") + "\n"
        else:
            lines.insert(place, lie)
        file.write_bytes("".join(lines).encode(errors="surrogatepass"))
    elif how == 2:
        file.write_bytes(rng.choice(YAML_LIES).encode(errors="surrogatepass"))
    else:
        content = yaml.safe_load(text)
        for _ in range(rng.choice([1, 1, 2])):
            content = change_content(content, rng)
        flow = rng.choice([None, True, False])
        with contextlib.suppress(yaml.YAMLError, ValueError):
            said = yaml.dump(content, default_flow_style=flow, sort_keys=False)
            file.write_bytes(said.encode(errors="surrogatepass"))


def change_json(text: str, rng: Rng) -> str:
    """Return another JSON text."""
    how = rng.randrange(6)
    if how == 0:
        return change_bytes(text.encode(), rng).decode(errors="replace")
    if how == 1:
        at = rng.randrange(len(text))
        lie = rng.choice(["[" * 100_000, '{"a":' * 100_000, "9" * 100_000, "1e999", "NaN",
                          '"\\ud800"', "-Infinity", "\\u0000", '"' * 9, "1" + "0" * 4000,
                          " " * 2_000_000, "null", "{}"])  # fmt: skip
        return text[:at] + lie + text[rng.choice([at, len(text)]) :]
    content = json.loads(text)
    for _ in range(rng.choice([1, 1, 2])):
        content = change_content(content, rng)
    return json.dumps(content)


# -- tables --------------------------------------------------------------------------------------


def change_table(file: Path, rng: Rng) -> None:
    """Change a table's file: its bytes, its zip directory, or what its members are."""
    how = rng.randrange(5)
    if how == 0:
        return change_file(file, rng)
    if how == 1 and rng.random() < 0.3:
        return change_place(file, rng)
    with zipfile.ZipFile(file) as content:
        members = [(name, content.read(name)) for name in content.namelist()]
    n = rng.randrange(len(members))
    name, data = members[n]
    if how == 2:
        members[n] = name, change_bytes(data, rng)
    elif how == 3:
        descr = rng.choice(
            [
                "'<f8'",
                "'>f8'",
                "'<i8'",
                "'|O'",
                "'<U9'",
                "'|V1'",
                "[('a', '<f8')]",
                "'<U99999999'",
                "'<m8'",
                "'|b1'",
                "1",
                "'" + "x" * 9000 + "'",
            ]
        )
        shape = rng.choice(
            [
                "()",
                "(12, 9)",
                "(108,)",
                "(-1, 9)",
                f"({10**15}, 9)",
                "(12, 9, 1)",
                f"({'9' * 5000},)",
                "(" * 300,
                "(0,)",
                "12",
                "(1, " * 50,
            ]
        )
        header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
        header += b"\n"
        version = rng.choice([b"\1\0", b"\1\0", b"\2\0", b"\3\0", b"\xff\xff"])
        length = struct.pack("<H", rng.choice([len(header), len(header), 0, 65535]))
        members[n] = name, b"\x93NUMPY" + version + length + header + data[128:]
    elif how == 4:
        way = rng.randrange(5)
        if way == 0:
            del members[n]
        elif way == 1:
            members.append(members[n])
        elif way == 2:
            members[n] = name, bytes(rng.choice([1, 1 << 20, 1 << 28]))
        elif way == 3:
            members[n] = name, data + bytes(1 << 26)
        else:
            at = rng.randrange(len(members))
            members[n] = name, members[at][1]
    else:
        members = [
            (each, json_member(part, rng) if each == "about.npy" else part)
            for each, part in members
        ]
    how = rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_DEFLATED,
                      zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])  # fmt: skip
    with zipfile.ZipFile(file, "w", how) as content, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of members that are there twice
        for each, part in members:
            content.writestr(each, part)
    if rng.random() < 0.3:  # what the directory says of a member
        out, form = bytearray(file.read_bytes()), rng.choice(["<I", "<H"])
        size = struct.calcsize(form)
        at = out.find(b"PK\x01\x02") + rng.randrange(8, 46)
        out[at : at + size] = struct.pack(form, rng.choice(SIZES) % (1 << 8 * size))
        file.write_bytes(out)
    return None


def json_member(data: bytes, rng: Rng) -> bytes:
    """Return another JSON text as an array of numpy's."""
    text = change_json(data[128:].decode("utf-32-le", errors="replace"), rng).replace("\0", " ")
    header = f"{{'descr': '<U{len(text)}', 'fortran_order': False, 'shape': (), }}\n".encode()
    coded = text.encode("utf-32-le", errors="surrogatepass")
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + coded


# -- MCAP ----------------------------------------------------------------------------------------

_HEAD, _CHUNK = struct.Struct("<BQ"), struct.Struct("<QQQII")
RunRecord = tuple[int, bytes]
MAGIC = b"\x89MCAP0\r\n"


def records(data: bytes) -> list[RunRecord]:
    """Return what lies behind one another in an MCAP file or chunk."""
    found, at = [], 0
    while at + 9 <= len(data):
        kind, length = _HEAD.unpack_from(data, at)
        found.append((kind, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def laid_out(found: Sequence[RunRecord]) -> bytes:
    """Return records as bytes."""
    return b"".join(_HEAD.pack(kind, len(data)) + data for kind, data in found)


def opened_chunk(data: bytes) -> list[RunRecord]:
    """Return the records in a chunk."""
    _, _, _, _, length = _CHUNK.unpack_from(data)
    return records(zstandard.decompress(data[_CHUNK.size + length + 8 :]))


def closed_chunk(
    inside: bytes, rng: Rng, *, size: int | None = None, first: int = 0, last: int = 0
) -> bytes:
    """Return a chunk of anything, compressed in some way, that tells some size."""
    ways = ["zstd", "zstd", "lz4", "", "bz2"]
    how = rng.choice(ways[:3] if len(inside) > 1 << 16 else ways)
    coded = inside
    if how == "zstd":
        packer = zstandard.ZstdCompressor(write_content_size=rng.random() < 0.7)
        coded = packer.compress(inside)
    elif how == "lz4":
        coded = lz4.frame.compress(inside, store_size=rng.random() < 0.5)
    told = len(inside) if size is None else size
    crc = rng.choice([0, zlib.crc32(inside)])
    return (
        _CHUNK.pack(first, last, told, crc, len(how)) + how.encode()
        + struct.pack("<Q", len(coded)) + coded
    )  # fmt: skip


def bombs(rng: Rng) -> list[RunRecord]:
    """Return chunks that grow a thousandfold, with sizes that are true or not."""
    size = rng.choice([1 << 20, 1 << 25, (1 << 25) - 9, 1 << 28])
    inside = _HEAD.pack(rng.choice([1, 3, 4, 5, 6, 9]), size - 9) + bytes(size - 9)
    times = rng.choice([1, 1, 50])
    if rng.random() < 0.3:  # as many messages as fit; to read them all takes its time, and may
        inside = laid_out([(5, struct.pack("<HIQQ", 1, 0, 0, 0))]) * (size // 31)
        times = 1
    told = rng.choice([None, None, 100, 0, 2**63, 2**64 - 1])
    return [(6, closed_chunk(inside, rng, size=told))] * times


def message_record(data: bytes, rng: Rng) -> bytes:
    """Return the record of a message with another channel, time, or content."""
    channel, sequence, log, sent = struct.unpack_from("<HIQQ", data)
    content, how = data[22:], rng.randrange(6)
    if how == 0:
        channel = rng.choice([0, channel + 1, 65535])
    elif how == 1:
        log = rng.choice([0, 2**63, 2**64 - 1, log + 10**18])
    elif how == 2:
        content = zstandard.compress(rng.choice([content, bytes(1 << 20), bytes(1 << 27)]))
    elif how == 3:
        content = zstandard.compress(content)[: rng.randrange(20)]
    else:
        content = change_message(content, rng)
    return struct.pack("<HIQQ", channel % 65536, sequence, log, sent) + content


NUMBERS = [0.0, -0.0, 1e308, -1e308, 5e-324, math.nan, math.inf, -math.inf, 1e30, 0.5, 2.0**53]


def change_message(data: bytes, rng: Rng) -> bytes:
    """Return another message: other bytes, or another number in it."""
    if rng.random() < 0.4 or len(data) < 16:
        return change_bytes(data, rng)
    at = rng.randrange(4, len(data) - 7, 4) if len(data) > 12 else 4
    form = rng.choice(["<d", "<d", "<I", "<i"])
    wrong: Any = rng.choice(NUMBERS if form == "<d" else [0, 1, 2**31 - 1, 10**9, 10**6])
    return data[:at] + struct.pack(form, wrong) + data[at + struct.calcsize(form) :]


def change_mcap(file: Path, rng: Rng) -> None:
    """Change an MCAP file: its bytes, its records, or what is in its chunks."""
    how = rng.randrange(8)
    if how == 0:
        return change_file(file, rng)
    if how == 1 and rng.random() < 0.3:
        return change_place(file, rng)
    data = file.read_bytes()
    found = records(data[8:-8])
    chunks = [n for n, (kind, _) in enumerate(found) if kind == 6]
    for _ in range(rng.choice([1, 1, 2, 5])):
        n, at = rng.choice(chunks), rng.randrange(len(found))
        how = rng.randrange(12)
        if how <= 3 and found[n][0] == 6:
            with contextlib.suppress(Exception):  # another change may have broken it
                inside = opened_chunk(found[n][1])
                each = rng.randrange(len(inside))
                kind, told = inside[each]
                changed = message_record(told, rng) if kind == 5 else change_bytes(told, rng)
                inside[each] = kind, changed
                first, last = struct.unpack_from("<QQ", found[n][1])
                found[n] = 6, closed_chunk(laid_out(inside), rng, first=first, last=last)
        elif how == 4:
            found[n:n] = bombs(rng)
        elif how == 5:
            found.insert(at, found[rng.randrange(len(found))])
        elif how == 6 and len(found) > 2:
            del found[at]
            chunks = [n for n, (kind, _) in enumerate(found) if kind == 6] or [0]
        elif how == 7:
            kind, told = found[at]
            found[at] = kind, change_bytes(told, rng)
        elif how == 8:
            found[at] = rng.choice([0, 1, 2, 3, 4, 5, 6, 8, 11, 15, 255]), found[at][1]
        elif how == 9:
            begin = min(rng.choice([0, 8, 16, 24]), max(0, len(found[at][1]) - 8))
            wrong = struct.pack("<Q", rng.choice(SIZES))
            told = found[at][1]
            found[at] = found[at][0], told[:begin] + wrong + told[begin + 8 :]
        elif how == 10:
            found.insert(n, (6, closed_chunk(laid_out([found[n]]), rng)))  # a chunk in a chunk
        else:  # a schema, or a channel with a bomb in YAML for its quality of service
            strings = [b"/x", b"cdr", b"offered_qos_profiles", YAML_LIES[rng.randrange(2)].encode()]
            coded = [struct.pack("<I", len(each)) + each for each in strings]
            told = coded[2] + coded[3]
            channel = struct.pack("<HH", rng.choice([1, 99]), 1) + coded[0] + coded[1]
            found.insert(at, (4, channel + struct.pack("<I", len(told)) + told))
    out = bytearray(MAGIC + laid_out(found) + MAGIC)
    if rng.random() < 0.3:  # a length that is another
        at = rng.randrange(8, len(out) - 9)
        struct.pack_into("<Q", out, at, rng.choice(SIZES))
    file.write_bytes(out)
    return None


# -- SQLite --------------------------------------------------------------------------------------

ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT "
SQL_LIES = [
    f"DROP TABLE messages; CREATE VIEW messages AS {ENDLESS} x AS id, 1 AS topic_id, x AS "
    "timestamp, x'00' AS data FROM n",
    f"DROP TABLE topics; CREATE VIEW topics AS {ENDLESS} x AS id, 'a' AS name, 'b' AS type, "
    "'cdr' AS serialization_format, '' AS offered_qos_profiles, '' AS type_description_hash FROM n",
    f"DROP TABLE message_definitions; CREATE VIEW message_definitions AS {ENDLESS} 'a' AS "
    "topic_type, 'b' AS encoding, 'c' AS encoded_message_definition FROM n",
    f"DROP TABLE schema; CREATE VIEW schema AS {ENDLESS} x AS schema_version FROM n",
    f"DROP TABLE metadata; CREATE VIEW metadata AS {ENDLESS} x AS metadata FROM n",
    f"CREATE VIEW x AS {ENDLESS} x FROM n",
    "CREATE TABLE new(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB AS "
    "(zeroblob(900000000))); INSERT INTO new SELECT id, topic_id, timestamp FROM messages; DROP "
    "TABLE messages; ALTER TABLE new RENAME TO messages",
    "CREATE TABLE new(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB "
    "CHECK (length(hex(zeroblob(400000000))) > 5)); PRAGMA ignore_check_constraints=ON; INSERT "
    "INTO new SELECT * FROM messages; DROP TABLE messages; ALTER TABLE new RENAME TO messages",
    "DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
    "UPDATE messages SET data = zeroblob(200000000) WHERE id = 9",
    "UPDATE messages SET data = zeroblob(30000000) WHERE id < 9",
    "UPDATE messages SET data = CAST(data AS TEXT)", "UPDATE messages SET data = 5 WHERE id = 7",
    "UPDATE messages SET timestamp = 'noon' WHERE id = 7", "UPDATE messages SET timestamp = -5",
    "UPDATE messages SET timestamp = 1e300 WHERE id = 7", "UPDATE messages SET timestamp = x'00'",
    "UPDATE messages SET timestamp = 9223372036854775807 WHERE id = 70",
    "UPDATE messages SET topic_id = 99 WHERE id = 70", "UPDATE messages SET topic_id = 'x'",
    "UPDATE topics SET name = x'ff'", "UPDATE topics SET name = ''", "UPDATE topics SET name = 5",
    "UPDATE topics SET type = name", "UPDATE topics SET name = '/clock'",
    "UPDATE topics SET name = hex(zeroblob(5000000))", "UPDATE topics SET id = id + 1",
    "UPDATE topics SET serialization_format = 'xml'", "UPDATE topics SET type = x'00'",
    "UPDATE topics SET offered_qos_profiles = '[[[[[[' || hex(zeroblob(1000))",
    "UPDATE topics SET offered_qos_profiles = hex(zeroblob(3000000))",
    "DROP TABLE topics", "DROP TABLE messages", "DROP TABLE schema", "DROP INDEX timestamp_idx",
    "ALTER TABLE messages RENAME COLUMN data TO x", "ALTER TABLE topics DROP COLUMN type",
    "UPDATE schema SET schema_version = 'x'", "UPDATE schema SET schema_version = 99",
    "DELETE FROM topics", "DELETE FROM messages", "DELETE FROM messages WHERE id % 3 = 0",
    "INSERT INTO message_definitions VALUES (1, 'a', 'b', hex(zeroblob(9000000)), 'c')",
    "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n LIMIT 20000) INSERT INTO "
    "topics SELECT x + 100, '/t' || x, 'std_msgs/msg/String', 'cdr', '', '' FROM n",
    "PRAGMA journal_mode=WAL", "PRAGMA user_version=-1", "PRAGMA encoding='UTF-16'",
    "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM topics; END",
    "CREATE INDEX x ON messages (hex(zeroblob(1000)))",
    "PRAGMA writable_schema=ON; UPDATE sqlite_master SET rootpage = 3 WHERE name = 'messages'",
    "PRAGMA writable_schema=ON; UPDATE sqlite_master SET rootpage = 99999",
    "PRAGMA writable_schema=ON; UPDATE sqlite_master SET sql = 'CREATE TABLE x' WHERE rowid = 2",
    "PRAGMA writable_schema=ON; UPDATE sqlite_master SET name = 'topics' WHERE name = 'schema'",
    "PRAGMA writable_schema=ON; UPDATE sqlite_master SET sql = replace(sql, 'BLOB', 'BLOB AS (x)')",
]  # fmt: skip


def change_sqlite(file: Path, rng: Rng) -> None:
    """Change a database: its bytes, its pages, or what is in its tables."""
    how = rng.randrange(6)
    if how == 0:
        return change_file(file, rng)
    if how == 1 and rng.random() < 0.3:
        return change_place(file, rng)
    if how == 1:  # whole pages, and the numbers in their heads
        data, size = bytearray(file.read_bytes()), 4096
        pages = len(data) // size
        one, other = rng.randrange(pages) * size, rng.randrange(pages) * size
        if rng.random() < 0.5:
            data[one : one + size] = data[other : other + size]
        else:
            at = one + rng.choice([0, 1, 3, 5, 7, 8, 10, 12, 16, 20]) + 100 * (one == 0)
            wrong = rng.choice([0, 1, 2, pages, 2**31, rng.randrange(pages + 1)])
            data[at : at + 4] = struct.pack(">I", wrong)
        file.write_bytes(data)
        return None
    with contextlib.closing(sqlite3.connect(file)) as database:
        if how <= 3:
            for _ in range(rng.choice([1, 1, 2])):
                with contextlib.suppress(sqlite3.Error):
                    database.executescript(rng.choice(SQL_LIES))
        else:
            ids = [row[0] for row in database.execute("SELECT id FROM messages")]
            for each in rng.sample(ids, rng.choice([1, 2, 9])):
                (data,) = database.execute(
                    "SELECT data FROM messages WHERE id = ?", (each,)
                ).fetchone()
                changed = message_record(bytes(22) + data, rng)[22:]
                database.execute("UPDATE messages SET data = ? WHERE id = ?", (changed, each))
        database.commit()
    return None


def change_store(file: Path, rng: Rng) -> None:
    """Change the database of a table: its bytes, or what is in its tables."""
    if rng.random() < 0.5:
        change_file(file, rng)
        return
    with contextlib.closing(sqlite3.connect(file)) as database:
        lies = ("NULL", "-1", "'x'", "zeroblob(7)", "zeroblob(1000000)", "2.5", "1 << 62")
        table, columns = rng.choice(
            [
                ("push", ("leg", "run", "epoch", "cells_sha256", "ticks", "cells", "targets")),
                ("run", ("leg", "run", "epoch")),
                ("checkpoint", ("states", "actions", "cells_sha256", "table_sha256", "contents")),
            ]
        )
        with contextlib.suppress(sqlite3.Error):
            database.execute(f"UPDATE {table} SET {rng.choice(columns)} = {rng.choice(lies)}")
        if rng.random() < 0.2:
            with contextlib.suppress(sqlite3.Error):
                database.executescript(rng.choice(SQL_LIES))
        database.commit()


# -- readers -------------------------------------------------------------------------------------


def read_store(file: Path) -> None:
    """Open the database of a table, and take its pushes up as the table_node does."""
    store = TableStore(file.with_suffix(""), cells_sha256(PARAMS))
    try:
        empty = empty_table(PARAMS)
        stored = store.load(empty.states, empty.actions)
        if stored is not None:
            DurableTable(
                stored.table,
                legs=len(PARAMS.robot.legs),
                cells=cells_sha256(PARAMS),
                rate=PARAMS.walk.rate,
                sync_every=PARAMS.walk.sync_every,
                life=1,
                store=store,
            ).resume(stored)
    finally:
        store.close()


def read_bag(path: Path) -> None:
    """Open a bag, look into it, and read all that it has."""
    with Bag(path) as opened:
        info(opened)
        for _ in opened.raw():
            pass


def change_card(folder: Path, rng: Rng) -> None:
    """Change the card or the table at the start, or leave out what a run needs, in a whole bag."""
    with Bag(folder) as opened:
        raws = list(opened.raw())
    shutil.rmtree(folder)
    chosen = rng.choice(["card", "card", "card", topics.VALUES.name, topics.VISITS.name])
    writer = McapWriter(BagOptions(folder))
    try:
        for raw in raws:
            data = raw.data
            if chosen == "card" and raw.topic == "/" + topics.RUN_METADATA.name:
                text = change_json(cdr.read_text(data, "card"), rng)
                if rng.random() < 0.5:
                    text = hashed(text)
                coded = text.encode(errors="surrogatepass") + b"\0"
                data = cdr.ENCAPSULATION + struct.pack("<I", len(coded)) + coded
                if rng.random() < 0.1:
                    data = change_bytes(data, rng)
            elif raw.topic == "/" + chosen:
                data = change_message(data, rng)
            writer.write(writer.channel(raw.topic, raw.kind), raw.ns, data)
        writer.close()
    finally:
        writer.abandon()


def hashed(text: str) -> str:
    """Return a card that has the SHA-256 of its parameters, if it has any."""
    try:
        run_metadata = json.loads(text)
        flat = {
            f"{group}.{name}": value
            for group, numbers in run_metadata["params"].items()
            for name, value in numbers.items()
        }
        return json.dumps({**run_metadata, "params_sha256": params_sha256(replace(Params(), flat))})
    except (EmberError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return text


class Reader(NamedTuple):
    """One way into this package, and how its files are spoilt."""

    source: str
    """In the corpus: a file, or a folder."""
    change: Callable[[Path, Rng], None]
    read: Callable[[Path], object]
    share: int = 1
    """Of all mutants."""


def first(pattern: str, change: Callable[[Path, Rng], None]) -> Callable[[Path, Rng], None]:
    """Return how the one file of a folder is changed."""
    return lambda folder, rng: change(next(folder.glob(pattern)), rng)


def with_files(change: Callable[[Path, Rng], None]) -> Callable[[Path, Rng], None]:
    """Return how what metadata say is changed, or where they lie."""
    return lambda folder, rng: (change_place if rng.random() < 0.05 else change)(
        folder / METADATA, rng
    )


READERS = {
    "table": Reader("table.npz", change_table, lambda file: load_table(file, PARAMS), 3),
    "store": Reader("table.npz.store", change_store, read_store, 2),
    "parameters": Reader("params.yaml", change_yaml, load_params, 3),
    "MCAP": Reader("bag", first("*.mcap", change_mcap), read_bag, 4),
    "SQLite": Reader("sqlite", first("*.db3", change_sqlite), read_bag, 4),
    "metadata.yaml": Reader("bag", with_files(change_yaml), read_bag, 3),
    "card": Reader("bag", change_card, read_bag, 2),
    "repair of MCAP": Reader("bag", first("*.mcap", change_mcap), repair, 2),
    "repair of SQLite": Reader("sqlite", first("*.db3", change_sqlite), repair, 2),
    "repair by metadata.yaml": Reader("bag", with_files(change_yaml), repair, 1),
}


# -- the campaign --------------------------------------------------------------------------------


class Slow(BaseException):
    """A reader took too long; no reader catches this."""


def _too_slow(_: int, __: Any) -> None:
    raise Slow


def _peak_kb(name: str) -> int:
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(name))


class Watch:
    """What one call cost: CPU time, and how far the resident memory grew over what it was."""

    seconds = mb = 0.0

    def __enter__(self) -> Watch:
        """Forget the memory's highest mark, and begin."""
        Path("/proc/self/clear_refs").write_text("5")
        self._before, self._begin = _peak_kb("VmRSS"), time.process_time()
        signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
        # Where no signal is looked at, or where nothing is done: by wall time, on any machine.
        faulthandler.dump_traceback_later(STUCK_S, exit=True)
        return self

    def __exit__(self, *_: object) -> None:
        """Take the measure."""
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
        self.seconds = time.process_time() - self._begin
        self.mb = (_peak_kb("VmHWM") - self._before) / 1024


def one(name: str, n: int, corpus: Path, folder: Path) -> tuple[str, Watch, str]:
    """Make a mutant and have it read: what came of it, what it cost, what was wrong."""
    reader, rng = READERS[name], Rng(f"{name} {n}")
    file = folder / reader.source
    source = corpus / reader.source
    (shutil.copytree if source.is_dir() else shutil.copy)(source, file)
    reader.change(file, rng)
    said, outcome, watch = "", "read", Watch()
    try:
        with watch:
            reader.read(file)
    except EmberError as error:
        outcome, said = "refused", str(error)
    except Slow:
        outcome, said = "failed", f"more than {LIMIT_S} s: {traceback.format_exc()}"
    except BaseException:
        outcome, said = "failed", traceback.format_exc()
    if outcome == "refused" and (len(said) > MAX_MESSAGE or "\n" in said or not said.isprintable()):
        outcome, said = "failed", f"a message of {len(said)} characters: {said[:300]!r}"
    elif watch.mb > LIMIT_MB:
        outcome, said = "failed", f"{watch.mb:.0f} MB; {said}"
    return outcome, watch, said if outcome == "failed" else ""


def campaign(names: Sequence[str], count: int, seed: int = 0) -> Iterator[dict[str, Any]]:
    """Yield what came of the mutants, a reader at a time."""
    signal.signal(signal.SIGPROF, _too_slow)
    space = _peak_kb("VmSize") * 1024 + ADDRESS_SPACE
    resource.setrlimit(resource.RLIMIT_AS, (space, resource.RLIM_INFINITY))
    total = sum(READERS[name].share for name in names)
    with tempfile.TemporaryDirectory(prefix="ember_ros_mutants_") as place:
        corpus = Path(place, "corpus")
        corpus.mkdir()
        make_corpus(corpus)
        for name in names:
            reader = READERS[name]
            reader.read(corpus / reader.source)  # it is whole, and everything is imported
            row = {"reader": name, "mutants": 0, "read": 0, "refused": 0, "failed": 0}
            slowest = most = 0.0
            failures = []
            for n in range(seed, seed + -(-count * reader.share // total)):
                folder = Path(place, "mutant")
                folder.mkdir()
                outcome, watch, said = one(name, n, corpus, folder)
                shutil.rmtree(folder)
                Path(place, "elsewhere").unlink(missing_ok=True)
                row["mutants"] += 1  # type: ignore[operator]
                row[outcome] += 1  # type: ignore[operator]
                slowest, most = max(slowest, watch.seconds), max(most, watch.mb)
                if said:
                    failures.append({"mutant": n, "said": said})
            yield {**row, "slowest_s": slowest, "most_mb": most, "failures": failures}


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Return the results as a page."""
    lines = [
        "# Files that lie",
        "",
        f"{sum(row['mutants'] for row in rows)} mutated files, read in one process: made by "
        "`make fuzz`. A file is read or refused",
        f"with one line; a failure is a traceback, more than {LIMIT_S:.0f} s, or more than "
        f"{LIMIT_MB:.0f} MB of memory.",
        "",
        "| reader | mutants | read | refused | failed | slowest, s | most memory, MB |",
        "|---|---:|---:|---:|---:|---:|---:|",
        *(
            f"| {row['reader']} | {row['mutants']} | {row['read']} | {row['refused']} | "
            f"{row['failed']} | {row['slowest_s']:.2f} | {row['most_mb']:.0f} |"
            for row in rows
        ),
        "",
    ]
    return "\n".join(lines)


def main() -> int:
    """Run a campaign; return 1 if a mutant failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--count", type=int, default=6000, help="mutants, of all readers together")
    parser.add_argument("--seed", type=int, default=0, help="the number of the first mutant")
    parser.add_argument("--reader", choices=READERS, action="append", help="all without it")
    parser.add_argument("--out", type=Path, help="folder for mutants.json and mutants.md")
    given = parser.parse_args()
    rows = []
    for row in campaign(given.reader or list(READERS), given.count, given.seed):
        rows.append(row)
        print(json.dumps({**row, "failures": len(row["failures"])}), flush=True)
        for failure in row["failures"][:20]:
            print(f"{row['reader']} {failure['mutant']}: {failure['said']}", file=sys.stderr)
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
        (given.out / "mutants.json").write_text(json.dumps(rows, indent=1) + "\n")
        (given.out / "mutants.md").write_text(page(rows))
    return int(any(row["failed"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
