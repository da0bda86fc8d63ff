"""One walk as other recorders leave it: every layout of rosbag2, by its storage, version and habit.

What is read is read whole, with all its bits; what cannot be is refused in words.
"""

from __future__ import annotations

import random
import sqlite3
from collections import Counter
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml

from ember_ros.bag.reader import Bag
from ember_ros.bag.storage import INFORMATION, METADATA
from ember_ros.errors import BagError
from support.bags import SHIPPED_BAG
from support.needs import needs_bags

pytestmark = needs_bags

CYCLES_S = 1.0
"""So much of the walk is enough: two cycles."""
NOON = 1_717_243_200_000_000_000
"""Wall-clock time, ns."""
FOREVER = {"sec": 9223372036, "nsec": 854775807}
NO_HASH = "RIHS01_" + "0" * 64


class Message(NamedTuple):
    """A message, with its type's definition."""

    topic: str
    kind: str
    text: str
    ns: int
    data: bytes


Messages = list[Message]
Write = Callable[[Path, Messages], None]


@pytest.fixture(scope="module")
def messages() -> Messages:
    """Return the first messages of a walk, as they lie in its file."""
    from mcap.reader import make_reader

    (file,) = SHIPPED_BAG.glob("*.mcap")
    found = []
    with file.open("rb") as raw:
        for schema, channel, message in make_reader(raw).iter_messages(log_time_order=False):
            if message.log_time >= CYCLES_S * 1e9:
                break
            assert schema is not None
            text = schema.data.decode()
            found.append(Message(channel.topic, schema.name, text, message.log_time, message.data))
    return found


def ticks_of(bag: Path) -> list[str]:
    """Return the ticks of a bag, each with all its bits; nothing is damaged or left over."""
    with Bag(bag) as opened:
        ticks = [repr(tick) for tick in opened.ticks()]
        assert opened.damages == []
        assert opened.stale == 0
    return ticks


# -- how others write -----------------------------------------------------------------------------


def qos(depth: int = 1) -> str:
    """Return a quality of service, as rosbag2 puts it into a text: numbers for names."""
    profile: dict[str, Any] = {"history": 1, "depth": depth, "reliability": 1, "durability": 1}
    profile |= {"deadline": FOREVER, "lifespan": FOREVER, "liveliness": 1}
    profile |= {"liveliness_lease_duration": FOREVER, "avoid_ros_namespace_conventions": False}
    return yaml.safe_dump([profile], sort_keys=False)


def tell(
    bag: Path,
    messages: Sequence[Message],
    files: Sequence[str],
    storage: str,
    version: int = 9,
    profile: str | None = None,
    **changes: Any,
) -> None:
    """Write ``metadata.yaml`` as the rosbag2 that had this version of it does."""
    times = [message.ns for message in messages] or [0]
    length = {"nanoseconds": max(times) - min(times)}
    begin = {"nanoseconds_since_epoch": min(times)}
    topics = []
    for (name, kind), count in Counter((m.topic, m.kind) for m in messages).items():
        topic: dict[str, Any] = {"name": name, "type": kind, "serialization_format": "cdr"}
        if version >= 4:
            topic["offered_qos_profiles"] = qos() if profile is None else profile
        if version >= 7:
            topic["type_description_hash"] = NO_HASH
        topics.append({"topic_metadata": topic, "message_count": count})
    told: dict[str, Any] = {
        "version": version,
        "storage_identifier": storage,
        "duration": length,
        "starting_time": begin,
        "message_count": len(messages),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": list(files),
    }
    if version >= 5:
        rest = {"starting_time": begin, "duration": length, "message_count": len(messages)}
        told["files"] = [{"path": file, **rest} for file in files]
    if version >= 6:
        told["custom_data"] = None
    if version >= 8:
        told["ros_distro"] = "jazzy"
    (bag / METADATA).write_text(yaml.safe_dump({INFORMATION: told | changes}, sort_keys=False))


def write_mcap(
    file: Path,
    messages: Sequence[Message],
    *,
    named: str = "ros2",
    defined: bool = True,
    profile: str | None = "",
    **layout: Any,
) -> None:
    """Write a file of MCAP with the reference writer; ``layout`` is for it."""
    from mcap.writer import Writer

    writer = Writer(str(file), **layout)
    writer.start(named, library="another recorder")
    schemas: dict[str, int] = {}
    channels: dict[tuple[str, str], int] = {}
    for topic, kind, text, ns, data in messages:
        if kind not in schemas:
            encoding = "ros2msg" if defined else ""
            schemas[kind] = writer.register_schema(kind, encoding, text.encode() * defined)
        if (topic, kind) not in channels:
            told = {} if profile is None else {"offered_qos_profiles": profile or qos()}
            channels[topic, kind] = writer.register_channel(topic, "cdr", schemas[kind], told)
        writer.add_message(channels[topic, kind], ns, data, ns)
    writer.finish()  # type: ignore[no-untyped-call]


