"""Brings back what is whole in a bag whose recording was cut off, or that was damaged later."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ember_ros.bag.storage import (
    METADATA,
    STORAGES,
    BagOptions,
    BagWriter,
    lock,
    needs_rosbags,
    read_metadata,
)
from ember_ros.errors import BagError

DRAFT = ".repair"


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


class _Tally:
    def __init__(self) -> None:
        self.chunks = self.damaged = self.torn = 0
        self.first: int | None = None
        self.last = 0

    def see(self, ns: int) -> None:
        self.first = ns if self.first is None else min(self.first, ns)
        self.last = max(self.last, ns)


def repair(folder: Path) -> Repaired:
    """Write the bag anew from its whole chunks, in the place of the damaged one.

    Args:
        folder: of the bag.

    Raises:
        BagError: there is no bag, nothing in it is whole, or it cannot be written; then what was
            there is untouched.
    """
    files = _files(folder)
    storage = next(name for name, end in STORAGES.items() if files[0].suffix == end)
    held = lock(folder)
    draft = folder / DRAFT
    shutil.rmtree(draft, ignore_errors=True)
    tally, writer = _Tally(), None
    try:
        writer = BagWriter(BagOptions(draft / folder.resolve().name, storage))
        for n, file in enumerate(files):
            if n:
                writer.begin_file()
            (_copy_mcap if storage == "mcap" else _copy_sqlite3)(file, writer, tally)
        if not writer.messages:
            raise BagError(f"nothing in {folder} is whole: not one chunk was finished")
        writer.close(_kept(folder, tally, writer.messages))
        made = sorted(writer.folder.iterdir(), key=lambda file: file.name == METADATA)
        for file in made:  # over the old ones: at no moment are there none
            os.replace(file, folder / file.name)
        for file in files:
            Path(f"{file}-journal").unlink(missing_ok=True)  # of the old database
            if file.name not in {each.name for each in made}:
                file.unlink()
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
        if writer is not None:
            writer.abandon()
        shutil.rmtree(draft, ignore_errors=True)
        os.close(held)
    seconds = (tally.last - (tally.first or 0)) * 1e-9
    return Repaired(writer.messages, seconds, tally.chunks, tally.damaged, tally.torn)


def _kept(folder: Path, tally: _Tally, messages: int) -> dict[str, str]:
    """Return what the old metadata knew of the run's end, if nothing of the run is missing."""
    try:
        old = read_metadata(folder)
    except BagError:
        return {}
    whole = not tally.damaged and not tally.torn and old.get("message_count") == messages
    custom = old.get("custom_data")
    return dict(custom) if whole and isinstance(custom, dict) else {}


def _files(folder: Path) -> list[Path]:
    """Return the files of one storage, in the order in which they were written."""
    if folder.is_file():
        raise BagError(f"{folder} is one file; the folder that it lies in would be right")
    if not folder.is_dir():
        raise BagError(f"there is no bag {folder}; the folder of one would be right")

    def number(file: Path) -> tuple[int, str]:
        found = re.search(r"_(\d+)$", file.stem)
        return int(found[1]) if found else -1, file.name

    for end in STORAGES.values():
        files = sorted(folder.glob(f"*{end}"), key=number)
        if files:
            return files
    raise BagError(f"{folder} is no bag: it has no file of {' or '.join(STORAGES.values())}")


def _copy_mcap(file: Path, writer: BagWriter, tally: _Tally) -> None:
    """Copy every whole chunk, each as a chunk again."""
    try:
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import StreamReader, breakup_chunk
    except ModuleNotFoundError as error:
        raise needs_rosbags(error) from error
    known: dict[int, tuple[str, str]] = {}
    schemas: dict[int, str] = {}

    def learn(each: Any) -> None:
        if isinstance(each, Schema):
            schemas[each.id] = each.name
        elif isinstance(each, Channel) and each.schema_id in schemas:
            known[each.id] = each.topic, schemas[each.schema_id]

    def read(raw: Any) -> Iterator[tuple[Any, Any, int]]:
        """Yield whole records, what is inside, None for a broken chunk, and where each ends."""
        records = iter(StreamReader(raw, emit_chunks=True).records)
        while True:
            # A torn record makes the reader raise nearly anything; there is nothing behind it.
            try:
                record = next(records, None)
            except Exception:
                return
            inside: Any = [record]
            if isinstance(record, Chunk):
                try:
                    inside = breakup_chunk(record, validate_crc=True)
                except Exception:  # zstd, struct and mcap raise nearly anything
                    inside = None
            yield record, inside, raw.tell()
            if record is None:
                return

    size, whole = file.stat().st_size, 0
    with file.open("rb") as raw:
        # What channels there are is said again at the end of a file that was finished.
        for _, inside, _ in read(raw):
            for each in inside or ():
                learn(each)
        raw.seek(0)
        channels: dict[int, int] = {}
        for record, inside, end in read(raw):
            if inside is None:
                if end == size:
                    break
                tally.damaged += 1
                continue
            whole = end
            for each in inside:
                if isinstance(each, Channel) and isinstance(record, Chunk) and each.id in known:
                    channels[each.id] = writer.channel(*known[each.id])
                elif isinstance(each, Message) and each.channel_id in known:
                    if each.channel_id not in channels:
                        channels[each.channel_id] = writer.channel(*known[each.channel_id])
                    writer.write(channels[each.channel_id], each.log_time, each.data)
                    tally.see(each.log_time)
            if isinstance(record, Chunk):
                tally.chunks += 1
                writer.flush()
    tally.torn += size - whole


def _copy_sqlite3(file: Path, writer: BagWriter, tally: _Tally) -> None:
    """Copy every message of all transactions that were finished."""
    try:
        # Not read-only: SQLite rolls back what was not finished when it may write.
        with contextlib.closing(sqlite3.connect(file)) as database:
            topics = {
                number: writer.channel(str(name), str(kind))
                for number, name, kind in database.execute("SELECT id, name, type FROM topics")
            }
            rows = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id")
            for number, ns, data in rows:
                if number not in topics or type(ns) is not int or type(data) is not bytes:
                    raise BagError(f"{file} is no whole database: a message of it is damaged")
                writer.write(topics[number], ns, data)
                tally.see(ns)
            tally.chunks += len(topics)
            writer.flush()
    except sqlite3.Error as error:
        raise BagError(f"{file} is no whole database: {error}") from error
