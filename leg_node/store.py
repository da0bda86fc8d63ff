"""The durable copy of the shared table: a SQLite database beside the table's file. Pure.

The database holds a checkpoint of the table, and every push since that checkpoint. A push is
committed before it is acknowledged, so no acknowledged push is lost when the process is killed, or,
with ``durability`` ``full``, when the power fails. After a regular end the table's own file holds
everything, and the database is removed.

SQLite in write-ahead mode does what a journal of our own would have to do: torn writes, checksums,
full disks. Its exclusive lock gives every database one owner.
"""

from __future__ import annotations

import sqlite3
from array import array
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ember_ros.errors import TableError
from ember_ros.signals import TDUpdate
from leg_node.shared import UpdateBatch
from leg_node.table import Table

ENDINGS = (".store", ".store-wal", ".store-journal")
"""Appended to the name of the table's file: the database, and the files that SQLite keeps beside
it while it is open."""
MAX_PUSHES = 1024
"""Pushes after which a new checkpoint is due; bounds the file's size and the time to read it."""
DURABILITIES = {"normal": "NORMAL", "full": "FULL"}
"""Values of the option ``durability``: SQLite's ``synchronous`` in write-ahead mode."""
APPLICATION_ID = 0x656D6265
"""Marks a SQLite file as ours ("embe")."""
_SCHEMA = (
    "CREATE TABLE checkpoint (states INTEGER, actions INTEGER, cells_sha256 TEXT, "
    "table_sha256 TEXT, contents BLOB)",
    "CREATE TABLE run (leg INTEGER, run TEXT, epoch INTEGER, PRIMARY KEY (leg, run))",
    "CREATE TABLE push (leg INTEGER, run TEXT, epoch INTEGER, cells_sha256 TEXT, "
    "ticks BLOB, cells BLOB, targets BLOB)",
)
_HEADER_BYTES = 100
_INTS, _FLOATS = "q", "d"


class Stored(NamedTuple):
    """What a database holds."""

    table: Table
    """The table at the checkpoint."""
    runs: dict[tuple[int, str], int]
    """The last epoch of each run of each leg, by (leg, run)."""
    pushes: list[UpdateBatch]
    """The pushes that are not in the table yet, in the order in which they were received."""


