"""The console scripts, so light that Ctrl-C is heard while everything else is imported.

What is not installed is named in one line, with how to get it.
"""

from __future__ import annotations

import importlib
import os
import sys

from ember_ros.errors import PIP, MissingError, no_ros


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
    """Run the command line."""
    _call("ember_ros.cli")


def sim_node() -> None:
    """Run the simulator."""
    _call("sim_node.node")


def leg_node() -> None:
    """Run a leg."""
    _call("leg_node.node")


def cpg_node() -> None:
    """Run the central pattern generator."""
    _call("cpg_node.node")


def table_node() -> None:
    """Run the table that legs share."""
    _call("leg_node.table_node")


def recorder_node() -> None:
    """Run the recorder of bags."""
    _call("ember_ros.bag.recorder_node")
