"""Brings back what is whole in a bag whose recording was cut off, or that was damaged later."""

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

from ember_ros.bag.files import (
    CHANNEL,
    CHUNK,
    FOOTER,
    HEAD,
    MAGIC,
    MESSAGE,
    SCHEMA,
    Channels,
    Connection,
    Files,
    Key,
    Sqlite3,
    bounded,
    chunk,
    files_of,
    message_in,
    plain,
    records_in,
    unpacked,
)
from ember_ros.bag.guard import MAX_BYTES, MAX_TIMES, check_file, load_yaml
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
"""Profiles of one topic, which are its publishers."""
FLUSH_MESSAGES = 1000
"""Messages a chunk, where those that are brought back lay in none."""


class Repaired(NamedTuple):
    """What was brought back."""

    messages: int
    seconds: float
    """From the first message to the last, in the bag's own time."""
    chunks: int
    """Chunks of MCAP, or topics of SQLite, that were whole."""
    damaged: int
    """Chunks that were not, among whole ones."""
    torn_bytes: int
    """Behind the last whole record: what was being written when the recording was cut off."""
    original: Path | None = None
    """Where the damaged bag is now; None if it was dropped, or was never damaged."""
    healthy: bool = False
    """Whether nothing is wrong with the bag, and nothing was touched."""


class _Sum:
    """The messages of one topic, in whatever order they come: equal sums are equal messages."""

    def __init__(self) -> None:
        self.count = self.bytes = self.digest = 0

    def add(self, ns: int, data: bytes) -> None:
        told = hashlib.blake2b(data, digest_size=8, salt=ns.to_bytes(8, "little")).digest()
        self.count, self.bytes = self.count + 1, self.bytes + len(data)
        self.digest = (self.digest + int.from_bytes(told, "little")) % (1 << 64)

    def all(self) -> tuple[int, int, int]:
        return self.count, self.bytes, self.digest


class _Copy:
    """A bag that is written from what is whole in another."""

    def __init__(self, writer: McapWriter, qos: dict[Key, Sequence[Any]]) -> None:
        self.writer, self._qos = writer, qos
        self.chunks = self.damaged = self.torn = 0
        self.first: int | None = None
        self.last = 0
        self.sums: dict[Key, _Sum] = {}

    def channel(self, connection: Connection) -> int:
        """Return the number of a topic, which keeps its definition and quality of service."""
        topic, kind = connection[:2]
        encoding, text = connection.schema
        known = Definition("", connection.told.get("topic_type_hash", ""), "")
        if text:
            known = known._replace(text=text.decode(errors="replace"), encoding=encoding)
        else:
            with contextlib.suppress(BagError):  # of a type that nobody here knows: without one
                known = definition(kind)
        qos = self._qos.get((topic, kind)) or _qos(connection.told.get("offered_qos_profiles"))
        return self.writer.channel(topic, kind, known, qos)

    def write(self, number: int, key: Key, ns: int, data: bytes) -> None:
        """Write a message."""
        self.writer.write(number, ns, data)
        self.sums.setdefault(key, _Sum()).add(ns, data)
        self.first = ns if self.first is None else min(self.first, ns)
        self.last = max(self.last, ns)


def repair(folder: Path, *, drop: bool = False) -> Repaired:
    """Write a bag anew from its whole chunks; the damaged one is kept beside it.

    A bag with which nothing is wrong is not touched.

    Args:
        folder: of the bag.
        drop: whether to remove the damaged one once the new one was read back whole.

    Raises:
        BagError: there is no bag, nothing in it is whole, or it cannot be written; then what was
            there is untouched.
    """
    files = _files(folder)
    held = lock(folder)
    place = folder.resolve()
    draft = place.with_name(f".{place.name}.repair")
    original = place.with_name(f"{place.name}.orig")
    copy: _Copy | None = None
    try:
        if healthy := _whole(folder):
            return healthy
        if original.exists():
            raise BagError(
                f"{original} is there already: what an earlier repair kept; move it away"
            )
        shutil.rmtree(draft, ignore_errors=True)
        copy = _Copy(McapWriter(BagOptions(draft / place.name)), _qos_of(folder))
        for n, file in enumerate(_plain(files, draft)):
            if n:
                copy.writer.begin_file()
            (_copy_sqlite3 if file.name.endswith(STORAGES["sqlite3"]) else _copy_mcap)(file, copy)
        if not copy.writer.messages:
            raise BagError(f"nothing in {folder} is whole: not one chunk was finished")
        copy.writer.close(_kept(folder, copy))
        _read_back(draft / place.name, copy)
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
        if str(draft) in str(error):  # the writer's own: it speaks of a folder that is gone
            why = getattr(error.__cause__, "strerror", None) or error.__cause__
        elif str(folder) in str(error):
            raise
        raise BagError(f"cannot repair {folder}: {why}") from error
    finally:
        if copy is not None:
            copy.writer.abandon()
        shutil.rmtree(draft, ignore_errors=True)
        os.close(held)
    seconds = (copy.last - (copy.first or 0)) * 1e-9
    return Repaired(
        copy.writer.messages, seconds, copy.chunks, copy.damaged, copy.torn,
        None if drop else original,
    )  # fmt: skip


