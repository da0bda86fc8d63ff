"""What came of a run, for whoever looks into it: a run, a saved run, and a Q-table with names."""

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
    """A Q-table with one axis for each that the discretizer has, and one for actions.

    A learner that keeps several tables, such as double Q-learning, has them along a first axis
    ``table``.
    """

    q: Floats
    """Values, ``(*shape of the discretizer, actions)``, float64, read-only."""
    visits: Ints
    """Updates of each cell so far, of the same shape, int64, read-only."""
    params: Params
    """With which it was learnt: they give the cells their meaning."""
    axes: tuple[str, ...] = field(init=False)
    """Names of the axes of ``q``: those of the discretizer (``axis_0`` and so on where it gives
    none), and ``action``."""

    def __post_init__(self) -> None:
        axes, shape = _cells_of(self.params)
        object.__setattr__(self, "axes", axes)
        for name, kind in (("q", np.float64), ("visits", np.int64)):
            given = np.array(getattr(self, name), order="C")
            if given.shape != shape or given.dtype != kind:
                raise TableError(
                    f"{name} is {given.dtype} {given.shape}; these parameters need "
                    f"{np.dtype(kind)} {shape}"
                )
            given.flags.writeable = False
            object.__setattr__(self, name, given)
        if not np.isfinite(self.q).all() or (self.visits < 0).any():
            raise TableError("q holds values that are not finite, or visits numbers under 0")

    @classmethod
    def of(cls, table: Table, params: Params) -> QTable:
        """Return a table of the learner with names.

        Args:
            table: its cells, which are copied.
            params: with which it was learnt.

        Raises:
            TableError: it has another size than the parameters ask for.
        """
        _, shape = _cells_of(params)
        if math.prod(shape) != len(table):
            raise TableError(f"a table of {len(table)} cells; {shape} would be right")
        return cls(table.values.reshape(shape), table.visits.reshape(shape), params)

    @classmethod
    def load(cls, file: str | Path) -> QTable:
        """Read a table's file, with the parameters that it was learnt with.

        Raises:
            TableError: the file is missing, is no table, or is of another version.
            ParameterError: a part that gives its cells their meaning cannot be found here.
        """
        params = params_of(Path(file), load_about(Path(file)))
        return cls.of(load_table(Path(file), params)[0], params)

    @property
    def best_action(self) -> Ints:
        """Return the action of the largest value of each state, the first of equal ones.

        Of the discretizer's shape; -1 in states that were never visited. The values of several
        tables are added. As the values stand: a learner that reads a table smoothed, as the default
        does, may choose otherwise.
        """
        several = self.axes[0] == "table"
        q, visits = (self.q.sum(0), self.visits.sum(0)) if several else (self.q, self.visits)
        best: Ints = np.where(visits.sum(-1) > 0, q.argmax(-1), -1)
        return best

    @property
    def sha256(self) -> str:
        """Return the SHA-256 of size, values and visits, as ``ember`` prints it."""
        return self.cells().sha256()

    def cells(self) -> Table:
        """Return a copy as a learner has it."""
        actions = self.q.shape[-1]
        table = Table(self.q.size // actions, actions)
        table.values[:] = self.q.reshape(-1)
        table.visits[:] = self.visits.reshape(-1)
        return table

    def __repr__(self) -> str:
        """Return the size by names of axes, and how much of it is known."""
        size = " x ".join(f"{n} {name}" for name, n in zip(self.axes, self.q.shape, strict=True))
        known = np.count_nonzero(self.visits)
        return (
            f"QTable of {size}: {known} of {self.q.size} cells visited, {self.visits.sum()} times"
        )


def _cells_of(params: Params) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return names and lengths of the axes of a Q-table.

    Raises:
        TableError: the discretizer names fewer or more axes than it has.
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
    """What is kept of a run in its folder; ``load`` reads one."""

    config: RunConfig
    """What was run: world, cycles, seed, params, policy."""
    record: RunRecord
    """Lines a cycle, pose by tick, summary."""
    table: QTable
    """What was learnt in the end."""

    @property
    def params(self) -> Params:
        """Return all parameters, with the parts that were named."""
        return self.config.params

    @property
    def legs(self) -> tuple[str, ...]:
        """Return the names of the legs, in the order of all columns."""
        return self.config.legs

    @property
    def summary(self) -> dict[str, Any]:
        """Return what the recorder made of the run, plain numbers by name.

        Cycles, falls, distance, reward by term at first and in the end, hashes of all signals.
        """
        return self.record.measured

    @property
    def body(self) -> Pose:
        """Return where the body was at the start of each tick."""
        return pose_of(self.record)

    @property
    def cycles(self) -> DataFrame:
        """Return a line a cycle and module as a pandas DataFrame: the columns of ``cycles.csv``.

        ``module`` is a leg's name or ``body``; what a line does not tell is NaN.

        Raises:
            MissingError: pandas is not installed.
        """
        need("pandas", why="for run.cycles; run.record.rows has the same as tuples")
        import pandas

        return pandas.DataFrame(self.record.rows, columns=list(Row._fields))

    def plot(self) -> Figure:
        """Return the picture of the run that ``ember`` draws, a matplotlib Figure.

        A notebook shows it where it is a cell's last line; elsewhere ``plot().savefig("run.png")``.

        Raises:
            MissingError: matplotlib is not installed.
            RunError: there was no whole cycle.
        """
        need("matplotlib", why="to draw")
        from ember_ros.report import figures

        what = "trained" if self.config.stage == "train" else "walked"
        ticks = self.params.gait.ticks
        picture = figures.picture(**{what: self.record}, ticks=ticks)
        if picture is None:
            raise RunError("the run has no whole cycle to draw; one or more would be right")
        return picture

    def __repr__(self) -> str:
        """Return the main figures in three lines."""
        config, told = self.config, self.summary
        first, last = told["first"], told["last"]
        how = "learning" if config.learning else "not learning"
        return "\n".join(
            [
                f"{type(self).__name__} in {config.world}: {told['cycles']} cycles, legs "
                f"{len(self.legs)}, seed {config.seed}, policy {config.policy}, {how}",
                f"  {_told(last['distance_per_cycle_m'])} m a cycle at the end (first "
                f"{_told(first['distance_per_cycle_m'])}), reward a tick {_told(last['reward'])} "
                f"(first {_told(first['reward'])}), {told['falls']} falls",
                f"  SHA-256 of table {self.table.sha256[:12]}, senses "
                f"{told['senses_sha256'][:12]}, parameters {params_sha256(config.params)[:12]}",
            ]
        )

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Say why what happened by the tick is not there."""
            why = (
                "a saved run keeps only the pose of the body by the tick; the Run that train() or "
                "walk() returned has the rest, and so has a bag (`ember walk --bag`)"
            )
            own = f"{type(self).__name__!r} object has no attribute {name!r}"
            raise AttributeError(f"{own}: {why}" if name in _BY_TICK else own)


@dataclass(frozen=True, eq=False, repr=False)
class Run(SavedRun):
    """What came of a run of the direct loop, with everything that happened by the tick.

    Row ``t`` of every array is about tick ``t``; columns are the legs in the order of ``legs``.
    """

    ticks: Ticks
    """Everything by the tick; the properties below are its fields."""
    provenance: dict[str, str]
    """Where and when it was run."""
    start_sha256: str | None
    """Of the table that it started from; None of an empty one."""

    @property
    def senses(self) -> Senses:
        """Return what each leg sensed: ``senses.hip`` and so on, each ``(ticks, legs)``."""
        return self.ticks.senses

    @property
    def commands(self) -> Commands:
        """Return what was asked of the motors: ``commands.hip_speed``, each ``(ticks, legs)``."""
        return self.ticks.commands

    @property
    def rewards(self) -> Mapping[str, Floats]:
        """Return the reward by term, ``(ticks, legs)`` each, 0 where nothing was credited."""
        return self.ticks.rewards

    @property
    def reward(self) -> Floats:
        """Return the sum of all terms, ``(ticks, legs)``."""
        return self.ticks.reward

    @property
    def credited(self) -> Bools:
        """Return which ticks were rewarded, ``(ticks, legs)``: all but the last and falls."""
        return self.ticks.credited

    @property
    def states(self) -> Ints:
        """Return the states, indices as the discretizer gives them, ``(ticks, legs)``."""
        return self.ticks.states

    @property
    def actions(self) -> Ints:
        """Return the actions, positions in ``params.leg.knee_speeds``, ``(ticks, legs)``."""
        return self.ticks.actions

    @property
    def stances(self) -> Bools:
        """Return which ticks are of stance, ``(ticks, legs)``."""
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
        """Return where the body was at the start of each tick, each ``(ticks,)``."""
        return self.ticks.body

    def save(self, folder: str | Path, *, replace: bool = False) -> None:
        """Write the files that ``ember train`` leaves: table, cycles, traces and summary.

        What happened by the tick is not among them, but for the pose of the body.

        Args:
            folder: made if need be.
            replace: whether an earlier run in it may be replaced.

        Raises:
            EmberError: it cannot be written, or holds an earlier run.
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


_BY_TICK = {"save", "ticks", *(each.name for each in dataclasses.fields(Ticks))}
"""What a run has that a saved one has not."""


def load(folder: str | Path) -> SavedRun:
    """Read what is kept of a finished run, of ``ember`` or of ``Run.save``.

    Args:
        folder: in which it left ``table.npz``, ``cycles.csv``, ``traces.npy``, ``summary.json``.

    Raises:
        RunError: the folder holds no finished run.
        TableError: its table cannot be read.
        ParameterError: a part or world that it names cannot be found here.
    """
    folder = Path(folder)
    try:
        record = load_record(folder)
        told = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        start = told["start_table"]
        known = {
            name: told[name] for name in ("world", "seed", "policy", "learning", "start_cycle")
        }
        cycles = told["planned_cycles"]
    except OSError as error:
        raise RunError(
            f"{folder} holds no finished run: {error.filename}: {error.strerror}; a folder that "
            "`ember train` or run.save() has written would be right"
        ) from error
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise RunError(f"{folder} holds a run that cannot be read: {error}") from error
    table = QTable.load(folder / TABLE)
    config = RunConfig(
        cycles=cycles, params=table.params, table=Path(start) if start else None, **known
    )
    return SavedRun(config, record, table)


def _told(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
