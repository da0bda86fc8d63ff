"""Reads the messages in a bag's files, MCAP or SQLite, of any recorder. Pure.

Every file is read from its beginning to its end; indexes are ignored. Data that is stored twice
(QoS in the file and in ``metadata.yaml``, the compression of a message) need not agree. But if
fewer messages are found than a file or ``metadata.yaml`` counts, it is an error: a bag is read
completely, or not at all.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import sqlite3
import struct
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, BinaryIO, NamedTuple, Protocol, TypeAlias

from ember_ros.bag.guard import (
    MAX_BYTES,
    MAX_OPEN,
    MAX_RECORDS,
    MAX_REPORTED,
    MAX_TIMES,
    check_database,
    check_file,
    check_topics,
)
from ember_ros.bag.storage import METADATA, STORAGES, VERSION, needs_rosbags, read_metadata
from ember_ros.bounded_io import open_file
from ember_ros.errors import BagError, shown

_ZSTD = b"\x28\xb5\x2f\xfd"
MAGIC = b"\x89MCAP0\r\n"
_SQLITE = b"SQLite format 3\0"


class Connection(NamedTuple):
    """A topic with one type, as the files define it."""

    topic: str
    msgtype: str
    msgcount: int
    encoding: str
    """Of its messages: ``cdr``, or one that is not read here."""
    schema: tuple[str, bytes]
    """The format of its type's definition, ``ros2msg`` or ``ros2idl``, and the definition."""
    metadata: dict[str, str]
    """What else the file has on it: QoS profiles, the hash of its type."""


class Message(NamedTuple):
    """One message of a bag."""

    ns: int
    topic: str
    kind: str
    data: bytes


Key: TypeAlias = "tuple[str, str]"
"""A topic and its type."""


class _Source(NamedTuple):
    """Messages in the order of their times; it is opened when its first message is next."""

    first: int
    messages: Callable[[], Iterator[Message]]
    size: int
    """Bytes of memory that it needs while it is open."""


class _Storage(Protocol):
    """One file of a bag."""

    connections: dict[Key, Connection]

    def sources(self, wanted: Collection[Key], start: int) -> Iterator[_Source]: ...
    def check(self) -> None: ...
    def close(self) -> None: ...


# -- unpacking -------------------------------------------------------------------------------------


def _zstd() -> Any:
    try:
        import zstandard
    except ModuleNotFoundError as error:
        raise needs_rosbags(error) from error
    return zstandard


def _decompressor() -> Any:
    return _zstd().ZstdDecompressor(max_window_size=MAX_BYTES)


def unpack(data: bytes, compression: str, size: int, limit: int = MAX_BYTES) -> bytes:
    """Return uncompressed data, of which at most ``size`` bytes and one are ever in memory.

    Raises:
        ValueError: it has another size, is too large, or has another compression.
    """
    if size > limit:
        raise ValueError(f"{size} bytes in one chunk; up to {limit} are unpacked")
    if compression == "":
        unpacked_data = data
    elif compression == "zstd":
        with _decompressor().stream_reader(data) as reader:
            unpacked_data = reader.read(size + 1)
    elif compression == "lz4":
        import lz4.frame

        unpacked_data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    else:
        raise ValueError(f"compressed as {shown(compression)}; zstd or lz4 would be right")
    if len(unpacked_data) != size:
        raise ValueError(f"{len(unpacked_data)} bytes are unpacked instead of {size}")
    return bytes(unpacked_data)


def plain(data: bytes) -> bytes:
    """Return a message uncompressed: one that begins like zstd cannot be CDR, and is unpacked.

    Raises:
        ValueError: it is too large, or cut off.
    """
    if data[:4] != _ZSTD:
        return data
    with _decompressor().stream_reader(data, read_across_frames=True) as reader:
        message = bytes(reader.read(MAX_BYTES + 1))
    if len(message) > MAX_BYTES:
        raise ValueError(f"a message of more than {MAX_BYTES} bytes when it is unpacked")
    size = _zstd().frame_content_size(data)
    if size >= 0 and size != len(message):
        raise ValueError(f"a message of {len(message)} bytes with a header that says {size}")
    return message


