"""Checks of a bag's files and contents before they are unpacked, loaded or run. Pure."""

from __future__ import annotations

import sqlite3
import stat
import sys
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml

from ember_ros.errors import shown

MAX_BYTES = 1 << 25
"""Of a chunk or a message when it is unpacked: a larger one is refused before that."""
MAX_OPEN = 1 << 25
"""Bytes of chunks that are open together because the times of their messages overlap."""
MAX_RECORDS = 200_000
"""In one chunk."""
MAX_TIMES = 100
"""Times its size, plus ``MAX_BYTES``, that a file may have unpacked; recordings grow tenfold."""
MAX_TOPICS, MAX_NAME = 5000, 1000
"""Topics of a file, and characters of a topic or its type."""
MAX_REPORTED = 1 << 24
"""Bytes of all records on topics in one file."""
MAX_TEXT = 1 << 22
"""Characters of a YAML text."""
MAX_YAML, MAX_DEPTH = 200_000, 100
"""Nodes of a YAML text when every alias is expanded, and how deep they may be nested."""
SLOWEST_S, SLOWEST_BYTES_S = 10.0, 20e6
"""Wall time in which SQLite must check a file: a constant, and its size over a rate."""
_STEPS = 100_000
"""Steps of SQLite between two checks of the time."""

# CSafeLoader is ten times as fast, where it is installed.
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def check_file(file: Path, folder: Path) -> None:
    """Check that a file of a bag is a regular one in the bag's folder.

    Raises:
        OSError: it does not exist.
        ValueError: it is a pipe, a device or a folder, or a link to somewhere else.
    """
    try:
        place = file.resolve(strict=True)
        regular = stat.S_ISREG(place.stat().st_mode)
    except RuntimeError as error:  # before Python 3.13, where it is an OSError
        raise ValueError(f"{file.name} is a link to itself") from error
    if not regular:
        raise ValueError(f"{file.name} is no regular file")
    if not place.is_relative_to(folder.resolve()):
        raise ValueError(f"{file.name} leads out of the folder, to {place}")


def check_topics(topics: Collection[tuple[str, str]]) -> None:
    """Check the number of a file's topics, and the lengths of their names and types.

    Raises:
        ValueError: there are too many, or one has too long a name.
    """
    if len(topics) > MAX_TOPICS:
        raise ValueError(f"{len(topics)} topics; up to {MAX_TOPICS} would be right")
    for name in (name for topic in topics for name in topic):
        if len(name) > MAX_NAME:
            raise ValueError(f"a topic or a type of {len(name)} characters: {shown(name)}")


def load_yaml(text: str) -> Any:
    """Return the content of a YAML text.

    Raises:
        ValueError: it is no YAML, is nested too deeply, or its aliases expand to too much.
    """
    if len(text) > MAX_TEXT:
        raise ValueError(f"{len(text)} characters of YAML; up to {MAX_TEXT} would be right")
    try:
        _check_yaml(text)
        return yaml.load(text, LOADER)
    except Exception as error:  # wrong tags and dates raise many kinds
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error


def _check_yaml(text: str) -> None:
    """Check a text's events, since a loader would build the objects first."""
    sizes: dict[str, int] = {}
    inside: list[tuple[str | None, int]] = []
    nodes = 0
    for event in yaml.parse(text, LOADER):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise ValueError(f"alias *{event.anchor} has no anchor, or is inside of it")
            nodes += sizes[event.anchor]
        elif isinstance(event, yaml.CollectionStartEvent):
            inside.append((event.anchor, nodes))
            nodes += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = inside.pop()
            if anchor is not None:
                sizes[anchor] = nodes - before
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        if nodes > MAX_YAML or len(inside) > MAX_DEPTH:
            raise ValueError(
                f"more than {MAX_YAML} values by its aliases, or more than {MAX_DEPTH} deep"
            )


def check_database(database: sqlite3.Connection, size: int) -> None:
    """Check that a database has sound pages, stored tables only, and sizes within the limits.

    A virtual table, a generated column or a constraint computes, perhaps without end; so do pages
    that refer to each other. (Views are never read.)

    Args:
        database: an open one.
        size: of its file, bytes.

    Raises:
        ValueError: it cannot be a file of a bag.
        sqlite3.Error: it is damaged.
    """
    deadline = time.monotonic() + SLOWEST_S + size / SLOWEST_BYTES_S
    database.set_progress_handler(lambda: time.monotonic() > deadline, _STEPS)
    try:
        if sys.version_info >= (3, 11):
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BYTES)
        database.execute("PRAGMA trusted_schema=OFF")
        database.execute("PRAGMA ignore_check_constraints=ON")
        computed = (
            "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage = 0",
            "SELECT m.name FROM sqlite_master m, pragma_table_xinfo(m.name) c "
            "WHERE m.type = 'table' AND c.hidden > 1",
        )
        for query in computed:
            for (name,) in database.execute(query):
                raise ValueError(f"table {shown(name)} is computed; a stored one would be right")
        (result,) = database.execute("PRAGMA quick_check(1)").fetchone()
        if result != "ok":
            raise ValueError(" ".join(str(result).split()))
    finally:
        database.set_progress_handler(None, 0)