def _whole(folder: Path) -> Repaired | None:
    """Return what is in a bag of which every byte and message is as it was written; else None."""
    if not (folder / METADATA).exists():
        return None
    # Whatever is wrong with it: that is what a repair is for.
    with contextlib.suppress(Exception), contextlib.closing(Files(folder)) as files:
        files.check()
        times = [message.ns for message in files.messages()]
        seconds = (max(times) - min(times)) * 1e-9 if times else 0.0
        return Repaired(len(times), seconds, 0, 0, 0, healthy=True)
    return None


def _read_back(folder: Path, copy: _Copy) -> None:
    """Hold the new bag against what was meant to be in it, byte for byte."""
    found: dict[Key, _Sum] = {}
    try:
        with contextlib.closing(Files(folder)) as files:
            files.check()
            for ns, topic, kind, data in files.messages():
                found.setdefault((topic, kind), _Sum()).add(ns, data)
    except ValueError as error:
        raise BagError(f"what was written could not be read back: {error}") from error
    if {key: each.all() for key, each in found.items()} != {
        key: each.all() for key, each in copy.sums.items()
    }:
        raise BagError("what was written was read back as something else")


def _metadata(folder: Path) -> dict[str, Any]:
    try:
        return read_metadata(folder)
    except BagError:
        return {}


def _kept(folder: Path, copy: _Copy) -> dict[str, str]:
    """Return what the old metadata knew of the run's end, if nothing of the run is missing."""
    old = _metadata(folder)
    count = old.get("message_count")
    whole = not copy.damaged and not copy.torn and count == copy.writer.messages
    custom = old.get("custom_data")
    return dict(custom) if whole and isinstance(custom, dict) else {}


# -- quality of service ----------------------------------------------------------------------------

_WORDS = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": (
        "system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown",
        "best_available",
    ),
}  # fmt: skip
"""What rmw's numbers mean, which rosbag2 wrote before version 9."""


def _qos(told: Any) -> Sequence[Any]:
    """Return profiles, from whichever version, in the words of version 9; ours if there are none.

    What is no list of profiles tells nothing.
    """
    if isinstance(told, str):
        try:
            told = load_yaml(told if len(told) < MAX_QOS * 1000 else "")
        except ValueError:
            return QOS
    if not isinstance(told, list) or not all(map(_is_profile, told[:MAX_QOS])):
        return QOS
    profiles = []
    for each in told[:MAX_QOS]:
        profile = dict(each)
        for name, words in _WORDS.items():
            if type(profile.get(name)) is int and 0 <= profile[name] < len(words):
                profile[name] = words[profile[name]]
        profiles.append(profile)
    return profiles or QOS


def _is_profile(told: Any) -> bool:
    """Return whether something has the words and numbers of a profile, and nothing else."""

    def plain(value: Any) -> bool:
        return isinstance(value, (bool, int)) or (isinstance(value, str) and len(value) < 100)

    return (
        isinstance(told, dict)
        and told.keys() <= QOS[0].keys()
        and all(
            plain(value)
            or (isinstance(value, dict) and len(value) < 4 and all(map(plain, value.values())))
            for value in told.values()
        )
    )


