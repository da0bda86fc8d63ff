"""The only conversion between messages and signals. It changes no bit of any number.

What is said every tick travels as bytes: publishers here write CDR themselves, subscriptions are
raw, and a message that looks byte for byte as our own writers make it, numbers apart, is read with
one ``struct`` call. That is four times as fast as filling and building message objects. Any other
message of the same type, from ``ros2 topic pub`` or a real leg's driver, takes the way through
rclpy's deserializer and is held to the same rules.

Readers refuse what does not carry what it should with a ``SignalError`` that names what, where,
and what would be right.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from ember_ros.errors import PushError, SignalError
from ember_ros.signals import LegCommand, LegSense, Pair, Phase
from leg_node.shared import Changes, Push
from leg_node.table import as_floats, as_ints

JOINTS = ("hip", "knee")
CONTACT = ("slip", "inclination", "hair", "touch", "restart", "load", "load_peak")
"""What ``<leg>/contact`` names. The first five are in ``position``: m, rad, and three bits as 0 or
1; ``load`` and ``load_peak`` are in ``effort``: N, mean and largest of the tick. The rest is 0."""
GIGA = 1_000_000_000
CDR = b"\x00\x01\x00\x00"
"""The four bytes before every message: plain CDR, little endian."""

Bytes = bytes | bytearray | memoryview


def set_stamp(stamp: Any, ns: int) -> None:
    """Write ns into a stamp."""
    stamp.sec, stamp.nanosec = divmod(ns, GIGA)


def _deserialize(data: Bytes, kind: Any, where: str) -> Any:
    try:
        return deserialize_message(bytes(data), kind)
    except Exception as error:  # rclpy raises its own RCLError and RuntimeError
        raise SignalError(f"{where}: {len(data)} bytes are no {kind.__name__}") from error


def tick_of(ns: int, tick_ns: int, where: str) -> int:
    """Return the tick that a stamp names.

    Raises:
        SignalError: the stamp lies between ticks or before the start.
    """
    tick, rest = divmod(ns, tick_ns)
    if rest or tick < 0:
        raise SignalError(
            f"{where}: stamp {ns} ns is no multiple of the tick length {tick_ns} ns from 0 up; "
            "do all nodes have the same gait.period and gait.ticks?"
        )
    return tick


# -- clock and phase -------------------------------------------------------------------------

_CLOCK = struct.Struct("<4siI")
_PHASE = struct.Struct("<4sd")


def pack_clock(ns: int) -> bytes:
    """Return a rosgraph_msgs/Clock."""
    return _CLOCK.pack(CDR, *divmod(ns, GIGA))


def read_clock(data: Bytes, where: str) -> int:
    """Return the time in a rosgraph_msgs/Clock, ns.

    Raises:
        SignalError: it is no clock, or before the start.
    """
    if len(data) == _CLOCK.size and data[:4] == CDR:
        _, sec, nanosec = _CLOCK.unpack(data)
    else:
        clock = _deserialize(data, Clock, where).clock
        sec, nanosec = clock.sec, clock.nanosec
    if sec < 0:
        raise SignalError(f"{where}: {sec} s is before the start")
    return int(sec * GIGA + nanosec)


def pack_phase(phase: Phase) -> bytes:
    """Return a std_msgs/Float64."""
    return _PHASE.pack(CDR, phase)


def read_phase(data: Bytes, ticks: int, where: str) -> tuple[int, Phase]:
    """Return the tick that a std_msgs/Float64 names as phase, and the phase.

    Raises:
        SignalError: it is not finite, under 0, or between ticks.
    """
    if len(data) == _PHASE.size and data[:4] == CDR:
        _, phase = _PHASE.unpack(data)
    else:
        phase = _deserialize(data, Float64, where).data
    tick = phase * ticks
    if not 0.0 <= tick < 2.0**53 or tick != int(tick):
        raise SignalError(f"{where}: {phase!r} is no phase; a multiple of 1/{ticks} from 0 up is")
    return int(tick), phase


# -- joint states ----------------------------------------------------------------------------


def _padded(data: bytes, size: int) -> bytes:
    """Return data filled with zeros to a multiple of ``size``: CDR aligns every number."""
    return data + bytes(-len(data) % size)


def _string(data: bytes, text: str) -> bytes:
    """Return data with a CDR string behind it."""
    coded = text.encode() + b"\0"
    return _padded(data, 4) + struct.pack("<I", len(coded)) + coded


class Stamped(NamedTuple):
    """The numbers of one sensor_msgs/JointState."""

    ns: int
    first: tuple[float, ...]
    second: tuple[float, ...]


class JointWire:
    """A sensor_msgs/JointState of fixed names, two of its three arrays in use."""

    FIELDS = ("position", "velocity", "effort")

    def __init__(self, frame: str, names: Sequence[str], first: str, second: str) -> None:
        """Lay the message out.

        Args:
            frame: ``header.frame_id``.
            names: of the joints.
            first: of ``FIELDS``, the array in use.
            second: the other one, behind ``first`` in ``FIELDS``.
        """
        self.names, self.first, self.second = list(names), first, second
        n = len(self.names)
        # Offsets count from behind the encapsulation; the stamp's 8 bytes come first.
        data = _string(bytes(8), frame)
        data = _padded(data, 4) + struct.pack("<I", n)
        for name in names:
            data = _string(data, name)
        form, constants, done = "<4siI", [], 8
        for field in self.FIELDS:
            used = field in (first, second)
            data = _padded(data, 4) + struct.pack("<I", n if used else 0)
            if used:
                data = _padded(data, 8)
                constants.append(data[done:])
                form += f"{len(constants[-1])}s{n}d"
                data += bytes(8 * n)
                done = len(data)
        self._between, self._behind, rest = constants[0], constants[1], data[done:]
        self._rest = rest
        self._struct = struct.Struct(f"{form}{len(rest)}s")
        self._n = n

    def pack(self, ns: int, first: Sequence[float], second: Sequence[float]) -> bytes:
        """Return the message with a stamp of ``ns`` and these numbers, one a name."""
        return self._struct.pack(
            CDR, *divmod(ns, GIGA), self._between, *first, self._behind, *second, self._rest
        )

    def read(self, data: Bytes, where: str) -> Stamped:
        """Return the numbers in a message.

        Raises:
            SignalError: it is no JointState, has other names or lengths, or is not finite.
        """
        n = self._n
        if len(data) == self._struct.size:
            parts = self._struct.unpack(data)
            if (
                parts[0] == CDR
                and parts[3] == self._between
                and parts[4 + n] == self._behind
                and parts[-1] == self._rest
            ):
                stamped = Stamped(
                    parts[1] * GIGA + parts[2], parts[4 : 4 + n], parts[5 + n : 5 + 2 * n]
                )
                total = sum(stamped.first) + sum(stamped.second)
                if total - total == 0.0:
                    return stamped
        return self._read_slowly(data, where)

    def _read_slowly(self, data: Bytes, where: str) -> Stamped:
        """Read a message that others made, or say what is wrong with it."""
        message = _deserialize(data, JointState, where)
        if list(message.name) != self.names:
            raise SignalError(
                f"{where}: joint names {list(message.name)}; {self.names} would be right"
            )
        numbers = []
        for field in (self.first, self.second):
            numbers.append(tuple(getattr(message, field)))
            if len(numbers[-1]) != self._n:
                raise SignalError(
                    f"{where}: {len(numbers[-1])} numbers in {field}; {self._n}, one a name, "
                    "would be right"
                )
            if not all(map(math.isfinite, numbers[-1])):
                raise SignalError(f"{where}: {field} {list(numbers[-1])} is not finite")
        stamp = message.header.stamp
        return Stamped(stamp.sec * GIGA + stamp.nanosec, *numbers)


class SenseWire:
    """The two messages in which a leg's senses travel."""

    def __init__(self, leg: str, tick_ns: int) -> None:
        """Lay out the messages of ``leg``."""
        self._leg, self._tick_ns = leg, tick_ns
        self._joints = JointWire(f"{leg}_thigh", JOINTS, "position", "velocity")
        self._contact = JointWire(f"{leg}_foot", CONTACT, "position", "effort")

    def pack(self, sense: LegSense) -> tuple[bytes, bytes]:
        """Return ``<leg>/joint_states`` and ``<leg>/contact``."""
        ns = sense.tick * self._tick_ns
        joints = self._joints.pack(ns, (sense.hip, sense.knee), (sense.hip_speed, sense.knee_speed))
        contact = self._contact.pack(
            ns,
            (sense.slip, sense.inclination, sense.hair, sense.contact, sense.restart, 0.0, 0.0),
            (0.0, 0.0, 0.0, 0.0, 0.0, sense.force_mean, sense.force_peak),
        )
        return joints, contact

    def read_joints(self, data: Bytes) -> tuple[int, Stamped]:
        """Return the tick and the numbers of a ``<leg>/joint_states``.

        Raises:
            SignalError: it does not carry what it should.
        """
        where = f"{self._leg}/joint_states"
        stamped = self._joints.read(data, where)
        return tick_of(stamped.ns, self._tick_ns, where), stamped

    def read_contact(self, data: Bytes) -> tuple[int, Stamped]:
        """Return the tick and the numbers of a ``<leg>/contact``.

        Raises:
            SignalError: it does not carry what it should.
        """
        where = f"{self._leg}/contact"
        stamped = self._contact.read(data, where)
        for name, bit in zip(CONTACT[2:5], stamped.first[2:5], strict=True):
            if bit not in (0.0, 1.0):
                raise SignalError(f"{where}: {name} is {bit}; 0 or 1 would be right")
        return tick_of(stamped.ns, self._tick_ns, where), stamped

    @staticmethod
    def sense(tick: int, joints: Stamped, contact: Stamped) -> LegSense:
        """Return the senses in the numbers of one tick's two messages."""
        slip, inclination, hair, touch, restart = contact.first[:5]
        hip, knee = joints.first
        hip_speed, knee_speed = joints.second
        load, load_peak = contact.second[5:]
        return LegSense(
            tick, hip, knee, hip_speed, knee_speed, load, load_peak, inclination, slip,
            hair == 1.0, touch == 1.0, restart == 1.0,
        )  # fmt: skip


