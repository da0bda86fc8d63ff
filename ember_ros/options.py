"""The options of all nodes: their parameters that do not describe the robot or its learning."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from ember_ros.errors import ParameterError


class Option(NamedTuple):
    """A parameter of a node that does not describe the robot or its learning."""

    default: Any
    doc: str
    choices: tuple[str, ...] = ()
    path: bool = False
    """Whether it is a file or folder, in which ``~`` is replaced by the home folder."""
    dotted: bool = False
    """Whether the dotted path of a class is allowed besides the choices."""
    declared: str = ""
    """The declared name, if the option's name is also a group's: a dump cannot hold both."""


OPTIONS = {
    "world": Option("walker", "where the legs are mounted", ("walker", "trainer"), dotted=True),
    "mode": Option("lockstep", "wait for all commands, or never", ("lockstep", "realtime")),
    "gui": Option(False, "show Bullet's window"),
    "cycles": Option(-1, "cycles to run; -1: until stopped"),
    "patience": Option(1.0, "wall time to wait for a leg, s"),
    "table_patience": Option(0.4, "wall time that a leg waits for the table, s"),
    "out": Option("", "folder for the record of the run; '' for none", path=True),
    "bag": Option("", "folder of a new bag to record the run into; '' for none", path=True),
    "split_mb": Option(0.0, "megabytes after which the bag starts a new file; 0: never"),
    "split_s": Option(0.0, "simulated seconds after which the bag starts a new file; 0: never"),
    "recorder": Option(False, "wait for a recorder node before the first tick"),
    "all_robots": Option(False, "record every robot on the graph, not only this namespace's"),
    "seed": Option(0, "seed of the run; each part that is random has its own generator"),
    "leg": Option("", "the leg to control; leg_name is the same", declared="leg_name"),
    "start_cycle": Option(0, "cycles learnt before; exploration continues from there"),
    "stage": Option("walk", "which group of learning parameters is used", ("walk", "train")),
    "policy": Option(
        "learned", "how the knee's speed is chosen", ("learned", "scripted", "random"), dotted=True
    ),
    "learning": Option(True, "whether the leg learns"),
    "shared": Option(True, "whether the leg shares its table through the table services"),
    "table": Option("", "an .npz to start from, or `trained`; '' for an empty table", path=True),
    "save": Option(
        "", "file for the table, written on exit and by table/save; '' for none", path=True
    ),
    "fresh": Option(
        False, "start from `table`, even if the file `save` exists; after a crash it is ignored"
    ),
    "durability": Option(
        "normal",
        "normal: an acknowledged push survives a killed process; full: a power failure too",
        ("normal", "full"),
    ),
}
"""All options by name."""
MINIMA = {
    "cycles": -1,
    "seed": 0,
    "start_cycle": 0,
    "patience": 0,
    "table_patience": 0,
    "split_mb": 0,
    "split_s": 0,
}
OPTION_NAMES = frozenset(OPTIONS) | {each.declared for each in OPTIONS.values() if each.declared}
"""The names under which nodes accept options."""

ROS_OWN = ("use_sim_time", "start_type_description_service")
_QOS = "qos_overrides."


def is_ros_own(name: str) -> bool:
    """Return whether ROS itself declares this parameter on every node."""
    return name in ROS_OWN or name.startswith(_QOS)


def check_option(name: str, value: Any, default: Any) -> Any:
    """Return an option's value in its own type; in a path, ``~`` is replaced by the home folder.

    Raises:
        ParameterError: it has the wrong type, is not one of the choices, or is too small.
    """
    option = OPTIONS[name]
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not type(default):
        raise ParameterError(f"{name} = {value!r} must be a {type(default).__name__}: {option.doc}")
    dotted = option.dotted and isinstance(value, str) and "." in value
    if option.choices and value not in option.choices and not dotted:
        more = ", or the dotted path of a class" if option.dotted else ""
        raise ParameterError(f"{name} = {value!r} must be one of {', '.join(option.choices)}{more}")
    least = MINIMA.get(name)
    if least is not None and not value >= least:  # NaN is not
        raise ParameterError(f"{name} = {value!r} must be {least} or more: {option.doc}")
    if option.path:
        # A shell does not expand `-p save:=~/walked.npz`, a launch argument or a file's value.
        original, value = value, os.path.expanduser(value)
        if value.startswith("~"):
            raise ParameterError(
                f"{name} = {original!r}: there is no such home folder; the full path would be "
                f"right, or ./{original} for a name that starts with ~"
            )
    return value
