"""Functions for a notebook: train a leg, let a robot walk, load a finished run.

All runs use the direct loop, like ``ember --on loop``: the same arguments give the same bits.
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

ParamsLike: TypeAlias = "Params | Mapping[str, Any] | str | Path"
"""A ``Params``, a dict of full parameter names, or the path or name of a parameter file."""
PartLike: TypeAlias = "str | Callable[..., Any] | None"
"""A class or its dotted path; None for the one that the parameters name."""
TableLike: TypeAlias = "SavedRun | QTable | str | Path | None"
"""A run (its learnt table), a table, the path or name of a table file, or None for no table."""


def train(
    cycles: int = 6000,
    seed: int = 0,
    *,
    params: ParamsLike | Sequence[ParamsLike] | None = None,
    reward: PartLike = None,
    discretizer: PartLike = None,
    learner: PartLike = None,
    value: PartLike = None,
    gait: PartLike = None,
    cpg: PartLike = None,
    world: str | Callable[..., Any] = "trainer",
    policy: str | Callable[..., Any] = "learned",
    table: TableLike = None,
    learning: bool | None = None,
    start_cycle: int = 0,
    progress: bool = True,
) -> Run:
    """Train one leg on the trainer with the direct loop, as ``ember train`` does.

    Args:
        cycles: cycles of the central pattern generator to run; one is ``gait.ticks`` ticks (32 by
            default), which is one step of the leg.
        seed: seed of all random numbers of the run.
        params: one or several of: name or path of a parameter file (``"plain"``), dict of full
            parameter names (``{"trainer.tip_mass": 2.0}``), ``Params``. Later ones override earlier
            ones. The base is a ``Params`` that comes first, otherwise the parameters that ``table``
            was learnt with, otherwise the defaults.
        reward: class that implements ``RewardFunction``, or its dotted path.
        discretizer: class that implements ``Discretizer``, or its dotted path.
        learner: class that implements ``Learner``, or its dotted path.
        value: class that implements ``ValueEstimate``, or its dotted path.
        gait: class that implements ``Gait``, or its dotted path.
        cpg: class that implements ``CentralPatternGenerator``, or its dotted path.
        world: ``"trainer"``, ``"walker"``, a class that implements ``World``, or its dotted path.
        policy: ``"learned"``, ``"scripted"``, ``"random"``, a class that implements ``Policy``, or
            its dotted path.
        table: the Q-table to start from, with the parameters that it was learnt with.
        learning: whether the table is updated. None: yes, unless the policy does not read it.
        start_cycle: cycles of learning before this run; the exploration schedule continues there.
            At 0 the schedule starts from its beginning, even if ``table`` is already trained.
        progress: whether to show the progress on standard error.

    Returns:
        The run with all signals of all ticks.

    A class is identified by its dotted path, in ``run.params.parts`` and in all hashes. The path of
    a class of a notebook, ``__main__.MyReward``, exists in this process only: no other process can
    load it. Only the path is recorded: a class whose code was changed keeps its path.

    Raises:
        ParameterError: a parameter is unknown or out of range, or a part cannot be used.
        TableError: the table cannot be used with these parameters.
    """
    parts = _part_params(
        reward=reward, discretizer=discretizer, learner=learner, value=value, gait=gait, cpg=cpg
    )
    return _run(cycles, seed, params, parts, world, policy, table, learning, start_cycle, progress)


def walk(
    table: TableLike = None,
    cycles: int = 300,
    seed: int = 0,
    *,
    params: ParamsLike | Sequence[ParamsLike] | None = None,
    reward: PartLike = None,
    discretizer: PartLike = None,
    learner: PartLike = None,
    value: PartLike = None,
    gait: PartLike = None,
    cpg: PartLike = None,
    world: str | Callable[..., Any] = "walker",
    policy: str | Callable[..., Any] = "learned",
    learning: bool | None = None,
    start_cycle: int = 0,
    progress: bool = True,
) -> Run:
    """Let the robot walk with the direct loop, still learning, as ``ember walk`` does.

    The arguments are those of ``train``; the default world differs. The parameters that the table
    was learnt with are kept, so ``walk(train(reward=MyReward))`` uses the same reward class.

    Args:
        table: the Q-table to start from: the result of ``train``, a path, or None for an empty one.
        cycles: cycles of the central pattern generator to run, ``gait.ticks`` ticks each.
        seed: seed of all random numbers of the run.
        params: override the parameters of the table; later ones override earlier ones.
        reward: class or dotted path: computes the reward of a tick.
        discretizer: class or dotted path: turns senses into a state.
        learner: class or dotted path: turns transitions into updates of the table.
        value: class or dotted path: estimates action values from the table.
        gait: class or dotted path: turns the phase into stance or swing and a hip target.
        cpg: class or dotted path: generates the phase.
        world: a name, a class or its dotted path.
        policy: a name, a class or its dotted path.
        learning: whether the table is updated. None: yes, unless the policy does not read it.
        start_cycle: cycles of learning before this run.
        progress: whether to show the progress on standard error.

    Returns:
        The run with all signals of all ticks.

    Raises:
        ParameterError: a parameter is unknown or out of range, or a part cannot be used.
        TableError: the table cannot be used with these parameters.
    """
    parts = _part_params(
        reward=reward, discretizer=discretizer, learner=learner, value=value, gait=gait, cpg=cpg
    )
    return _run(cycles, seed, params, parts, world, policy, table, learning, start_cycle, progress)


def make_params(*layers: ParamsLike) -> Params:
    """Return the parameters of several files and dicts; later ones override earlier ones.

    Example: ``make_params("plain", "narrow", {"walker.mass": 4.0})``.

    Args:
        *layers: names or paths of parameter files, and dicts of full parameter names. The first may
            be a ``Params``, the base; without one the base is the defaults.

    Raises:
        ParameterError: a file cannot be read, or a name or value is wrong.
    """
    return _override(Params(), layers)


def _override(base: Params, layers: Sequence[ParamsLike]) -> Params:
    """Return ``base`` with the values of files and dicts, in their order."""
    for is_file, group in groupby(layers, lambda layer: isinstance(layer, (str, Path))):
        adjacent: list[Any] = list(group)
        # Files that follow each other are loaded together, so that they are checked against each
        # other as `ember` does.
        if is_file:
            base = load_params(*adjacent, base=base)
            continue
        for layer in adjacent:
            if isinstance(layer, Mapping):
                base = replace(
                    base, {_checked_name(name): _to_python(v) for name, v in layer.items()}
                )
            elif not isinstance(layer, Params):
                raise ParameterError(
                    f"params = {shown(layer)}: a Params, a dict of full names, a file's name or "
                    "path, or a list of these would be right"
                )
            elif layer is layers[0]:
                base = layer
            else:
                raise ParameterError(
                    "params: a Params has all parameters, so it must be the first of the list"
                )
    return base


def _checked_name(name: Any) -> str:
    if not isinstance(name, str):
        raise ParameterError(
            f"params: {shown(name)} is no parameter name; a full one, such as "
            "'walker.mass', would be right"
        )
    return name


def _to_python(value: Any) -> Any:
    """Return a NumPy scalar or array as Python numbers; other values as they are."""
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def _part_params(**parts: PartLike) -> dict[str, str]:
    """Return the parameters ``parts.*`` of the parts that are not None."""
    return {
        f"parts.{name}": _dotted_path(part, name)
        for name, part in parts.items()
        if part is not None
    }


def _dotted_path(part: Any, name: str) -> str:
    """Return the dotted path of a class, or of a function that makes a part.

    Raises:
        ParameterError: it cannot be imported by a dotted path.
    """
    if isinstance(part, str):
        return part
    module, qualname = getattr(part, "__module__", None), getattr(part, "__qualname__", None)
    if not callable(part) or not isinstance(module, str) or not isinstance(qualname, str):
        raise ParameterError(
            f"{name} = {shown(part)} is neither a class nor the dotted path of one"
        )
    if getattr(sys.modules.get(module), qualname, None) is not part:
        raise ParameterError(
            f"{name} = {shown(part)} is not the present value of {module}.{qualname}; a class at "
            "the top level of a module or notebook, as it was defined last, would be right"
        )
    return f"{module}.{qualname}"


def _start_table(table: TableLike) -> tuple[QTable | None, Path | None]:
    """Return the table to start from, and its path if it comes from a file.

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


