"""Restores what is intact in a bag whose recording was cut off, or that was damaged later."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ember_ros.bag.compression import plain, unpacked
from ember_ros.bag.files import Files, files_of
from ember_ros.bag.guard import MAX_BYTES, MAX_TIMES, check_file, load_yaml
from ember_ros.bag.mcap_file import (
    CHANNEL,
    CHUNK,
    FOOTER,
    HEAD,
    MAGIC,
    MESSAGE,
    SCHEMA,
    Channels,
    bounded,
    chunk,
    message_in,
    records_in,
)
from ember_ros.bag.messages import Connection, Key
from ember_ros.bag.sqlite3_file import Sqlite3
from ember_ros.bag.storage import (
    METADATA,
    QOS,
    STORAGES,
    BagOptions,
    Definition,
    McapWriter,
    definition,
    lock,
    read_metadata,
)
from ember_ros.bounded_io import open_file
from ember_ros.errors import BagError

MAX_QOS = 100
"""QoS profiles of one topic, one per publisher."""
FLUSH_MESSAGES = 1000
"""Messages per chunk, where the restored ones are in none."""


class Repaired(NamedTuple):
    """The result of a repair."""

    messages: int
    seconds: float
    """From the first message to the last, in the bag's time."""
    chunks: int
    """Intact chunks of MCAP, or topics of SQLite."""
    damaged: int
    """Damaged chunks among intact ones."""
    torn_bytes: int
    """Behind the last intact record: what was being written when the recording was cut off."""
    original: Path | None = None
    """Where the damaged bag is now; None if it was removed, or was never damaged."""
    healthy: bool = False
    """Whether the bag is intact, and was not changed."""


class _Checksum:
    """Of the messages of one topic, in any order: equal sums are equal messages."""

    def __init__(self) -> None:
        self.count = self.bytes = self.digest = 0

    def add(self, ns: int, data: bytes) -> None:
        digest = hashlib.blake2b(data, digest_size=8, salt=ns.to_bytes(8, "little")).digest()
        self.count, self.bytes = self.count + 1, self.bytes + len(data)
        self.digest = (self.digest + int.from_bytes(digest, "little")) % (1 << 64)

    def all(self) -> tuple[int, int, int]:
        return self.count, self.bytes, self.digest


class _Copy:
    """A new bag that receives what is intact in another."""

    def __init__(self, writer: McapWriter, qos: dict[Key, Sequence[Any]]) -> None:
        self.writer, self._qos = writer, qos
        self.chunks = self.damaged = self.torn = 0
        self.first: int | None = None
        self.last = 0
        self.checksums: dict[Key, _Checksum] = {}

    def channel(self, connection: Connection) -> int:
        """Return the channel of a topic, with the definition and QoS that it has in the old bag."""
        topic, kind = connection[:2]
        encoding, text = connection.schema
        known = Definition("", connection.metadata.get("topic_type_hash", ""), "")
        if text:
            known = known._replace(text=text.decode(errors="replace"), encoding=encoding)
        else:
            with contextlib.suppress(BagError):  # an unknown type stays without a definition
                known = definition(kind)
        qos = self._qos.get((topic, kind)) or _profiles(
            connection.metadata.get("offered_qos_profiles")
        )
        return self.writer.channel(topic, kind, known, qos)

    def write(self, number: int, key: Key, ns: int, data: bytes) -> None:
        """Write a message."""
        self.writer.write(number, ns, data)
        self.checksums.setdefault(key, _Checksum()).add(ns, data)
        self.first = ns if self.first is None else min(self.first, ns)
        self.last = max(self.last, ns)


