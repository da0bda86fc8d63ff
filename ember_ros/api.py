"""What a notebook calls: train a leg, let legs walk, and look at what came of it.

Everything runs as ``ember`` runs it with ``--on loop``: the same call gives the same bits.
"""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ember_ros.arrays import Collector
from ember_ros.errors import ParameterError, TableError, shown
from ember_ros.loop import Loop
from ember_ros.params import Params, cells_sha256, replace
from ember_ros.params_file import load_params
from ember_ros.report.run_statistics import RunStatistics
from ember_ros.result import QTable, Run, SavedRun, load
from ember_ros.run import learns_by_default
from ember_ros.run_config import RunConfig
from ember_ros.shipped import shipped_table
from ember_ros.versions import provenance
from leg_node.table_file import check_cells

__all__ = ["load", "make_params", "train", "walk"]

GivenParams: TypeAlias = "Params | Mapping[str, Any] | str | Path"
"""All parameters, some by full names, or a file of them by its path or name."""
GivenPart: TypeAlias = "str | Callable[..., Any] | None"
"""A class, or its dotted path; None for the one that the parameters name."""
GivenTable: TypeAlias = "SavedRun | QTable | str | Path | None"
"""A run, for what it learnt; a table; a table's file by its path or name; None for nothing."""


def train(
    cycles: int = 6000,
    seed: int = 0,
    *,
    params: GivenParams | Sequence[GivenParams] | None = None,
    reward: GivenPart = None,
    discretizer: GivenPart = None,
    learner: GivenPart = None,
    value: GivenPart = None,
    gait: GivenPart = None,
    cpg: GivenPart = None,
    world: str | Callable[..., Any] = "trainer",
    policy: str | Callable[..., Any] = "learned",
    table: GivenTable = None,
    learning: bool | None = None,
    start_cycle: int = 0,
    progress: bool = True,
) -> Run:
    """Train one leg on the trainer by the direct loop, as ``ember train`` does.

    Args:
        cycles: of the pattern generator, 32 ticks each: steps of the leg.
        seed: of the run: everything that is drawn follows from it.
        params: laid one on the other in their order: names or paths of parameter files
            (``"plain"``), and dicts of full names (``{"trainer.tip_mass": 2.0}``). They lie on
            the defaults, on a ``Params`` that comes first, or else on those that ``table`` was
            learnt with.
        reward: a class that does what ``RewardFunction`` says, or its dotted path.
        discretizer: the same, of ``Discretizer``.
        learner: the same, of ``Learner``.
        value: the same, of ``ValueEstimate``.
        gait: the same, of ``Gait``.
        cpg: the same, of ``CentralPatternGenerator``.
        world: ``"trainer"``, ``"walker"``, a class that does what ``World`` says, or its path.
        policy: ``"learned"``, ``"scripted"``, ``"random"``, a class that does what ``Policy``
            says, or its dotted path.
        table: to start from; it brings the parameters that it was learnt with.
        learning: whether the table changes; None: unless the policy chooses without it.
        start_cycle: cycles that were learnt before: exploration goes on from there. At 0 it begins
            anew, whatever the table knows.
        progress: whether to show how far it is, on standard error.

    A class is named by its dotted path, in ``run.params.parts`` and in all hashes. That of a
    notebook is ``__main__.MyReward``, which is known in this process alone: in another one nobody
    can run with it. It is a name alone: a class that was changed has the same name as before.

    Raises:
        ParameterError: a parameter is unknown or out of range, or a part cannot be used.
        TableError: the table cannot be used with these parameters.
    """
    parts = _parts(
        reward=reward, discretizer=discretizer, learner=learner, value=value, gait=gait, cpg=cpg
    )
    return _run(cycles, seed, params, parts, world, policy, table, learning, start_cycle, progress)


def walk(
    table: GivenTable = None,
    cycles: int = 300,
    seed: int = 0,
    *,
    params: GivenParams | Sequence[GivenParams] | None = None,
    reward: GivenPart = None,
    discretizer: GivenPart = None,
    learner: GivenPart = None,
    value: GivenPart = None,
    gait: GivenPart = None,
    cpg: GivenPart = None,
    world: str | Callable[..., Any] = "walker",
    policy: str | Callable[..., Any] = "learned",
    learning: bool | None = None,
    start_cycle: int = 0,
    progress: bool = True,
) -> Run:
    """Let legs carry a body by the direct loop, still learning, as ``ember walk`` does.

    All as in ``train``, but for the world. The table brings the parameters that it was learnt with,
    so that ``walk(train(reward=MyReward))`` is rewarded by the same class.

    Args:
        table: to start from: what ``train`` returned, a path, or None for legs that know nothing.
        cycles: of the pattern generator, 32 ticks each.
        seed: of the run.
        params: laid one on the other, and on those of the table.
        reward: a class or its dotted path; so are the other parts.
        discretizer: turns senses into a state.
        learner: turns transitions into updates.
        value: reads values from the table.
        gait: turns the beat into stance and the hip's goal.
        cpg: says the phase.
        world: a name, a class or its dotted path.
        policy: a name, a class or its dotted path.
        learning: whether the table changes; None: unless the policy chooses without it.
        start_cycle: cycles that were learnt before.
        progress: whether to show how far it is, on standard error.

    Raises:
        ParameterError: a parameter is unknown or out of range, or a part cannot be used.
        TableError: the table cannot be used with these parameters.
    """
    parts = _parts(
        reward=reward, discretizer=discretizer, learner=learner, value=value, gait=gait, cpg=cpg
    )
    return _run(cycles, seed, params, parts, world, policy, table, learning, start_cycle, progress)


