"""Every option of every node, once: what a node is told that is not a number of the robot."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from ember_ros.errors import ParameterError


class Option(NamedTuple):
    """A parameter of a node that is not a number of the robot."""

    default: Any
    doc: str
    choices: tuple[str, ...] = ()
    path: bool = False
    """Whether it names a file or folder: ``~`` is the home then."""
    own: bool = False
    """Whether a dotted path of a class of one's own may stand for one of the choices."""
    declared: str = ""
    """What it is declared as, where its own name is a group's too and a dump would hold both."""


OPTIONS = {
    "world": Option("walker", "where the legs are mounted", ("walker", "trainer"), own=True),
    "mode": Option("lockstep", "wait for all commands, or never", ("lockstep", "realtime")),
    "gui": Option(False, "show Bullet's window"),
    "cycles": Option(-1, "cycles to run; -1: until stopped"),
    "patience": Option(1.0, "wall seconds to wait for a leg, s"),
    "table_patience": Option(0.4, "wall seconds a leg waits for the table, s"),
    "out": Option("", "folder for the record of the run; '' for none", path=True),
    "bag": Option("", "folder of a new bag to record the run into; '' for none", path=True),
    "split_mb": Option(0.0, "megabytes after which the bag begins a new file; 0: never"),
    "split_s": Option(0.0, "simulated seconds after which the bag begins a new file; 0: never"),
    "recorder": Option(False, "wait for a recorder node before the first tick"),
    "all_robots": Option(False, "record every robot on the graph, not only this namespace's"),
    "seed": Option(0, "seed of the run; whatever draws random numbers has its own generator"),
    "leg": Option("", "the leg that this node is; `leg` as well at the start", declared="leg_name"),
    "start_cycle": Option(0, "cycles learnt before; exploration goes on from there"),
    "stage": Option("walk", "which learning numbers hold", ("walk", "train")),
    "policy": Option(
        "learned", "how the knee is chosen", ("learned", "scripted", "random"), own=True
    ),
    "learning": Option(True, "whether the leg learns"),
    "shared": Option(True, "whether the leg shares its table through the table services"),
    "table": Option("", "an .npz to start from, or `trained`; '' for an empty table", path=True),
    "save": Option(
        "", "where the table is written on exit and by table/save; '' for nowhere", path=True
    ),
}
"""Every option of every node, once."""
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
"""What nodes may be told an option by."""

ROS_OWN = ("use_sim_time", "start_type_description_service")
_QOS = "qos_overrides."


def is_ros_own(name: str) -> bool:
    """Return whether a parameter is one that ROS itself gives every node."""
    return name in ROS_OWN or name.startswith(_QOS)


def check_option(name: str, value: Any, default: Any) -> Any:
    """Return an option's value in its own type, a path with its ``~`` as the home.

    Raises:
        ParameterError: it is of the wrong type, none of the choices, or too small.
    """
    option = OPTIONS[name]
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not type(default):
        raise ParameterError(f"{name} = {value!r} must be a {type(default).__name__}: {option.doc}")
    own = option.own and isinstance(value, str) and "." in value
    if option.choices and value not in option.choices and not own:
        more = ", or the dotted path of a class" if option.own else ""
        raise ParameterError(f"{name} = {value!r} must be one of {', '.join(option.choices)}{more}")
    least = MINIMA.get(name)
    if least is not None and not value >= least:  # NaN is not
        raise ParameterError(f"{name} = {value!r} must be {least} or more: {option.doc}")
    if option.path:
        # No shell sees the value of `-p save:=~/walked.npz`, a launch argument or a file.
        told, value = value, os.path.expanduser(value)
        if value.startswith("~"):
            raise ParameterError(
                f"{name} = {told!r} names no user's home; the whole path would be right, or "
                f"./{told} for a name that begins so"
            )
    return value