def write_sqlite(
    file: Path, messages: Sequence[Message], schema: int = 3, *, wal: bool = False
) -> None:
    """Write a database; schema 1 is Dashing's, 2 that from Foxy to Humble, 3 that from Iron on."""
    base = sqlite3.connect(file)
    if wal:
        base.execute("PRAGMA journal_mode=WAL")
    columns = ["id INTEGER PRIMARY KEY", "name TEXT", "type TEXT", "serialization_format TEXT"]
    columns += ["offered_qos_profiles TEXT"] * (schema > 1)
    columns += ["type_description_hash TEXT"] * (schema > 2)
    base.execute(f"CREATE TABLE topics({', '.join(columns)})")
    base.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB)"
    )
    if schema > 2:
        base.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
        base.execute("INSERT INTO schema VALUES (4, 'jazzy')")
        base.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, "
            "encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)"
        )
        for kind, text in {m.kind: m.text for m in messages}.items():
            row = (None, kind, "ros2msg", text, NO_HASH)
            base.execute("INSERT INTO message_definitions VALUES (?, ?, ?, ?, ?)", row)
    ids: dict[str, int] = {}
    for topic, kind, _, ns, data in messages:
        if topic not in ids:
            ids[topic] = len(ids) + 1
            told = [ids[topic], topic, kind, "cdr", qos(), NO_HASH][: len(columns)]
            base.execute(f"INSERT INTO topics VALUES ({', '.join('?' * len(told))})", told)
        base.execute("INSERT INTO messages VALUES (NULL, ?, ?, ?)", (ids[topic], ns, data))
    base.commit()
    base.close()


def squeezed(data: bytes) -> bytes:
    """Return bytes as rosbag2's zstd has them."""
    import zstandard

    return zstandard.compress(data)


def mcap(version: int = 9, change: Callable[[Messages], Messages] = list, **layout: Any) -> Write:
    """Return a writer of a bag of one MCAP file."""

    def write(bag: Path, messages: Messages) -> None:
        changed = change(messages)
        write_mcap(bag / "walk_0.mcap", changed, **layout)
        tell(bag, changed, ["walk_0.mcap"], "mcap", version)

    return write


def sqlite(version: int, *, wal: bool = False, **changes: Any) -> Write:
    """Return a writer of a bag of one database."""

    def write(bag: Path, messages: Messages) -> None:
        write_sqlite(bag / "walk_0.db3", messages, 1 + (version > 3) + (version > 5), wal=wal)
        tell(bag, messages, ["walk_0.db3"], "sqlite3", version, **changes)

    return write


def compressed(storage: str, mode: str) -> Write:
    """Return a writer of a bag whose files or messages are compressed by rosbag2 itself."""

    def write(bag: Path, messages: Messages) -> None:
        name = "walk_0.mcap" if storage == "mcap" else "walk_0.db3"
        inside = messages
        if mode == "MESSAGE":
            inside = [m._replace(data=squeezed(m.data)) for m in messages]
        (write_mcap if storage == "mcap" else write_sqlite)(bag / name, inside)
        if mode == "FILE":
            (bag / f"{name}.zstd").write_bytes(squeezed((bag / name).read_bytes()))
            (bag / name).unlink()
            name += ".zstd"
        tell(bag, messages, [name], storage, compression_format="zstd", compression_mode=mode)

    return write


def split(*, without: int | None = None, **changes: Any) -> Write:
    """Return a writer of a bag in three files, of which one may be lost."""

    def write(bag: Path, messages: Messages) -> None:
        third = len(messages) // 3 + 1
        names = [f"walk_{n}.mcap" for n in range(3)]
        for n, name in enumerate(names):
            write_mcap(bag / name, messages[n * third : (n + 1) * third])
        tell(bag, messages, names, "mcap", 5, **changes)
        if without is not None:
            (bag / names[without]).unlink()

    return write