def make_params(*given: GivenParams) -> Params:
    """Return parameters: files and dicts laid one on the other, on a ``Params`` or the defaults.

    ``make_params("plain", "narrow", {"walker.mass": 4.0})``; later ones win.

    Args:
        *given: names or paths of parameter files, dicts of full names, a ``Params`` as the first.

    Raises:
        ParameterError: a file cannot be read, or a name or value is wrong.
    """
    return _laid(Params(), given)


def _laid(base: Params, given: Sequence[GivenParams]) -> Params:
    """Return parameters with others laid on them."""
    for is_file, some in groupby(given, lambda each: isinstance(each, (str, Path))):
        layers: list[Any] = list(some)
        if is_file:  # together, so that they are held against each other as `ember` does
            base = load_params(*layers, base=base)
            continue
        for layer in layers:
            if isinstance(layer, Mapping):
                base = replace(base, {_name(name): _plain(v) for name, v in layer.items()})
            elif not isinstance(layer, Params):
                raise ParameterError(
                    f"params = {shown(layer)}: a Params, a dict of full names, a file's name or "
                    "path, or a list of these would be right"
                )
            elif layer is given[0]:
                base = layer
            else:
                raise ParameterError(
                    "params: a Params says every number, and nothing may come before it"
                )
    return base


def _name(name: Any) -> str:
    if not isinstance(name, str):
        raise ParameterError(
            f"params: {shown(name)} is no name; a full one, such as 'walker.mass', would be right"
        )
    return name


def _plain(value: Any) -> Any:
    """Return a value of numpy as Python has it."""
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def _parts(**given: GivenPart) -> dict[str, str]:
    return {
        f"parts.{name}": _path_of(part, name) for name, part in given.items() if part is not None
    }


def _path_of(part: Any, name: str) -> str:
    """Return the dotted path of a class, or of a function that makes a part.

    Raises:
        ParameterError: it has none by which it would be found again.
    """
    if isinstance(part, str):
        return part
    module, own = getattr(part, "__module__", None), getattr(part, "__qualname__", None)
    if not callable(part) or not isinstance(module, str) or not isinstance(own, str):
        raise ParameterError(
            f"{name} = {shown(part)} is neither a class nor the dotted path of one"
        )
    if getattr(sys.modules.get(module), own, None) is not part:
        raise ParameterError(
            f"{name} = {shown(part)} is not what {module}.{own} names now; a class at the top "
            "level of a module or notebook, as it was defined last, would be right"
        )
    return f"{module}.{own}"


def _start(table: GivenTable) -> tuple[QTable | None, Path | None]:
    """Return the table to start from, and its file if it is one.

    Raises:
        TableError: there is no such table.
    """
    if table is None or isinstance(table, QTable):
        return table, None
    if isinstance(table, SavedRun):
        return table.table, None
    if not isinstance(table, (str, Path)):
        raise TableError(f"table = {shown(table)}: a path, a run, a QTable or None would be right")
    file = shipped_table(Path(table))
    return QTable.load(file), file


def _whole(value: Any, name: str) -> int:
    try:
        return operator.index(value)
    except TypeError:
        raise ParameterError(f"{name} = {shown(value)} must be a whole number") from None


def _run(
    cycles: int,
    seed: int,
    params: GivenParams | Sequence[GivenParams] | None,
    parts: Mapping[str, str],
    world: Any,
    policy: Any,
    table: GivenTable,
    learning: bool | None,
    start_cycle: int,
    progress: bool,
) -> Run:
    start, file = _start(table)
    if params is None:
        given: Sequence[GivenParams] = ()
    else:
        given = [params] if isinstance(params, (Params, Mapping, str, Path)) else list(params)
    own = replace(_laid(start.params if start else Params(), given), parts)
    policy = _path_of(policy, "policy")
    config = RunConfig(
        _path_of(world, "world"),
        _whole(cycles, "cycles"),
        seed=_whole(seed, "seed"),
        params=own,
        policy=policy,
        learning=learns_by_default(policy) if learning is None else learning,
        table=file,
        start_cycle=_whole(start_cycle, "start_cycle"),
    )
    if start is not None:
        check_cells("the table", cells_sha256(start.params), own)
    where = provenance()
    loop = Loop(config)
    try:
        if start is not None and file is None:
            loop.shared.table.copy_from(start.cells())  # which legs pull before their first tick
        recorder, collector = RunStatistics(own, config.legs), Collector(own, config.legs)
        with _shown(config, progress) as update:
            for cycle in range(config.cycles):
                update(cycle, loop.world.body().falls)
                for _ in range(own.gait.ticks):
                    loop.tick(recorder, collector)
        learnt = loop.finish()
        recorder.finish(loop.world.observe(), loop.world.body())
    finally:
        loop.close()
    record = recorder.record()
    return Run(
        config,
        record,
        QTable.of(learnt, own),
        collector.ticks(record),
        where,
        start.sha256 if start else None,
    )


@contextmanager
def _shown(config: RunConfig, wanted: bool) -> Iterator[Callable[[int, int], None]]:
    """Show how far a run is, if that is wanted."""
    if not wanted:
        yield lambda done, falls: None
        return
    from ember_ros.terminal import progress

    label = "training" if config.stage == "train" else "walking"
    with progress(label, config.cycles) as update:
        yield lambda done, falls: update(done, f"{done}/{config.cycles} cycles, {falls} falls")
