"""Converts between the table's service messages and Python values, bit for bit.

An ament_python package cannot generate service types. The two standard types used here carry named
arrays and can be called from a terminal. Readers raise ``UpdateError`` for a malformed message.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically

from ember_ros.errors import UpdateError, shown
from ember_ros.signals import TDUpdate
from leg_node.shared import Changes, UpdateBatch
from leg_node.table import Table, as_floats, as_ints

NOT_STORED = "not stored: "
"""How the reason of a push begins that was refused only for now, and may be sent again."""
MAX_NAMES = 16
"""Names in one ``table/pull``."""
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
    """Return the request of ``table/push`` for a push."""
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
    """Return the push in a request of ``table/push``.

    Raises:
        UpdateError: a field is missing, unknown, repeated or of the wrong type, or the arrays have
            different lengths.
    """
    fields: dict[str, Any] = {}
    for parameter in request.parameters:
        name, kind = parameter.name, parameter.value.type
        if name not in _PUSH or name in fields:
            raise UpdateError(
                f"push: field {shown(name)} is unknown or repeated; {', '.join(_PUSH)}, each once, "
                "would be right"
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
            f"push: tick, cell and target have {lengths} entries; equal numbers would be right"
        )
    updates = tuple(map(TDUpdate, fields["tick"], fields["cell"], fields["target"]))
    return UpdateBatch(
        fields["leg"], fields["run"], fields["epoch"], fields["cells_sha256"], updates
    )


def write_pull(since: int | None, upto: int) -> GetParameters.Request:
    """Return the request of ``table/pull``.

    Args:
        since: version of the table that the caller has; None for the whole table.
        upto: epoch up to which all updates must be merged.
    """
    return GetParameters.Request(
        names=[
            f"since={-1 if since is None else since}",
            f"upto={upto}",
            "version",
            "cells",
            "values",
            "visits",
            "cells_sha256",
        ]
    )


def read_pull(request: GetParameters.Request) -> tuple[int | None, int | None, list[str]]:
    """Return ``since``, ``upto`` (None where missing) and the requested names, in order.

    Raises:
        UpdateError: a name is unknown to the service, repeated, one of too many, or a number is
            beyond 64 bits.
    """
    if len(request.names) > MAX_NAMES or len(set(request.names)) < len(request.names):
        raise UpdateError(
            f"pull: {len(request.names)} names; up to {MAX_NAMES}, each once, would be right"
        )
    bounds: dict[str, int] = {}
    wanted: list[str] = []
    for name in request.names:
        key, _, number = name.partition("=")
        if key in ("since", "upto") and number.removeprefix("-").isdecimal():
            bounds[key] = int(number)
            if not -(2**63) <= bounds[key] < 2**63:
                raise UpdateError(f"pull: {name} is not a 64-bit number")
        elif name not in ("version", "cells", "values", "visits", "cells_sha256", "about"):
            raise UpdateError(
                f"pull: {shown(name)} is unknown; since=VERSION, upto=EPOCH, version, cells, "
                "values, visits, cells_sha256, about would be right"
            )
        wanted.append(name)
    return bounds.get("since"), bounds.get("upto"), wanted


def write_pull_response(
    wanted: Sequence[str], changes: Changes, cells_sha256: str, about: Callable[[], str]
) -> list[ParameterValue]:
    """Return the response of ``table/pull``: one value for each requested name, in order.

    Args:
        wanted: the requested names.
        changes: of the table.
        cells_sha256: meaning of the table's cells (``params.cells_sha256``).
        about: returns the JSON text with seed and parameters.
    """
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
            out.append(_value(_STR, cells_sha256 if key == "cells_sha256" else about()))
    return out


def read_changes(response: GetParameters.Response, table: Table, cells_sha256: str) -> Changes:
    """Return the changes in the response to a ``write_pull`` request.

    Args:
        response: the response.
        table: the table that the changes are for.
        cells_sha256: meaning of its cells.

    Raises:
        UpdateError: the table refused the request, its cells have another meaning, or the changes
            do not fit the table.
    """
    if len(response.values) != 7:
        raise UpdateError("pull: the table_node refused; its log gives the reason")
    version, cells, values, visits, meaning = response.values[2:]
    if meaning.string_value != cells_sha256:
        raise UpdateError(
            f"pull: the shared table was learned with other parameters (cells "
            f"{shown(meaning.string_value[:12])}..., here {cells_sha256[:12]}...); give the leg "
            "and the table the same parameter file"
        )
    changes = Changes(
        version.integer_value,
        as_ints(cells.integer_array_value),
        as_floats(values.double_array_value),
        as_ints(visits.integer_array_value),
    )
    if not len(changes.cells) == len(changes.values) == len(changes.visits):
        raise UpdateError("pull: cells, values and visits differ in length")
    if len(changes.cells) and not 0 <= changes.cells.min() <= changes.cells.max() < len(table):
        raise UpdateError(f"pull: there are cells outside 0 to {len(table) - 1}")
    if not np.isfinite(changes.values).all() or (changes.visits < 0).any():
        raise UpdateError("pull: there are values that are not finite, or negative visits")
    return changes
