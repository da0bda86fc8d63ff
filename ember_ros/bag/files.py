"""Reads the messages in a bag's files, MCAP or SQLite, whoever wrote them. Pure.

Every file is gone through from its beginning to its end; no index is needed and none is believed.
What is said twice (the quality of service in the file and in ``metadata.yaml``, how a message is
compressed) need not agree. But whatever anybody counted must be read, or it is an error: a bag is
read whole, or not at all.
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
    """A topic with one type, as the files say it."""

    topic: str
    msgtype: str
    msgcount: int
    encoding: str
    """Of its messages: ``cdr``, or something that nobody here reads."""
    schema: tuple[str, bytes]
    """How its type is defined, ``ros2msg`` or ``ros2idl``, and the definition; may be empty."""
    told: dict[str, str]
    """What else the file says of it: quality of service, the hash of its type."""


class Message(NamedTuple):
    """One message as it lies in a bag."""

    ns: int
    topic: str
    kind: str
    data: bytes


Key: TypeAlias = "tuple[str, str]"
"""A topic and its type."""


class _Source(NamedTuple):
    """Messages that come in the order of their times, not to be opened before the first is due."""

    first: int
    messages: Callable[[], Iterator[Message]]
    size: int
    """Bytes that it keeps in memory while it is open."""


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


def unpack(data: bytes, compression: str, size: int, most: int = MAX_BYTES) -> bytes:
    """Return what was compressed, without ever holding more than ``size`` bytes of it and one.

    Raises:
        ValueError: it is of another size, too large, or compressed in another way.
    """
    if size > most:
        raise ValueError(f"{size} bytes in one chunk; up to {most} are unpacked")
    if compression == "":
        found = data
    elif compression == "zstd":
        with _decompressor().stream_reader(data) as reader:
            found = reader.read(size + 1)
    elif compression == "lz4":
        import lz4.frame

        found = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    else:
        raise ValueError(f"compressed as {shown(compression)}; zstd or lz4 would be right")
    if len(found) != size:
        raise ValueError(f"{len(found)} bytes are unpacked instead of {size}")
    return bytes(found)


def plain(data: bytes) -> bytes:
    """Return a message as it was sent: one that begins like zstd cannot be CDR, and is unpacked.

    Raises:
        ValueError: it is too large, or cut off.
    """
    if data[:4] != _ZSTD:
        return data
    with _decompressor().stream_reader(data, read_across_frames=True) as reader:
        found = bytes(reader.read(MAX_BYTES + 1))
    if len(found) > MAX_BYTES:
        raise ValueError(f"a message of more than {MAX_BYTES} bytes when it is unpacked")
    size = _zstd().frame_content_size(data)
    if size >= 0 and size != len(found):
        raise ValueError(f"a message of {len(found)} bytes that says it has {size}")
    return found


def unpacked(file: Path, folder: Path) -> Path:
    """Return a file that was compressed as a whole, unpacked into ``folder``; or itself.

    Raises:
        ValueError: it grows beyond all measure.
    """
    with open_file(file) as raw:
        if raw.read(4) != _ZSTD:
            return file
        raw.seek(0)
        into, most = folder / file.stem, MAX_BYTES + file.stat().st_size * MAX_TIMES
        size = _zstd().frame_content_size(raw.read(18))  # -1 where it is not said
        raw.seek(0)
        if size > most:
            raise ValueError(f"{file} says that it grows to {size} bytes; up to {most} are right")
        size = 0
        with into.open("wb") as out:
            for part in _decompressor().read_to_iter(raw):
                size += len(part)
                if size > most:
                    raise ValueError(f"{file} grows to more than {MAX_TIMES} times its size")
                out.write(part)
    return into


# -- MCAP ------------------------------------------------------------------------------------------

HEAD = struct.Struct("<BQ")
_OF_MESSAGE = struct.Struct("<HIQQ")
_OF_CHUNK = struct.Struct("<QQQII")
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, _DATA_END = 2, 3, 4, 5, 6, 11, 15


class _Run(NamedTuple):
    """Messages that lie outside of chunks, one behind the other and in the order of their times."""

    first: int
    begin: int
    end: int


class Channels:
    """What an MCAP file says of its channels."""

    def __init__(self) -> None:
        """Begin before the first record."""
        self.keys: dict[int, Key] = {}
        self.counted: dict[int, int] = {}
        """Messages a channel, as the file's statistics have it."""
        self._learnt: dict[tuple[int, bytes], bytes] = {}
        self._size = 0
        self._schemas: dict[int, tuple[str, tuple[str, bytes]]] = {}
        self._told: dict[int, tuple[str, tuple[str, bytes], dict[str, str]]] = {}

    def learn(self, kind: int, data: bytes) -> None:
        """Take in a record, if it tells of messages.

        Raises:
            ValueError: it is cut off, or tells something else than one before it.
        """
        if kind not in (SCHEMA, CHANNEL, STATISTICS) or self._learnt.get((kind, data[:2])) == data:
            return
        self._learnt[kind, data[:2]] = data
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
            self._told[channel.id] = channel.message_encoding, text, dict(channel.metadata)
        else:
            told = records.Statistics.read(stream)
            if sum(told.channel_message_counts.values()) == told.message_count:
                self.counted = dict(told.channel_message_counts)

    def connection(self, number: int, count: int) -> Connection:
        """Return what is known of a channel."""
        encoding, schema, told = self._told[number]
        return Connection(*self.keys[number], count, encoding, schema, told)


