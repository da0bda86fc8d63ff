"""The only conversion between the table's service calls and values. It changes no bit of a number.

An ament_python package cannot generate service types; the two used here carry named arrays, and can
be called from a terminal. Readers refuse what is not as it should be with a ``UpdateError``.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically

from ember_ros.errors import UpdateError
from ember_ros.signals import TDUpdate
from leg_node.shared import Changes, UpdateBatch
from leg_node.table import as_floats, as_ints

_INT = ParameterType.PARAMETER_INTEGER
_STR = ParameterType.PARAMETER_STRING
_INTS = ParameterType.PARAMETER_INTEGER_ARRAY
_FLOATS = ParameterType.PARAMETER_DOUBLE_ARRAY
_FIELD = {
    _INT: "integer_value",
    _STR: "string_value",
    _INTS: "integer_array_value",
    _FLOATS: "double_array_value",
}
_PUSH = {
    "leg": _INT,
    "run": _STR,
    "epoch": _INT,
    "cells_sha256": _STR,
    "tick": _INTS,
    "cell": _INTS,
    "target": _FLOATS,
}


def _named(name: str, kind: int, value: Any) -> Parameter:
    return Parameter(name=name, value=_value(kind, value))


def _value(kind: int, value: Any) -> ParameterValue:
    return ParameterValue(type=kind, **{_FIELD[kind]: value})


def write_push(push: UpdateBatch) -> SetParametersAtomically.Request:
    """Return the request that carries a push."""
    fields: dict[str, Any] = {
        "leg": push.leg,
        "run": push.run,
        "epoch": push.epoch,
        "cells_sha256": push.cells_sha256,
        "tick": array("q", [update.tick for update in push.updates]),
        "cell": array("q", [update.cell for update in push.updates]),
        "target": array("d", [update.target for update in push.updates]),
    }
    parameters = [_named(name, kind, fields[name]) for name, kind in _PUSH.items()]
    return SetParametersAtomically.Request(parameters=parameters)


def read_push(request: SetParametersAtomically.Request) -> UpdateBatch:
    """Return the push in a request.

    Raises:
        UpdateError: a field is missing, unknown, twice there, of the wrong type, or the arrays are
            of unequal length.
    """
    fields: dict[str, Any] = {}
    for parameter in request.parameters:
        name, kind = parameter.name, parameter.value.type
        if name not in _PUSH or name in fields:
            raise UpdateError(
                f"push: field {name!r} is unknown or twice there; once each of "
                f"{', '.join(_PUSH)} would be right"
            )
        if kind != _PUSH[name]:
            raise UpdateError(
                f"push: {name} has parameter type {kind}; {_PUSH[name]} "
                f"({_FIELD[_PUSH[name]]}) would be right"
            )
        fields[name] = getattr(parameter.value, _FIELD[kind])
    missing = [name for name in _PUSH if name not in fields]
    if missing:
        raise UpdateError(f"push: {', '.join(missing)} missing")
    lengths = [len(fields[name]) for name in ("tick", "cell", "target")]
    if len(set(lengths)) != 1:
        raise UpdateError(
            f"push: tick, cell and target have {lengths} entries; as many each would be right"
        )
    updates = tuple(map(TDUpdate, fields["tick"], fields["cell"], fields["target"]))
    return UpdateBatch(
        fields["leg"], fields["run"], fields["epoch"], fields["cells_sha256"], updates
    )


def write_pull(since: int | None, upto: int) -> GetParameters.Request:
    """Return the request for what changed after a version with all epochs to ``upto`` merged."""
    return GetParameters.Request(
        names=[
            f"since={-1 if since is None else since}",
            f"upto={upto}",
            "version",
            "cells",
            "values",
            "visits",
        ]
    )


def read_pull(request: GetParameters.Request) -> tuple[int | None, int | None, list[str]]:
    """Return ``since``, ``upto`` (None where not given) and what is asked for, in order.

    Raises:
        UpdateError: a name is not one of those that the service knows.
    """
    bounds: dict[str, int] = {}
    wanted: list[str] = []
    for name in request.names:
        key, _, number = name.partition("=")
        if key in ("since", "upto") and number.removeprefix("-").isdecimal():
            bounds[key] = int(number)
            if not -(2**63) <= bounds[key] < 2**63:
                raise UpdateError(f"pull: {name} is no 64-bit number")
        elif name not in ("version", "cells", "values", "visits", "about"):
            raise UpdateError(
                f"pull: {name!r} is unknown; since=VERSION, upto=EPOCH, version, cells, "
                "values, visits, about are known"
            )
        wanted.append(name)
    return bounds.get("since"), bounds.get("upto"), wanted


def write_pull_response(
    wanted: Sequence[str], changes: Changes, about: Callable[[], str]
) -> list[ParameterValue]:
    """Return one value a wanted name, in order."""
    out = []
    for name in wanted:
        key, _, number = name.partition("=")
        if number:
            out.append(_value(_INT, int(number)))
        elif key == "version":
            out.append(_value(_INT, changes.version))
        elif key == "values":
            out.append(_value(_FLOATS, array("d", changes.values.tobytes())))
        elif key in ("cells", "visits"):
            numbers = changes.cells if key == "cells" else changes.visits
            out.append(_value(_INTS, array("q", numbers.tobytes())))
        else:
            out.append(_value(_STR, about()))
    return out


def read_changes(response: GetParameters.Response) -> Changes:
    """Return what changed from the answer to ``write_pull``.

    Raises:
        UpdateError: the answer is empty: the table refused the request.
    """
    if len(response.values) != 6:
        raise UpdateError("pull: the table node refused; its log says why")
    version, cells, values, visits = response.values[2:]
    return Changes(
        version.integer_value,
        as_ints(cells.integer_array_value),
        as_floats(values.double_array_value),
        as_ints(visits.integer_array_value),
    )