def repair(folder: Path, *, drop: bool = False) -> Repaired:
    """Write a new bag from the intact chunks of a damaged one, which is kept beside it.

    An intact bag is not changed.

    Args:
        folder: of the bag.
        drop: whether to remove the damaged one once the new one is verified.

    Raises:
        BagError: there is no bag, nothing in it is intact, or it cannot be written; then the old
            one is not changed.
    """
    files = _files(folder)
    lock_descriptor = lock(folder)
    place = folder.resolve()
    draft = place.with_name(f".{place.name}.repair")
    original = place.with_name(f"{place.name}.orig")
    copy: _Copy | None = None
    try:
        if healthy := _healthy(folder):
            return healthy
        if original.exists():
            raise BagError(f"{original} exists already: an earlier repair kept it; move it away")
        shutil.rmtree(draft, ignore_errors=True)
        copy = _Copy(McapWriter(BagOptions(draft / place.name)), _qos_of(folder))
        for n, file in enumerate(_plain(files, draft)):
            if n:
                copy.writer.begin_file()
            (_copy_sqlite3 if file.name.endswith(STORAGES["sqlite3"]) else _copy_mcap)(file, copy)
        if not copy.writer.messages:
            raise BagError(f"nothing in {folder} is intact: it has no complete chunk")
        copy.writer.close(_custom_data(folder, copy))
        _verify(draft / place.name, copy)
        os.rename(place, original)
        try:
            os.rename(draft / place.name, place)
        except OSError:
            os.rename(original, place)
            raise
        if drop:
            shutil.rmtree(original)
    except OSError as error:
        raise BagError(f"cannot repair {folder}: {error.strerror}") from error
    except BagError as error:
        why: object = error
        if str(draft) in str(error):  # an error of the writer: it names the draft, which is gone
            why = getattr(error.__cause__, "strerror", None) or error.__cause__
        elif str(folder) in str(error):
            raise
        raise BagError(f"cannot repair {folder}: {why}") from error
    finally:
        if copy is not None:
            copy.writer.abandon()
        shutil.rmtree(draft, ignore_errors=True)
        os.close(lock_descriptor)
    seconds = (copy.last - (copy.first or 0)) * 1e-9
    return Repaired(
        copy.writer.messages, seconds, copy.chunks, copy.damaged, copy.torn,
        None if drop else original,
    )  # fmt: skip


def _healthy(folder: Path) -> Repaired | None:
    """Return the result for a bag in which every byte and message is intact; None for others."""
    if not (folder / METADATA).exists():
        return None
    # Every error means that the bag needs a repair.
    with contextlib.suppress(Exception), contextlib.closing(Files(folder)) as files:
        files.check()
        times = [message.ns for message in files.messages()]
        seconds = (max(times) - min(times)) * 1e-9 if times else 0.0
        return Repaired(len(times), seconds, 0, 0, 0, healthy=True)
    return None


def _verify(folder: Path, copy: _Copy) -> None:
    """Compare the new bag with what was written into it, byte for byte."""
    checksums: dict[Key, _Checksum] = {}
    try:
        with contextlib.closing(Files(folder)) as files:
            files.check()
            for ns, topic, kind, data in files.messages():
                checksums.setdefault((topic, kind), _Checksum()).add(ns, data)
    except ValueError as error:
        raise BagError(f"the new bag cannot be read: {error}") from error
    if {key: checksum.all() for key, checksum in checksums.items()} != {
        key: checksum.all() for key, checksum in copy.checksums.items()
    }:
        raise BagError("the new bag does not hold what was written into it")


def _metadata(folder: Path) -> dict[str, Any]:
    try:
        return read_metadata(folder)
    except BagError:
        return {}


def _custom_data(folder: Path, copy: _Copy) -> dict[str, str]:
    """Return the old metadata's ``custom_data`` if no message is missing; else nothing."""
    old = _metadata(folder)
    count = old.get("message_count")
    complete = not copy.damaged and not copy.torn and count == copy.writer.messages
    custom = old.get("custom_data")
    return dict(custom) if complete and isinstance(custom, dict) else {}


# -- quality of service ----------------------------------------------------------------------------