class CommandWire:
    """The message in which a leg's command travels."""

    def __init__(self, leg: str, tick_ns: int) -> None:
        """Lay out the message of ``leg``."""
        self._leg, self._tick_ns = leg, tick_ns
        self._wire = JointWire(f"{leg}_thigh", JOINTS, "velocity", "effort")

    def pack(self, command: LegCommand) -> bytes:
        """Return ``<leg>/command``."""
        return self._wire.pack(
            command.tick * self._tick_ns,
            (command.hip_speed, command.knee_speed),
            (command.hip_torque, command.knee_torque),
        )

    def read(self, data: Bytes) -> LegCommand:
        """Return the command in a message.

        Raises:
            SignalError: it does not carry what it should, or a torque is under 0.
        """
        where = f"{self._leg}/command"
        stamped = self._wire.read(data, where)
        if min(stamped.second) < 0.0:
            raise SignalError(f"{where}: torques {stamped.second} N m must be 0 or more")
        return LegCommand(
            tick_of(stamped.ns, self._tick_ns, where), *stamped.first, *stamped.second
        )


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
            raise PushError(
                f"push: field {name!r} is unknown or twice there; once each of "
                f"{', '.join(_PUSH)} would be right"
            )
        if kind != _PUSH[name]:
            raise PushError(
                f"push: {name} has parameter type {kind}; {_PUSH[name]} "
                f"({_FIELD[_PUSH[name]]}) would be right"
            )
        fields[name] = getattr(parameter.value, _FIELD[kind])
    missing = [name for name in _PUSH if name not in fields]
    if missing:
        raise PushError(f"push: {', '.join(missing)} missing")
    lengths = [len(fields[name]) for name in ("tick", "cell", "target")]
    if len(set(lengths)) != 1:
        raise PushError(
            f"push: tick, cell and target have {lengths} entries; as many each would be right"
        )
    pairs = tuple(map(Pair, fields["tick"], fields["cell"], fields["target"]))
    return Push(fields["leg"], fields["run"], fields["epoch"], fields["cells_sha256"], pairs)


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
        PushError: a name is not one of those that the service knows.
    """
    bounds: dict[str, int] = {}
    wanted: list[str] = []
    for name in request.names:
        key, _, number = name.partition("=")
        if key in ("since", "upto") and number.removeprefix("-").isdecimal():
            bounds[key] = int(number)
            if not -(2**63) <= bounds[key] < 2**63:
                raise PushError(f"pull: {name} is no 64-bit number")
        elif name not in ("version", "cells", "values", "visits", "about"):
            raise PushError(
                f"pull: {name!r} is unknown; since=VERSION, upto=EPOCH, version, cells, "
                "values, visits, about are known"
            )
        wanted.append(name)
    return bounds.get("since"), bounds.get("upto"), wanted


def answer_pull(
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
