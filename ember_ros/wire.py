"""The only conversion between the robot's messages and signals. It changes no bit of any number.

What is published every tick is packed and read as bytes: publishers write CDR themselves, and
subscriptions are raw. A message with the layout of our own writers is read with one ``struct``
call, which is four times as fast as making message objects. A message of the same type with
another layout, from ``ros2 topic pub`` or a real leg's driver, goes through rclpy's deserializer,
and the same rules hold for it; nothing else here needs ROS.

Readers raise a ``SignalError`` that names what is wrong, where, and what would be right.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ember_ros import topics
from ember_ros.cdr import (
    ENCAPSULATION,
    NS_PER_S,
    Bytes,
    append_string,
    deserialize,
    joint_names,
    pad,
)
from ember_ros.errors import SignalError
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition

JOINTS = ("hip", "knee")
CONTACT = ("slip", "inclination", "hair", "touch", "restart", "load", "load_peak")
"""The names in ``<leg>/contact``. The first five are in ``position``: m, rad, and three bits as 0
or 1; ``load`` and ``load_peak`` are in ``effort``: N, mean and largest of the tick. The rest is 0.
"""
TRANSITION = ("state", "stance", "action", "next_state", "next_stance", "td_error")
"""The first names in ``<leg>/transition``, in ``position``: indexes, -1 where there is nothing to
credit, bits as 0 or 1, and an error in units of the reward; every weighted term of the reward
follows by its own name."""
OLDER_TRANSITION = ("stance", "state", "action")
"""Its first names in older bags, which had no next state; such a message is not read."""


def tick_of(ns: int, tick_ns: int, where: str) -> int:
    """Return the tick of a stamp.

    Raises:
        SignalError: the stamp is between ticks or before the start.
    """
    tick, rest = divmod(ns, tick_ns)
    if rest or tick < 0:
        raise SignalError(
            f"{where}: stamp {ns} ns is no multiple of the tick length {tick_ns} ns from 0 up; "
            "do all nodes have the same gait.period and gait.ticks?"
        )
    return tick


# -- the phase of older bags -----------------------------------------------------------------

_BARE_PHASE = struct.Struct("<4sd")


def read_bare_phase(data: Bytes, ticks: int, where: str) -> Beat:
    """Return the beat in a std_msgs/Float64 of older bags: its tick follows from its phase.

    Raises:
        SignalError: it is not finite, under 0, or between ticks.
    """
    if len(data) == _BARE_PHASE.size and data[:4] == ENCAPSULATION:
        _, phase = _BARE_PHASE.unpack(data)
    else:
        phase = deserialize(data, topics.BARE_PHASE.kind, where).data
    tick = phase * ticks
    if not 0.0 <= tick < 2.0**53 or tick != int(tick):
        raise SignalError(f"{where}: {phase!r} is no phase; a multiple of 1/{ticks} from 0 up is")
    return Beat(int(tick), phase)


# -- joint states ----------------------------------------------------------------------------


class Stamped(NamedTuple):
    """The numbers of one sensor_msgs/JointState."""

    ns: int
    first: tuple[float, ...]
    second: tuple[float, ...]
    """Empty where only one array is in use."""


class JointWire:
    """A sensor_msgs/JointState with fixed names that uses one or two of its three arrays.

    Our own messages have one layout. Messages of others may have the names in any order, and other
    names too; the content of an array that is not used is ignored.
    """

    FIELDS = ("position", "velocity", "effort")
    REASONS: Mapping[str, str] = {
        "position": "it holds measured values, and no default replaces one",
        "velocity": "it holds measured or commanded speeds, and no default replaces one",
        "effort": "it holds a force or the largest torque, and a missing one is not 0",
    }
    """Why each array must be complete where it is used."""

    def __init__(self, frame: str, names: Sequence[str], first: str, second: str = "") -> None:
        """Compute the layout.

        Args:
            frame: ``header.frame_id``.
            names: of the joints.
            first: of ``FIELDS``, the array that is used.
            second: of ``FIELDS``, behind ``first``: the other array that is used, if there is one.
        """
        self.names, self.first, self.second = list(names), first, second
        n = len(self.names)
        # Offsets count from behind the encapsulation; the stamp's 8 bytes come first.
        data = append_string(bytes(8), frame)
        data = pad(data, 4) + struct.pack("<I", n)
        for name in names:
            data = append_string(data, name)
        form, constants, done = "<4siI", [], 8
        for field in self.FIELDS:
            used = field in (first, second)
            data = pad(data, 4) + struct.pack("<I", n if used else 0)
            if used:
                data = pad(data, 8)
                constants.append(data[done:])
                form += f"{len(constants[-1])}s{n}d"
                data += bytes(8 * n)
                done = len(data)
        rest = data[done:]
        self._between, self._behind = constants[0], tuple(constants[1:])
        self._rest = rest
        self._struct = struct.Struct(f"{form}{len(rest)}s")
        self._n = n

    def pack(self, ns: int, first: Sequence[float], second: Sequence[float] = ()) -> bytes:
        """Return the message with a stamp of ``ns`` and these numbers, one per name."""
        return self._struct.pack(
            ENCAPSULATION,
            *divmod(ns, NS_PER_S),
            self._between,
            *first,
            *self._behind,
            *second,
            self._rest,
        )

    def read(self, data: Bytes, where: str) -> Stamped:
        """Return the numbers in a message.

        Raises:
            SignalError: it is no JointState, a name or its number is missing, or is not finite.
        """
        return self.read_own(data) or self._read_other(data, where)

    def read_own(self, data: Bytes) -> Stamped | None:
        """Return the numbers in a message with the layout of ``pack``; None for another layout."""
        n = self._n
        if len(data) == self._struct.size:
            parts = self._struct.unpack(data)
            if (
                parts[0] == ENCAPSULATION
                and parts[3] == self._between
                and parts[4 + n : 4 + n + len(self._behind)] == self._behind
                and parts[-1] == self._rest
            ):
                stamped = Stamped(
                    parts[1] * NS_PER_S + parts[2], parts[4 : 4 + n], parts[5 + n : -1]
                )
                total = sum(stamped.first) + sum(stamped.second)
                if total - total == 0.0:
                    return stamped
        return None

    def _read_other(self, data: Bytes, where: str) -> Stamped:
        """Read a message of another layout."""
        message = deserialize(data, topics.JOINT_STATE, where)
        names = list(message.name)
        if missing := [name for name in self.names if names.count(name) != 1]:
            raise SignalError(
                f"{where}: joint names {names}; each of {missing} once would be right, in any order"
            )
        places = [names.index(name) for name in self.names]
        numbers: list[tuple[float, ...]] = []
        for field in (self.first, self.second):
            if not field:
                numbers.append(())
                continue
            values = getattr(message, field)
            if len(values) != len(names):
                raise SignalError(
                    f"{where}: {len(values)} numbers in {field}; {len(names)}, one per name, would "
                    f"be right: {self.REASONS[field]}"
                )
            numbers.append(tuple(float(values[place]) for place in places))
            if not all(map(math.isfinite, numbers[-1])):
                raise SignalError(
                    f"{where}: {field} {list(numbers[-1])} is not finite: {self.REASONS[field]}"
                )
        stamp = message.header.stamp
        return Stamped(stamp.sec * NS_PER_S + stamp.nanosec, *numbers)


class BeatWire:
    """Packs and reads ``cpg/phase``, which carries the beat."""

    def __init__(self, tick_ns: int) -> None:
        """Compute the layout."""
        self._tick_ns = tick_ns
        self._wire = JointWire("cpg", ("cpg",), "position")

    def pack(self, beat: Beat) -> bytes:
        """Return ``cpg/phase``."""
        return self._wire.pack(beat.tick * self._tick_ns, (beat.phase,))

    def read(self, data: Bytes) -> Beat:
        """Return the beat in a message.

        Raises:
            SignalError: it does not carry what it should, or the phase is under 0.
        """
        where = topics.PHASE.name
        stamped = self._wire.read(data, where)
        (phase,) = stamped.first
        if not 0.0 <= phase < 2.0**53:
            raise SignalError(f"{where}: {phase!r} is no phase; 0 or more would be right")
        return Beat(tick_of(stamped.ns, self._tick_ns, where), phase)


class SenseWire:
    """Packs and reads the two messages that carry a leg's senses."""

    def __init__(self, leg: str, tick_ns: int) -> None:
        """Compute the layouts of ``leg``."""
        self._leg, self._tick_ns = leg, tick_ns
        self._joints = JointWire(f"{leg}_thigh", JOINTS, "position", "velocity")
        self._contact = JointWire(f"{leg}_foot", CONTACT, "position", "effort")

    def pack(self, sense: LegSense) -> tuple[bytes, bytes]:
        """Return ``<leg>/joint_states`` and ``<leg>/contact``."""
        ns = sense.tick * self._tick_ns
        joints = self._joints.pack(ns, (sense.hip, sense.knee), (sense.hip_speed, sense.knee_speed))
        contact = self._contact.pack(
            ns,
            (sense.slip, sense.inclination, sense.hair, sense.contact, sense.first_tick, 0.0, 0.0),
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
        """Return the senses from the numbers of one tick's two messages."""
        slip, inclination, hair, touch, first_tick = contact.first[:5]
        hip, knee = joints.first
        hip_speed, knee_speed = joints.second
        load, load_peak = contact.second[5:]
        return LegSense(
            tick, hip, knee, hip_speed, knee_speed, load, load_peak, inclination, slip,
            hair == 1.0, touch == 1.0, first_tick == 1.0,
        )  # fmt: skip


class CommandWire:
    """Packs and reads ``<leg>/command``, which carries a leg's command."""

    def __init__(self, leg: str, tick_ns: int) -> None:
        """Compute the layout of ``leg``."""
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


class TransitionWire:
    """Packs and reads ``<leg>/transition``, which carries a leg's transition."""

    def __init__(self, leg: str, tick_ns: int) -> None:
        """Compute the layout of ``leg``; the reward's terms follow from the messages."""
        self._leg, self._tick_ns = leg, tick_ns
        self._wire = self._layout(())

    def _layout(self, terms: Sequence[str]) -> JointWire:
        return JointWire(f"{self._leg}_thigh", (*TRANSITION, *terms), "position")

    def pack(self, transition: Transition) -> bytes:
        """Return ``<leg>/transition``."""
        names = [name for name, _ in transition.terms]
        if self._wire.names[len(TRANSITION) :] != names:
            self._wire = self._layout(names)
        t = transition
        fixed = (t.state, t.stance, t.action, t.next_state, t.next_stance, t.td_error)
        return self._wire.pack(t.tick * self._tick_ns, (*fixed, *[value for _, value in t.terms]))

    def read(self, data: Bytes) -> Transition:
        """Return the transition in a message.

        Raises:
            SignalError: it does not carry what it should.
        """
        where = f"{self._leg}/transition"
        stamped = self._wire.read_own(data)
        if stamped is None:  # other terms than before, or another layout
            self._wire = self._layout(self._terms(data, where))
            stamped = self._wire.read(data, where)
        state, stance, action, next_state, next_stance, td_error, *values = stamped.first
        indexes, bits = (state, action, next_state), (stance, next_stance)
        if any(index != int(index) or index < -1.0 for index in indexes) or set(bits) - {0.0, 1.0}:
            raise SignalError(
                f"{where}: state, action, next_state {indexes}, stance, next_stance {bits}; whole "
                "numbers from -1 up, and bits as 0 or 1, would be right"
            )
        names = self._wire.names[len(TRANSITION) :]
        return Transition(
            tick_of(stamped.ns, self._tick_ns, where),
            int(state),
            stance == 1.0,
            int(action),
            tuple(zip(names, values, strict=True)),
            int(next_state),
            next_stance == 1.0,
            td_error,
        )

    @staticmethod
    def _terms(data: Bytes, where: str) -> list[str]:
        """Return the names of the reward's terms in a message."""
        names = list(joint_names(data, where))
        if tuple(names[: len(TRANSITION)]) != TRANSITION:
            raise SignalError(
                f"{where}: names {names[:8]}; {list(TRANSITION)} and the reward's terms would be "
                "right"
            )
        return names[len(TRANSITION) :]


def is_older_transition(data: Bytes) -> bool:
    """Return whether a message is a ``<leg>/transition`` of an older bag."""
    try:
        return tuple(itertools.islice(joint_names(data, ""), 3)) == OLDER_TRANSITION
    except SignalError:
        return False


# -- the body --------------------------------------------------------------------------------

# Frames as in REP 105, except that the child frame is the body. Covariance and twist are unknown.
_FRAMES = pad(append_string(append_string(bytes(8), "odom"), "body"), 8)[8:]
_UNKNOWN = bytes(8 * (36 + 6 + 36))
_ODOMETRY = struct.Struct(f"<4siI{len(_FRAMES)}s7d{len(_UNKNOWN)}s")


def pack_odometry(ns: int, body: BodyState) -> bytes:
    """Return a nav_msgs/Odometry with the body's pose."""
    turn = quaternion(body.roll, body.pitch, body.yaw)
    return _ODOMETRY.pack(
        ENCAPSULATION, *divmod(ns, NS_PER_S), _FRAMES, body.x, body.y, body.height, *turn, _UNKNOWN
    )


def read_odometry(data: Bytes, where: str) -> tuple[int, tuple[float, ...]]:
    """Return the stamp, ns, and x, y, height (m), roll, pitch, yaw (rad) of a nav_msgs/Odometry.

    Raises:
        SignalError: it is none, or not finite.
    """
    pose: tuple[float, ...]
    if (
        len(data) == _ODOMETRY.size
        and data[:4] == ENCAPSULATION
        and data[12 : 12 + len(_FRAMES)] == _FRAMES
    ):
        parts = _ODOMETRY.unpack(data)
        ns, pose = parts[1] * NS_PER_S + parts[2], parts[4:11]
    else:
        message = deserialize(data, topics.ODOMETRY.kind, where)
        stamp, at = message.header.stamp, message.pose.pose.position
        ns, turn = stamp.sec * NS_PER_S + stamp.nanosec, message.pose.pose.orientation
        pose = at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w
    if not all(map(math.isfinite, pose)):
        raise SignalError(f"{where}: pose {pose} is not finite")
    return ns, (*pose[:3], *euler(*pose[3:]))


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


def euler(x: float, y: float, z: float, w: float) -> tuple[float, float, float]:
    """Return roll, pitch and yaw, rad, of a unit quaternion: the inverse of ``quaternion``."""
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
