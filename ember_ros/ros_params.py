"""Between the dataclasses of ``params`` and the parameters of a node.

Every node declares the groups it needs and the options that are its own; descriptors, ranges and
checks come from the same fields as everything else. One parameter file with a section ``/**``
serves all nodes and the command ``ember``: a name of another node's group is let pass, a name that
nobody knows is refused.
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
        closed = False  # a range is of one number
    elif isinstance(spec.default, int):
        described.type = ParameterType.PARAMETER_INTEGER
    else:
        described.type = ParameterType.PARAMETER_DOUBLE
    if not closed:  # a range has two ends: said in words, and held by `check`
        described.additional_constraints = range_of(spec)
    elif isinstance(spec.default, int):
        described.integer_range = [IntegerRange(from_value=int(spec.low), to_value=int(spec.high))]
    else:
        described.floating_point_range = [
            FloatingPointRange(from_value=float(spec.low), to_value=float(spec.high))
        ]
    return described


def _set(node: Node, name: str, value: Any, descriptor: ParameterDescriptor) -> None:
    """Declare a parameter with its checked value, whether it was given from outside or not."""
    if node.has_parameter(name):  # given from outside, and declared by its mere presence
        node.undeclare_parameter(name)
    node.declare_parameter(
        name, list(value) if isinstance(value, tuple) else value, descriptor, ignore_override=True
    )


def _rename(node: Node) -> None:
    """Declare what was given by a name that is a group's too by the other one.

    `ros2 param dump` nests names at their dots, and fails where one is both a value and a group.
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
                f"{name} = {value!r} and {declared} = {other!r} contradict each other; one of "
                "them would be right"
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
    _rename(node)
    given: dict[str, Any] = {}
    for name, parameter in node.get_parameters_by_prefix("").items():
        if name in OPTION_NAMES or is_ros_own(name):
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
        declared = option.declared or name
        given = node.has_parameter(declared)
        value = node.get_parameter(declared).value if given else default
        values[name] = check_option(name, value, default)
        descriptor = ParameterDescriptor(description=option.doc, read_only=True)
        _set(node, declared, values[name], descriptor)
    return values
