"""What is asked of a bag's files before anything in them is believed, unpacked or run. Pure."""

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
"""Of a chunk or a message when it is unpacked: more is said before anything is unpacked."""
MAX_OPEN = 1 << 25
"""Bytes of chunks that are open together, since the times of their messages overlap."""
MAX_RECORDS = 200_000
"""In one chunk."""
MAX_TIMES = 100
"""That a file may grow when all in it is unpacked, and MOST_BYTES; recordings grow tenfold."""
MAX_TOPICS, MAX_NAME = 5000, 1000
"""Topics of a file, and characters of a topic or its type."""
MAX_REPORTED = 1 << 24
"""Bytes of everything that one file tells of its topics."""
MAX_TEXT = 1 << 22
"""Characters of a YAML text."""
MAX_YAML, MAX_DEPTH = 200_000, 100
"""Nodes of a YAML text when every alias is written out, and how deep they may lie."""
SLOWEST_S, SLOWEST_BYTES_S = 10.0, 20e6
"""Wall time that SQLite has to look at a file: so much, and so much more for what is in it."""
_STEPS = 100_000
"""Steps of SQLite between two looks at the time."""

LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast, where it is


def check_file(file: Path, folder: Path) -> None:
    """Hold that a file of a bag is one, and lies in the bag's folder.

    Raises:
        OSError: it is not there.
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
    """Hold that the topics of a file, and their types, can be those of a robot.

    Raises:
        ValueError: there are too many, or one has too long a name.
    """
    if len(topics) > MAX_TOPICS:
        raise ValueError(f"{len(topics)} topics; up to {MAX_TOPICS} would be right")
    for name in (name for topic in topics for name in topic):
        if len(name) > MAX_NAME:
            raise ValueError(f"a topic or a type of {len(name)} characters: {shown(name)}")


def load_yaml(text: str) -> Any:
    """Return what a YAML text says.

    Raises:
        ValueError: it is none, is nested too deeply, or grows beyond all measure by its aliases.
    """
    if len(text) > MAX_TEXT:
        raise ValueError(f"{len(text)} characters of YAML; up to {MAX_TEXT} would be right")
    try:
        _check_yaml(text)
        return yaml.load(text, LOADER)
    except Exception as error:  # wrong tags and dates make it raise nearly anything
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error


def _check_yaml(text: str) -> None:
    """Go through a text's events: a loader would already have built what they make."""
    sizes: dict[str, int] = {}
    inside: list[tuple[str | None, int]] = []
    nodes = 0
    for event in yaml.parse(text, LOADER):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise ValueError(f"*{event.anchor} stands for nothing, or for what it is in")
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
    """Hold that a database is what it seems: sound pages, tables that are tables, sizes in bounds.

    A virtual table, a generated column or a constraint computes, and may do so for ever; of pages
    that lie in each other there is no end either. (Nobody reads the views.)

    Args:
        database: an open one.
        size: of its file, bytes.

    Raises:
        ValueError: it is none of a bag.
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
                raise ValueError(f"table {shown(name)} is computed; nothing in a bag is")
        (said,) = database.execute("PRAGMA quick_check(1)").fetchone()
        if said != "ok":
            raise ValueError(" ".join(str(said).split()))
    finally:
        database.set_progress_handler(None, 0)
