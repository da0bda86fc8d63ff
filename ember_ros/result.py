"""Results for analysis in Python: a run, a saved run, and a Q-table with named axes."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ember_ros.arrays import Body, Bools, Commands, Pose, Senses, Ticks, pose_of
from ember_ros.errors import RunError, TableError, need, shown
from ember_ros.params import Params, params_sha256
from ember_ros.report.run_statistics import Row, RunRecord, load_record
from ember_ros.run import SUMMARY, TABLE, save_run
from ember_ros.run_config import RunConfig
from leg_node.assembly import empty_table, make_discretizer
from leg_node.discretizer import states_of
from leg_node.table import Floats, Ints, Table
from leg_node.table_file import load_about, load_table, params_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


@dataclass(frozen=True, eq=False)
class QTable:
    """A Q-table with the axes of the discretizer, followed by an axis for the actions.

    If the learner keeps several tables, as double Q-learning does, the first axis is ``table``.
    """

    q: Floats
    """Values, ``(*shape of the discretizer, actions)``, float64, read-only."""
    visits: Ints
    """Number of updates of each cell, same shape as ``q``, int64, read-only."""
    params: Params
    """The parameters that it was learnt with; they define the meaning of the cells."""
    axes: tuple[str, ...] = field(init=False)
    """Names of the axes of ``q``: those of the discretizer (``axis_0`` and so on if it has no
    ``names``), and ``action``."""

    def __post_init__(self) -> None:
        axes, shape = _axes_and_shape(self.params)
        object.__setattr__(self, "axes", axes)
        for name, kind in (("q", np.float64), ("visits", np.int64)):
            array = np.array(getattr(self, name), order="C")
            if array.shape != shape or array.dtype != kind:
                raise TableError(
                    f"{name} is {array.dtype} {array.shape}; these parameters need "
                    f"{np.dtype(kind)} {shape}"
                )
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if not np.isfinite(self.q).all() or (self.visits < 0).any():
            raise TableError("q holds values that are not finite, or visits numbers under 0")

    @classmethod
    def of(cls, table: Table, params: Params) -> QTable:
        """Return a learner's table as a ``QTable``.

        Args:
            table: the learner's table; its cells are copied.
            params: the parameters that it was learnt with.

        Raises:
            TableError: its size is not that of the parameters.
        """
        _, shape = _axes_and_shape(params)
        if math.prod(shape) != len(table):
            raise TableError(f"a table of {len(table)} cells; {shape} would be right")
        return cls(table.values.reshape(shape), table.visits.reshape(shape), params)

    @classmethod
    def load(cls, file: str | Path) -> QTable:
        """Read a table file and the parameters that the table was learnt with.

        Raises:
            TableError: the file is missing, is no table, or is of another version.
            ParameterError: a part that defines the meaning of the cells cannot be imported.
        """
        params = params_of(Path(file), load_about(Path(file)))
        return cls.of(load_table(Path(file), params)[0], params)

    @property
    def best_action(self) -> Ints:
        """Return the index of the action with the largest value in each state.

        Of several equal ones the first; -1 in states that were never visited. The values of several
        tables are added. The values are not smoothed: with a value estimate that smooths the table,
        as the default does, a policy may choose another action.
        """
        has_tables = self.axes[0] == "table"
        q, visits = (self.q.sum(0), self.visits.sum(0)) if has_tables else (self.q, self.visits)
        best: Ints = np.where(visits.sum(-1) > 0, q.argmax(-1), -1)
        return best

    @property
    def sha256(self) -> str:
        """Return the SHA-256 of size, values and visits, the one that ``ember`` prints."""
        return self.cells().sha256()

    def cells(self) -> Table:
        """Return a copy as a ``Table`` for a learner."""
        actions = self.q.shape[-1]
        table = Table(self.q.size // actions, actions)
        table.values[:] = self.q.reshape(-1)
        table.visits[:] = self.visits.reshape(-1)
        return table

    def __repr__(self) -> str:
        """Return the named axes with their lengths, and how many cells were visited."""
        size = " x ".join(f"{n} {name}" for name, n in zip(self.axes, self.q.shape, strict=True))
        visited = np.count_nonzero(self.visits)
        return (
            f"QTable of {size}: {visited} of {self.q.size} cells visited, {self.visits.sum()} times"
        )


def _axes_and_shape(params: Params) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return the names of the axes of a Q-table, and its shape.

    Raises:
        TableError: the discretizer has another number of names than of axes.
        ParameterError: a part cannot be used.
    """
    discretizer, cells = make_discretizer(params), empty_table(params)
    sizes = tuple(discretizer.shape)
    names = getattr(discretizer, "names", None) or [f"axis_{n}" for n in range(len(sizes))]
    if len(names) != len(sizes):
        raise TableError(
            f"{params.parts.discretizer} names {len(names)} axes, {shown(tuple(names))}; "
            f"a name for each of {len(sizes)} would be right"
        )
    axes, shape = (*names, "action"), (*sizes, cells.actions)
    tables = cells.states // states_of(discretizer)
    return (("table", *axes), (tables, *shape)) if tables > 1 else (axes, shape)


