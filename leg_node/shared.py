"""The table that all legs share, and a leg's own copy of it (paper, section VI-C). Pure.

Time is cut into epochs of ``sync_every`` ticks; epoch ``e`` holds the ticks ``e * sync_every`` to
``(e + 1) * sync_every - 1``. A leg applies its updates to its copy at once, and keeps them. With
the last tick of an epoch it pushes them as one batch, and sends that tick's command only when the
push is acknowledged; with the first tick of the next epoch it pulls what changed. The world does
not step before it has every leg's command. So no leg reaches the next epoch before all pushes of
this one are acknowledged: when anybody pulls, everybody's updates of all epochs before are in; the
answer never waits for another leg, and does not depend on who came first. With ``sync_every = 1``
all legs read one table. The exception is a leg that goes on without the table, since this does not
answer in time or gives nothing to use (``skip_sync``): it keeps its updates for a later push.

The shared table applies an epoch's updates in the order (tick, leg), one after the other, so that
many legs that visit one cell move it as one leg that visits it often would. Summed differences
would overshoot.

What a leg reads of its copy may be older than the copy: ``SmoothedValues`` in ``leg_node.value``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from ember_ros.errors import UpdateError
from ember_ros.params import Rate
from ember_ros.signals import TDUpdate
from leg_node.table import Floats, Ints, Table

MAX_PENDING = 64
"""Epochs that may lie unmerged before a push merges the oldest: bounds the memory."""
MAX_RUNS = 16
"""Runs of one leg whose last epoch is remembered: bounds the memory."""
NO_EPOCH = -2
"""Nothing was pulled yet. Not -1: that is pulled at tick 0, the table as it is before epoch 0."""


class UpdateBatch(NamedTuple):
    """The updates of one leg in one epoch; (leg, run, epoch) names the batch."""

    leg: int
    """Position of the leg in the order of legs."""
    run: str
    """Names one life of one leg module."""
    epoch: int
    cells_sha256: str
    """SHA-256 of what gives cells their meaning (``params.cells_sha256``)."""
    updates: tuple[TDUpdate, ...]


class Changes(NamedTuple):
    """What changed in the shared table since a version of it."""

    version: int
    """Of the table now; it grows with every merge that changes something."""
    cells: Ints
    """Cells that changed, ``(n,)``."""
    values: Floats
    """Their values, ``(n,)``."""
    visits: Ints
    """Their visits, ``(n,)``."""


class SharedTable:
    """The merged table and the batches that wait to be merged."""

    def __init__(
        self, table: Table, *, legs: int, cells: str, rate: Rate, version: int = 0
    ) -> None:
        """Start from ``table``, which is owned from now on.

        Args:
            table: what was learnt before.
            legs: how many there are.
            cells: SHA-256 that each batch must carry.
            rate: bounds of the learning rate.
            version: to count from; beyond all versions of an earlier life of the same table.
        """
        self.table = table
        self.version = version
        self.merges_pushes = True
        """Whether pushes are merged; they are dropped otherwise."""
        self._legs, self._cells, self._rate = legs, cells, rate
        self._changed: Ints = np.full(len(table), version, dtype=np.int64)
        self._answer: tuple[tuple[int, int], Changes] | None = None
        self._pending: dict[int, list[UpdateBatch]] = {}
        self._done: dict[int, dict[str, int]] = {}

    def push(self, batch: UpdateBatch) -> bool:
        """Take the updates of an epoch.

        Returns:
            False if this batch, or a later one of its run, was taken before: nothing changed now.

        Raises:
            UpdateError: it is malformed; nothing of it is taken.
        """
        self._check(batch)
        runs = self._done.setdefault(batch.leg, {})
        if batch.epoch <= runs.get(batch.run, -1):
            return False
        runs.pop(batch.run, None)  # to the end of the order in which runs are forgotten
        runs[batch.run] = batch.epoch
        while len(runs) > MAX_RUNS:
            runs.pop(next(iter(runs)))
        if self.merges_pushes:
            self._pending.setdefault(batch.epoch, []).append(batch)
            if len(self._pending) > MAX_PENDING:
                self.merge(min(self._pending))
        return True

    def pull(self, since: int | None = None, upto: int | None = None) -> Changes:
        """Merge all epochs up to ``upto``, and return what changed after a version.

        Args:
            since: a version; everything is returned for None.
            upto: an epoch; nothing is merged for None.
        """
        if upto is not None:
            self.merge(upto)
        if since is None:
            return Changes(
                self.version,
                np.arange(len(self.table)),
                self.table.values.copy(),
                self.table.visits.copy(),
            )
        if self._answer is None or self._answer[0] != (since, self.version):
            # Kept, since all legs ask for the same, one after the other.
            cells = np.flatnonzero(self._changed > since)
            values, visits = self.table.values[cells], self.table.visits[cells]
            for array in (cells, values, visits):
                array.flags.writeable = False
            self._answer = (since, self.version), Changes(self.version, cells, values, visits)
        return self._answer[1]

    def merge(self, upto: int | None = None) -> None:
        """Merge all pending epochs up to and including ``upto``; all there are for None."""
        due = [epoch for epoch in self._pending if upto is None or epoch <= upto]
        if not due:
            return
        self.version += 1
        for update in self._in_order(due):
            self.table.update(update.cell, update.target, self._rate)
            self._changed[update.cell] = self.version
        for epoch in due:
            del self._pending[epoch]

    def _in_order(self, epochs: Iterable[int]) -> Iterator[TDUpdate]:
        """Yield the pending updates of epochs as they are to be merged: epoch, tick, leg."""
        for epoch in sorted(epochs):
            batches = self._pending[epoch]
            updates = [
                (update.tick, batch.leg, update) for batch in batches for update in batch.updates
            ]
            for _, _, update in sorted(updates):
                yield update

    def preview(self) -> Table:
        """Return the table as it would be with everything merged, and merge nothing."""
        table = Table(self.table.states, self.table.actions)
        table.copy_from(self.table)
        for update in self._in_order(self._pending):
            table.update(update.cell, update.target, self._rate)
        return table

    def pending(self) -> list[UpdateBatch]:
        """Return the batches that are not merged yet."""
        return [batch for batches in self._pending.values() for batch in batches]

    def done(self) -> dict[int, dict[str, int]]:
        """Return the last epoch of each run of each leg."""
        return {leg: dict(runs) for leg, runs in self._done.items()}

    def restore(self, done: dict[int, dict[str, int]], pending: list[UpdateBatch]) -> None:
        """Take up what an earlier life of this table had taken and not merged."""
        self._done = {leg: dict(runs) for leg, runs in done.items()}
        for batch in pending:
            self._pending.setdefault(batch.epoch, []).append(batch)

    def _check(self, batch: UpdateBatch) -> None:
        if batch.cells_sha256 != self._cells:
            raise UpdateError(
                f"push of leg {batch.leg}, epoch {batch.epoch}: learnt with other parameters "
                f"(cells {batch.cells_sha256[:12]}..., here {self._cells[:12]}...); give the leg "
                "and the table the same parameter file"
            )
        if not 0 <= batch.leg < self._legs or batch.epoch < 0 or not batch.run:
            raise UpdateError(
                f"push of leg {batch.leg}, run {batch.run!r}, epoch {batch.epoch}: leg must be "
                f"0 to {self._legs - 1}, epoch 0 or more, and the run must have a name"
            )
        for update in batch.updates:
            if not 0 <= update.cell < len(self.table):
                raise UpdateError(
                    f"push of leg {batch.leg}, epoch {batch.epoch}: cell {update.cell} is not in "
                    f"0 to {len(self.table) - 1}"
                )
            if update.tick < 0 or update.target - update.target != 0.0:
                raise UpdateError(
                    f"push of leg {batch.leg}, epoch {batch.epoch}: the target of cell "
                    f"{update.cell} at tick {update.tick} is {update.target}; a finite number "
                    "and a tick of 0 or more would be right"
                )


class LocalCopy:
    """One leg's copy of the shared table, always ahead of it by what the leg learnt itself."""

    def __init__(
        self, table: Table, *, leg: int, run: str, cells: str, rate: Rate, sync_every: int
    ) -> None:
        """Start from ``table``, which is owned from now on.

        Args:
            table: a first content, replaced by the first pull where there is one.
            leg: position of the leg in the order of legs.
            run: names this life of the leg.
            cells: SHA-256 of what gives cells their meaning.
            rate: bounds of the learning rate.
            sync_every: ticks an epoch; 0 never syncs: the table is this leg's own.
        """
        self.table = table
        self.version: int | None = None
        """Version of the shared table that is in this copy; None before the first pull."""
        self._sync_every = sync_every
        self._leg, self._run, self._cells, self._rate = leg, run, cells, rate
        self._epoch = NO_EPOCH
        self._epoch_updates: list[TDUpdate] = []
        """Updates of the present epoch, which are in no batch yet."""
        self._unmerged: list[UpdateBatch] = []
        self._sent = 0  # how many of _unmerged are acknowledged, from the front
        self._shared_cells: dict[int, tuple[float, int]] = {}
        """(value, visits) of the cells that this leg has changed, as in the shared table."""

    def learn(self, update: TDUpdate) -> float:
        """Apply an update at once, keep it for the next push, and return its error."""
        if self._sync_every:
            self._epoch_updates.append(update)
            return self._apply_over_shared(update)
        return self.table.update(update.cell, update.target, self._rate)

    def _apply_over_shared(self, update: TDUpdate) -> float:
        """Apply an update on top of the shared content, remembering what lies below."""
        if update.cell not in self._shared_cells:
            self._shared_cells[update.cell] = self.table.read(update.cell)
        return self.table.update(update.cell, update.target, self._rate)

    def epoch_to_pull(self, tick: int) -> int | None:
        """Return the epoch up to which to pull before the tick is acted on, or None.

        That is -1 in epoch 0, to which ``NO_EPOCH`` is less: even the first tick pulls.
        """
        if not self._sync_every:
            return None
        upto = tick // self._sync_every - 1
        return upto if upto > self._epoch else None

    def apply(self, changes: Changes, upto: int) -> None:
        """Take over what changed up to an epoch, and lay what is not yet in it back on top.

        Acknowledged batches up to ``upto`` are in what was pulled; keep all others. Epochs restart
        at 0 after a reset, so acknowledged ones may still have a greater epoch.
        """
        for cell, content in self._shared_cells.items():
            self.table.write(cell, *content)
        self._shared_cells.clear()
        self.table.values[changes.cells] = changes.values
        self.table.visits[changes.cells] = changes.visits
        self.version, self._epoch = changes.version, upto
        left = [
            batch for n, batch in enumerate(self._unmerged) if n >= self._sent or batch.epoch > upto
        ]
        self._sent -= len(self._unmerged) - len(left)
        self._unmerged = left
        for batch in self._unmerged:
            for update in batch.updates:
                self._apply_over_shared(update)
        for update in self._epoch_updates:
            self._apply_over_shared(update)

    def skip_sync(self, upto: int) -> None:
        """Note that the shared table would not give what it has up to an epoch."""
        self._epoch = upto

    def close_epoch(self, tick: int, *, early: bool = False) -> bool:
        """Make a batch of the epoch's updates if ``tick`` is its last one (or ``early``)."""
        if not self._sync_every or not self._epoch_updates:
            return False
        if not early and (tick + 1) % self._sync_every != 0:
            return False
        epoch = tick // self._sync_every
        batch = UpdateBatch(self._leg, self._run, epoch, self._cells, tuple(self._epoch_updates))
        self._unmerged.append(batch)
        self._epoch_updates.clear()
        return True

    def oldest_unacknowledged(self) -> UpdateBatch | None:
        """Return the oldest batch that was not acknowledged, or None."""
        return self._unmerged[self._sent] if self._sent < len(self._unmerged) else None

    def acknowledged(self, batch: UpdateBatch) -> None:
        """Note that the shared table has a batch for good."""
        if self.oldest_unacknowledged() is batch:
            self._sent += 1

    def reset(self, last_tick: int, run: str) -> None:
        """Begin a new life: ticks, and so epochs, begin anew; nothing learnt is dropped."""
        self.close_epoch(last_tick, early=True)
        self._run, self._epoch = run, NO_EPOCH