def metadata_of_a_tool(bag: Path, messages: Messages) -> None:
    """Leave no quality of service in the file."""
    write_mcap(bag / "walk_0.mcap", messages, profile=None)
    tell(bag, messages, ["walk_0.mcap"], "mcap")


def another_depth_in_metadata(bag: Path, messages: Messages) -> None:
    """Say two things of one topic."""
    write_sqlite(bag / "walk_0.db3", messages, 2)
    tell(bag, messages, ["walk_0.db3"], "sqlite3", 5, profile=qos(10))


def no_quality_in_metadata(bag: Path, messages: Messages) -> None:
    """Leave it in the file alone."""
    write_mcap(bag / "walk_0.mcap", messages)
    tell(bag, messages, ["walk_0.mcap"], "mcap", 5, profile="")


def path_with_folder(bag: Path, messages: Messages) -> None:
    """Name the folder too, as Foxy did."""
    write_sqlite(bag / "walk_0.db3", messages, 2)
    tell(bag, messages, [f"{bag.name}/walk_0.db3"], "sqlite3", 4)


def counted_but_not_there(bag: Path, messages: Messages) -> None:
    """Count more messages than there are."""
    write_mcap(bag / "walk_0.mcap", messages[:9])
    tell(bag, messages, ["walk_0.mcap"], "mcap")


def shuffled(messages: Messages) -> Messages:
    """Return messages in no order."""
    found = list(messages)
    random.Random(1).shuffle(found)
    return found


def at_noon(messages: Messages) -> Messages:
    """Return messages with the wall clock's times."""
    return [m._replace(ns=NOON + m.ns) for m in messages]


def at_noon_but_the_first(messages: Messages) -> Messages:
    """Return them as with simulated time: who spoke before the first ``/clock`` has the time 0."""
    return [m._replace(ns=NOON + m.ns if n > 20 else 0) for n, m in enumerate(messages)]


def with_another(topic: str, kind: str, text: str, data: bytes) -> Callable[[Messages], Messages]:
    """Return what puts a message of somebody else among them."""

    def change(messages: Messages) -> Messages:
        other = Message(topic, kind, text, messages[0].ns, data)
        return [*messages[:5], other, *messages[5:]]

    return change


def of_others(messages: Messages) -> Messages:
    """Return what no recorder of ours is needed for: its checksums are of the bytes it heard."""
    return [message for message in messages if "/run/" not in message.topic]


def joints(change: Callable[[Any], None]) -> Callable[[Messages], Messages]:
    """Return what says joint states as other drivers do."""

    def changed(messages: Messages) -> Messages:
        from rosbags.typesys import Stores, get_typestore

        store, kind = get_typestore(Stores.ROS2_JAZZY), "sensor_msgs/msg/JointState"
        found = []
        for message in of_others(messages):
            if message.topic.endswith("/joint_states"):
                joint = store.deserialize_cdr(message.data, kind)
                change(joint)
                message = message._replace(data=bytes(store.serialize_cdr(joint, kind)))
            found.append(message)
        return found

    return changed


def the_other_way_round(joint: Any) -> None:
    """Say the knee before the hip."""
    joint.name.reverse()
    joint.position, joint.velocity = joint.position[::-1].copy(), joint.velocity[::-1].copy()


def with_an_ankle(joint: Any) -> None:
    """Say a joint that is nobody's here."""
    joint.name.append("ankle")
    joint.position, joint.velocity = (np.append(x, 0.0) for x in (joint.position, joint.velocity))


def with_efforts(joint: Any) -> None:
    """Say efforts that are not measured."""
    joint.effort = np.full(len(joint.name), np.nan)


def with_a_frame(joint: Any) -> None:
    """Name a frame."""
    joint.header.frame_id = "base_link"


def without_speeds(joint: Any) -> None:
    """Measure no speeds: nobody here reads them."""
    joint.velocity = np.array([])


SPLIT = (
    "rosbag2_interfaces/msg/WriteSplitEvent",
    "string closed_file\nstring opened_file\nstring node_name\n",
    b"\0\1\0\0" + 3 * (b"\1\0\0\0\0" + b"\0\0\0"),
)


