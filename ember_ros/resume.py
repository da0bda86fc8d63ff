"""What a run that starts from a table goes on from, and what is other now than it was then."""

from __future__ import annotations

import json
from pathlib import Path

from ember_ros.errors import ParameterError
from ember_ros.params import Params
from ember_ros.run import SUMMARY, TABLE
from ember_ros.run_config import RunConfig
from leg_node.policy import epsilon_at
from leg_node.table_file import describe_differences, load_about, load_table, params_of


def resume_point(run: Path, world: str) -> tuple[int, Params]:
    """Return how many cycles a run had come to, and its parameters.

    Args:
        run: its folder.
        world: in which it is to go on.

    Raises:
        ParameterError: it was in another world, or does not say how far it came.
        TableError: its table cannot be read.
    """
    about = load_about(run / TABLE)
    try:
        told = json.loads((run / SUMMARY).read_text(encoding="utf-8"))
        where, cycle = told["world"], told["start_cycle"] + told["cycles"]
    except (OSError, ValueError, KeyError, TypeError):  # killed, or of an older version
        where, cycle = world, about.get("cycle")
    if where != world:
        raise ParameterError(f"{run} is a run of the {where}; --table {run / TABLE} starts from it")
    if not isinstance(cycle, int) or isinstance(cycle, bool):
        raise ParameterError(
            f"{run} does not say how many cycles it came to; --table {run / TABLE} starts from its "
            "table at cycle 0"
        )
    return cycle, params_of(run / TABLE, about)


def start_messages(config: RunConfig) -> list[str]:
    """Return what is to be said before a run that starts from a table.

    Raises:
        TableError: the table cannot be used.
    """
    if config.table is None:
        return []
    lines = []
    _, about = load_table(config.table, config.params)
    other = describe_differences(config.table, about, config.params)
    if other is not None:
        lines.append(other)
    numbers = config.params.walk if config.stage == "walk" else config.params.train
    epsilon = epsilon_at(numbers, config.start_cycle)
    share = f"{100 * epsilon:.3g} %"
    if config.start_cycle:
        lines.append(f"going on from cycle {config.start_cycle}, exploring {share} at first")
    elif config.policy == "learned" and epsilon > numbers.epsilon_end:
        lines.append(
            f"starting from {config.table} at cycle 0: {share} of the actions are random at "
            "first, which may undo what it knows; --resume RUN goes on where a run was"
        )
    return lines