class Mcap:
    """An MCAP file that was ended well, chunks or no chunks, index or no index."""

    def __init__(self, file: Path) -> None:
        """Go through the file, chunk by chunk, unpacking none if the file says what is inside.

        Raises:
            ValueError: it is cut off or damaged.
        """
        self._channels = Channels()
        self._chunks: list[tuple[int, int, int, int]] = []
        self._runs: list[_Run] = []
        self._file = open_file(file)
        try:
            self._walk()
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

    def _walk(self) -> None:
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
                first, _, told, _, _ = _OF_CHUNK.unpack(raw.read(_OF_CHUNK.size))
                self._chunks.append((first, begin + HEAD.size, length, told))
                grown += told
                if grown > MAX_BYTES + MAX_TIMES * size:
                    raise ValueError(f"it grows to more than {MAX_TIMES} times its size")
            elif kind in (SCHEMA, CHANNEL, STATISTICS):
                self._channels.learn(kind, bounded(raw, length))
            elif kind == FOOTER:
                break
            raw.seek(at)
        raw.seek(at)
        if raw.read(9) != MAGIC:
            raise ValueError("it does not end as an MCAP file")
        self._end = begin

    def _counts(self) -> Counter[int]:
        """Return how many messages each channel has: as was counted, or anew."""
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
            raise ValueError(f"nothing tells what its channels {sorted(unknown)} are")
        return counts

    def sources(self, wanted: Collection[Key], start: int) -> Iterator[_Source]:
        """Yield the chunks, and the runs of messages outside of them."""
        numbers = {n: key for n, key in self._channels.keys.items() if key in wanted}

        def reads(found: Callable[[Any], Iterator[tuple[int, int, bytes]]], place: Any) -> Any:
            def read() -> Iterator[Message]:
                for ns, number, data in found(place):
                    if ns >= start and number in numbers:
                        yield Message(ns, *numbers[number], plain(data))

            return read

        for place in self._chunks:
            yield _Source(place[0], reads(self._in_chunk, place), place[3])
        for run in self._runs:
            yield _Source(run.first, reads(self._in_run, run), 0)

    def _in_chunk(self, place: tuple[int, int, int, int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield the messages of a chunk by their times: time, channel, bytes."""
        _, at, length, _ = place
        self._file.seek(at)
        found = []
        for kind, data in records_in(chunk(bounded(self._file, length))):
            if kind == MESSAGE:
                found.append(message_in(data))
            else:
                self._channels.learn(kind, data)
        yield from sorted(found, key=lambda message: message[0])

    def _in_run(self, run: _Run) -> Iterator[tuple[int, int, bytes]]:
        at = run.begin
        while at < run.end:
            self._file.seek(at)
            kind, length = HEAD.unpack(self._file.read(HEAD.size))
            at += HEAD.size + length
            if kind == MESSAGE:
                yield message_in(bounded(self._file, length))

    def check(self) -> None:
        """Hold the file against the CRCs of its data and of its summary, where there are any.

        Raises:
            ValueError: something in it was changed.
        """
        self._file.seek(self._end + HEAD.size)
        summary, _, expected = struct.unpack("<QQI", self._file.read(20))
        # All from the summary on, with the footer but for the CRC itself.
        of_summary = (summary, self._end + HEAD.size + 16)
        if expected and summary and _crc(self._file, *of_summary) != expected:
            raise ValueError("its summary is not as it was written")
        end = summary or self._end
        self._file.seek(max(0, end - HEAD.size - 4))
        kind, length, expected = struct.unpack("<BQI", self._file.read(HEAD.size + 4))
        there = (kind, length) == (_DATA_END, 4) and expected
        if there and _crc(self._file, 0, end - HEAD.size - 4) != expected:
            raise ValueError("its data are not as they were written")


def bounded(raw: BinaryIO, length: int) -> bytes:
    """Return what a record holds."""
    if length > MAX_BYTES:
        raise ValueError(f"a record of {length} bytes; up to {MAX_BYTES} are read")
    return raw.read(length)


class _Exactly:
    """Bytes that are read as many as are asked for, or not at all."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def read(self, length: int) -> bytes:
        """Return the next bytes."""
        found = self._data[self._at : self._at + length]
        if len(found) < length:
            raise ValueError("a record ends before it is whole")
        self._at += length
        return found


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
    """Return time, channel and bytes in the record of a message, which is whole."""
    number, _, ns, _ = _OF_MESSAGE.unpack_from(data)
    return ns, number, data[_OF_MESSAGE.size :]


def chunk(data: bytes, most: int = MAX_BYTES) -> bytes:
    """Return what is inside an MCAP chunk, its CRC checked, of up to ``most`` bytes.

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
    found = unpack(data[at + 8 :], compression, size, min(most, MAX_BYTES))
    if crc and zlib.crc32(found) != crc:
        raise ValueError("a chunk has another CRC-32 than it names")
    return found


def records_in(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the records of an unpacked chunk: what each is, and its bytes.

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
    """A SQLite file of rosbag2, from Dashing's on."""

    def __init__(self, file: Path) -> None:
        """Open the file, read-only and as it is.

        Raises:
            ValueError: it is none of a bag, or somebody has not ended writing it.
        """
        for ending in ("-wal", "-journal"):
            beside = file.with_name(file.name + ending)
            if beside.exists() and beside.stat().st_size:
                raise ValueError(f"{beside.name} lies beside it: it was not closed")
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
        """Return the columns of a table; none of a view, which may compute for ever."""
        rows = self._database.execute("SELECT type FROM sqlite_master WHERE name = ?", (table,))
        if [row[0] for row in rows] != ["table"]:
            return []
        # The sixth number tells what is generated, and not there.
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
        told = {"topic_type", "encoding", "encoded_message_definition"}
        if told <= set(self._columns("message_definitions")):
            for kind, encoding, text in self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                definitions[str(kind)] = str(encoding), str(text).encode()
        counted = "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
        counts: dict[Any, int] = dict(self._database.execute(counted).fetchall())
        also = {"offered_qos_profiles": "", "type_description_hash": ""}
        fields = [*("id", "name", "type", "serialization_format"), *(also.keys() & set(columns))]
        for number, name, kind, encoding, *rest in self._database.execute(
            f"SELECT {', '.join(fields)} FROM topics ORDER BY id"
        ):
            if not (isinstance(name, str) and isinstance(kind, str)):
                raise ValueError(
                    f"topic {shown(number)} has the name {shown(name)} and the type {shown(kind)}"
                )
            key = name, kind
            more = dict(zip(fields[4:], map(str, rest), strict=True))
            if "type_description_hash" in more:
                more["topic_type_hash"] = more.pop("type_description_hash")
            self._topics[number] = key
            count = counts.pop(number, 0)
            if key in self.connections:
                count += self.connections[key].msgcount
            self.connections[key] = Connection(
                *key, count, str(encoding), definitions.get(key[1], ("", b"")), more
            )
        if counts:
            raise ValueError(f"{sum(counts.values())} messages are of no topic that it names")

    def sources(self, wanted: Collection[Key], start: int) -> Iterator[_Source]:
        """Yield all messages as one source."""
        numbers = [number for number, key in self._topics.items() if key in wanted]
        if not numbers:
            return
        marks = ",".join("?" * len(numbers))
        where = f"FROM messages WHERE topic_id IN ({marks}) AND timestamp >= ?"
        given = (*numbers, max(start, -(1 << 63)))
        first = self._database.execute(f"SELECT min(timestamp) {where}", given).fetchone()[0]

        def read() -> Iterator[Message]:
            rows = self._database.execute(
                f"SELECT topic_id, timestamp, data {where} ORDER BY timestamp, id", given
            )
            for number, ns, data in rows:
                if type(ns) is not int or type(data) is not bytes:
                    raise ValueError(f"a message of {self._topics[number][0]} is damaged")
                yield Message(ns, *self._topics[number], plain(data))

        if first is not None:
            yield _Source(first if type(first) is int else start, read, 0)

    def check(self) -> None:
        """Have SQLite look at all of its pages.

        Raises:
            ValueError: one is damaged.
        """
        (said,) = self._database.execute("PRAGMA quick_check(1)").fetchone()
        if said != "ok":
            raise ValueError(str(said))


# -- a whole bag -----------------------------------------------------------------------------------


def number(value: Any, what: str) -> int:
    """Return a whole number of ``metadata.yaml``, which some tools write as text.

    Raises:
        ValueError: it is none.
    """
    text = value.strip() if isinstance(value, str) else value
    if type(text) is int or (isinstance(text, str) and text.isdecimal() and len(text) < 20):
        return int(text)
    raise ValueError(f"its {METADATA} says {shown(value)} for {what}; a whole number is right")


def _order(sources: Iterator[_Source]) -> Iterator[Message]:
    """Yield what the sources have by its times, with no source open before it is due."""
    waiting = sorted(enumerate(sources), key=lambda each: (each[1].first, each[0]), reverse=True)
    heap: list[tuple[int, int, Message, Iterator[Message]]] = []
    sizes: dict[int, int] = {}
    while heap or waiting:
        # Of two of one time the first is read to its end before the second is opened.
        while waiting and (not heap or (waiting[-1][1].first, waiting[-1][0]) < heap[0][:2]):
            n, source = waiting.pop()
            messages, sizes[n] = source.messages(), source.size
            if len(sizes) > 1 and sum(sizes.values()) > MAX_OPEN:
                raise ValueError(f"chunks of more than {MAX_OPEN} bytes are of the same time")
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
            BagError: a file is missing, or of something else.
            Exception: it is damaged; nearly anything that SQLite, zstd or struct raise.
        """
        self.paths = [path]
        self.connections: dict[Key, Connection] = {}
        self.topics: dict[Key, dict[str, Any]] = {}
        """What ``metadata.yaml`` says of each topic."""
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
        for key, told in self.topics.items():
            encoding = str(told.get("serialization_format", "cdr"))
            empty = Connection(*key, 0, encoding, ("", b""), {})
            self.connections.setdefault(key, empty)

    def close(self) -> None:
        """Close all files; safe to call twice."""
        self._close.close()

    def _read_metadata(self, folder: Path) -> None:
        told = read_metadata(folder)
        version = told.get("version")
        with contextlib.suppress(ValueError):
            version = number(version, "version")
        if type(version) is not int or version > VERSION:
            raise BagError(
                f"{folder} is a bag of version {shown(version)}; versions up to {VERSION} are known"
            )
        storage = told.get("storage_identifier") or ""
        if storage and storage not in STORAGES:
            raise BagError(
                f"{folder} is stored as {shown(storage)}; {' or '.join(STORAGES)} would be right"
            )
        packed = str(told.get("compression_format") or "zstd")
        if packed != "zstd" and str(told.get("compression_mode") or "none").lower() != "none":
            raise BagError(f"{folder} is compressed as {shown(packed)}; zstd would be right")
        names = told.get("relative_file_paths")
        if not isinstance(names, list) or not names:
            raise ValueError(f"its {METADATA} names no file")
        # Some versions wrote folder/file; and no file of a bag lies anywhere but in its folder.
        self.paths = [folder / PurePath(str(name)).name for name in dict.fromkeys(map(str, names))]
        missing = [file.name for file in self.paths if not os.path.lexists(file)]
        if missing:
            raise BagError(
                f"{folder} has {METADATA}, and of the files named there {', '.join(missing)} is "
                f"missing; `ember bag repair {folder}` makes a bag of those that are there"
            )
        for file in self.paths:
            check_file(file, folder)
        for each in told.get("topics_with_message_count") or ():
            topic = each["topic_metadata"]
            key = str(topic["name"]), str(topic["type"])
            self.topics[key] = topic
            self._expected[key] += number(each["message_count"], f"the messages of {key[0]}")
        check_topics(self.topics)

    def _open(self, file: Path) -> None:
        with open_file(file) as raw:
            begins = raw.read(16)
        if not begins:
            raise ValueError(f"the file {file.name} is empty")
        if begins[:4] == _ZSTD:
            folder = self._close.enter_context(tempfile.TemporaryDirectory(prefix="ember_ros_bag_"))
            file = unpacked(file, Path(folder))
            with file.open("rb") as raw:
                begins = raw.read(16)
        opened: Mcap | Sqlite3
        opened = Sqlite3(file) if begins == _SQLITE else Mcap(file)
        self._close.callback(opened.close)
        self._opened.append(opened)
        for key, each in opened.connections.items():
            known = self.connections.get(key)
            if known is not None:
                each = each._replace(msgcount=each.msgcount + known.msgcount)
            self.connections[key] = each

    def messages(
        self, wanted: Collection[Key] | None = None, start: int | None = None
    ) -> Iterator[Message]:
        """Yield messages by their times; all that were counted, or none of them was right.

        Args:
            wanted: topics and their types; all for None.
            start: the first time, ns.

        Raises:
            ValueError: fewer are there than are counted in the files or in the metadata.
            Exception: a file is damaged.
        """
        keys = self.connections.keys() if wanted is None else wanted
        begin = -(1 << 63) if start is None else start
        found: Counter[Key] = Counter()
        for message in _order(s for each in self._opened for s in each.sources(keys, begin)):
            found[message[1:3]] += 1
            yield message
        if start is not None:
            return
        for key in keys:
            if key not in self.connections:
                continue
            expected = max(self.connections[key].msgcount, self._expected[key])
            if found[key] < expected:
                raise ValueError(
                    f"{expected} messages of {key[0]} are counted, and {found[key]} are there"
                )

    def check(self) -> None:
        """Go through every byte and every message, and hold all against what is said of them.

        Raises:
            Exception: something is not as it was written.
        """
        for each in self._opened:
            each.check()
        for _ in self.messages():
            pass


def files_of(folder: Path) -> Sequence[Path]:
    """Return the files in a folder that are of a bag by their names."""
    ends = (*STORAGES.values(), *(f"{end}.zstd" for end in STORAGES.values()))
    return [file for file in folder.iterdir() if file.name.endswith(ends) and file.is_file()]