def _qos_of(folder: Path) -> dict[Key, Sequence[Any]]:
    """Return what the old metadata says of each topic's quality of service."""
    found: dict[Key, Sequence[Any]] = {}
    with contextlib.suppress(KeyError, TypeError, AttributeError):
        for each in _metadata(folder).get("topics_with_message_count") or ():
            topic = each["topic_metadata"]
            if topic.get("offered_qos_profiles"):
                key = str(topic["name"]), str(topic["type"])
                found[key] = _qos(topic["offered_qos_profiles"])
    return found


# -- files -----------------------------------------------------------------------------------------


def _files(folder: Path) -> list[Path]:
    """Return the files of one storage, in the order in which they were written."""
    if folder.is_file():
        raise BagError(f"{folder} is one file; the folder that it lies in would be right")
    if not folder.is_dir():
        raise BagError(f"there is no bag {folder}; the folder of one would be right")

    def number(file: Path) -> tuple[int, str]:
        found = re.search(r"_(\d+)\.", file.name)
        return int(found[1]) if found else -1, file.name

    every = files_of(folder)
    try:
        for file in every:
            check_file(file, folder)
    except (OSError, ValueError) as error:
        raise BagError(f"{folder}: {error}") from error
    for end in STORAGES.values():
        files = sorted((file for file in every if end in file.suffixes), key=number)
        if files:
            return files
    raise BagError(f"{folder} is no bag: it has no file of {' or '.join(STORAGES.values())}")


def _plain(files: Sequence[Path], draft: Path) -> Iterator[Path]:
    """Yield the files as they are when nothing is compressed around them, unpacked into a draft."""
    for file in files:
        try:
            yield unpacked(file, draft)
        except Exception:  # zstd raises nearly anything; what it gave until then is there
            yield draft / file.stem


def _copy_mcap(file: Path, copy: _Copy) -> None:
    """Copy every whole chunk, each as a chunk again."""
    channels = Channels()
    size, whole = file.stat().st_size, 0
    with open_file(file) as raw:
        # What channels there are is said again at the end of a file that was finished.
        for _, inside, _ in _records(raw, size):
            for kind, data in inside or ():
                with contextlib.suppress(ValueError, UnicodeDecodeError):
                    channels.learn(kind, data)
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
            whole = end
            for kind, data in inside:
                if kind == MESSAGE:
                    ns, number, sent = message_in(data)
                    if number in channels.keys:
                        copy.write(channel(number), channels.keys[number], ns, sent)
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
    copy.torn += size - whole


def _records(raw: BinaryIO, size: int) -> Iterator[tuple[int, list[tuple[int, bytes]] | None, int]]:
    """Yield whole records: what each is, what is inside, None if that is damaged, and its end.

    Messages inside are as they were sent, whatever they were compressed with.
    """
    raw.seek(0)
    if raw.read(len(MAGIC)) != MAGIC:
        return
    at, most = len(MAGIC), MAX_BYTES + MAX_TIMES * size
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
                most -= len(grown := chunk(data, most))
                inside = list(records_in(grown))
            else:
                inside = [(kind, data)]
            inside = [(each, _sent(told) if each == MESSAGE else told) for each, told in inside]
        except Exception:  # zstd, lz4 and struct raise nearly anything
            inside = None
        if kind == FOOTER:
            raw.seek(at)
            at += len(MAGIC) if raw.read(len(MAGIC) + 1) == MAGIC else 0
        yield kind, inside, at
        if kind == FOOTER:
            return


def _sent(record: bytes) -> bytes:
    """Return the record of a message with the message as it was sent."""
    _, _, data = message_in(record)
    sent = plain(data)
    return record if sent is data else record[: len(record) - len(data)] + sent


def _copy_sqlite3(file: Path, copy: _Copy) -> None:
    """Copy every message of all transactions that were finished."""
    where = copy.writer.folder.parent
    opened = where / file.name
    try:
        # SQLite rolls back what was not finished: in a copy, since the original stays as it is.
        for ending in ("", "-journal", "-wal"):
            beside = file.with_name(file.name + ending)
            if beside.exists() and beside.parent != where:
                shutil.copyfile(beside, where / beside.name)
        with contextlib.closing(sqlite3.connect(opened)) as database:
            database.execute("PRAGMA journal_mode=DELETE").fetchall()
            database.execute("SELECT count(*) FROM sqlite_master").fetchall()
        for ending in ("-journal", "-wal"):  # what was in it is in the database now
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
    except Exception as error:  # zstd raises its own
        raise BagError(f"{file} is no whole database: {error}") from error
