"""Declares the dataclasses of ``params`` and the ``options`` as ROS parameters of a node.

Every node declares the groups and options that it uses; descriptors, ranges and checks come from
the dataclass fields. One parameter file with the section ``/**`` serves all nodes and the command
``ember``: a node ignores the parameters of groups that it does not use, and refuses unknown names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType
from rclpy.node import Node

from ember_ros.errors import ParameterError
from ember_ros.options import OPTION_NAMES, OPTIONS, check_option, is_ros_own
from ember_ros.params import SPECS, Params, Spec, check, replace
from ember_ros.params_file import range_of


def _descriptor(spec: Spec) -> ParameterDescriptor:
    described = ParameterDescriptor(description=f"{spec.doc} [{spec.unit}]", read_only=True)
    closed = math.isfinite(spec.low) and math.isfinite(spec.high)
    if spec.form:
        many = isinstance(spec.default, tuple)
        described.type = (
            ParameterType.PARAMETER_STRING_ARRAY if many else ParameterType.PARAMETER_STRING
        )
        described.description = f"{spec.doc} ({spec.form})"
        return described
    if isinstance(spec.default, tuple):
        described.type = ParameterType.PARAMETER_DOUBLE_ARRAY
        closed = False  # ROS has ranges for single numbers only
    elif isinstance(spec.default, int):
        described.type = ParameterType.PARAMETER_INTEGER
    else:
        described.type = ParameterType.PARAMETER_DOUBLE
    if not closed:  # a ROS range needs two ends: this one is text, and `check` enforces it
        described.additional_constraints = range_of(spec)
    elif isinstance(spec.default, int):
        described.integer_range = [IntegerRange(from_value=int(spec.low), to_value=int(spec.high))]
    else:
        described.floating_point_range = [
            FloatingPointRange(from_value=float(spec.low), to_value=float(spec.high))
        ]
    return described


def _set(node: Node, name: str, value: Any, descriptor: ParameterDescriptor) -> None:
    """Declare a parameter with its checked value, also if an override has declared it already."""
    if node.has_parameter(name):  # an override, which rclpy has declared without a descriptor
        node.undeclare_parameter(name)
    node.declare_parameter(
        name, list(value) if isinstance(value, tuple) else value, descriptor, ignore_override=True
    )


def _rename(node: Node) -> None:
    """Redeclare overrides of options whose name is also a group's under their other name.

    `ros2 param dump` nests names at their dots, and fails if a name is both a value and a group.

    Raises:
        ParameterError: both names are set, to different values.
    """
    for name, option in OPTIONS.items():
        declared = option.declared
        if not declared or not node.has_parameter(name):
            continue
        value = node.get_parameter(name).value
        node.undeclare_parameter(name)
        if not node.has_parameter(declared):
            node.declare_parameter(declared, value)
        elif node.get_parameter(declared).value != value:
            other = node.get_parameter(declared).value
            raise ParameterError(
                f"{name} = {value!r} and {declared} = {other!r} contradict each other; only one "
                "of them would be right"
            )


def declare_params(node: Node, groups: Sequence[str]) -> Params:
    """Declare the parameters of some groups on a node; return all groups.

    Overrides of groups that the node does not declare are checked and returned as well. The node
    must be created with ``automatically_declare_parameters_from_overrides=True``, so that unknown
    names are detected.

    Raises:
        ParameterError: an unknown name, a value of the wrong type or out of range.
    """
    known = {field.name for field in fields(Params)}
    assert known.issuperset(groups), groups
    _rename(node)
    overrides: dict[str, Any] = {}
    for name, parameter in node.get_parameters_by_prefix("").items():
        if name in OPTION_NAMES or is_ros_own(name):
            continue
        overrides[name] = check(name, parameter.value)
    params = replace(Params(), overrides)
    for name, spec in SPECS.items():
        group, field = name.split(".")
        if group in groups:
            _set(node, name, getattr(getattr(params, group), field), _descriptor(spec))
    return params


def declare_options(node: Node, names: Sequence[str], **defaults: Any) -> dict[str, Any]:
    """Declare some of ``OPTIONS`` on a node and return their values.

    Raises:
        ParameterError: a value has the wrong type or is not one of the choices.
    """
    values = {}
    for name in names:
        option = OPTIONS[name]
        default = defaults.get(name, option.default)
        declared = option.declared or name
        is_set = node.has_parameter(declared)
        value = node.get_parameter(declared).value if is_set else default
        values[name] = check_option(name, value, default)
        descriptor = ParameterDescriptor(description=option.doc, read_only=True)
        _set(node, declared, values[name], descriptor)
    return values
