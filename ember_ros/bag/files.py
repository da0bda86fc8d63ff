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
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, Protocol

from ember_ros.bag.compression import ZSTD, unpacked
from ember_ros.bag.guard import MAX_OPEN, check_file, check_topics
from ember_ros.bag.mcap_file import Mcap
from ember_ros.bag.messages import Connection, Key, Message, Source
from ember_ros.bag.sqlite3_file import Sqlite3
from ember_ros.bag.storage import METADATA, STORAGES, VERSION, read_metadata
from ember_ros.bounded_io import open_file
from ember_ros.errors import BagError, shown

_SQLITE = b"SQLite format 3\0"


class _Storage(Protocol):
    """One file of a bag."""

    connections: dict[Key, Connection]

    def sources(self, wanted: Collection[Key], start: int) -> Iterator[Source]: ...
    def check(self) -> None: ...
    def close(self) -> None: ...


def number(value: Any, what: str) -> int:
    """Return an integer of ``metadata.yaml``, which some tools write as text.

    Raises:
        ValueError: it is no integer.
    """
    text = value.strip() if isinstance(value, str) else value
    if type(text) is int or (isinstance(text, str) and text.isdecimal() and len(text) < 20):
        return int(text)
    raise ValueError(f"its {METADATA} has {shown(value)} for {what}; a whole number is right")


def _order(sources: Iterator[Source]) -> Iterator[Message]:
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
        if head[:4] == ZSTD:
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
