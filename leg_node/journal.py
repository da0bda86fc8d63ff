"""A write-ahead journal: no acknowledged push is lost when the table's process is killed. Pure.

A snapshot holds the table; the journal holds one line for each push after the snapshot. Both are
next to the file that the table will be saved to. They carry the same generation number: a journal
of an older generation is contained in the snapshot already. After a crash, the snapshot and the
journal together give the table that the legs know. After a regular end, both are removed.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from ember_ros.bounded_io import open_file
from ember_ros.errors import TableError
from ember_ros.signals import TDUpdate
from leg_node.shared import UpdateBatch

ENDINGS = (".journal", ".snapshot.npz")
"""Appended to the name of the table's file: the journal and the snapshot."""
MAX_BATCHES = 1024
"""Pushes after which a new snapshot is due; bounds the file's size and the time to read it."""


def to_json(push: UpdateBatch) -> list[Any]:
    """Return a push as plain lists; floats survive JSON bit for bit."""
    return [*push[:-1], [list(update) for update in push.updates]]


def from_json(content: list[Any]) -> UpdateBatch:
    """Return the push that ``to_json`` made these lists of."""
    leg, run, epoch, cells_sha256, updates = content
    return UpdateBatch(
        leg, run, epoch, cells_sha256, tuple(TDUpdate(*update) for update in updates)
    )


class Journal:
    """The file of all pushes since a snapshot; the owner writes the snapshot itself."""

    def __init__(self, table_file: Path) -> None:
        """Create a journal next to ``table_file``; ``start`` opens its file."""
        self.file, self.snapshot = (table_file.with_name(table_file.name + end) for end in ENDINGS)
        self.pushes = 0
        self._out: Any = None

    def start(self, generation: int) -> None:
        """Start a new file after a snapshot was written.

        Raises:
            TableError: the file cannot be written.
        """
        self.close()
        draft = self.file.with_name(self.file.name + ".new")
        try:
            self._out = draft.open("w", encoding="utf-8")
            self._write_line({"generation": generation})
            os.replace(draft, self.file)
        except OSError as error:
            raise TableError(f"cannot write {self.file}: {error.strerror}") from error
        self.pushes = 0

    def add(self, push: UpdateBatch) -> None:
        """Write a push, before it is acknowledged.

        Raises:
            TableError: the file cannot be written; the push is not durable.
        """
        try:
            self._write_line(to_json(push))
        except OSError as error:
            raise TableError(f"cannot write {self.file}: {error.strerror}") from error
        self.pushes += 1

    def _write_line(self, content: Any) -> None:
        self._out.write(json.dumps(content) + "\n")
        self._out.flush()  # the operating system has it now, even if this process is killed

    def read(self, generation: int) -> list[UpdateBatch]:
        """Return the pushes since the snapshot of a generation, up to the first incomplete line."""
        pushes: list[UpdateBatch] = []
        try:
            with open_file(self.file) as raw:
                lines = raw.read().decode(errors="replace").splitlines()
            if json.loads(lines[0]) != {"generation": generation}:
                return []
            for line in lines[1:]:
                pushes.append(from_json(json.loads(line)))
        except (OSError, ValueError, IndexError, TypeError, RecursionError):
            pass  # the process was killed during this line: the push was not acknowledged
        return pushes

    def close(self) -> None:
        """Close the file; it stays on disk."""
        if self._out is not None:
            self._out.close()
            self._out = None

    def remove(self) -> None:
        """Close the journal; remove it and the snapshot: the table's own file holds everything."""
        self.close()
        self.file.unlink(missing_ok=True)
        self.snapshot.unlink(missing_ok=True)
