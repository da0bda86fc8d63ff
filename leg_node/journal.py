"""What makes an acknowledged push last: a snapshot of the table, and a line a push after it. Pure.

Both lie beside the file that the table will be saved to. A snapshot and its journal carry the same
generation: a journal of an older one is already in the snapshot. After the death of the process,
the two together are the table as everybody was told it is; after a good end both are gone.
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
"""Behind the name of the table's file: the journal and the snapshot."""
MAX_BATCHES = 1024
"""Pushes after which a new snapshot is due: bounds the file and the time to read it."""


def to_json(push: UpdateBatch) -> list[Any]:
    """Return a push as plain lists; floats survive JSON bit for bit."""
    return [*push[:-1], [list(update) for update in push.updates]]


def from_json(content: list[Any]) -> UpdateBatch:
    """Return the push in plain lists."""
    leg, run, epoch, cells_sha256, updates = content
    return UpdateBatch(
        leg, run, epoch, cells_sha256, tuple(TDUpdate(*update) for update in updates)
    )


class Journal:
    """The pushes since a snapshot; the snapshot itself is written by its owner."""

    def __init__(self, table_file: Path) -> None:
        """Keep the journal of ``table_file`` beside it."""
        self.file, self.snapshot = (table_file.with_name(table_file.name + end) for end in ENDINGS)
        self.pushes = 0
        self._out: Any = None

    def begin(self, generation: int) -> None:
        """Begin anew after a snapshot was written.

        Raises:
            TableError: the file cannot be written.
        """
        self.close()
        draft = self.file.with_name(self.file.name + ".new")
        try:
            self._out = draft.open("w", encoding="utf-8")
            self._line({"generation": generation})
            os.replace(draft, self.file)
        except OSError as error:
            raise TableError(f"cannot write {self.file}: {error.strerror}") from error
        self.pushes = 0

    def add(self, push: UpdateBatch) -> None:
        """Write a push down before it is acknowledged.

        Raises:
            TableError: the file cannot be written; the push is not durable.
        """
        try:
            self._line(to_json(push))
        except OSError as error:
            raise TableError(f"cannot write {self.file}: {error.strerror}") from error
        self.pushes += 1

    def _line(self, content: Any) -> None:
        self._out.write(json.dumps(content) + "\n")
        self._out.flush()  # to the system: it outlives this process

    def read(self, generation: int) -> list[UpdateBatch]:
        """Return the pushes since the snapshot of a generation, up to the first torn line."""
        pushes: list[UpdateBatch] = []
        try:
            with open_file(self.file) as raw:
                lines = raw.read().decode(errors="replace").splitlines()
            if json.loads(lines[0]) != {"generation": generation}:
                return []
            for line in lines[1:]:
                pushes.append(from_json(json.loads(line)))
        except (OSError, ValueError, IndexError, TypeError, RecursionError):
            pass  # torn where the process died: that push was not acknowledged
        return pushes

    def close(self) -> None:
        """Close the file and leave it."""
        if self._out is not None:
            self._out.close()
            self._out = None

    def remove(self) -> None:
        """Close and remove both files: the table's own file holds everything."""
        self.close()
        self.file.unlink(missing_ok=True)
        self.snapshot.unlink(missing_ok=True)
