"""Bags as files: what is written is there, outlives kills and full disks, and others read it."""

from __future__ import annotations

import dataclasses
import fcntl
import gc
import hashlib
import json
import os
import re
import select
import shutil
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import mcap.reader
import mcap.records
import mcap.stream_reader
import mcap.writer
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from ember_ros import cdr, topics
from ember_ros.bag import run_writer as recording_module
from ember_ros.bag import storage as storage_module
from ember_ros.bag.reader import Bag
from ember_ros.bag.repair import Repaired, repair
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.run_writer import RunWriter, TickMessages
from ember_ros.bag.storage import METADATA, STORAGES, BagOptions, McapWriter, read_metadata, seal
from ember_ros.errors import BagError
from ember_ros.loop import Loop
from ember_ros.observer import Observer
from ember_ros.params import Params
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, BodyState
from leg_node.assembly import empty_table
from leg_node.table import Table
from sim_node.fake import FakeWorld
from support.bags import SHIPPED_BAG
from support.legs import LEGS
from support.runs import SignalLog
from support.waiting import DEADLINE_S

PARAMS = Params()
TICK_NS = PARAMS.gait.tick_ns
FLUSH = recording_module.FLUSH_TICKS
CONFIG = RunConfig("walker", 1, seed=3)
FALLS_AT = (5, 6, 40)
VERSIONS = {"ember_ros": "of this test"}
STRING = "std_msgs/msg/String"
STRING_RIHS01 = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
"""As ROS 2 Jazzy has it in ``share/std_msgs/msg/String.json``."""
JAZZY: Any = get_typestore(Stores.ROS2_JAZZY)
"""Wall time after which a condition is said not to come true. No test that passes waits for it."""
INSTALL_S = 180.0
"""The same for npm and the network."""
READERS = Path(__file__).parent / "readers"


# -- what is used all over -----------------------------------------------------------------------


class Written(NamedTuple):
    """A message as it lies in a file."""

    topic: str
    kind: str
    ns: int
    data: bytes


@contextmanager
def writing(folder: Path, *, split_mb: float = 0.0, split_s: float = 0.0) -> Iterator[McapWriter]:
    """Give a writer, and let go of its files if the test did not close it."""
    writer = McapWriter(BagOptions(folder, split_mb, split_s))
    try:
        yield writer
    finally:
        writer.abandon()


def put(writer: McapWriter, message: Written) -> None:
    """Write a message."""
    writer.write(writer.channel(message.topic, message.kind), message.ns, message.data)


