"""The only conversion between messages and signals. It changes no bit of any number.

Writers fill one message over and over; readers refuse what does not carry what it should with a
``SignalError`` that names what, where, and what would be right.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from sensor_msgs.msg import JointState

from ember_ros.errors import PushError, SignalError
from ember_ros.signals import LegCommand, LegSense, Pair, Phase
from leg_node.shared import Changes, Push
from leg_node.table import as_floats, as_ints

JOINTS = ["hip", "knee"]
CONTACT = ["slip", "inclination", "hair", "touch", "restart", "load", "load_peak"]
"""What ``<leg>/contact`` names. The first five are in ``position``: m, rad, and three bits as 0 or
1; ``load`` and ``load_peak`` are in ``effort``: N, mean and largest of the tick."""
BITS = (0.0, 1.0)
GIGA = 1_000_000_000


def stamp_ns(stamp: Any) -> int:
    """Return a stamp in ns."""
    return int(stamp.sec) * GIGA + int(stamp.nanosec)


def set_stamp(stamp: Any, ns: int) -> None:
    """Write ns into a stamp."""
    stamp.sec, stamp.nanosec = divmod(ns, GIGA)


def tick_of(stamp: Any, tick_ns: int, where: str) -> int:
    """Return the tick a stamp names.

    Raises:
        SignalError: the stamp lies between ticks or before the start.
    """
    tick, rest = divmod(stamp_ns(stamp), tick_ns)
    if rest or tick < 0:
        raise SignalError(
            f"{where}: stamp {stamp_ns(stamp)} ns is no multiple of the tick length {tick_ns} ns; "
            "do all nodes have the same gait.period and gait.ticks?"
        )
    return tick


def phase_tick(phase: Phase, ticks: int, where: str) -> int:
    """Return the tick a phase names.

    Raises:
        SignalError: it is not finite, under 0, or between ticks.
    """
    tick = phase * ticks
    if not 0.0 <= tick < 2.0**53 or tick != int(tick):
        raise SignalError(f"{where}: {phase!r} is no phase; a multiple of 1/{ticks} from 0 up is")
    return int(tick)


def _check(message: JointState, names: list[str], fields: Sequence[str], where: str) -> None:
    if message.name != names:
        raise SignalError(f"{where}: joint names {list(message.name)}; {names} would be right")
    for field in fields:
        numbers = getattr(message, field)
        if len(numbers) != len(names):
            raise SignalError(
                f"{where}: {len(numbers)} numbers in {field}; {len(names)}, one a name, "
                "would be right"
            )
        total = sum(numbers)
        if total - total != 0.0:  # infinite or NaN
            raise SignalError(f"{where}: {field} {list(numbers)} is not finite")


class SenseWriter:
    """Fills the two messages in which a leg's senses travel."""

    def __init__(self, leg: str, tick_ns: int) -> None:
        """Make the messages of ``leg``."""
        self._tick_ns = tick_ns
        self.joints = JointState(
            name=JOINTS, position=array("d", [0.0] * 2), velocity=array("d", [0.0] * 2)
        )
        self.contact = JointState(
            name=CONTACT, position=array("d", [0.0] * 7), effort=array("d", [0.0] * 7)
        )
        self.joints.header.frame_id = f"{leg}_thigh"
        self.contact.header.frame_id = f"{leg}_foot"

    def fill(self, sense: LegSense) -> None:
        """Write ``sense`` into ``joints`` and ``contact``."""
        ns = sense.tick * self._tick_ns
        set_stamp(self.joints.header.stamp, ns)
        set_stamp(self.contact.header.stamp, ns)
        position, velocity = self.joints.position, self.joints.velocity
        position[0], position[1] = sense.hip, sense.knee
        velocity[0], velocity[1] = sense.hip_speed, sense.knee_speed
        felt, effort = self.contact.position, self.contact.effort
        felt[0], felt[1] = sense.slip, sense.inclination
        felt[2], felt[3], felt[4] = sense.hair, sense.contact, sense.restart
        effort[5], effort[6] = sense.force_mean, sense.force_peak


def check_joints(message: JointState, where: str) -> None:
    """Raise a SignalError unless this is a ``<leg>/joint_states`` message."""
    _check(message, JOINTS, ("position", "velocity"), where)


def check_contact(message: JointState, where: str) -> None:
    """Raise a SignalError unless this is a ``<leg>/contact`` message."""
    _check(message, CONTACT, ("position", "effort"), where)
    bits = message.position[2:5]
    if any(bit not in BITS for bit in bits):
        raise SignalError(f"{where}: hair, touch, restart are {list(bits)}; each must be 0 or 1")


def read_sense(tick: int, joints: JointState, contact: JointState) -> LegSense:
    """Return the senses in two checked messages of one tick."""
    hip, knee = joints.position
    hip_speed, knee_speed = joints.velocity
    slip, inclination, hair, touch, restart = contact.position[:5]
    load, peak = contact.effort[5:]
    return LegSense(
        tick, hip, knee, hip_speed, knee_speed, load, peak, inclination, slip,
        hair == 1.0, touch == 1.0, restart == 1.0,
    )  # fmt: skip


