"""The shared table of a server: durable, bounded, and with every push checked. Pure."""

from __future__ import annotations

from ember_ros.errors import TableError, UpdateError
from ember_ros.params import Rate
from leg_node.shared import Changes, SharedTable, UpdateBatch
from leg_node.store import MAX_PUSHES, Stored, TableStore
from leg_node.table import Table

MAX_AHEAD = 64
"""Epochs that a push of a known run may be ahead of the newest one of all legs: a wrong one must
not make all later ones of the run look as if they were taken already."""
MAX_EPOCHS_PER_PUSH = 16
"""Epochs of which one push may hold updates: a leg that misses the last tick of an epoch pushes it
together with the next one."""
MAX_PENDING_PUSHES = 1024
"""Pushes that wait to be merged; more are merged before their turn."""
MAX_RUNS_PER_LEG = 10_000
"""Runs of one leg that are remembered; pushes of further ones are refused."""
MAX_TARGET = 1e12
"""Greatest absolute value of a target: with greater ones, sums of values may overflow."""
MAX_LIFE = 2**22 - 1
"""Greatest number of a life, so that a version is a 64-bit integer."""
_LIFE_SHIFT = 40


class DurableTable(SharedTable):
    """A ``SharedTable`` that writes every push to a store before it takes it.

    Versions are ``life << 40 | counter``. Each process draws its life at random, so that a leg's
    version of an earlier process is not taken for one of this process, whatever any clock says.
    """

    def __init__(
        self,
        table: Table,
        *,
        legs: int,
        cells: str,
        rate: Rate,
        sync_every: int,
        life: int,
        store: TableStore | None = None,
    ) -> None:
        """Start from ``table``, which is owned from now on.

        Args:
            table: what was learnt before.
            legs: number of legs.
            cells: SHA-256 that each push must carry.
            rate: bounds of the learning rate.
            sync_every: ticks per epoch.
            life: number of this process, 1 to ``MAX_LIFE``.
            store: where pushes are written to; None if nothing is to be durable.
        """
        self._life = life
        super().__init__(
            table, legs=legs, cells=cells, rate=rate, version=self._life << _LIFE_SHIFT
        )
        self._sync_every, self._store = sync_every, store
        self._runs: dict[tuple[int, str], int] = {}
        self._newest: int | None = None

    def resume(self, stored: Stored) -> None:
        """Take the pushes of an earlier process, which are in the store already.

        Raises:
            TableError: one of them is not a valid push.
        """
        for batch in stored.pushes:
            try:
                self._check(batch)
            except (UpdateError, TypeError) as error:
                raise TableError(f"the store is damaged: {error}") from error
            self._pending.setdefault(batch.epoch, []).append(batch)
        self._runs = dict(stored.runs)
        self._newest = max(self._runs.values(), default=None)

    def push(self, batch: UpdateBatch) -> bool:
        """Store the updates of an epoch, then take them.

        Returns:
            False if this push, or a later one of its run, was taken before: nothing changed now.

        Raises:
            UpdateError: it is malformed; nothing of it is taken.
            TableError: it could not be stored; nothing of it is taken, and it may be sent again.
        """
        self._check(batch)
        run = (batch.leg, batch.run)
        last = self._runs.get(run)
        if last is not None and batch.epoch <= last:
            return False
        if last is None and sum(leg == batch.leg for leg, _ in self._runs) >= MAX_RUNS_PER_LEG:
            raise UpdateError(
                f"push of leg {batch.leg}: the table knows {MAX_RUNS_PER_LEG} runs of this leg and "
                "takes no more; restart the table_node"
            )
        if self.merges_pushes:
            if self._store is not None:
                if self._store.pushes >= MAX_PUSHES:
                    self.checkpoint()
                self._store.add(batch)
            self._pending.setdefault(batch.epoch, []).append(batch)
            while sum(map(len, self._pending.values())) > MAX_PENDING_PUSHES:
                self.merge(min(self._pending))
        self._runs[run] = batch.epoch
        self._newest = batch.epoch if self._newest is None else max(self._newest, batch.epoch)
        return True

    def _check(self, batch: UpdateBatch) -> None:
        super()._check(batch)
        where = f"push of leg {batch.leg}, epoch {batch.epoch}"
        known = (batch.leg, batch.run) in self._runs
        if known and self._newest is not None and batch.epoch > self._newest + MAX_AHEAD:
            raise UpdateError(
                f"{where}: the newest epoch of all legs is {self._newest}; up to {MAX_AHEAD} more "
                "would be right"
            )
        limit = MAX_EPOCHS_PER_PUSH * max(1, self._sync_every)
        if len(batch.updates) > limit:
            raise UpdateError(
                f"{where}: {len(batch.updates)} updates; up to {limit} would be right"
            )
        for update in batch.updates:
            if update.tick >= (batch.epoch + 1) * self._sync_every:
                raise UpdateError(
                    f"{where}: tick {update.tick} is after this epoch of {self._sync_every} ticks "
                    "(sync_every); give the leg and the table the same parameter file and stage"
                )
            if not abs(update.target) <= MAX_TARGET:
                raise UpdateError(
                    f"{where}: the target of cell {update.cell} is {update.target}; up to "
                    f"{MAX_TARGET:g} would be right"
                )

    def checkpoint(self) -> None:
        """Write the table and the pushes that wait to the store.

        Raises:
            TableError: they could not be written; the store holds what it held before.
        """
        if self._store is not None:
            self._store.checkpoint(self.table, self.pending())

    def pull(self, since: int | None = None, upto: int | None = None) -> Changes:
        """Return what changed after a version in the table with all epochs to ``upto`` merged.

        Everything is returned for None, and for a version of another process.
        """
        if since is not None and not self.is_own(since):
            since = None
        return super().pull(since, upto)

    def is_own(self, version: int) -> bool:
        """Return whether a version is one of this process."""
        return version >> _LIFE_SHIFT == self._life