def text(n: int, characters: int = 2000) -> Written:
    """Return the n-th message of many that differ and cannot be compressed much."""
    words = hashlib.shake_128(b"%d" % n).hexdigest(characters // 2)
    return Written(f"/said/{n % 3}", STRING, n * 1_000_000, cdr.pack_text(words))


def files_of(folder: Path) -> list[Path]:
    """Return a bag's files in the order in which they were begun."""
    files = [file for file in folder.iterdir() if file.suffix in STORAGES.values()]
    return sorted(files, key=lambda file: int(file.stem.rpartition("_")[2]))


def in_file(file: Path) -> Iterator[Written]:
    """Yield what is in a finished file, in the order in which it was written, by no code of ours.

    All CRCs are checked.
    """
    if file.suffix == ".db3":
        with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as database:
            yield from map(
                Written._make,
                database.execute(
                    "SELECT name, type, timestamp, data FROM messages "
                    "JOIN topics ON topics.id = topic_id ORDER BY messages.id"
                ),
            )
        return
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with file.open("rb") as raw:
        reader: Any = mcap.stream_reader.StreamReader(raw, validate_crcs=True)
        for record in reader.records:
            if isinstance(record, mcap.records.Schema):
                schemas[record.id] = record.name
            elif isinstance(record, mcap.records.Channel):
                channels[record.id] = record.topic, schemas[record.schema_id]
            elif isinstance(record, mcap.records.Message):
                assert record.publish_time == record.log_time
                yield Written(*channels[record.channel_id], record.log_time, record.data)


def written(folder: Path) -> list[Written]:
    """Return what is in all files of a bag."""
    return [message for file in files_of(folder) for message in in_file(file)]


def tree(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


def start_table() -> Table:
    """Return a table in which something is known."""
    table, rng = empty_table(PARAMS), np.random.default_rng(7)
    table.values[:] = rng.normal(size=len(table.values))
    table.visits[:] = rng.integers(0, 1000, len(table.visits))
    return table


def run_loop(ticks: int, *observers: Observer, config: RunConfig = CONFIG) -> None:
    """Run the loop in the fake world, which falls now and then."""
    loop = Loop(config, FakeWorld(config.legs, PARAMS, falls_at=FALLS_AT))
    for _ in range(ticks):
        loop.tick(*observers)


def record(
    folder: Path,
    ticks: int,
    *observers: Observer,
    split_mb: float = 0.0,
    split_s: float = 0.0,
    config: RunConfig = CONFIG,
    finish: bool = True,
) -> Path:
    """Record a run of the loop into a bag, finished or abandoned; return its folder."""
    table = start_table()
    with writing(folder, split_mb=split_mb, split_s=split_s) as writer:
        taking = RunWriter(writer, RunMetadata.of_config(config, table, VERSIONS), table)
        run_loop(ticks, taking, *observers, config=config)
        if finish:
            taking.finish()
            writer.close()
    return folder


def in_sqlite(folder: Path) -> Path:
    """Make a bag one of SQLite, as another recorder would have left it."""
    messages = written(folder)
    shutil.rmtree(folder)
    with RosbagsWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, ns, data in messages:
            if topic not in connections:
                text, rihs01 = storage_module.definition(kind)[:2]
                connections[topic] = writer.add_connection(topic, kind, msgdef=text, rihs01=rihs01)
            writer.write(connections[topic], ns, data)
    (made,) = folder.glob("*.db3")
    made.rename(folder / f"{folder.name}_0.db3")
    text = (folder / METADATA).read_text()
    (folder / METADATA).write_text(text.replace(made.name, f"{folder.name}_0.db3"))
    return folder


def decoded(message: Written) -> Any:
    """Return a message as rosbags reads it, which knows all types of Jazzy."""
    return JAZZY.deserialize_cdr(message.data, message.kind)


@contextmanager
def same_descriptors() -> Iterator[None]:
    """Hold that no file is left open."""
    gc.collect()
    before = sorted(os.listdir("/proc/self/fd"))
    yield
    gc.collect()  # what a traceback holds is not what somebody forgot
    assert sorted(os.listdir("/proc/self/fd")) == before, "a file was left open"


# -- the files -----------------------------------------------------------------------------------

messages = st.builds(
    lambda n, ns, data: Written(f"/topic_{n}", STRING, ns, data),
    st.integers(0, 3),
    st.integers(0, 2**62),
    st.binary(max_size=60),
)


@settings(max_examples=20)
@given(st.lists(st.lists(messages, max_size=6), max_size=5), st.sampled_from([0.0, 1e-4, 1.0]))
def test_all_that_is_written_is_there(flushes: list[list[Written]], split_s: float) -> None:
    """Whatever the bytes, the times and the flushes: the same messages in the same order.

    And ``metadata.yaml`` counts them, in all, by topic and by file, and says when they are.
    """
    everything = [message for each in flushes for message in each]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "bag"
        with writing(folder, split_s=split_s) as writer:
            for each in flushes:
                for message in each:
                    put(writer, message)
                writer.flush()
            assert writer.messages == len(everything)
            writer.close()
        assert written(folder) == everything
        metadata = read_metadata(folder)
        files = files_of(folder)
        assert metadata["relative_file_paths"] == [file.name for file in files]
        told = {
            each["topic_metadata"]["name"]: each["message_count"]
            for each in metadata["topics_with_message_count"]
        }
        named = [message.topic for message in everything]
        assert told == {topic: named.count(topic) for topic in named}
        parts = [(metadata, everything)]
        parts += [
            (each, list(in_file(file))) for each, file in zip(metadata["files"], files, strict=True)
        ]
        for said, found in parts:
            times = [message.ns for message in found] or [0]
            assert said["message_count"] == len(found)
            assert said["starting_time"] == {"nanoseconds_since_epoch": min(times)}
            assert said["duration"] == {"nanoseconds": max(times) - min(times)}


def test_the_metadata_is_that_of_jazzy(tmp_path: Path) -> None:
    """Version 9, and its words; the quality of service, the types and their hashes of topics."""
    folder = record(tmp_path / "walk", FLUSH)
    content = yaml.safe_load((folder / METADATA).read_text(encoding="utf-8"))
    (metadata,) = content.values()
    assert list(content) == ["rosbag2_bagfile_information"]
    assert set(metadata) == {
        "version", "storage_identifier", "duration", "starting_time", "message_count",
        "topics_with_message_count", "compression_format", "compression_mode",
        "relative_file_paths", "files", "custom_data", "ros_distro",
    }  # fmt: skip
    assert metadata["version"] == 9
    assert metadata["storage_identifier"] == "mcap"
    assert metadata["relative_file_paths"] == ["walk_0.mcap"]
    assert [each["path"] for each in metadata["files"]] == metadata["relative_file_paths"]
    assert metadata["compression_format"] == metadata["compression_mode"] == ""
    assert metadata["ros_distro"] == "jazzy"
    for each in metadata["topics_with_message_count"]:
        topic = each["topic_metadata"]
        assert set(topic) == {
            "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash"
        }  # fmt: skip
        assert topic["serialization_format"] == "cdr"
        assert re.fullmatch(r"RIHS01_[0-9a-f]{64}", topic["type_description_hash"])
        if topic["type"] == STRING:
            assert topic["type_description_hash"] == STRING_RIHS01
        (profile,) = topic["offered_qos_profiles"]
        assert profile["history"] == "keep_last"  # a word, not a number: that is version 9
    with Reader(folder) as reader:
        assert reader.ros_distro == "jazzy"
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles  # type: ignore[union-attr]
            assert qos.history == QosHistory.KEEP_LAST
            assert qos.depth == 1
            assert qos.reliability == QosReliability.RELIABLE
            assert qos.durability == QosDurability.TRANSIENT_LOCAL
            assert qos.liveliness == QosLiveliness.AUTOMATIC
            assert qos.deadline == qos.lifespan == QosTime(9223372036, 854775807)


def test_the_type_hashes_are_those_of_ros() -> None:
    """Where ROS is: the hash of each type in a bag is the one in ROS' own files."""
    prefixes = [sys.prefix, *os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
    kinds = {value.kind for value in vars(topics).values() if isinstance(value, topics.Topic)} | {
        topics.JOINT_STATE
    }
    found = {}
    for kind in kinds:
        package, folder, name = kind.split("/")
        for prefix in filter(None, prefixes):
            file = Path(prefix, "share", package, folder, f"{name}.json")
            if file.exists():
                hashes = json.loads(file.read_text())["type_hashes"]
                found[kind] = next(h["hash_string"] for h in hashes if h["type_name"] == kind)
    if not found:
        pytest.skip("no ROS installation here says what the hashes of its types are")
    assert found.keys() == kinds
    assert {kind: storage_module.definition(kind).rihs01 for kind in kinds} == found


def test_an_mcap_file_says_everything_itself(tmp_path: Path) -> None:
    """Profile, schemas, hashes, quality of service, as rosbag2 writes them; no name of a file."""
    folder = record(tmp_path / "walk", FLUSH)
    with files_of(folder)[0].open("rb") as raw:
        reader: Any = mcap.reader.make_reader(raw, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary.statistics.message_count == len(written(folder))
        assert summary.statistics.chunk_count == 2  # what determined the run, and a flush of ticks
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
            rihs01 = storage_module.definition(schema.name).rihs01
            assert channel.metadata["topic_type_hash"] == rihs01
            (qos,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
            assert qos == storage_module.QOS[0]
        assert list(reader.iter_metadata()) == []  # it would name the bag, which may be any


def test_the_same_messages_make_the_same_bytes(tmp_path: Path) -> None:
    """An MCAP bag of the same name is, file by file, what it was before; split or not."""
    for split_mb in (0.0, 0.02):
        for turn in "ab":
            with writing(tmp_path / f"{turn}{split_mb}" / "bag", split_mb=split_mb) as writer:
                for n in range(60):
                    put(writer, text(n))
                    if n % 7 == 0:
                        writer.flush()
                writer.close()
        one, other = tree(tmp_path / f"a{split_mb}"), tree(tmp_path / f"b{split_mb}")
        assert len(one) == 2 if split_mb == 0.0 else len(one) > 3
        assert one == other


def test_a_bag_is_never_written_over(tmp_path: Path) -> None:
    """Folder, file or link that is there already: refused, and left as it is."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_bytes(b"mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    record(tmp_path / "bag", 1)
    before = tree(tmp_path)
    for name in ("empty", "file", "link", "bag"):
        with pytest.raises(BagError, match=rf"{name} is there already, and a bag is never"):
            McapWriter(BagOptions(tmp_path / name))
    assert tree(tmp_path) == before
    assert not (tmp_path / "nowhere").exists()


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    """Below a file there is no folder: a BagError that names it and says why."""
    (tmp_path / "file").write_bytes(b"mine")
    with same_descriptors(), pytest.raises(BagError, match=r"file/bag: Not a directory"):
        McapWriter(BagOptions(tmp_path / "file" / "bag"))


def test_an_unknown_message_type_is_refused_and_costs_nothing_else(tmp_path: Path) -> None:
    """A BagError names it; what is written before and after is in a bag that closes well."""
    folder, reason = tmp_path / "bag", "type robot_msgs/msg/Leg is not part of Jazzy"
    with writing(folder) as writer:
        put(writer, text(0))
        for _ in range(2):
            with pytest.raises(BagError, match=reason):
                put(writer, Written("/leg", "robot_msgs/msg/Leg", 5, b"\0\1\0\0"))
        put(writer, text(1))
        writer.close()
    assert written(folder) == [text(0), text(1)]
    told = read_metadata(folder)["topics_with_message_count"]
    assert [each["topic_metadata"]["name"] for each in told] == [text(0).topic, text(1).topic]


# -- splitting -----------------------------------------------------------------------------------


def alone(file: Path) -> list[Written]:
    """Return what rosbags reads in one file without its bag, in the order of times."""
    with Reader(file) as reader:
        return [
            Written(connection.topic, connection.msgtype, ns, bytes(data))
            for connection, ns, data in reader.messages()
        ]


def test_splitting_by_size(tmp_path: Path) -> None:
    """A new file begins at the flush at which the old one has reached its megabytes.

    Each file can be read by itself; together they are all, in order, and so is the bag.
    """
    folder, every = tmp_path / "bag", [text(n) for n in range(200)]
    sizes = []
    with writing(folder, split_mb=0.1) as writer:
        for n, message in enumerate(every):
            put(writer, message)
            if n % 5 == 4:
                writer.flush()
                sizes.append(files_of(folder)[0].stat().st_size)
        writer.close()
    files = files_of(folder)
    assert [file.name for file in files] == [f"bag_{n}.mcap" for n in range(len(files))]
    assert len(files) > 2
    assert all(file.stat().st_size >= 100_000 for file in files[:-1])
    assert max(size for size in sizes if size < 100_000) > 80_000  # not split long before
    assert [message for file in files for message in alone(file)] == every
    assert alone(folder) == every


def test_splitting_by_time(tmp_path: Path) -> None:
    """A new file begins at the flush at which the old one spans its seconds of simulated time.

    A bag in many files is read as the same run.
    """
    folder = record(tmp_path / "bag", 100, split_s=0.5)
    whole = record(tmp_path / "whole", 100)
    files, told = files_of(folder), read_metadata(folder)["files"]
    assert len(files) > 2
    for each in told[:-1]:
        seconds = each["duration"]["nanoseconds"] * 1e-9
        assert 0.5 <= seconds <= 0.5 + FLUSH * TICK_NS * 1e-9
    assert written(folder) == written(whole)
    assert [m for file in files for m in sorted(alone(file))] == [
        m for file in files for m in sorted(in_file(file))
    ]
    with Bag(folder) as one, Bag(whole) as other:
        assert list(one.ticks()) == list(other.ticks())
        assert one.damages == other.damages == []


@pytest.mark.parametrize("split", [{"split_s": 1.0}, {"split_mb": 0.05}], ids=["time", "size"])
def test_no_file_is_begun_for_nothing(split: dict[str, float], tmp_path: Path) -> None:
    """A bag that ends, or is flushed again, just when it was to be split has no empty file."""
    folder = tmp_path / "bag"
    with writing(folder, **split) as writer:
        put(writer, text(0))
        put(writer, text(1, 100_000)._replace(ns=2_000_000_000))
        for _ in range(3):
            writer.flush()
        writer.close()
    assert [each["message_count"] for each in read_metadata(folder)["files"]] == [2]
    assert len(files_of(folder)) == 1


# -- the end of writing --------------------------------------------------------------------------


def test_closing_twice_is_once(tmp_path: Path) -> None:
    """The second time changes nothing, nor does abandoning; writing on is refused."""
    folder = tmp_path / "bag"
    with same_descriptors(), writing(folder) as writer:
        channel = writer.channel("/said", STRING)
        writer.write(channel, 1, cdr.pack_text("once"))
        writer.close({"fact": "kept"})
        before = tree(folder)
        writer.close({"fact": "lost"})
        writer.flush()
        writer.begin_file()
        writer.abandon()
        with pytest.raises(BagError, match=r"bag is closed"):
            writer.write(channel, 2, cdr.pack_text("twice"))
        with pytest.raises(BagError, match=r"bag is closed"):
            writer.channel("/new", STRING)
        assert tree(folder) == before
    assert set(before) == {METADATA, "bag_0.mcap"}  # no journal, no draft
    assert read_metadata(folder)["custom_data"] == {"fact": "kept"}


def test_an_abandoned_bag_is_cut_off_at_its_last_flush(tmp_path: Path) -> None:
    """It has no metadata, says how to repair it, and has after that what was flushed."""
    folder = tmp_path / "bag"
    with same_descriptors(), writing(folder) as writer:
        for n in range(20):
            put(writer, text(n))
            if n == 11:
                writer.flush()
        writer.abandon()
        writer.abandon()
        writer.close()
    assert not (folder / METADATA).exists()
    with pytest.raises(BagError, match=rf"cut off; `ember bag repair {folder}` restores it"):
        Bag(folder)
    done = repair(folder)
    assert (done.messages, done.damaged) == (12, 0)
    assert written(folder) == [text(n) for n in range(12)]


def test_a_bag_without_messages(tmp_path: Path) -> None:
    """It is a whole bag; there is just nothing in it."""
    folder = tmp_path / "bag"
    with writing(folder) as writer:
        writer.flush()
        writer.close()
    with Reader(folder) as reader:
        assert (reader.message_count, reader.duration, list(reader.messages())) == (0, 0, [])
    with pytest.raises(BagError, match="no robot of ember_ros"):
        Bag(folder)


def test_sealing_adds_what_was_known_later(tmp_path: Path) -> None:
    """Facts are added to those that are there; nothing else changes."""
    folder = tmp_path / "bag"
    with writing(folder) as writer:
        put(writer, text(0))
        writer.close({"a": "1", "b": "2"})
    metadata, files = read_metadata(folder), tree(folder)
    seal(folder, b="3", table_sha256="c0ffee")
    assert read_metadata(folder) == {
        **metadata,
        "custom_data": {"a": "1", "b": "3", "table_sha256": "c0ffee"},
    }
    after = tree(folder)
    assert after.keys() == files.keys()
    assert [name for name in files if after[name] != files[name]] == [METADATA]
    with Reader(folder) as reader:
        assert reader.storage.metadata.custom == {"a": "1", "b": "3", "table_sha256": "c0ffee"}


def test_sealing_what_is_no_closed_bag(tmp_path: Path) -> None:
    """Where there is no metadata, or something else in its place: a BagError, and nothing done."""
    with pytest.raises(BagError, match=r"nowhere/metadata\.yaml: No such file"):
        seal(tmp_path / "nowhere", fact="1")
    for wrong in ("[", "a list: [1]", "- 1", "rosbag2_bagfile_information: 3", "\udc80", ""):
        (tmp_path / METADATA).write_text(wrong, encoding="utf-8", errors="surrogateescape")
        before = tree(tmp_path)
        with pytest.raises(
            BagError, match=rf"(?s)is no metadata of a bag .*ember bag repair {tmp_path}"
        ):
            seal(tmp_path, fact="1")
        assert tree(tmp_path) == before


def test_sealing_on_a_full_disk(tmp_path: Path) -> None:
    """A BagError says so; the metadata that was there is whole and unchanged, and no draft left."""
    folder = record(tmp_path / "bag", FLUSH)
    before = tree(folder)
    (folder / f".{METADATA}").symlink_to("/dev/full")
    with pytest.raises(BagError, match=r"cannot write .*metadata\.yaml: No space left on device"):
        seal(folder, fact="1")
    assert tree(folder) == before
    assert sorted(file.name for file in folder.iterdir()) == sorted(before)


def test_a_disk_that_has_no_room_for_the_metadata(tmp_path: Path) -> None:
    """The last thing that is written can fail too: a BagError, and repair makes it anew."""
    folder = tmp_path / "bag"
    with same_descriptors(), writing(folder) as writer:
        put(writer, text(0))
        (folder / f".{METADATA}").symlink_to("/dev/full")
        with pytest.raises(BagError, match="No space left") as error:
            writer.close()
    assert f"`ember bag repair {folder}`" in str(error.value)
    with pytest.raises(BagError, match="ember bag repair"):
        Bag(folder)
    assert repair(folder).messages == 1
    assert written(folder) == [text(0)]
    assert sorted(file.name for file in folder.iterdir()) == ["bag_0.mcap", METADATA]


# -- full disks ----------------------------------------------------------------------------------

# Writes messages until the disk is full, and says what it was told then, and after that.
FULL = """
import json, resource, signal, sys
from pathlib import Path
from ember_ros.bag.storage import BagOptions, McapWriter
from ember_ros.errors import BagError

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
folder, when, room, texts = json.load(sys.stdin)
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]

def full(bytes):
    resource.setrlimit(resource.RLIMIT_FSIZE, (bytes, hard))

said = []
try:
    writer = McapWriter(BagOptions(Path(folder)))
    for n, (topic, kind, ns, data) in enumerate(texts):
        writer.write(writer.channel(topic, kind), ns, bytes.fromhex(data))
        if n % 10 == 9:
            writer.flush()
    full(max(file.stat().st_size for file in Path(folder).iterdir()) + room)
    if when == "close":
        writer.close({"note": "x" * 100_000})
    elif when == "split":
        writer.write(writer.channel("/said/0", kind), ns, bytes.fromhex(data))
        writer.begin_file()
    else:
        for n in range(40 if when == "flush" else 100_000):
            said = []
            topic, kind, ns, data = texts[n % len(texts)]
            writer.write(writer.channel(topic, kind), ns, bytes.fromhex(data))
        said = ["written"]
        writer.flush()
except BagError as error:
    said.append(str(error))
try:
    writer.write(0, ns, bytes.fromhex(data))
except BagError as error:
    said.append(str(error))
writer.flush()
writer.close()
writer.abandon()
json.dump(said, sys.stdout)
"""


def child(script: str, *given: Any) -> Any:
    """Run a script that reads JSON and prints JSON; any warning and any stray word fails it."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("when", "room"),
    [
        ("flush", 1000),
        ("flush", 0),
        ("split", 300),
        ("close", 0),
    ],
)
def test_a_full_disk_costs_what_was_not_flushed(when: str, room: int, tmp_path: Path) -> None:
    """A BagError names the bag, why, and what to do; then repair brings back all that was flushed.

    Whether the disk is full at a write, a flush, a split or at the end; torn bytes are let go of.
    The writer is closed then: more is refused, and nobody is told twice.
    """
    folder, every = tmp_path / "bag", [text(n) for n in range(40)]
    given = [[*message[:3], message.data.hex()] for message in every]
    *before, told, refused = child(FULL, str(folder), when, room, given)
    assert before == (["written"] if when == "flush" else [])
    assert told.startswith(f"cannot write the bag {folder}: ")
    assert f"`ember bag repair {folder}` restores what is in it" in told
    assert refused == f"the bag {folder} is closed"
    with pytest.raises(BagError, match=rf"cut off; `ember bag repair {folder}`"):
        Bag(folder)
    done = repair(folder)
    assert written(folder)[:40] == every
    if when == "split":  # its chunk may be whole or not
        assert done.messages in (40, 41)
    else:
        assert (done.messages, done.damaged) == (40, 0)
        assert done.torn_bytes == (room if when == "flush" else 0)


REPAIR = """
import json, resource, signal, sys
from pathlib import Path
from ember_ros.bag.repair import repair
from ember_ros.errors import BagError

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
folder, room = json.load(sys.stdin)
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
try:
    done = repr(repair(Path(folder)))
except BagError as error:
    done = str(error)
json.dump(done, sys.stdout)
"""


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_disk_that_is_full_while_repairing_costs_nothing(share: float, tmp_path: Path) -> None:
    """The repair fails as a BagError about this bag; the bag is as it was, and can be repaired."""
    folder, every = tmp_path / "bag", [text(n) for n in range(60)]
    with writing(folder) as writer:
        for n, message in enumerate(every):
            put(writer, message)
            if n % 10 == 9:
                writer.flush()
    before = tree(folder)
    told = child(REPAIR, str(folder), int(share * files_of(folder)[0].stat().st_size))
    assert tree(folder) == before, told
    assert sorted(file.name for file in folder.iterdir()) == sorted(before)
    assert told.startswith("cannot ")
    assert str(folder) in told
    assert ".repair" not in told  # that folder is gone: nobody can do anything with it
    assert repair(folder).messages == 60
    assert written(folder) == every


# -- recordings ----------------------------------------------------------------------------------


def expected_order(received: SignalLog, legs: Sequence[str] = LEGS) -> list[tuple[str, int]]:
    """Return the topics and ticks that a recording of a run must have, in their order."""
    found = [("/run/card", 0), ("/run/values", 0), ("/run/visits", 0)]
    falls = None
    for tick, body in enumerate(received.bodies):
        found.append(("/clock", tick))
        if body.falls != falls:
            falls = body.falls
            found.append(("/falls", tick))
        found.append(("/odometry", tick))
        for leg in legs:
            found += [(f"/{leg}/joint_states", tick), (f"/{leg}/contact", tick)]
        found.append(("/cpg/phase", tick))
        for leg, command in zip(legs, received.commands[tick], strict=True):
            if command is not None:
                found.append((f"/{leg}/command", tick))
        found += [(f"/{leg}/transition", tick) for leg in legs]
        if (tick + 1) % FLUSH == 0 or tick + 1 == len(received.bodies):
            found.append(("/run/crc", tick))
    return found


@pytest.mark.parametrize("world", ["walker", "trainer"])
def test_a_recording_is_every_tick_in_one_order(world: str, tmp_path: Path) -> None:
    """Each topic's message for each leg and tick, once, at exactly its tick's time.

    In the order of a tick; falls only when there are more; a CRC message after each flush of ticks
    and at the end.
    """
    received, config = SignalLog(), RunConfig(world, 1, seed=3)
    ticks = 3 * FLUSH + 5
    folder = record(tmp_path / "bag", ticks, received, config=config)
    found = written(folder)
    assert [(message.topic, message.ns) for message in found] == [
        (topic, tick * TICK_NS) for topic, tick in expected_order(received, config.legs)
    ]
    kinds = {message.topic: message.kind for message in found}
    assert {kinds[f"/{leg}/{what}"] for leg in config.legs for what in ("contact", "command")} == {
        "sensor_msgs/msg/JointState"
    }
    assert kinds["/clock"] == "rosgraph_msgs/msg/Clock"
    assert kinds["/odometry"] == "nav_msgs/msg/Odometry"
    assert kinds["/run/crc"] == "std_msgs/msg/UInt32MultiArray"


@pytest.fixture(scope="module")
def run_of_64(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SignalLog]:
    """A recording of 64 ticks, and what happened in it; nobody may change it."""
    received = SignalLog()
    return record(tmp_path_factory.mktemp("run") / "bag", 64, received), received


def test_a_recording_says_what_happened(run_of_64: tuple[Path, SignalLog]) -> None:
    """Read by rosbags, each message carries its tick's numbers, and its stamp is its log time."""
    folder, received = run_of_64
    by_topic: dict[str, list[Any]] = {}
    for message in written(folder):
        content = decoded(message)
        stamp = getattr(getattr(content, "header", None), "stamp", getattr(content, "clock", None))
        if stamp is not None:
            assert stamp.sec * 10**9 + stamp.nanosec == message.ns
        by_topic.setdefault(message.topic, []).append(content)
    for beat, said in zip(received.phases, by_topic["/cpg/phase"], strict=True):
        assert said.header.stamp.sec * 10**9 + said.header.stamp.nanosec == beat.tick * TICK_NS
        assert (said.name, said.position.tolist()) == (["cpg"], [beat.phase])
    assert [each.data for each in by_topic["/falls"]] == [0, 1, 2, 3]
    positions = [each.pose.pose.position for each in by_topic["/odometry"]]
    assert [(at.x, at.y, at.z) for at in positions] == [body[:3] for body in received.bodies]
    for n, leg in enumerate(LEGS):
        for sense, joints, contact in zip(
            [senses[n] for senses in received.senses],
            by_topic[f"/{leg}/joint_states"],
            by_topic[f"/{leg}/contact"],
            strict=True,
        ):
            assert joints.name == ["hip", "knee"]
            assert joints.position.tolist() == [sense.hip, sense.knee]
            assert joints.velocity.tolist() == [sense.hip_speed, sense.knee_speed]
            said = dict(zip(contact.name, contact.position.tolist(), strict=True))
            assert (said["slip"], said["inclination"]) == (sense.slip, sense.inclination)
            assert [said[bit] for bit in ("hair", "touch", "restart")] == list(sense[9:])
            assert contact.effort.tolist()[-2:] == [sense.force_mean, sense.force_peak]
        for commands, said in zip(received.commands, by_topic[f"/{leg}/command"], strict=True):
            command = commands[n]
            assert command is not None
            assert said.velocity.tolist() == list(command[1:3])
            assert said.effort.tolist() == list(command[3:])


def test_a_recording_is_read_as_the_run(run_of_64: tuple[Path, SignalLog]) -> None:
    """What comes out of the bag, tick by tick, is what happened, with every bit."""
    folder, received = run_of_64
    with Bag(folder) as bag:
        ticks = list(bag.ticks())
        assert (bag.damages, bag.stale) == ([], 0)
    assert [tick.tick for tick in ticks] == list(range(64))
    assert [tick.beat for tick in ticks] == received.phases
    assert [tick.senses for tick in ticks] == received.senses
    assert [tick.commands for tick in ticks] == received.commands
    assert [tick.body for tick in ticks] == received.bodies
    assert [tick.transitions for tick in ticks] == received.transitions


def crcs(folder: Path) -> dict[int, tuple[int, ...]]:
    """Return the CRC messages of a bag as rosbags reads them: tick, and a CRC a leg."""
    found: dict[int, tuple[int, ...]] = {}
    for message in written(folder):
        if message.topic != "/run/crc":
            continue
        content = decoded(message)
        count, legs = (dim.size for dim in content.layout.dim)
        assert [dim.label for dim in content.layout.dim] == ["tick", "leg"]
        assert [dim.stride for dim in content.layout.dim] == [count * legs, legs]
        assert content.layout.data_offset == 2
        low, high, *numbers = content.data.tolist()
        first = low + (high << 32)
        assert message.ns == (first + count - 1) * TICK_NS
        for n in range(count):
            assert first + n not in found
            found[first + n] = tuple(numbers[n * legs : (n + 1) * legs])
        assert len(numbers) == count * legs
    return found


def test_the_crcs_are_of_the_senses_as_they_lie(run_of_64: tuple[Path, SignalLog]) -> None:
    """Each tick and leg has one: CRC-32 of joint states and contact, byte for byte."""
    folder, _ = run_of_64
    data = {(message.topic, message.ns // TICK_NS): message.data for message in written(folder)}
    assert crcs(folder) == {
        tick: tuple(
            zlib.crc32(data[f"/{leg}/joint_states", tick] + data[f"/{leg}/contact", tick])
            for leg in LEGS
        )
        for tick in range(64)
    }


def test_card_and_table_come_back(run_of_64: tuple[Path, SignalLog]) -> None:
    """What determined the run is in the bag: the card, and the table with every bit."""
    folder, _ = run_of_64
    table = start_table()
    with Bag(folder) as bag:
        assert bag.run_metadata == RunMetadata.of_config(CONFIG, table, VERSIONS)
        assert bag.table is not None
        assert bag.table.sha256() == table.sha256() == bag.run_metadata.start_table_sha256
        assert bag.params == PARAMS
    first = {message.topic: decoded(message) for message in written(folder)[:3]}
    run_metadata = json.loads(first["/run/card"].data)
    assert run_metadata["legs"]["rear_left"] == {
        "stage": "walk", "seed": 3, "policy": "learned", "learning": True, "shared": True,
        "start_cycle": 0,
    }  # fmt: skip
    assert first["/run/values"].data.tolist() == table.values.tolist()
    assert first["/run/visits"].data.tolist() == table.visits.tolist()
    sizes = [dim.size for dim in first["/run/values"].layout.dim]
    assert sizes == [table.states, table.actions]


def test_a_table_that_nobody_knew_is_not_made_up(tmp_path: Path) -> None:
    """Without a table the bag has none, and neither topic has a message."""
    run_metadata = RunMetadata.of_config(CONFIG, start_table(), VERSIONS).without_table()
    with writing(tmp_path / "bag") as writer:
        taking = RunWriter(writer, run_metadata, None)
        run_loop(3, taking)
        taking.finish()
        writer.close()
    found = {message.topic for message in written(tmp_path / "bag")}
    assert "/run/card" in found
    assert not found & {"/run/values", "/run/visits"}
    with Bag(tmp_path / "bag") as bag:
        assert bag.table is None
        assert bag.run_metadata == run_metadata


class Without:
    """An observer that passes on what it hears, but for some commands.

    ``missing`` says of a tick and a leg's place whether its command is absent.
    """

    def __init__(self, other: Observer, missing: Callable[[int, int], bool]) -> None:
        self._other, self._missing = other, missing

    def tick(self, phase: Beat, senses: Any, commands: Any, body: BodyState, paid: Any) -> None:
        """Pass a tick on."""
        left = [None if self._missing(senses[0].tick, n) else c for n, c in enumerate(commands)]
        self._other.tick(phase, senses, left, body, paid)


def test_an_absent_command_leaves_no_message(tmp_path: Path) -> None:
    """A leg that did not answer has no command in the bag, and all others are there."""
    received, table = SignalLog(), start_table()

    def missing(tick: int, n: int) -> bool:
        return tick in (0, 7, 31) and n != 2

    with writing(tmp_path / "bag") as writer:
        taking = RunWriter(writer, RunMetadata.of_config(CONFIG, table, VERSIONS), table)
        run_loop(40, Without(taking, missing), Without(received, missing))
        taking.finish()
        writer.close()
    found = [(message.topic, message.ns // TICK_NS) for message in written(tmp_path / "bag")]
    assert found == expected_order(received)
    assert len(found) == len(set(found))
    assert sum(topic.endswith("/command") for topic, _ in found) == 4 * 40 - 9
    with Bag(tmp_path / "bag") as bag:
        assert [tick.commands for tick in bag.ticks()] == received.commands


@pytest.mark.parametrize("split_s", [0.0, 0.5])
def test_the_same_run_makes_the_same_bytes(split_s: float, tmp_path: Path) -> None:
    """Two recordings of one plan are equal, file by file; one of another seed is not.

    And the messages' files are equal whatever the bag is called.
    """
    plan3, plan4 = RunConfig("walker", 1, seed=3), RunConfig("walker", 1, seed=4)
    bags = [
        record(tmp_path / name / "bag", 70, config=config, split_s=split_s)
        for name, config in (("a", plan3), ("b", plan3), ("c", plan4))
    ]
    trees = [tree(bag) for bag in bags]
    assert trees[0] == trees[1]
    assert len(trees[0]) == (2 if split_s == 0.0 else 3)
    assert trees[0].keys() == trees[2].keys()
    assert trees[0] != trees[2]
    renamed = record(tmp_path / "of_another_name", 70, config=plan3, split_s=split_s)
    assert [f.read_bytes() for f in files_of(renamed)] == [
        f.read_bytes() for f in files_of(bags[0])
    ]


def test_a_robot_in_a_namespace(tmp_path: Path) -> None:
    """All its topics are below it, and are otherwise the same."""
    table = start_table()
    for name, namespace in (("plain", ""), ("named", "/lab/robot_2/")):
        run_metadata = RunMetadata.of_config(CONFIG, table, VERSIONS)
        with writing(tmp_path / name) as writer:
            taking = RunWriter(writer, run_metadata, table, namespace=namespace)
            run_loop(20, taking)
            taking.finish()
            writer.close()
    assert [
        message._replace(topic=f"/lab/robot_2{message.topic}")
        for message in written(tmp_path / "plain")
    ] == written(tmp_path / "named")
    with Bag(tmp_path / "named") as bag:
        assert bag.robots() == ["lab/robot_2"]
        assert len(list(bag.ticks())) == 20


def told(tick: int, *, silent: Sequence[int] = (), numb: Sequence[int] = ()) -> TickMessages:
    """Return made-up messages of a tick; legs in ``silent`` have none, in ``numb`` no contact."""
    mark = b"%d" % tick
    return TickMessages(
        b"clock" + mark,
        None,
        b"odometry" + mark,
        [None if n in silent else b"joints%d" % n + mark for n in range(4)],
        [None if n in silent or n in numb else b"contact%d" % n + mark for n in range(4)],
        b"phase" + mark,
        [None if n in silent else b"command%d" % n + mark for n in range(4)],
        [None if n in silent else b"transition%d" % n + mark for n in range(4)],
    )


def test_bytes_that_were_heard_are_kept_as_they_are(tmp_path: Path) -> None:
    """Also of a run that is heard late and with gaps: nothing is moved, and nothing made up.

    What was not heard leaves no message; its CRC is that of what there is; the CRCs of ticks
    before and after a gap are in messages of their own.
    """
    table = start_table()
    run_metadata = dataclasses.replace(
        RunMetadata.of_config(CONFIG, table, VERSIONS), first_tick=2**33 + 20
    )
    ticks = [*range(2**33 + 20, 2**33 + 45), *range(2**33 + 90, 2**33 + 93)]
    said = {tick: told(tick) for tick in ticks}
    said[ticks[3]] = told(ticks[3], silent=[1], numb=[2])
    with writing(tmp_path / "bag") as writer:
        taking = RunWriter(writer, run_metadata, None)
        for tick in ticks:
            taking.write(tick, said[tick])
        taking.finish()
        assert taking.ticks == len(ticks)
        writer.close()
    found = written(tmp_path / "bag")
    assert found[0].ns == (2**33 + 20) * TICK_NS
    received = [message for message in found if not message.topic.startswith("/run/")]
    expected = []
    for tick, one in said.items():
        senses = [each for update in zip(one.joints, one.contacts, strict=True) for each in update]
        parts = [one.clock, one.odometry, *senses, one.phase, *one.commands, *one.transitions]
        expected += [(tick * TICK_NS, data) for data in parts if data is not None]
    assert [(message.ns, message.data) for message in received] == expected
    assert crcs(tmp_path / "bag") == {
        tick: tuple(
            zlib.crc32((joints or b"") + (contact or b""))
            for joints, contact in zip(one.joints, one.contacts, strict=True)
        )
        for tick, one in said.items()
    }


# -- kill -9 -------------------------------------------------------------------------------------

# Records without end, and says after each flush how many ticks are flushed.
ENDLESS = """
import sys
from pathlib import Path
import numpy as np
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.run_writer import FLUSH_TICKS, RunWriter
from ember_ros.bag.storage import BagOptions, McapWriter
from ember_ros.loop import Loop
from ember_ros.params import Params
from ember_ros.run_config import RunConfig
from leg_node.assembly import empty_table
from sim_node.fake import FakeWorld

folder, versions, falls_at = eval(sys.argv[1])
config, table, rng = RunConfig("walker", 1, seed=3), empty_table(Params()), np.random.default_rng(7)
table.values[:] = rng.normal(size=len(table.values))
table.visits[:] = rng.integers(0, 1000, len(table.visits))
loop = Loop(config, FakeWorld(config.legs, Params(), falls_at=falls_at))
recording = RunWriter(
    McapWriter(BagOptions(Path(folder))), RunMetadata.of_config(config, table, versions), table
)
while True:
    loop.tick(recording)
    if loop.now % FLUSH_TICKS == 0:
        print(loop.now, flush=True)
"""


def killed_at(folder: Path, ticks: int) -> int:
    """Record until so many ticks are flushed, then kill -9; return how many were said to be."""
    given = repr((str(folder), VERSIONS, FALLS_AT))
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", ENDLESS, given],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    said, deadline = b"", time.monotonic() + DEADLINE_S
    try:
        while last(said) < ticks:
            left = max(0.0, deadline - time.monotonic())
            assert select.select([process.stdout], [], [], left)[0], f"{ticks} ticks: not in time"
            fresh = os.read(process.stdout.fileno(), 1 << 16)
            assert fresh, f"ended by itself after {said!r}"
            said += fresh
    finally:
        process.kill()
        said += process.stdout.read()
        process.stdout.close()
        code = process.wait(DEADLINE_S)
    assert code == -9
    return last(said)


def last(said: bytes) -> int:
    """Return the number in the last whole line."""
    lines = said.rpartition(b"\n")[0].split()
    return int(lines[-1]) if lines else 0


@pytest.mark.parametrize("ticks", [16, 80, 160, 304, 480])
@pytest.mark.slow
def test_a_kill_costs_what_was_not_flushed(ticks: int, tmp_path: Path) -> None:
    """Killed with -9 at any time: after a repair all flushed ticks are there, each whole.

    Every byte is as in a recording that nobody disturbed, and the CRCs hold. Before, the bag says
    how to repair it.
    """
    folder = tmp_path / "killed"
    flushed = killed_at(folder, ticks)
    assert flushed >= ticks
    with pytest.raises(BagError, match=rf"cut off; `ember bag repair {folder}` restores it"):
        Bag(folder)
    done = repair(folder)
    with Bag(folder) as bag:
        found = list(bag.ticks())
        assert bag.damages == []
    assert len(found) >= flushed
    assert [tick.tick for tick in found] == list(range(len(found)))
    received = SignalLog()
    whole = record(tmp_path / "whole", len(found), received)
    assert written(folder) == written(whole)
    assert [tick.senses for tick in found] == received.senses
    assert [tick.commands for tick in found] == received.commands
    assert [tick.body for tick in found] == received.bodies
    assert done.messages == len(written(whole))
    assert done.damaged == 0
    assert done.seconds == pytest.approx((len(found) - 1) * TICK_NS * 1e-9)
    assert sorted(file.name for file in folder.iterdir()) == [
        "killed_0.mcap", METADATA
    ]  # fmt: skip


# -- repairs -------------------------------------------------------------------------------------

CHUNK, MAGIC = 0x06, 8


class RunRecord(NamedTuple):
    """A record of an MCAP file."""

    kind: int
    start: int
    end: int


def records_in(data: bytes) -> list[RunRecord]:
    """Return the whole records of an MCAP file that may be cut off."""
    found: list[RunRecord] = []
    at = MAGIC
    while at + 9 <= len(data):
        kind, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            break
        found.append(RunRecord(kind, at, at + 9 + length))
        at = found[-1].end
    return found


def chunks_in(data: bytes) -> list[bytes]:
    """Return the whole chunks of an MCAP file, each with its head."""
    return [data[each.start : each.end] for each in records_in(data) if each.kind == CHUNK]


class Whole(NamedTuple):
    """A finished bag of one MCAP file."""

    name: str
    data: bytes
    metadata: bytes
    messages: list[Written]
    chunks: list[RunRecord]
    by_chunk: list[list[Written]]


@pytest.fixture(scope="module")
def whole(run_of_64: tuple[Path, SignalLog]) -> Whole:
    """The recording of 64 ticks, taken apart."""
    folder, _ = run_of_64
    (file,) = files_of(folder)
    data, everything = file.read_bytes(), written(folder)
    by_chunk: list[list[Written]] = [[]]
    for message in everything:  # a chunk ends with the table, or with CRCs
        by_chunk[-1].append(message)
        if message.topic in ("/run/visits", "/run/crc"):
            by_chunk.append([])
    chunks = [each for each in records_in(data) if each.kind == CHUNK]
    assert len(chunks) == len(by_chunk) - 1 == 1 + 64 // FLUSH
    return Whole(
        file.name, data, (folder / METADATA).read_bytes(), everything, chunks, by_chunk[:-1]
    )


@contextmanager
def bag_of(whole: Whole, data: bytes, *, metadata: bool = True) -> Iterator[Path]:
    """Give the folder of a bag with other bytes in its file."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "bag"
        folder.mkdir()
        (folder / whole.name).write_bytes(data)
        if metadata:
            (folder / METADATA).write_bytes(whole.metadata)
        yield folder


def refuses(folder: Path, reason: str) -> None:
    """Hold that a repair is refused, and leaves everything as it is."""
    before = tree(folder) if folder.is_dir() else {}
    names = sorted(file.name for file in folder.iterdir()) if folder.is_dir() else []
    with same_descriptors(), pytest.raises(BagError, match=reason):
        repair(folder)
    if folder.is_dir():
        assert tree(folder) == before
        assert sorted(file.name for file in folder.iterdir()) == names


def cut(whole: Whole, offset: int, *, metadata: bool) -> None:
    """Hold that a bag whose file ends at an offset comes back up to its last whole chunk."""
    kept = sum(each.end <= offset for each in whole.chunks)
    with bag_of(whole, whole.data[:offset], metadata=metadata) as folder:
        if not kept:
            refuses(folder, rf"nothing in {folder} is intact")
            return
        done = repair(folder)
        (file,) = files_of(folder)
        assert file.name == whole.name
        assert chunks_in(file.read_bytes()) == chunks_in(whole.data)[:kept]
        left = [message for each in whole.by_chunk[:kept] for message in each]
        assert written(folder) == left
        ends = [each.end for each in records_in(whole.data[:offset])]
        behind = 0 if offset == len(whole.data) else offset - ends[-1]
        if metadata and offset == len(whole.data):
            assert done.healthy
            return
        assert done == Repaired(len(left), done.seconds, kept, 0, behind, done.original)
        assert done.seconds == pytest.approx(max(m.ns for m in left) * 1e-9)
        told = read_metadata(folder)
        assert told["message_count"] == len(left)
        with Reader(folder) as reader:
            assert reader.message_count == len(left)


@pytest.mark.slow
@pytest.mark.parametrize("beside", [-1, 0, 1])
def test_a_bag_cut_off_near_the_end_of_a_chunk(whole: Whole, beside: int) -> None:
    """One byte decides: a chunk is brought back if its last byte is there, and else is not."""
    for each in whole.chunks:
        cut(whole, each.start + beside, metadata=False)
        cut(whole, each.end + beside, metadata=False)


@pytest.mark.slow
@settings(max_examples=30)
@given(st.floats(0.0, 1.0), st.booleans())
def test_a_bag_cut_off_anywhere(whole: Whole, share: float, metadata: bool) -> None:
    """Wherever the file ends: the whole chunks before come back, with all their bytes, or none is.

    Metadata of the bag that it once was does not change that.
    """
    cut(whole, int(share * len(whole.data)), metadata=metadata)


@pytest.mark.parametrize("offset", [0, 1, 7, 8, 9, 20])
def test_a_bag_cut_off_before_anything_is_whole(whole: Whole, offset: int) -> None:
    """An empty file, half a magic number, half a header: nothing to bring back, as a BagError."""
    cut(whole, offset, metadata=False)


def test_repairing_a_whole_bag_changes_nothing(whole: Whole) -> None:
    """Not a byte; nothing is damaged and nothing is torn. Without metadata these are made anew."""
    with bag_of(whole, whole.data, metadata=False) as folder:
        done = repair(folder)
        assert done == Repaired(
            len(whole.messages), done.seconds, len(whole.chunks), 0, 0, done.original
        )
        assert tree(folder) == {whole.name: whole.data, METADATA: whole.metadata}
        assert done.original is not None
        assert tree(done.original) == {whole.name: whole.data}
        before = {file: file.stat().st_mtime_ns for file in (folder, *folder.iterdir())}
        again = repair(folder)
        assert again == Repaired(len(whole.messages), done.seconds, 0, 0, 0, healthy=True)
        assert {file: file.stat().st_mtime_ns for file in before} == before
        assert tree(folder) == {whole.name: whole.data, METADATA: whole.metadata}


def flipped(data: bytes, at: int, bit: int = 0) -> bytes:
    """Return data with one bit the other way round."""
    return data[:at] + bytes([data[at] ^ (1 << bit)]) + data[at + 1 :]


@pytest.mark.parametrize("n", range(1 + 64 // FLUSH))
def test_a_damaged_chunk_costs_itself(whole: Whole, n: int) -> None:
    """Bits of one chunk turn: it is said to be damaged, and all others are kept, whole.

    More than one, since now and then one alone means nothing to the decompressor.
    """
    chunk = whole.chunks[n]
    data, middle = whole.data, (chunk.start + chunk.end) // 2
    for at in range(middle, middle + 8):
        data = flipped(data, at)
    with bag_of(whole, data) as folder:
        done = repair(folder)
        assert (done.chunks, done.damaged) == (len(whole.chunks) - 1, 1)
        left = [m for k, each in enumerate(whole.by_chunk) if k != n for m in each]
        assert written(folder) == left
        assert done.messages == len(left)
        with Bag(folder) as bag:
            lost = set(range((n - 1) * FLUSH, n * FLUSH)) if n else set()
            assert [t.tick for t in bag.ticks()] == [t for t in range(64) if t not in lost]
            assert bag.damages == []


def test_a_damaged_chunk_in_a_bag_that_was_cut_off(whole: Whole) -> None:
    """Both at once: the whole chunks before and after are kept, up to the torn one."""
    _, one, two, three, four = whole.chunks
    data = flipped(whole.data, (two.start + two.end) // 2)[: four.end - 5]
    with bag_of(whole, data, metadata=False) as folder:
        done = repair(folder)
        assert (done.chunks, done.damaged) == (3, 1)
        assert written(folder) == [m for n in (0, 1, 3) for m in whole.by_chunk[n]]
    assert one.end < three.start


def is_part(some: Iterable[Written], every: Iterable[Written]) -> bool:
    """Return whether some are among all, in the same order."""
    rest = iter(every)
    return all(each in rest for each in some)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 7))
def test_whatever_bit_turns_nothing_is_made_up(whole: Whole, share: float, bit: int) -> None:
    """Of any bit in the file: what comes back was written, in its order; or a BagError says why."""
    data = flipped(whole.data, int(share * len(whole.data)), bit)
    with bag_of(whole, data) as folder:
        before = tree(folder)
        try:
            done = repair(folder)
        except BagError:
            assert tree(folder) == before
            return
        found = written(folder)
        assert done.messages == len(found) > 0
        assert is_part(found, whole.messages)


@pytest.mark.parametrize("share", [0.001, 0.5, 0.999])
def test_a_database_that_was_cut_off(share: float, tmp_path: Path) -> None:
    """What is no whole database is left as it is, with a BagError; or what comes back was in it."""
    folder = in_sqlite(record(tmp_path / "bag", 32))
    everything, (file,) = written(folder), files_of(folder)
    os.truncate(file, int(share * file.stat().st_size))
    before = tree(folder)
    try:
        done = repair(folder)
    except BagError:
        assert tree(folder) == before
        assert list(folder.parent.iterdir()) == [folder]
    else:
        assert done.messages == len(written(folder))
        assert is_part(written(folder), everything)


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE messages SET topic_id = 99 WHERE id = 100",
        "UPDATE messages SET timestamp = 'noon' WHERE id = 100",
        "UPDATE messages SET data = 5 WHERE id = 100",
        "DELETE FROM topics WHERE id = 4",
        "UPDATE topics SET type = x'ff' WHERE id = 4",
        "DROP TABLE messages",
    ],
    ids=["no topic", "no time", "no bytes", "topic lost", "no type", "no messages"],
)
@pytest.mark.slow
def test_a_database_with_nonsense_in_it(damage: str, tmp_path: Path) -> None:
    """A message of no topic, a time that is none: a BagError names the bag, which is left alone."""
    folder = in_sqlite(record(tmp_path / "bag", 16))
    (file,) = files_of(folder)
    with closing(sqlite3.connect(file)) as database:
        database.execute(damage)
        database.commit()
    refuses(folder, re.escape(str(folder)))


def test_a_bag_cut_off_before_its_first_flush(tmp_path: Path) -> None:
    """There is nothing to bring back, which is said; what there is stays."""
    folder = tmp_path / "bag"
    with writing(folder) as writer:
        put(writer, text(0))
    refuses(folder, rf"nothing in {folder} is intact")


@pytest.mark.parametrize("metadata", [True, False])
def test_a_database_with_a_journal_was_not_closed(metadata: bool, tmp_path: Path) -> None:
    """It is refused, and comes back as MCAP; the old one lies beside, to the byte."""
    folder = in_sqlite(record(tmp_path / "bag", 16))
    everything, (file,) = written(folder), files_of(folder)
    Path(f"{file}-journal").write_bytes(bytes(512))
    if not metadata:
        (folder / METADATA).unlink()
    before = tree(folder)
    with pytest.raises(BagError, match="ember bag repair"):
        Bag(folder)
    done = repair(folder)
    assert sorted(each.name for each in folder.iterdir()) == ["bag_0.mcap", METADATA]
    assert written(folder) == everything
    assert done.original == tmp_path / "bag.orig"
    assert tree(done.original) == before


@pytest.mark.parametrize("ticks", [70, 100, 130])
def test_a_split_bag_that_was_cut_off(ticks: int, tmp_path: Path) -> None:
    """The last file is torn, or has nothing in it yet: the run goes on over all files.

    Finished files of MCAP are kept to the byte.
    """
    folder = record(tmp_path / "bag", ticks, split_s=0.5, finish=False)
    *finished, _ = files_of(folder)
    before = tree(folder)
    assert len(finished) == ticks // 48
    repair(folder)
    flushed = ticks // FLUSH * FLUSH
    whole = record(tmp_path / "whole", flushed)
    assert written(folder) == written(whole)
    assert set(tree(folder)) <= {*before, METADATA}
    after = tree(folder)
    for file in finished:
        assert after[file.name] == before[file.name]
    with Bag(folder) as bag:
        assert [tick.tick for tick in bag.ticks()] == list(range(flushed))


def test_a_split_bag_with_a_file_missing(tmp_path: Path) -> None:
    """The other files are kept, and are files of a bag again, none of the old ones beside them."""
    folder = record(tmp_path / "bag", 100, split_s=0.5)
    first, gone, third = files_of(folder)
    left = [*in_file(first), *in_file(third)]
    gone.unlink()
    with pytest.raises(BagError, match="ember bag repair"):
        Bag(folder)
    repair(folder)
    assert written(folder) == left
    assert [file.name for file in files_of(folder)] == [first.name, gone.name]
    with Bag(folder) as bag:
        assert len(list(bag.ticks())) < 100


def test_repairing_what_is_no_bag(tmp_path: Path) -> None:
    """Nothing, an empty folder, a folder of something else, a file: each said, and left alone."""
    refuses(tmp_path / "nowhere", "there is no bag .*nowhere; the folder of a bag would be right")
    (tmp_path / "empty").mkdir()
    refuses(tmp_path / "empty", r"empty is no bag: it has no file of \.mcap or \.db3")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    (tmp_path / "other" / METADATA).write_text("mine")
    refuses(tmp_path / "other", "other is no bag")
    refuses(tmp_path / "other" / "notes.txt", "notes.txt is one file; its folder")
    assert (tmp_path / "other" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("content", [b"", b"mine, and no bag at all\n" * 100])
@pytest.mark.parametrize(
    ("ending", "reason"),
    [(".mcap", "nothing in .*bag is intact"), (".db3", "is no intact database")],
)
@pytest.mark.slow
def test_repairing_files_that_only_look_like_a_bag(
    ending: str, reason: str, content: bytes, tmp_path: Path
) -> None:
    """An empty file, or a text: a BagError, and it is still there."""
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / f"bag_0{ending}").write_bytes(content)
    refuses(tmp_path / "bag", reason)


def test_repairing_the_bag_of_another_recorder(tmp_path: Path) -> None:
    """Types that Jazzy does not come with are kept, with the definition that is in the file."""
    folder = tmp_path / "bag"
    folder.mkdir()
    with (folder / "bag_0.mcap").open("wb") as out:
        writer: Any = mcap.writer.Writer(out)
        writer.start("ros2")
        for kind in (STRING, "robot_msgs/msg/Leg"):
            schema = writer.register_schema(kind, "ros2msg", b"string data")
            channel = writer.register_channel(f"/{kind[:5]}", "cdr", schema)
            for n in range(3):
                writer.add_message(channel, n, cdr.pack_text(str(n)), n)
            writer.flush()
    assert repair(folder).messages == 6
    with (folder / "bag_0.mcap").open("rb") as raw:
        reader: Any = mcap.reader.make_reader(raw, validate_crcs=True)
        found = [
            (s.name, s.encoding, s.data, c.topic, m.data) for s, c, m in reader.iter_messages()
        ]
    assert sorted(found) == sorted(
        (kind, "ros2msg", b"string data", f"/{kind[:5]}", cdr.pack_text(str(n)))
        for kind in (STRING, "robot_msgs/msg/Leg")
        for n in range(3)
    )


def test_a_repair_that_cannot_put_its_files_in_place(
    whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Should even the last step fail, the bag that was there is still there."""
    with bag_of(whole, whole.data[: whole.chunks[3].end], metadata=False) as folder:
        rename = os.rename

        def refuse(source: Path, target: Path) -> None:
            if Path(target) == folder and Path(source).parent != folder.parent:
                raise PermissionError(1, "Operation not permitted")
            rename(source, target)

        with monkeypatch.context() as patch:
            patch.setattr(os, "rename", refuse)
            refuses(folder, rf"cannot repair {folder}: Operation not permitted")
        assert repair(folder).chunks == 4


def test_a_bag_that_is_being_written_is_not_repaired(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever writes it goes on undisturbed; when it is closed, so is the matter."""
    monkeypatch.setattr(storage_module, "LOCK_S", 0.0)
    folder = tmp_path / "bag"
    with writing(folder) as writer:
        put(writer, text(0))
        writer.flush()
        refuses(folder, rf"{folder} is being written now; stop the recording first")
        put(writer, text(1))
        writer.close()
    assert written(folder) == [text(0), text(1)]
    assert repair(folder).messages == 2


# -- readers of others ---------------------------------------------------------------------------


def lay(value: Any) -> bytes:
    """Return a message's content as bytes, in the same way whoever decoded it.

    Numbers and bits are doubles, and no integer may be none; strings and arrays have their length
    before them; fields come in the order of the definition. All little endian.
    """
    if isinstance(value, str):
        coded = value.encode()
        return struct.pack("<d", len(coded)) + coded
    if isinstance(value, (int, float)):
        assert float(value) == value
        return struct.pack("<d", value)
    if hasattr(value, "__len__"):
        if len(value) and not isinstance(value[0], (int, float, np.generic)):
            return struct.pack("<d", len(value)) + b"".join(map(lay, value))
        numbers = np.asarray(value)
        doubles = numbers.astype("<f8")
        assert (doubles.astype(numbers.dtype) == numbers).all()
        return struct.pack("<d", len(value)) + doubles.tobytes()
    if dataclasses.is_dataclass(value):
        names = [f.name for f in dataclasses.fields(value) if not f.name.startswith("__")]
    else:
        names = list(value.__slots__)
    return b"".join(lay(getattr(value, name)) for name in names)


def summed(messages: Iterable[tuple[str, int, Any]]) -> dict[str, dict[str, Any]]:
    """Return what ``readers/read.mjs`` says: by topic, counts, hashes and sums."""
    found: dict[str, dict[str, Any]] = {}
    hashes: dict[str, Any] = {}
    for topic, ns, message in messages:
        one = found.setdefault(topic, {"count": 0, "positions": 0.0, "stamps": 0})
        one["count"] += 1
        digest = hashes.setdefault(topic, hashlib.sha256())
        digest.update(struct.pack("<Q", ns) + lay(message))
        for position in getattr(message, "position", ()):
            one["positions"] += float(position)  # one by one: sum() may be more exact
        header = getattr(message, "header", None)
        stamp = header.stamp if header is not None else getattr(message, "clock", None)
        if stamp is not None:
            one["stamps"] += stamp.sec * 10**9 + stamp.nanosec
    return {
        topic: {**one, "stamps": str(one["stamps"]), "sha256": hashes[topic].hexdigest()}
        for topic, one in found.items()
    }


def by_rosbags(folder: Path) -> dict[str, dict[str, Any]]:
    """Read a bag with rosbags, by its own definitions of the types of Jazzy."""
    with Reader(folder) as reader:
        return summed(
            (connection.topic, ns, JAZZY.deserialize_cdr(data, connection.msgtype))
            for connection, ns, data in reader.messages()
        )


def by_mcap(folder: Path) -> dict[str, dict[str, Any]]:
    """Read a bag with the library of the MCAP project, by the definitions in the bag."""

    def every() -> Iterator[tuple[str, int, Any]]:
        for file in files_of(folder):
            with file.open("rb") as raw:
                reader: Any = mcap.reader.make_reader(
                    raw, validate_crcs=True, decoder_factories=[DecoderFactory()]
                )
                for _, channel, message, content in reader.iter_decoded_messages():
                    yield channel.topic, message.log_time, content

    return summed(every())


OFFLINE = re.compile(
    r"ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ECONNRESET|ETIMEDOUT|ENETUNREACH|EHOSTUNREACH|ERR_SOCKET"
)


def installed() -> bool:
    """Return whether the JavaScript libraries are there, in the versions asked for."""
    wanted = json.loads((READERS / "package.json").read_text())["dependencies"]
    for name, version in wanted.items():
        package = READERS / "node_modules" / name / "package.json"
        if not package.exists() or json.loads(package.read_text())["version"] != version:
            return False
    return True


@pytest.fixture(scope="module")
def by_javascript() -> Callable[[Path], dict[str, dict[str, Any]]]:
    """Read a bag with @mcap/core and the libraries of Foxglove, by the definitions in the bag."""
    npm, node = shutil.which("npm"), shutil.which("node")
    if npm is None or node is None:
        pytest.skip("npm is not on the PATH: no JavaScript reads the bags")
    with Path(tempfile.gettempdir(), f"ember_ros_test_npm.{os.getuid()}").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another test run may be at it
        if not installed():
            done = subprocess.run(
                [npm, "install", "--no-package-lock"],
                cwd=READERS,
                capture_output=True,
                text=True,
                timeout=INSTALL_S,
                check=False,
            )
            if done.returncode and OFFLINE.search(done.stderr):
                pytest.skip("npm has no network: no JavaScript reads the bags")
            assert done.returncode == 0, done.stderr
            assert installed()

    def read(folder: Path) -> dict[str, dict[str, Any]]:
        done = subprocess.run(
            [node, str(READERS / "read.mjs"), *map(str, files_of(folder))],
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
        found: dict[str, dict[str, Any]] = json.loads(done.stdout)
        return found

    return read


class Extreme:
    """An observer that passes on what it hears, but makes numbers of one tick hard to carry."""

    def __init__(self, other: Observer) -> None:
        self._other = other

    def tick(self, phase: Beat, senses: Any, commands: Any, body: BodyState, paid: Any) -> None:
        """Pass a tick on."""
        if senses[0].tick == 9:
            hard = senses[1]._replace(
                hip=-0.0, knee=5e-324, hip_speed=-2.2e-308, knee_speed=1.7e308, slip=1 / 3
            )
            senses = (senses[0], hard, *senses[2:])
            body = body._replace(x=-1e-300, yaw=3.14159)
        self._other.tick(phase, senses, commands, body, paid)


def bag_for_readers(folder: Path, state: str) -> dict[str, int]:
    """Record a run into a bag that is as ``state`` says; return how many messages topics have."""
    table = start_table()
    with writing(folder, split_s=0.5 if state == "split" else 0.0) as writer:
        taking = RunWriter(writer, RunMetadata.of_config(CONFIG, table, VERSIONS), table)
        run_loop(90, Extreme(taking))
        if state != "repaired":
            taking.finish()
            writer.close()
    if state == "repaired":
        repair(folder)
    ticks = 80 if state == "repaired" else 90
    counts = {"/run/card": 1, "/run/values": 1, "/run/visits": 1, "/run/crc": -(-ticks // FLUSH)}
    counts |= {"/clock": ticks, "/odometry": ticks, "/cpg/phase": ticks}
    counts["/falls"] = 1 + len(FALLS_AT)
    for leg in LEGS:
        for what in ("joint_states", "contact", "command", "transition"):
            counts[f"/{leg}/{what}"] = ticks
    return counts


every_state = pytest.mark.parametrize("state", ["whole", "split", "repaired"])


@every_state
@pytest.mark.slow
def test_two_readers_in_python_agree(state: str, tmp_path: Path) -> None:
    """They decode every message of the same bag, and count the same, topic by topic.

    Each number, name and time is the same, to the last bit.
    """
    folder = tmp_path / "bag"
    counts = bag_for_readers(folder, state)
    found = by_rosbags(folder)
    assert {topic: one["count"] for topic, one in found.items()} == counts
    assert by_mcap(folder) == found
    joints = [found[f"/{leg}/joint_states"] for leg in LEGS]
    ticks = counts["/clock"]
    assert {one["stamps"] for one in joints} == {str(TICK_NS * ticks * (ticks - 1) // 2)}
    assert len({one["positions"] for one in joints}) > 1


@pytest.mark.slow
@every_state
def test_a_reader_in_javascript_agrees(
    state: str, tmp_path: Path, by_javascript: Callable[[Path], dict[str, dict[str, Any]]]
) -> None:
    """The libraries of Foxglove decode every message too, to the same counts, sums and hashes."""
    folder = tmp_path / "bag"
    bag_for_readers(folder, state)
    assert by_javascript(folder) == by_rosbags(folder)


@pytest.mark.slow
def test_repairing_a_whole_bag_keeps_what_is_known_of_its_end(tmp_path: Path) -> None:
    """A bag that lacks nothing keeps the SHA-256 of its table; one that was cut does not."""
    for name, cut in (("whole", 0), ("cut", 100_000)):
        folder = tmp_path / name / "walk"
        shutil.copytree(SHIPPED_BAG, folder)
        file = folder / "walk_0.mcap"
        data = file.read_bytes()
        file.write_bytes(data[: len(data) - cut])
        repair(folder)
        known = read_metadata(folder)["custom_data"]
        assert (known == read_metadata(SHIPPED_BAG)["custom_data"]) is (cut == 0)
        if not cut:
            assert file.read_bytes() == data
