"""Reads SQLite files of rosbag2. Pure."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from ember_ros.bag.compression import plain
from ember_ros.bag.guard import (
    check_database,
    check_topics,
)
from ember_ros.bag.messages import Connection, Key, Message, Source
from ember_ros.errors import shown


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

    def sources(self, wanted: Collection[Key], start: int) -> Iterator[Source]:
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
            yield Source(first if type(first) is int else start, read, 0)

    def check(self) -> None:
        """Let SQLite check all pages.

        Raises:
            ValueError: a page is damaged.
        """
        (result,) = self._database.execute("PRAGMA quick_check(1)").fetchone()
        if result != "ok":
            raise ValueError(str(result))