def _layouts() -> dict[str, Write]:
    from mcap.writer import CompressionType, IndexType

    bare: dict[str, Any] = {
        "use_chunking": False,
        "index_types": IndexType.NONE,
        "enable_crcs": False,
    }
    none: dict[str, Any] = {"use_statistics": False, "use_summary_offsets": False}
    none |= {"repeat_channels": False, "repeat_schemas": False}
    return {
        "mcap": mcap(),
        "mcap without chunks": mcap(**bare),
        "mcap without chunks and summary": mcap(**bare, **none),
        "mcap without an index of messages": mcap(index_types=IndexType.CHUNK),
        "mcap without an index of chunks": mcap(index_types=IndexType.MESSAGE),
        "mcap, lz4": mcap(compression=CompressionType.LZ4),
        "mcap, not compressed": mcap(compression=CompressionType.NONE),
        "mcap, a chunk a message": mcap(chunk_size=64),
        "mcap without definitions": mcap(defined=False),
        "mcap without a profile": mcap(named=""),
        "mcap without quality of service in the file": metadata_of_a_tool,
        "mcap without quality of service in the metadata": no_quality_in_metadata,
        **{f"mcap, metadata {version}": mcap(version) for version in range(3, 10)},
        "mcap in no order": mcap(change=shuffled),
        "mcap with a split event": mcap(change=with_another("/events/write_split", *SPLIT)),
        "mcap with a type of one's own": mcap(
            change=with_another(
                "/battery", "my_robot_msgs/msg/Battery", "float64 volts\n", b"\0\1\0\0" + bytes(8)
            )
        ),
        "mcap with another type of the same name": mcap(
            change=with_another(
                "/cpg/phase", "std_msgs/msg/Float32", "float32 data\n", b"\0\1\0\0" + bytes(4)
            )
        ),
        **{f"sqlite, metadata {version}": sqlite(version) for version in range(2, 10)},
        "sqlite with a write-ahead log": sqlite(5, wal=True),
        "sqlite, two qualities of service": another_depth_in_metadata,
        "sqlite, the folder in the path": path_with_folder,
        "sqlite, file compressed": compressed("sqlite3", "FILE"),
        "sqlite, messages compressed": compressed("sqlite3", "MESSAGE"),
        "mcap, file compressed": compressed("mcap", "FILE"),
        "mcap, messages compressed": compressed("mcap", "MESSAGE"),
        "split": split(),
        "split, the last file's duration": split(duration={"nanoseconds": 5}),
        "wall clock": mcap(change=at_noon),
        "wall clock and 0": mcap(change=at_noon_but_the_first),
        "knee before hip": mcap(change=joints(the_other_way_round)),
        "another joint": mcap(change=joints(with_an_ankle)),
        "efforts": mcap(change=joints(with_efforts)),
        "a frame": mcap(change=joints(with_a_frame)),
    }


LAYOUTS = _layouts() if find_spec("mcap") else {}
REFUSED: dict[str, tuple[Write, str]] = {
    "split, the first file is lost": (split(without=0), "walk_0.mcap"),
    "split, the last file is lost": (split(without=2), "walk_2.mcap"),
    "no speeds": (mcap(change=joints(without_speeds)), "0 numbers in velocity; 2, one per name"),
    "a count of what is not there": (
        counted_but_not_there,
        r"messages of /\w+/transition are counted, and 0 are there",
    ),
}


@pytest.mark.parametrize("layout", list(LAYOUTS))
def test_a_walk_is_read_whole_however_it_was_written(
    layout: str, messages: Messages, tmp_path: Path
) -> None:
    """All ticks, with all their bits."""
    plain, other = tmp_path / "plain", tmp_path / "other"
    for bag, write in ((plain, LAYOUTS["mcap"]), (other, LAYOUTS[layout])):
        bag.mkdir()
        write(bag, messages)
    ticks = ticks_of(plain)
    assert len(ticks) == 64
    assert ticks_of(other) == ticks


@pytest.mark.parametrize("layout", list(REFUSED))
def test_what_cannot_be_read_whole_is_refused(
    layout: str, messages: Messages, tmp_path: Path
) -> None:
    """In words that name what it is, and never as a bag that holds less."""
    write, reason = REFUSED[layout]
    write(tmp_path, messages)
    with pytest.raises(BagError, match=reason):
        ticks_of(tmp_path)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_without_a_message_is_a_bag_without_a_tick(storage: str, tmp_path: Path) -> None:
    """As a recorder leaves it that heard nobody."""
    if storage == "mcap":
        write_mcap(tmp_path / "walk_0.mcap", [])
    else:
        write_sqlite(tmp_path / "walk_0.db3", [])
    tell(tmp_path, [], ["walk_0.mcap" if storage == "mcap" else "walk_0.db3"], storage)
    with pytest.raises(BagError, match="no robot of ember_ros in it"):
        ticks_of(tmp_path)