class TableStore:
    """The database of one table; it has one owner at a time."""

    def __init__(self, table_file: Path, cells_sha256: str, durability: str = "normal") -> None:
        """Open the database beside a table's file, or create it.

        Args:
            table_file: the file that the table is saved to at a regular end.
            cells_sha256: meaning of the table's cells (``params.cells_sha256``).
            durability: ``normal``: an acknowledged push survives the end of the process;
                ``full``: it survives a power failure too.

        Raises:
            TableError: the file cannot be opened, belongs to another process, or is no database of
                this package.
        """
        self.file = table_file.with_name(table_file.name + ENDINGS[0])
        self.pushes = 0
        """Pushes since the last checkpoint."""
        self._cells = cells_sha256
        with self._errors("open"):
            self.file.parent.mkdir(parents=True, exist_ok=True)
            if self.file.exists() and 0 < self.file.stat().st_size < _HEADER_BYTES:
                raise sqlite3.DatabaseError("it is cut off")  # SQLite would take it for empty
            self._database = sqlite3.connect(self.file, timeout=0.0, isolation_level=None)
        try:
            with self._errors("open"):
                self._database.text_factory = lambda text: text.decode(errors="replace")
                self._database.execute("PRAGMA trusted_schema = OFF")
                self._database.execute("PRAGMA locking_mode = EXCLUSIVE")
                self._database.execute("BEGIN EXCLUSIVE")  # takes the lock, and keeps it
                self._check_or_create()
                self._database.execute("COMMIT")
                self._database.execute("PRAGMA journal_mode = WAL").fetchall()
                self._database.execute(f"PRAGMA synchronous = {DURABILITIES[durability]}")
                self._inode = self.file.stat().st_ino
        except BaseException:
            self._database.close()
            raise

    def _check_or_create(self) -> None:
        """Create the tables in an empty database; check that another one is ours.

        Raises:
            TableError: it is not.
        """
        found = self._database.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")
        schema = tuple(sql for (sql,) in found.fetchmany(len(_SCHEMA) + 1))
        (application,) = self._database.execute("PRAGMA application_id").fetchone()
        if not schema and application == 0:
            for statement in _SCHEMA:
                self._database.execute(statement)
            self._database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        elif schema != _SCHEMA or application != APPLICATION_ID:
            raise TableError(
                f"{self.file} is not a database of this package; move it away, or save the table "
                "under another name"
            )

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """Turn errors of SQLite and of the file system into a TableError that names the file."""
        try:
            yield
        except sqlite3.OperationalError as error:
            if "locked" in str(error):
                raise TableError(
                    f"{self.file} belongs to another table_node that is running; stop it, or save "
                    "the table under another name"
                ) from None
            raise TableError(f"cannot {what} {self.file}: {error}") from error
        except (sqlite3.Error, UnicodeError) as error:  # its messages quote what is in the file
            raise TableError(
                f"{self.file} is damaged ({error}); move it away to start without it"
            ) from error
        except OSError as error:
            raise TableError(f"cannot {what} {self.file}: {error.strerror or error}") from error

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """Commit everything in the block, or nothing.

        Raises:
            TableError: it could not be written.
        """
        with self._errors("write"):
            if self.file.stat().st_ino != self._inode:
                raise FileNotFoundError(2, "the file was replaced")
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield self._database
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                raise

    # -- write -------------------------------------------------------------------------------

    def add(self, push: UpdateBatch) -> None:
        """Write a push, before it is acknowledged.

        Raises:
            TableError: it could not be written, and is not in the database.
        """
        with self._transaction() as database:
            self._insert(database, push)
            database.execute(
                "INSERT INTO run VALUES (?, ?, ?) ON CONFLICT DO UPDATE SET epoch = excluded.epoch",
                (push.leg, push.run, push.epoch),
            )
        self.pushes += 1

    def checkpoint(self, table: Table, pending: Iterable[UpdateBatch]) -> None:
        """Replace the checkpoint by a table and the pushes that are not in it yet.

        Raises:
            TableError: it could not be written; the database holds what it held before.
        """
        contents = table.values.tobytes() + table.visits.tobytes()
        row = (table.states, table.actions, self._cells, table.sha256(), contents)
        with self._transaction() as database:
            database.execute("DELETE FROM checkpoint")
            database.execute("INSERT INTO checkpoint VALUES (?, ?, ?, ?, ?)", row)
            database.execute("DELETE FROM push")
            for push in pending:
                self._insert(database, push)
        self.pushes = 0

    @staticmethod
    def _insert(database: sqlite3.Connection, push: UpdateBatch) -> None:
        ticks, cells, targets = zip(*push.updates, strict=True) if push.updates else ((), (), ())
        database.execute(
            "INSERT INTO push VALUES (?, ?, ?, ?, ?, ?, ?)",
            (
                *push[:-1],
                array(_INTS, ticks).tobytes(),
                array(_INTS, cells).tobytes(),
                array(_FLOATS, targets).tobytes(),
            ),
        )

    # -- read --------------------------------------------------------------------------------

    def load(self, states: int, actions: int) -> Stored | None:
        """Return what an earlier owner left, who was killed; None if the database is new.

        Args:
            states: number of the table's states.
            actions: number of actions per state.

        Raises:
            TableError: it is damaged, or its cells have another meaning.
        """
        with self._errors("read"):
            rows = self._database.execute(
                "SELECT states, actions, cells_sha256, table_sha256, length(contents) "
                "FROM checkpoint LIMIT 2"
            ).fetchall()
            if not rows:
                return None
            if len(rows) > 1 or rows[0][:3] != (states, actions, self._cells):
                raise TableError(
                    f"{self.file} was left by a table_node that was killed, and whose parameters "
                    "gave the cells another meaning; start with those parameters, or move it away"
                )
            table, size = Table(states, actions), 8 * states * actions
            if rows[0][4] != 2 * size:
                raise TableError(f"{self.file} is damaged: its table is not whole")
            (contents,) = self._database.execute("SELECT contents FROM checkpoint").fetchone()
            if not isinstance(contents, bytes):
                raise TableError(f"{self.file} is damaged: its table is not whole")
            table.values[:] = np.frombuffer(contents, np.float64, states * actions)
            table.visits[:] = np.frombuffer(contents, np.int64, offset=size)
            if table.sha256() != rows[0][3]:
                raise TableError(f"{self.file} is damaged: its table has another SHA-256")
            runs = {}
            for leg, run, epoch in self._database.execute("SELECT leg, run, epoch FROM run"):
                if [type(each) for each in (leg, run, epoch)] != [int, str, int]:
                    raise TableError(f"{self.file} is damaged: a run is not whole")
                runs[leg, run] = epoch
            pushes = [
                self._push(*row)
                for row in self._database.execute("SELECT * FROM push ORDER BY rowid")
            ]
        self.pushes = len(pushes)
        return Stored(table, runs, pushes)

    def _push(self, leg: int, run: str, epoch: int, cells: str, *arrays: bytes) -> UpdateBatch:
        columns = []
        try:
            if [type(each) for each in (leg, run, epoch, cells)] != [int, str, int, str]:
                raise TypeError("a column has another type")
            for kind, content in zip((_INTS, _INTS, _FLOATS), arrays, strict=True):
                column: array[int] | array[float] = array(kind)
                column.frombytes(content)
                columns.append(column)
            updates = tuple(TDUpdate(*each) for each in zip(*columns, strict=True))
        except (TypeError, ValueError) as error:
            raise TableError(f"{self.file} is damaged: a push is not whole ({error})") from error
        return UpdateBatch(leg, run, epoch, cells, updates)

    # -- end ---------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the database; it stays on disk."""
        self._database.close()

    def remove(self) -> None:
        """Close and remove the database: the table's own file holds everything."""
        self.close()
        for ending in ENDINGS:
            self.file.with_name(self.file.name.removesuffix(ENDINGS[0]) + ending).unlink(
                missing_ok=True
            )
