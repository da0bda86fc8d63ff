"""Between the dataclasses of ``params`` and the parameters of a node.

Every node declares the groups it needs and the options that are its own; descriptors, ranges and
checks come from the same fields as everything else. One parameter file with a section ``/**``
serves all nodes and the command ``ember``: a name of another node's group is let pass, a name that
nobody knows is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType
from rclpy.node import Node

from ember_ros.errors import ParameterError
from ember_ros.params import SPECS, Params, Spec, check, replace


class Option(NamedTuple):
    """A parameter of a node that is not a number of the robot."""

    default: Any
    doc: str
    choices: tuple[str, ...] = ()


OPTIONS = {
    "world": Option("walker", "where the legs are mounted", ("walker", "trainer")),
    "mode": Option("lockstep", "wait for all commands, or never", ("lockstep", "realtime")),
    "gui": Option(False, "show Bullet's window"),
    "cycles": Option(-1, "cycles to run; -1: until stopped"),
    "patience": Option(1.0, "wall seconds to wait for a leg, s"),
    "table_patience": Option(0.4, "wall seconds a leg waits for the table, s"),
    "out": Option("", "folder for the record of the run; '' for none"),
    "bag": Option("", "folder of a new bag to record the run into; '' for none"),
    "split_mb": Option(0.0, "megabytes after which the bag begins a new file; 0: never"),
    "split_s": Option(0.0, "simulated seconds after which it does; 0: never"),
    "recorder": Option(False, "wait for a recorder node before the first tick"),
    "all_robots": Option(False, "record every robot on the graph, not only this namespace's"),
    "seed": Option(0, "seed of the run; each drawer has its own generator"),
    "leg": Option("", "the leg that this node is", ()),
    "start_cycle": Option(0, "cycles learnt before; exploration goes on from there"),
    "stage": Option("walk", "which learning numbers hold", ("walk", "train")),
    "policy": Option("learned", "how the knee is chosen", ("learned", "scripted", "random")),
    "learning": Option(True, "whether the leg learns"),
    "shared": Option(True, "whether the leg shares its table through the table services"),
    "table": Option("", "table to start from, an .npz; '' for an empty one"),
    "save": Option("", "where the table is written on exit and by table/save; '' for nowhere"),
}
"""Every option of every node, once."""
LEAST = {
    "cycles": -1,
    "seed": 0,
    "start_cycle": 0,
    "patience": 0,
    "table_patience": 0,
    "split_mb": 0,
    "split_s": 0,
}

_ROS_OWN = ("use_sim_time", "start_type_description_service", "qos_overrides")


def _descriptor(spec: Spec) -> ParameterDescriptor:
    described = ParameterDescriptor(description=f"{spec.doc} [{spec.unit}]", read_only=True)
    low, high = max(spec.low, -1.7e308), min(spec.high, 1.7e308)
    if isinstance(spec.default, tuple):
        described.type = ParameterType.PARAMETER_DOUBLE_ARRAY
    elif isinstance(spec.default, int):
        described.type = ParameterType.PARAMETER_INTEGER
        described.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    else:
        described.type = ParameterType.PARAMETER_DOUBLE
        described.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return described


def _set(node: Node, name: str, value: Any, descriptor: ParameterDescriptor) -> None:
    """Declare a parameter with its checked value, whether it was given from outside or not."""
    if node.has_parameter(name):  # given from outside, and declared by its mere presence
        node.undeclare_parameter(name)
    node.declare_parameter(
        name, list(value) if isinstance(value, tuple) else value, descriptor, ignore_override=True
    )


def declare_params(node: Node, groups: Sequence[str]) -> Params:
    """Declare the groups' parameters on a node and return all, others at their defaults.

    The node must be made with ``automatically_declare_parameters_from_overrides=True``, so that
    unknown names are seen.

    Raises:
        ParameterError: an unknown name, a value of the wrong type or out of range.
    """
    known = {field.name for field in fields(Params)}
    assert known.issuperset(groups), groups
    given: dict[str, Any] = {}
    for name, parameter in node.get_parameters_by_prefix("").items():
        if name in OPTIONS or name.startswith(_ROS_OWN):
            continue
        given[name] = check(name, parameter.value)
    params = replace(Params(), given)
    for name, spec in SPECS.items():
        group, field = name.split(".")
        if group in groups:
            _set(node, name, getattr(getattr(params, group), field), _descriptor(spec))
    return params


def declare_options(node: Node, names: Sequence[str], **defaults: Any) -> dict[str, Any]:
    """Declare some of ``OPTIONS`` on a node and return their values.

    Raises:
        ParameterError: a value of the wrong type, or none of the choices.
    """
    values = {}
    for name in names:
        option = OPTIONS[name]
        default = defaults.get(name, option.default)
        value = node.get_parameter(name).value if node.has_parameter(name) else default
        if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not type(default):
            raise ParameterError(
                f"{name} = {value!r} must be a {type(default).__name__}: {option.doc}"
            )
        if option.choices and value not in option.choices:
            raise ParameterError(f"{name} = {value!r} must be one of {', '.join(option.choices)}")
        least = LEAST.get(name)
        if least is not None and not value >= least:  # NaN is not
            raise ParameterError(f"{name} = {value!r} must be {least} or more: {option.doc}")
        _set(node, name, value, ParameterDescriptor(description=option.doc, read_only=True))
        values[name] = value
    return values
