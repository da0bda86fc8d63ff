"""The console scripts: they import little, so that Ctrl-C works while the rest is imported.

A missing library is reported in one line, with the command that installs it.
"""

from __future__ import annotations

import importlib
import os
import sys

from ember_ros.errors import PIP, MissingError, no_ros

NODES = {
    "sim_node": "sim_node.node",
    "leg_node": "leg_node.node",
    "cpg_node": "cpg_node.node",
    "table_node": "leg_node.table_node",
    "recorder_node": "ember_ros.bag.recorder_node",
}
"""The module of each node, by the name for ``ember node`` and ``ros2 run``."""


def _call(module: str) -> None:
    """Import a module and call its ``main``."""
    _open_standard_streams()
    try:
        importlib.import_module(module).main()
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        print(f"error: {MissingError(name) if name in PIP else no_ros(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader, such as `| head`, has ended
        with open(os.devnull, "wb") as devnull:
            os.dup2(devnull.fileno(), 1)


def _open_standard_streams() -> None:
    """Open closed standard streams (``2>&-``); else a file opened later would get their number."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False)


def ember() -> None:
    """Run the command line; ``ember node`` starts without the command line's own libraries."""
    match sys.argv[1:]:
        case ["node", name, *args] if name in NODES:
            run_node(name, args)
        case _:
            _call("ember_ros.cli")


def run_node(name: str, args: list[str]) -> None:
    """Run one of ``NODES`` in this process.

    Args:
        name: its key in ``NODES``.
        args: its arguments: ``--help``, or ``--ros-args`` and the ROS arguments.
    """
    sys.argv[1:] = args
    _call(NODES[name])