def _integer(value: Any, name: str) -> int:
    try:
        return operator.index(value)
    except TypeError:
        raise ParameterError(f"{name} = {shown(value)} must be a whole number") from None


def _run(
    cycles: int,
    seed: int,
    params: ParamsLike | Sequence[ParamsLike] | None,
    parts: Mapping[str, str],
    world: Any,
    policy: Any,
    table: TableLike,
    learning: bool | None,
    start_cycle: int,
    progress: bool,
) -> Run:
    start, file = _start_table(table)
    if params is None:
        layers: Sequence[ParamsLike] = ()
    else:
        layers = [params] if isinstance(params, (Params, Mapping, str, Path)) else list(params)
    run_params = replace(_override(start.params if start else Params(), layers), parts)
    policy = _dotted_path(policy, "policy")
    config = RunConfig(
        _dotted_path(world, "world"),
        _integer(cycles, "cycles"),
        seed=_integer(seed, "seed"),
        params=run_params,
        policy=policy,
        learning=learns_by_default(policy) if learning is None else learning,
        table=file,
        start_cycle=_integer(start_cycle, "start_cycle"),
    )
    if start is not None:
        check_cells("the table", cells_sha256(start.params), run_params)
    origin = provenance()
    loop = Loop(config)
    try:
        if start is not None and file is None:
            # Before the first tick, because the legs pull the shared table at its beginning.
            loop.shared.table.copy_from(start.cells())
        recorder = RunStatistics(run_params, config.legs)
        collector = Collector(run_params, config.legs)
        with _progress(config, progress) as update:
            for cycle in range(config.cycles):
                update(cycle, loop.world.body().falls)
                for _ in range(run_params.gait.ticks):
                    loop.tick(recorder, collector)
        table_at_end = loop.finish()
        recorder.finish(loop.world.observe(), loop.world.body())
    finally:
        loop.close()
    record = recorder.record()
    return Run(
        config,
        record,
        QTable.of(table_at_end, run_params),
        collector.ticks(record),
        origin,
        start.sha256 if start else None,
    )


@contextmanager
def _progress(config: RunConfig, enabled: bool) -> Iterator[Callable[[int, int], None]]:
    """Show the progress of a run, if enabled.

    Yields:
        The function to call with the number of cycles and of falls so far.
    """
    if not enabled:
        yield lambda done, falls: None
        return
    from ember_ros.terminal import progress

    label = "training" if config.stage == "train" else "walking"
    with progress(label, config.cycles) as update:
        yield lambda done, falls: update(done, f"{done}/{config.cycles} cycles, {falls} falls")
