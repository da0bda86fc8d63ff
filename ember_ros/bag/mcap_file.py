"""Reads MCAP files, with or without chunks and indexes. Pure."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ember_ros.bag.compression import plain, unpack
from ember_ros.bag.guard import MAX_BYTES, MAX_RECORDS, MAX_REPORTED, MAX_TIMES, check_topics
from ember_ros.bag.messages import Connection, Key, Message, Source
from ember_ros.bounded_io import open_file

MAGIC = b"\x89MCAP0\r\n"
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

    def sources(self, wanted: Collection[Key], start: int) -> Iterator[Source]:
        """Yield the chunks, and the runs of messages outside of chunks."""
        numbers = {n: key for n, key in self._channels.keys.items() if key in wanted}

        def reader(messages: Callable[[Any], Iterator[tuple[int, int, bytes]]], place: Any) -> Any:
            def read() -> Iterator[Message]:
                for ns, number, data in messages(place):
                    if ns >= start and number in numbers:
                        yield Message(ns, *numbers[number], plain(data))

            return read

        for place in self._chunks:
            yield Source(place[0], reader(self._in_chunk, place), place[3])
        for run in self._runs:
            yield Source(run.first, reader(self._in_run, run), 0)

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