def unpacked(file: Path, folder: Path) -> Path:
    """Return a file that was compressed as a whole, unpacked into ``folder``; others unchanged.

    Raises:
        ValueError: it is too large when it is unpacked.
    """
    with open_file(file) as raw:
        if raw.read(4) != _ZSTD:
            return file
        raw.seek(0)
        into, limit = folder / file.stem, MAX_BYTES + file.stat().st_size * MAX_TIMES
        size = _zstd().frame_content_size(raw.read(18))  # -1 if it is unknown
        raw.seek(0)
        if size > limit:
            raise ValueError(f"{file} grows to {size} bytes by its header; up to {limit} are right")
        size = 0
        with into.open("wb") as out:
            for part in _decompressor().read_to_iter(raw):
                size += len(part)
                if size > limit:
                    raise ValueError(f"{file} grows to more than {MAX_TIMES} times its size")
                out.write(part)
    return into


# -- MCAP ------------------------------------------------------------------------------------------

HEAD = struct.Struct("<BQ")
_OF_MESSAGE = struct.Struct("<HIQQ")
_OF_CHUNK = struct.Struct("<QQQII")
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, _DATA_END = 2, 3, 4, 5, 6, 11, 15


class _Run(NamedTuple):
    """Messages outside of chunks, one behind the other and in the order of their times."""

    first: int
    begin: int
    end: int


class Channels:
    """The channels of an MCAP file."""

    def __init__(self) -> None:
        """Begin without channels."""
        self.keys: dict[int, Key] = {}
        self.counted: dict[int, int] = {}
        """Messages per channel, by the file's statistics."""
        self._records: dict[tuple[int, bytes], bytes] = {}
        self._size = 0
        self._schemas: dict[int, tuple[str, tuple[str, bytes]]] = {}
        self._descriptions: dict[int, tuple[str, tuple[str, bytes], dict[str, str]]] = {}

    def add(self, kind: int, data: bytes) -> None:
        """Add a record, if it is a schema, a channel or statistics.

        Raises:
            ValueError: it is cut off, or contradicts an earlier one.
        """
        if kind not in (SCHEMA, CHANNEL, STATISTICS) or self._records.get((kind, data[:2])) == data:
            return
        self._records[kind, data[:2]] = data
        self._size += len(data)
        if self._size > MAX_REPORTED:
            raise ValueError(f"more than {MAX_REPORTED} bytes about its topics")
        from mcap import records
        from mcap.data_stream import ReadDataStream

        stream: Any = ReadDataStream(_Exactly(data))  # type: ignore[arg-type]
        if kind == SCHEMA:
            schema = records.Schema.read(stream)
            self._schemas[schema.id] = schema.name, (schema.encoding, schema.data)
        elif kind == CHANNEL:
            channel = records.Channel.read(stream)
            name, text = self._schemas.get(channel.schema_id, ("", ("", b"")))
            check_topics({*self.keys.values(), (channel.topic, name)})
            key = self.keys.setdefault(channel.id, (channel.topic, name))
            if key != (channel.topic, name):
                raise ValueError(f"channel {channel.id} is {key}, and {channel.topic}, {name} too")
            self._descriptions[channel.id] = channel.message_encoding, text, dict(channel.metadata)
        else:
            statistics = records.Statistics.read(stream)
            counts = dict(statistics.channel_message_counts)
            if sum(counts.values()) == statistics.message_count:
                self.counted = counts

    def connection(self, number: int, count: int) -> Connection:
        """Return a channel with its number of messages."""
        encoding, schema, metadata = self._descriptions[number]
        return Connection(*self.keys[number], count, encoding, schema, metadata)