_QOS_NAMES = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": (
        "system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown",
        "best_available",
    ),
}  # fmt: skip
"""The names of rmw's numbers, which rosbag2 wrote before version 9."""


def _profiles(content: Any) -> Sequence[Any]:
    """Return the QoS profiles of any version with the names of version 9.

    Returns:
        The profiles; our own where ``content`` is no list of profiles.
    """
    if isinstance(content, str):
        try:
            content = load_yaml(content if len(content) < MAX_QOS * 1000 else "")
        except ValueError:
            return QOS
    if not isinstance(content, list) or not all(map(_is_profile, content[:MAX_QOS])):
        return QOS
    profiles = []
    for each in content[:MAX_QOS]:
        profile = dict(each)
        for name, values in _QOS_NAMES.items():
            if type(profile.get(name)) is int and 0 <= profile[name] < len(values):
                profile[name] = values[profile[name]]
        profiles.append(profile)
    return profiles or QOS


def _is_profile(value: Any) -> bool:
    """Return whether a value has the keys and plain values of a profile, and nothing else."""

    def plain(item: Any) -> bool:
        return isinstance(item, (bool, int)) or (isinstance(item, str) and len(item) < 100)

    return (
        isinstance(value, dict)
        and value.keys() <= QOS[0].keys()
        and all(
            plain(item)
            or (isinstance(item, dict) and len(item) < 4 and all(map(plain, item.values())))
            for item in value.values()
        )
    )


def _qos_of(folder: Path) -> dict[Key, Sequence[Any]]:
    """Return each topic's QoS profiles in the old metadata."""
    qos: dict[Key, Sequence[Any]] = {}
    with contextlib.suppress(KeyError, TypeError, AttributeError):
        for each in _metadata(folder).get("topics_with_message_count") or ():
            topic = each["topic_metadata"]
            if topic.get("offered_qos_profiles"):
                key = str(topic["name"]), str(topic["type"])
                qos[key] = _profiles(topic["offered_qos_profiles"])
    return qos


# -- files -----------------------------------------------------------------------------------------


def _files(folder: Path) -> list[Path]:
    """Return the bag's files of one storage, in the order in which they were written."""
    if folder.is_file():
        raise BagError(f"{folder} is one file; its folder would be right")
    if not folder.is_dir():
        raise BagError(f"there is no bag {folder}; the folder of a bag would be right")

    def number(file: Path) -> tuple[int, str]:
        match = re.search(r"_(\d+)\.", file.name)
        return int(match[1]) if match else -1, file.name

    bag_files = files_of(folder)
    try:
        for file in bag_files:
            check_file(file, folder)
    except (OSError, ValueError) as error:
        raise BagError(f"{folder}: {error}") from error
    for end in STORAGES.values():
        files = sorted((file for file in bag_files if end in file.suffixes), key=number)
        if files:
            return files
    raise BagError(f"{folder} is no bag: it has no file of {' or '.join(STORAGES.values())}")


def _plain(files: Sequence[Path], draft: Path) -> Iterator[Path]:
    """Yield the files; one that is compressed as a whole is unpacked into a draft first."""
    for file in files:
        try:
            yield unpacked(file, draft)
        except Exception:  # zstd raises many kinds; what was unpacked until then is used
            yield draft / file.stem