class CommandWriter:
    """Fills the message in which a leg's command travels."""

    def __init__(self, leg: str, tick_ns: int) -> None:
        """Make the message of ``leg``."""
        self._tick_ns = tick_ns
        self.message = JointState(
            name=JOINTS, velocity=array("d", [0.0] * 2), effort=array("d", [0.0] * 2)
        )
        self.message.header.frame_id = f"{leg}_thigh"

    def fill(self, command: LegCommand) -> None:
        """Write ``command`` into ``message``."""
        set_stamp(self.message.header.stamp, command.tick * self._tick_ns)
        speed, torque = self.message.velocity, self.message.effort
        speed[0], speed[1] = command.hip_speed, command.knee_speed
        torque[0], torque[1] = command.hip_torque, command.knee_torque


def read_command(message: JointState, tick_ns: int, where: str) -> LegCommand:
    """Return the command in a message.

    Raises:
        SignalError: wrong names or lengths, not finite, a torque under 0, or between ticks.
    """
    _check(message, JOINTS, ("velocity", "effort"), where)
    tick = tick_of(message.header.stamp, tick_ns, where)
    hip_speed, knee_speed = message.velocity
    hip_torque, knee_torque = message.effort
    if hip_torque < 0.0 or knee_torque < 0.0:
        raise SignalError(f"{where}: torques {hip_torque}, {knee_torque} N m must be 0 or more")
    return LegCommand(tick, hip_speed, knee_speed, hip_torque, knee_torque)


# -- the table's services --------------------------------------------------------------------
# An ament_python package cannot generate service types; these two carry named arrays, and can be
# called from a terminal.

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


def write_push(push: Push) -> SetParametersAtomically.Request:
    """Return the request that carries a push."""
    fields: dict[str, Any] = {
        "leg": push.leg,
        "run": push.run,
        "epoch": push.epoch,
        "cells_sha256": push.cells_sha256,
        "tick": array("q", [pair.tick for pair in push.pairs]),
        "cell": array("q", [pair.cell for pair in push.pairs]),
        "target": array("d", [pair.target for pair in push.pairs]),
    }
    parameters = [_named(name, kind, fields[name]) for name, kind in _PUSH.items()]
    return SetParametersAtomically.Request(parameters=parameters)


def read_push(request: SetParametersAtomically.Request) -> Push:
    """Return the push in a request.

    Raises:
        PushError: a field is missing, unknown, twice there, of the wrong type, or the arrays are
            of unequal length.
    """
    fields: dict[str, Any] = {}
    for parameter in request.parameters:
        name, kind = parameter.name, parameter.value.type
        if name not in _PUSH or name in fields:
            raise PushError(f"push: field {name!r} is unknown or twice there; once each of "
                            f"{', '.join(_PUSH)} would be right")
        if kind != _PUSH[name]:
            raise PushError(f"push: {name} has parameter type {kind}; {_PUSH[name]} "
                            f"({_FIELD[_PUSH[name]]}) would be right")
        fields[name] = getattr(parameter.value, _FIELD[kind])
    missing = [name for name in _PUSH if name not in fields]
    if missing:
        raise PushError(f"push: {', '.join(missing)} missing")
    lengths = [len(fields[name]) for name in ("tick", "cell", "target")]
    if len(set(lengths)) != 1:
        raise PushError(f"push: tick, cell and target have {lengths} entries; as many each "
                        "would be right")
    pairs = tuple(map(Pair, fields["tick"], fields["cell"], fields["target"]))
    return Push(fields["leg"], fields["run"], fields["epoch"], fields["cells_sha256"], pairs)


def write_pull(since: int | None, upto: int) -> GetParameters.Request:
    """Return the request for what changed after a version with all epochs to ``upto`` merged."""
    return GetParameters.Request(
        names=[f"since={-1 if since is None else since}", f"upto={upto}", "version", "cells", "values", "visits"]
    )


def read_pull(request: GetParameters.Request) -> tuple[int | None, int | None, list[str]]:
    """Return ``since``, ``upto`` (None where not given) and what is asked for, in order.

    Raises:
        PushError: a name is not one of those that the service knows.
    """
    bounds: dict[str, int] = {}
    wanted: list[str] = []
    for name in request.names:
        key, _, number = name.partition("=")
        if key in ("since", "upto") and number.removeprefix("-").isdecimal():
            bounds[key] = int(number)
        elif name not in ("version", "cells", "values", "visits", "about"):
            raise PushError(f"pull: {name!r} is unknown; since=VERSION, upto=EPOCH, version, cells, "
                            "values, visits, about are known")
        wanted.append(name)
    return bounds.get("since"), bounds.get("upto"), wanted


def answer_pull(
    wanted: Sequence[str], changes: Changes, about: str
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
            out.append(_value(_STR, about))
    return out


def read_changes(response: GetParameters.Response) -> Changes:
    """Return what changed from the answer to ``write_pull``.

    Raises:
        PushError: the answer is empty: the table refused the request.
    """
    if len(response.values) != 6:
        raise PushError("pull: the table node refused; its log says why")
    version, cells, values, visits = response.values[2:]
    return Changes(
        version.integer_value,
        as_ints(cells.integer_array_value),
        as_floats(values.double_array_value),
        as_ints(visits.integer_array_value),
    )


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return x, y, z, w of a rotation given as roll, pitch and yaw about fixed axes, rad."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