@dataclass(frozen=True, eq=False, repr=False)
class SavedRun:
    """A run as saved in its folder; ``load`` reads it."""

    config: RunConfig
    """The configuration of the run: world, cycles, seed, params, policy."""
    record: RunRecord
    """The statistics per cycle, the pose per tick, and the summary."""
    table: QTable
    """The Q-table at the end."""

    @property
    def params(self) -> Params:
        """Return all parameters, including the names of the parts."""
        return self.config.params

    @property
    def legs(self) -> tuple[str, ...]:
        """Return the names of the legs, in the order of the array columns."""
        return self.config.legs

    @property
    def summary(self) -> dict[str, Any]:
        """Return the statistics of the run as plain values by name.

        Cycles, falls, distance, reward terms of the first and last cycles, hashes of all signals.
        """
        return self.record.measured

    @property
    def body(self) -> Pose:
        """Return the pose of the body at the start of each tick."""
        return pose_of(self.record)

    @property
    def cycles(self) -> DataFrame:
        """Return the statistics of each cycle as a pandas DataFrame.

        One row per cycle and module, with the columns of ``cycles.csv``. ``module`` is the
        name of a leg, or ``body``; values that a row does not have are NaN.

        Raises:
            MissingError: pandas is not installed.
        """
        need("pandas", why="for run.cycles; run.record.rows has the same as tuples")
        import pandas

        return pandas.DataFrame(self.record.rows, columns=list(Row._fields))

    def plot(self) -> Figure:
        """Return the figure of the run that ``ember`` draws, a matplotlib Figure.

        A notebook shows it as the last line of a cell; elsewhere use ``plot().savefig("run.png")``.

        Raises:
            MissingError: matplotlib is not installed.
            RunError: the run has no whole cycle.
        """
        need("matplotlib", why="to draw")
        from ember_ros.report import figures

        panel = "trained" if self.config.stage == "train" else "walked"
        ticks = self.params.gait.ticks
        figure = figures.picture(**{panel: self.record}, ticks=ticks)
        if figure is None:
            raise RunError("the run has no whole cycle to draw; one or more would be right")
        return figure

    def __repr__(self) -> str:
        """Return the main results in three lines."""
        config, summary = self.config, self.summary
        first, last = summary["first"], summary["last"]
        learning = "learning" if config.learning else "not learning"
        return "\n".join(
            [
                f"{type(self).__name__} in {config.world}: {summary['cycles']} cycles, legs "
                f"{len(self.legs)}, seed {config.seed}, policy {config.policy}, {learning}",
                f"  {_format(last['distance_per_cycle_m'])} m per cycle at the end (first "
                f"{_format(first['distance_per_cycle_m'])}), reward per tick "
                f"{_format(last['reward'])} (first {_format(first['reward'])}), "
                f"{summary['falls']} falls",
                f"  SHA-256 of table {self.table.sha256[:12]}, senses "
                f"{summary['senses_sha256'][:12]}, parameters {params_sha256(config.params)[:12]}",
            ]
        )

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raise an AttributeError that explains why the signals of the ticks are missing."""
            reason = (
                "a saved run has only the pose of the body for each tick; the Run that train() or "
                "walk() returned has all signals, and so has a bag (`ember walk --bag`)"
            )
            message = f"{type(self).__name__!r} object has no attribute {name!r}"
            raise AttributeError(f"{message}: {reason}" if name in _ONLY_IN_RUN else message)


@dataclass(frozen=True, eq=False, repr=False)
class Run(SavedRun):
    """A run of the direct loop, with all signals of all ticks.

    Row ``t`` of each array belongs to tick ``t``; columns are the legs in the order of ``legs``.
    """

    ticks: Ticks
    """The signals of all ticks; the properties below are its fields."""
    provenance: dict[str, str]
    """Date, machine and commit of the run."""
    start_sha256: str | None
    """SHA-256 of the table at the start; None if it was empty."""

    @property
    def senses(self) -> Senses:
        """Return the sensor readings: ``senses.hip`` and so on, each ``(ticks, legs)``."""
        return self.ticks.senses

    @property
    def commands(self) -> Commands:
        """Return the motor commands: ``commands.hip_speed`` and so on, each ``(ticks, legs)``."""
        return self.ticks.commands

    @property
    def rewards(self) -> Mapping[str, Floats]:
        """Return the reward terms by name, ``(ticks, legs)`` each, 0 where not ``credited``."""
        return self.ticks.rewards

    @property
    def reward(self) -> Floats:
        """Return the reward, the sum of its terms, ``(ticks, legs)``."""
        return self.ticks.reward

    @property
    def credited(self) -> Bools:
        """Return whether a tick was rewarded, ``(ticks, legs)``: all but the last one and falls."""
        return self.ticks.credited

    @property
    def states(self) -> Ints:
        """Return the indices of the discretized states, ``(ticks, legs)``."""
        return self.ticks.states

    @property
    def actions(self) -> Ints:
        """Return the actions, indices into ``params.leg.knee_speeds``, ``(ticks, legs)``."""
        return self.ticks.actions

    @property
    def stances(self) -> Bools:
        """Return whether a tick is in stance, ``(ticks, legs)``."""
        return self.ticks.stances

    @property
    def td_errors(self) -> Floats:
        """Return the temporal-difference errors, ``(ticks, legs)``, 0 where nothing was learnt."""
        return self.ticks.td_errors

    @property
    def phases(self) -> Floats:
        """Return the phase of the pattern generator, cycles since the start, ``(ticks,)``."""
        return self.ticks.phases

    @property
    def body(self) -> Body:
        """Return the ground truth of the body at the start of each tick, each ``(ticks,)``."""
        return self.ticks.body

    def save(self, folder: str | Path, *, replace: bool = False) -> None:
        """Write the files that ``ember train`` writes: table, cycles, traces and summary.

        Of the signals of the ticks, they contain only the pose of the body.

        Args:
            folder: where to write; created if it does not exist.
            replace: whether an earlier run in the folder may be replaced.

        Raises:
            EmberError: the folder cannot be written to, or contains an earlier run.
        """
        save_run(
            self.config,
            Path(folder),
            self.record,
            self.table.cells(),
            command=f"ember_ros.{'train' if self.config.stage == 'train' else 'walk'}",
            start_sha256=self.start_sha256,
            provenance=self.provenance,
            replace=replace,
        )


_ONLY_IN_RUN = {"save", "ticks", *(each.name for each in dataclasses.fields(Ticks))}
"""Attributes of ``Run`` that ``SavedRun`` does not have."""


def load(folder: str | Path) -> SavedRun:
    """Load a finished run that ``ember`` or ``Run.save`` has written.

    Args:
        folder: contains ``table.npz``, ``cycles.csv``, ``traces.npy`` and ``summary.json``.

    Raises:
        RunError: the folder contains no finished run.
        TableError: its table cannot be read.
        ParameterError: its world, or one of its parts, cannot be imported.
    """
    folder = Path(folder)
    try:
        record = load_record(folder)
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        start = summary["start_table"]
        options = {
            name: summary[name] for name in ("world", "seed", "policy", "learning", "start_cycle")
        }
        cycles = summary["planned_cycles"]
    except OSError as error:
        raise RunError(
            f"{folder} holds no finished run: {error.filename}: {error.strerror}; a folder that "
            "`ember train` or run.save() has written would be right"
        ) from error
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise RunError(f"{folder} holds a run that cannot be read: {error}") from error
    table = QTable.load(folder / TABLE)
    config = RunConfig(
        cycles=cycles, params=table.params, table=Path(start) if start else None, **options
    )
    return SavedRun(config, record, table)


def _format(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