def _copy_mcap(file: Path, copy: _Copy) -> None:
    """Copy every intact chunk, each as a chunk again."""
    channels = Channels()
    size, intact_end = file.stat().st_size, 0
    with open_file(file) as raw:
        # The end of a finished file lists the channels again.
        for _, inside, _ in _records(raw, size):
            for kind, data in inside or ():
                with contextlib.suppress(ValueError, UnicodeDecodeError):
                    channels.add(kind, data)
        numbers: dict[int, int] = {}

        def channel(number: int) -> int:
            if number not in numbers:
                numbers[number] = copy.channel(channels.connection(number, 0))
            return numbers[number]

        loose = 0
        for outer, inside, end in _records(raw, size):
            if inside is None:
                if end == size:
                    break
                copy.damaged += 1
                continue
            intact_end = end
            for kind, data in inside:
                if kind == MESSAGE:
                    ns, number, message = message_in(data)
                    if number in channels.keys:
                        copy.write(channel(number), channels.keys[number], ns, message)
                        loose += 1
                elif kind == CHANNEL and outer == CHUNK:
                    number = int.from_bytes(data[:2], "little")
                    if number in channels.keys:
                        channel(number)
            copy.chunks += outer == CHUNK
            if outer == CHUNK or loose >= FLUSH_MESSAGES:
                copy.writer.flush()
                loose = 0
        copy.writer.flush()
    copy.torn += size - intact_end


def _records(raw: BinaryIO, size: int) -> Iterator[tuple[int, list[tuple[int, bytes]] | None, int]]:
    """Yield complete records: the kind, the content (None if it is damaged), and the end.

    Messages in the content are uncompressed.
    """
    raw.seek(0)
    if raw.read(len(MAGIC)) != MAGIC:
        return
    at, limit = len(MAGIC), MAX_BYTES + MAX_TIMES * size
    while at + HEAD.size <= size:
        raw.seek(at)
        kind, length = HEAD.unpack(raw.read(HEAD.size))
        at += HEAD.size + length
        if kind == 0 or at > size:
            return
        inside: list[tuple[int, bytes]] | None
        try:
            data = bounded(raw, length) if kind in (CHUNK, MESSAGE, SCHEMA, CHANNEL) else b""
            if kind == CHUNK:
                limit -= len(content := chunk(data, limit))
                inside = list(records_in(content))
            else:
                inside = [(kind, data)]
            inside = [(k, _uncompressed(d) if k == MESSAGE else d) for k, d in inside]
        except Exception:  # zstd, lz4 and struct raise many kinds
            inside = None
        if kind == FOOTER:
            raw.seek(at)
            at += len(MAGIC) if raw.read(len(MAGIC) + 1) == MAGIC else 0
        yield kind, inside, at
        if kind == FOOTER:
            return


def _uncompressed(record: bytes) -> bytes:
    """Return the record of a message with the message uncompressed."""
    _, _, data = message_in(record)
    message = plain(data)
    return record if message is data else record[: len(record) - len(data)] + message


def _copy_sqlite3(file: Path, copy: _Copy) -> None:
    """Copy every message of the finished transactions."""
    where = copy.writer.folder.parent
    opened = where / file.name
    try:
        # SQLite rolls back unfinished transactions: in a copy, so that the original is not changed.
        for ending in ("", "-journal", "-wal"):
            beside = file.with_name(file.name + ending)
            if beside.exists() and beside.parent != where:
                shutil.copyfile(beside, where / beside.name)
        with contextlib.closing(sqlite3.connect(opened)) as database:
            database.execute("PRAGMA journal_mode=DELETE").fetchall()
            database.execute("SELECT count(*) FROM sqlite_master").fetchall()
        for ending in ("-journal", "-wal"):  # its content is in the database now
            opened.with_name(opened.name + ending).unlink(missing_ok=True)
        with contextlib.closing(Sqlite3(opened)) as database:
            numbers = {key: copy.channel(each) for key, each in database.connections.items()}
            for source in database.sources(numbers.keys(), 0):
                for n, (ns, topic, kind, data) in enumerate(source.messages(), 1):
                    copy.write(numbers[topic, kind], (topic, kind), ns, data)
                    if n % FLUSH_MESSAGES == 0:
                        copy.writer.flush()
            copy.chunks += len(numbers)
            copy.writer.flush()
    except BagError:
        raise
    except Exception as error:  # zstd raises its own kind
        raise BagError(f"{file} is no intact database: {error}") from error