class Mcap:
    """An MCAP file that was closed, with or without chunks and indexes."""

    def __init__(self, file: Path) -> None:
        """Read the file record by record; chunks are unpacked only if the statistics are missing.

        Raises:
            ValueError: it is cut off or damaged.
        """
        self._channels = Channels()
        self._chunks: list[tuple[int, int, int, int]] = []
        self._runs: list[_Run] = []
        self._file = open_file(file)
        try:
            self._read_records()
            counts = self._counts()
        except BaseException:
            self.close()
            raise
        self.connections: dict[Key, Connection] = {}
        for number, key in self._channels.keys.items():
            before = self.connections[key].msgcount if key in self.connections else 0
            self.connections[key] = self._channels.connection(number, before + counts[number])

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read_records(self) -> None:
        raw = self._file
        size = raw.seek(0, os.SEEK_END)
        raw.seek(0)
        if raw.read(8) != MAGIC:
            raise ValueError("it begins neither as MCAP nor as SQLite")
        at, run, grown = 8, None, 0
        while True:
            head = raw.read(HEAD.size)
            if len(head) < HEAD.size:
                raise ValueError("it is cut off")
            kind, length = HEAD.unpack(head)
            begin, at = at, at + HEAD.size + length
            if at > size:
                raise ValueError("it is cut off")
            if kind == MESSAGE and length >= _OF_MESSAGE.size:
                ns = _OF_MESSAGE.unpack(raw.read(_OF_MESSAGE.size))[2]
                if run is None or ns < run[1] or self._runs[-1].end != begin:
                    self._runs.append(_Run(ns, begin, at))
                else:
                    self._runs[-1] = self._runs[-1]._replace(end=at)
                run = self._runs[-1].first, ns
            elif kind == CHUNK:
                if length < _OF_CHUNK.size:
                    raise ValueError("a chunk is damaged")
                first, _, unpacked_size, _, _ = _OF_CHUNK.unpack(raw.read(_OF_CHUNK.size))
                self._chunks.append((first, begin + HEAD.size, length, unpacked_size))
                grown += unpacked_size
                if grown > MAX_BYTES + MAX_TIMES * size:
                    raise ValueError(f"it grows to more than {MAX_TIMES} times its size")
            elif kind in (SCHEMA, CHANNEL, STATISTICS):
                self._channels.add(kind, bounded(raw, length))
            elif kind == FOOTER:
                break
            raw.seek(at)
        raw.seek(at)
        if raw.read(9) != MAGIC:
            raise ValueError("it does not end as an MCAP file")
        self._end = begin

    def _counts(self) -> Counter[int]:
        """Return the messages per channel: by the statistics, or counted here."""
        counted, empty = self._channels.counted, not (self._chunks or self._runs)
        if counted.keys() <= self._channels.keys.keys() and (empty or any(counted.values())):
            return Counter(counted)
        counts: Counter[int] = Counter()
        for place in self._chunks:
            counts.update(number for _, number, _ in self._in_chunk(place))
        for run in self._runs:
            counts.update(number for _, number, _ in self._in_run(run))
        unknown = counts.keys() - self._channels.keys.keys()
        if unknown:
            raise ValueError(f"its channels {sorted(unknown)} are not defined")
        return counts

    def sources(self, wanted: Collection[Key], start: int) -> Iterator[_Source]:
        """Yield the chunks, and the runs of messages outside of chunks."""
        numbers = {n: key for n, key in self._channels.keys.items() if key in wanted}

        def reader(messages: Callable[[Any], Iterator[tuple[int, int, bytes]]], place: Any) -> Any:
            def read() -> Iterator[Message]:
                for ns, number, data in messages(place):
                    if ns >= start and number in numbers:
                        yield Message(ns, *numbers[number], plain(data))

            return read

        for place in self._chunks:
            yield _Source(place[0], reader(self._in_chunk, place), place[3])
        for run in self._runs:
            yield _Source(run.first, reader(self._in_run, run), 0)

    def _in_chunk(self, place: tuple[int, int, int, int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield the messages of a chunk in the order of their times: time, channel, bytes."""
        _, at, length, _ = place
        self._file.seek(at)
        messages = []
        for kind, data in records_in(chunk(bounded(self._file, length))):
            if kind == MESSAGE:
                messages.append(message_in(data))
            else:
                self._channels.add(kind, data)
        yield from sorted(messages, key=lambda message: message[0])

    def _in_run(self, run: _Run) -> Iterator[tuple[int, int, bytes]]:
        at = run.begin
        while at < run.end:
            self._file.seek(at)
            kind, length = HEAD.unpack(self._file.read(HEAD.size))
            at += HEAD.size + length
            if kind == MESSAGE:
                yield message_in(bounded(self._file, length))

    def check(self) -> None:
        """Check the CRCs of the data and of the summary, where there are any.

        Raises:
            ValueError: a CRC is wrong.
        """
        self._file.seek(self._end + HEAD.size)
        summary, _, expected = struct.unpack("<QQI", self._file.read(20))
        # From the summary on, with the footer except for the CRC itself.
        of_summary = (summary, self._end + HEAD.size + 16)
        if expected and summary and _crc(self._file, *of_summary) != expected:
            raise ValueError("its summary is damaged: its CRC-32 is wrong")
        end = summary or self._end
        self._file.seek(max(0, end - HEAD.size - 4))
        kind, length, expected = struct.unpack("<BQI", self._file.read(HEAD.size + 4))
        has_crc = (kind, length) == (_DATA_END, 4) and expected
        if has_crc and _crc(self._file, 0, end - HEAD.size - 4) != expected:
            raise ValueError("its data are damaged: their CRC-32 is wrong")


def bounded(raw: BinaryIO, length: int) -> bytes:
    """Return the content of a record."""
    if length > MAX_BYTES:
        raise ValueError(f"a record of {length} bytes; up to {MAX_BYTES} are read")
    return raw.read(length)


class _Exactly:
    """A stream whose ``read`` returns exactly the requested number of bytes, or raises."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def read(self, length: int) -> bytes:
        """Return the next bytes."""
        data = self._data[self._at : self._at + length]
        if len(data) < length:
            raise ValueError("a record ends before it is complete")
        self._at += length
        return data


def _crc(raw: BinaryIO, begin: int, end: int) -> int:
    crc = 0
    raw.seek(begin)
    while begin < end:
        part = raw.read(min(1 << 20, end - begin))
        if not part:
            break
        crc, begin = zlib.crc32(part, crc), begin + len(part)
    return crc


def message_in(data: bytes) -> tuple[int, int, bytes]:
    """Return time, channel and bytes in a complete record of a message."""
    number, _, ns, _ = _OF_MESSAGE.unpack_from(data)
    return ns, number, data[_OF_MESSAGE.size :]


def chunk(data: bytes, limit: int = MAX_BYTES) -> bytes:
    """Return the content of an MCAP chunk, of up to ``limit`` bytes; its CRC is checked.

    Raises:
        ValueError: it is damaged, or larger.
    """
    if len(data) < _OF_CHUNK.size:
        raise ValueError("a chunk is damaged")
    _, _, size, crc, length = _OF_CHUNK.unpack_from(data)
    at = _OF_CHUNK.size + length
    compression = data[_OF_CHUNK.size : at].decode(errors="replace")
    if len(data) < at + 8 or struct.unpack_from("<Q", data, at)[0] != len(data) - at - 8:
        raise ValueError("a chunk is damaged")
    content = unpack(data[at + 8 :], compression, size, min(limit, MAX_BYTES))
    if crc and zlib.crc32(content) != crc:
        raise ValueError("a chunk is damaged: its CRC-32 is wrong")
    return content


def records_in(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the records of an unpacked chunk: kind and bytes.

    Raises:
        ValueError: one is cut off, or there are too many.
    """
    at = count = 0
    while at < len(data):
        count += 1
        if count > MAX_RECORDS:
            raise ValueError(f"more than {MAX_RECORDS} records in one chunk")
        if at + HEAD.size > len(data):
            raise ValueError("a chunk is damaged")
        kind, length = HEAD.unpack_from(data, at)
        at += HEAD.size + length
        if at > len(data) or (kind == MESSAGE and length < _OF_MESSAGE.size):
            raise ValueError("a chunk is damaged")
        yield kind, data[at - length : at]


# -- SQLite ----------------------------------------------------------------------------------------


class Sqlite3:
    """A SQLite file of rosbag2, of Dashing or later."""

    def __init__(self, file: Path) -> None:
        """Open the file, read-only and immutable.

        Raises:
            ValueError: it is no file of a bag, or was not closed.
        """
        for ending in ("-wal", "-journal"):
            beside = file.with_name(file.name + ending)
            if beside.exists() and beside.stat().st_size:
                raise ValueError(f"{beside.name} is in the same folder: it was not closed")
        uri = f"{file.resolve().as_uri()}?mode=ro&immutable=1"
        self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        try:
            check_database(self._database, file.stat().st_size)
            self.connections: dict[Key, Connection] = {}
            self._topics: dict[int, Key] = {}
            self._read_topics()
            check_topics(self.connections)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def _columns(self, table: str) -> list[str]:
        """Return the columns of a table; none for a view, which may compute without end."""
        rows = self._database.execute("SELECT type FROM sqlite_master WHERE name = ?", (table,))
        if [row[0] for row in rows] != ["table"]:
            return []
        # The seventh value marks generated columns, which are not stored.
        info = self._database.execute(f"PRAGMA table_xinfo({table})").fetchall()
        return [row[1] for row in info if row[6] == 0]

    def _read_topics(self) -> None:
        columns = self._columns("topics")
        missing = {"id", "name", "type", "serialization_format"} - set(columns) or (
            {"id", "topic_id", "timestamp", "data"} - set(self._columns("messages"))
        )
        if missing:
            raise ValueError(f"no table of topics or messages has {', '.join(sorted(missing))}")
        definitions: dict[str, tuple[str, bytes]] = {}
        columns_needed = {"topic_type", "encoding", "encoded_message_definition"}
        if columns_needed <= set(self._columns("message_definitions")):
            for kind, encoding, text in self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                definitions[str(kind)] = str(encoding), str(text).encode()
        counted = "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
        counts: dict[Any, int] = dict(self._database.execute(counted).fetchall())
        optional = ("offered_qos_profiles", "type_description_hash")
        fields = [
            *("id", "name", "type", "serialization_format"),
            *(name for name in optional if name in columns),
        ]
        for number, name, kind, encoding, *rest in self._database.execute(
            f"SELECT {', '.join(fields)} FROM topics ORDER BY id"
        ):
            if not (isinstance(name, str) and isinstance(kind, str)):
                raise ValueError(
                    f"topic {shown(number)} has the name {shown(name)} and the type {shown(kind)}"
                )
            key = name, kind
            metadata = dict(zip(fields[4:], map(str, rest), strict=True))
            if "type_description_hash" in metadata:
                metadata["topic_type_hash"] = metadata.pop("type_description_hash")
            self._topics[number] = key
            count = counts.pop(number, 0)
            if key in self.connections:
                count += self.connections[key].msgcount
            self.connections[key] = Connection(
                *key, count, str(encoding), definitions.get(key[1], ("", b"")), metadata
            )
        if counts:
            raise ValueError(f"{sum(counts.values())} messages have a topic that is not defined")

    def sources(self, wanted: Collection[Key], start: int) -> Iterator[_Source]:
        """Yield all messages as one source."""
        numbers = [number for number, key in self._topics.items() if key in wanted]
        if not numbers:
            return
        marks = ",".join("?" * len(numbers))
        where = f"FROM messages WHERE topic_id IN ({marks}) AND timestamp >= ?"
        values = (*numbers, max(start, -(1 << 63)))
        first = self._database.execute(f"SELECT min(timestamp) {where}", values).fetchone()[0]

        def read() -> Iterator[Message]:
            rows = self._database.execute(
                f"SELECT topic_id, timestamp, data {where} ORDER BY timestamp, id", values
            )
            for number, ns, data in rows:
                if type(ns) is not int or type(data) is not bytes:
                    raise ValueError(f"a message of {self._topics[number][0]} is damaged")
                yield Message(ns, *self._topics[number], plain(data))

        if first is not None:
            yield _Source(first if type(first) is int else start, read, 0)

    def check(self) -> None:
        """Let SQLite check all pages.

        Raises:
            ValueError: a page is damaged.
        """
        (result,) = self._database.execute("PRAGMA quick_check(1)").fetchone()
        if result != "ok":
            raise ValueError(str(result))


# -- a whole bag -----------------------------------------------------------------------------------


def number(value: Any, what: str) -> int:
    """Return an integer of ``metadata.yaml``, which some tools write as text.

    Raises:
        ValueError: it is no integer.
    """
    text = value.strip() if isinstance(value, str) else value
    if type(text) is int or (isinstance(text, str) and text.isdecimal() and len(text) < 20):
        return int(text)
    raise ValueError(f"its {METADATA} has {shown(value)} for {what}; a whole number is right")


def _order(sources: Iterator[_Source]) -> Iterator[Message]:
    """Yield the messages of all sources by their times; a source is opened when it is next."""
    waiting = sorted(enumerate(sources), key=lambda each: (each[1].first, each[0]), reverse=True)
    heap: list[tuple[int, int, Message, Iterator[Message]]] = []
    sizes: dict[int, int] = {}
    while heap or waiting:
        # Of two sources with the same time the first is read completely before the second.
        while waiting and (not heap or (waiting[-1][1].first, waiting[-1][0]) < heap[0][:2]):
            n, source = waiting.pop()
            messages, sizes[n] = source.messages(), source.size
            if len(sizes) > 1 and sum(sizes.values()) > MAX_OPEN:
                raise ValueError(f"chunks of more than {MAX_OPEN} bytes have the same times")
            for message in messages:
                heapq.heappush(heap, (message.ns, n, message, messages))
                break
            else:
                del sizes[n]
        if not heap:
            continue
        _, n, message, messages = heap[0]
        yield message
        following = next(messages, None)
        if following is None:
            heapq.heappop(heap)
            del sizes[n]
        else:
            heapq.heapreplace(heap, (following.ns, n, following, messages))


class Files:
    """All files of a bag, read as one."""

    def __init__(self, path: Path) -> None:
        """Open a bag's folder, or one file of it.

        Raises:
            BagError: a file is missing, or is no file of a bag.
            Exception: it is damaged; any kind that SQLite, zstd or struct raise.
        """
        self.paths = [path]
        self.connections: dict[Key, Connection] = {}
        self.topics: dict[Key, dict[str, Any]] = {}
        """The entry of each topic in ``metadata.yaml``."""
        self._expected: Counter[Key] = Counter()
        self._opened: list[_Storage] = []
        self._close = contextlib.ExitStack()
        try:
            if path.is_dir():
                self._read_metadata(path)
            for file in self.paths:
                self._open(file)
        except BaseException:
            self.close()
            raise
        for key, topic in self.topics.items():
            encoding = str(topic.get("serialization_format", "cdr"))
            empty = Connection(*key, 0, encoding, ("", b""), {})
            self.connections.setdefault(key, empty)

    def close(self) -> None:
        """Close all files; safe to call twice."""
        self._close.close()

    def _read_metadata(self, folder: Path) -> None:
        metadata = read_metadata(folder)
        version = metadata.get("version")
        with contextlib.suppress(ValueError):
            version = number(version, "version")
        if type(version) is not int or version > VERSION:
            raise BagError(
                f"{folder} is a bag of version {shown(version)}; versions up to {VERSION} are read"
            )
        storage = metadata.get("storage_identifier") or ""
        if storage and storage not in STORAGES:
            raise BagError(
                f"{folder} is stored as {shown(storage)}; {' or '.join(STORAGES)} would be right"
            )
        compression = str(metadata.get("compression_format") or "zstd")
        if (
            compression != "zstd"
            and str(metadata.get("compression_mode") or "none").lower() != "none"
        ):
            raise BagError(f"{folder} is compressed as {shown(compression)}; zstd would be right")
        names = metadata.get("relative_file_paths")
        if not isinstance(names, list) or not names:
            raise ValueError(f"its {METADATA} names no file")
        # Some versions wrote folder/file; a bag has files in its own folder only.
        self.paths = [folder / PurePath(str(name)).name for name in dict.fromkeys(map(str, names))]
        missing = [file.name for file in self.paths if not os.path.lexists(file)]
        if missing:
            raise BagError(
                f"{folder} has {METADATA}, and of the files named there {', '.join(missing)} is "
                f"missing; `ember bag repair {folder}` makes a bag of those that are there"
            )
        for file in self.paths:
            check_file(file, folder)
        for entry in metadata.get("topics_with_message_count") or ():
            topic = entry["topic_metadata"]
            key = str(topic["name"]), str(topic["type"])
            self.topics[key] = topic
            self._expected[key] += number(entry["message_count"], f"the messages of {key[0]}")
        check_topics(self.topics)

    def _open(self, file: Path) -> None:
        with open_file(file) as raw:
            head = raw.read(16)
        if not head:
            raise ValueError(f"the file {file.name} is empty")
        if head[:4] == _ZSTD:
            folder = self._close.enter_context(tempfile.TemporaryDirectory(prefix="ember_ros_bag_"))
            file = unpacked(file, Path(folder))
            with file.open("rb") as raw:
                head = raw.read(16)
        opened: Mcap | Sqlite3
        opened = Sqlite3(file) if head == _SQLITE else Mcap(file)
        self._close.callback(opened.close)
        self._opened.append(opened)
        for key, connection in opened.connections.items():
            known = self.connections.get(key)
            count = connection.msgcount + (known.msgcount if known else 0)
            self.connections[key] = connection._replace(msgcount=count)

    def messages(
        self, wanted: Collection[Key] | None = None, start: int | None = None
    ) -> Iterator[Message]:
        """Yield messages in the order of their times; fewer than are counted is an error.

        Args:
            wanted: topics and their types; all for None.
            start: the first time, ns.

        Raises:
            ValueError: there are fewer than the files or the metadata count.
            Exception: a file is damaged.
        """
        keys = self.connections.keys() if wanted is None else wanted
        begin = -(1 << 63) if start is None else start
        read: Counter[Key] = Counter()
        for message in _order(s for file in self._opened for s in file.sources(keys, begin)):
            read[message[1:3]] += 1
            yield message
        if start is not None:
            return
        for key in keys:
            if key not in self.connections:
                continue
            expected = max(self.connections[key].msgcount, self._expected[key])
            if read[key] < expected:
                raise ValueError(
                    f"{expected} messages of {key[0]} are counted, and {read[key]} are there"
                )

    def check(self) -> None:
        """Read every message, and check all CRCs and counts.

        Raises:
            Exception: something is damaged.
        """
        for file in self._opened:
            file.check()
        for _ in self.messages():
            pass


def files_of(folder: Path) -> Sequence[Path]:
    """Return the files in a folder whose names are those of a bag's files."""
    suffixes = (*STORAGES.values(), *(f"{end}.zstd" for end in STORAGES.values()))
    return [file for file in folder.iterdir() if file.name.endswith(suffixes) and file.is_file()]
