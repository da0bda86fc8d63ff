"""Where a run that starts from a table continues, and the lines to print about it."""

from __future__ import annotations

import json
from pathlib import Path

from ember_ros.errors import ParameterError
from ember_ros.params import Params
from ember_ros.run import SUMMARY, TABLE
from ember_ros.run_config import RunConfig
from leg_node.assembly import learning_params_of
from leg_node.policy import epsilon_at
from leg_node.table_file import describe_differences, load_about, load_table, params_of


def resume_point(run: Path, world: str) -> tuple[int, Params]:
    """Return the number of cycles at the end of a run, and its parameters.

    Args:
        run: the folder of the run.
        world: the world in which it continues.

    Raises:
        ParameterError: the run was in another world, or its number of cycles is unknown.
        TableError: its table cannot be read.
    """
    about = load_about(run / TABLE)
    try:
        summary = json.loads((run / SUMMARY).read_text(encoding="utf-8"))
        run_world, cycle = summary["world"], summary["start_cycle"] + summary["cycles"]
    # The run was killed before it wrote a summary, or an older version wrote it.
    except (OSError, ValueError, KeyError, TypeError):
        run_world, cycle = world, about.get("cycle")
    if run_world != world:
        raise ParameterError(
            f"{run} is a run of the {run_world}; --table {run / TABLE} starts from its table"
        )
    if not isinstance(cycle, int) or isinstance(cycle, bool):
        raise ParameterError(
            f"{run} does not say how many cycles it has done; --table {run / TABLE} starts from "
            "its table at cycle 0"
        )
    return cycle, params_of(run / TABLE, about)


def start_messages(config: RunConfig) -> list[str]:
    """Return the lines to print before a run that starts from a table.

    Raises:
        TableError: the table cannot be used.
    """
    if config.table is None:
        return []
    lines = []
    _, about = load_table(config.table, config.params)
    differences = describe_differences(config.table, about, config.params)
    if differences is not None:
        lines.append(differences)
    learning_params = learning_params_of(config.params, config.stage)
    epsilon = epsilon_at(learning_params, config.start_cycle)
    share = f"{100 * epsilon:.3g} %"
    if config.start_cycle:
        lines.append(f"continuing from cycle {config.start_cycle}, exploring {share} at first")
    elif config.policy == "learned" and epsilon > learning_params.epsilon_end:
        lines.append(
            f"starting from {config.table} at cycle 0: {share} of the actions are random at "
            "first, which may undo what was learnt; --resume RUN continues a run"
        )
    return lines
