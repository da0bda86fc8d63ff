"""The console script, so light that Ctrl-C is heard while everything else is imported.

What is not installed is named in one line, with how to get it.
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
"""The module of each node, by the name that ``ember node`` and ``ros2 run`` start it under."""


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
    except BrokenPipeError:  # `| head` has heard enough
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 1)


def _open_standard_streams() -> None:
    """Open what was closed (``2>&-``): files that are opened later would be written into."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False)


def ember() -> None:
    """Run the command line, or a node without what only the command line needs."""
    match sys.argv[1:]:
        case ["node", name, *args] if name in NODES:
            run_node(name, args)
        case _:
            _call("ember_ros.cli")


def run_node(name: str, args: list[str]) -> None:
    """Run one of ``NODES`` in this process.

    Args:
        name: of the node.
        args: for the node and for rcl: ``--help``, or ``--ros-args`` and what follows.
    """
    sys.argv[1:] = args
    _call(NODES[name])
