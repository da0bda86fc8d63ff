"""What ``wire`` writes, ROS reads as it was meant; what it reads is refused or keeps every bit."""

from __future__ import annotations

import dataclasses
import math
import struct
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from ember_ros import cdr, wire
from ember_ros.errors import SignalError, UpdateError
from ember_ros.params import TRAINER_LEG, Params, cells_sha256
from ember_ros.signals import Beat, LegCommand, LegSense, TDUpdate, Transition
from leg_node import calls
from leg_node.assembly import empty_table
from leg_node.shared import Changes, SharedTable, UpdateBatch
from leg_node.table import Table
from support.legs import LEGS

TICK_NS = 15_625_000
TICKS = 32
TINY = 5e-324
"""The smallest subnormal double."""

legs = st.sampled_from([*LEGS, TRAINER_LEG])
ticks = st.integers(0, 2**36)  # the stamp's seconds are 31 bits
numbers = st.floats(allow_nan=False, allow_infinity=False)
torques = st.floats(min_value=0.0, allow_nan=False, allow_infinity=False) | st.just(-0.0)
not_finite = st.sampled_from([math.nan, math.inf, -math.inf])
bits = st.booleans()
senses = st.builds(LegSense, ticks, *[numbers] * 8, bits, bits, bits)
commands = st.builds(LegCommand, ticks, numbers, numbers, torques, torques)
terms = st.dictionaries(
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=20),
    numbers,
    max_size=8,
).map(lambda found: tuple(found.items()))
phases = st.floats(min_value=0.0, max_value=2.0**53, exclude_max=True) | st.just(-0.0)
indexes = st.integers(-1, 2**53)
transitions = st.builds(
    Transition, ticks, indexes, bits, indexes, terms, indexes, bits, td_error=numbers
)
int64 = st.integers(-(2**63), 2**63 - 1)
pushes = st.builds(
    UpdateBatch,
    int64,
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40),
    int64,
    st.text("0123456789abcdef", max_size=64),
    st.lists(st.builds(TDUpdate, int64, int64, numbers), max_size=40).map(tuple),
)

EXTREME = LegSense(7, -0.0, TINY, -TINY, 1.7e308, -1.7e308, 2.2e-308, 1 / 3, 0.0, True, False, True)


def exactly(value: Any) -> Any:
    """Return a value in which two floats are equal only when all their bits are."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, tuple):
        return tuple(map(exactly, value))
    return type(value), value


def arrays(cells: list[int], values: list[float], visits: list[int]) -> tuple[Any, Any, Any]:
    """Return the arrays of ``Changes``."""
    return np.array(cells), np.array(values, dtype=np.float64), np.array(visits)


def bare_phase(phase: float) -> bytes:
    """Return a std_msgs/Float64, as the phase travelled before it had a stamp."""
    return cdr.ENCAPSULATION + struct.pack("<d", phase)


def read_sense(leg: str, joints: bytes, contact: bytes) -> LegSense:
    """Read a leg's two messages."""
    reader = wire.SenseWire(leg, TICK_NS)
    tick, first = reader.read_joints(joints)
    same, second = reader.read_contact(contact)
    assert tick == same
    return reader.sense(tick, first, second)


# -- every tick's messages ---------------------------------------------------------------------


@given(legs, senses)
def test_a_sense_survives_bit_for_bit(leg: str, sense: LegSense) -> None:
    """Senses come out of their two messages with every bit they went in with, and every type."""
    joints, contact = wire.SenseWire(leg, TICK_NS).pack(sense)
    assert exactly(read_sense(leg, joints, contact)) == exactly(sense)


@given(legs, senses)
def test_ros_reads_a_sense_as_it_was_meant(leg: str, sense: LegSense) -> None:
    """Rclpy finds in our bytes the names, numbers and stamp that the table of topics promises."""
    joints, contact = (
        deserialize_message(data, JointState) for data in wire.SenseWire(leg, TICK_NS).pack(sense)
    )
    for message in (joints, contact):
        stamp = message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == sense.tick * TICK_NS
        assert 0 <= stamp.nanosec < 10**9
    assert joints.name == ["hip", "knee"]
    assert exactly(tuple(joints.position)) == exactly((sense.hip, sense.knee))
    assert exactly(tuple(joints.velocity)) == exactly((sense.hip_speed, sense.knee_speed))
    assert not joints.effort
    sensed = dict(zip(contact.name, contact.position, strict=True))
    load = dict(zip(contact.name, contact.effort, strict=True))
    assert exactly((sensed["slip"], sensed["inclination"])) == exactly(
        (sense.slip, sense.inclination)
    )
    assert (sensed["hair"], sensed["touch"], sensed["restart"]) == sense[-3:]
    assert exactly((load["load"], load["load_peak"])) == exactly(
        (sense.force_mean, sense.force_peak)
    )
    assert not contact.velocity


@given(legs, commands)
def test_a_command_survives_bit_for_bit(leg: str, command: LegCommand) -> None:
    """A command comes out of its message with every bit; rclpy reads the same numbers."""
    packed = wire.CommandWire(leg, TICK_NS)
    data = packed.pack(command)
    assert exactly(packed.read(data)) == exactly(command)
    message = deserialize_message(data, JointState)
    assert message.name == ["hip", "knee"]
    assert exactly((*message.velocity, *message.effort)) == exactly(command[1:])
    assert not message.position


@given(legs, st.lists(transitions, min_size=1, max_size=3))
def test_a_transition_survives_bit_for_bit(leg: str, said: list[Transition]) -> None:
    """What a leg was paid comes out of its message with every bit, whatever its terms are called.

    The reader is told no names: it finds them in what it hears, also when they change.
    """
    writer, reader = wire.TransitionWire(leg, TICK_NS), wire.TransitionWire(leg, TICK_NS)
    for transition in said:
        data = writer.pack(transition)
        assert exactly(tuple(reader.read(data))) == exactly(tuple(transition))
        message = deserialize_message(data, JointState)
        assert tuple(message.name) == (*wire.TRANSITION, *(name for name, _ in transition.terms))
        said_first = [getattr(transition, name) for name in wire.TRANSITION]
        numbers = [float(value) for value in (*said_first, *(v for _, v in transition.terms))]
        assert exactly(tuple(message.position)) == exactly(tuple(numbers))
        assert not message.velocity
        assert not message.effort


@given(legs, senses, commands, st.text(max_size=30), st.booleans())
def test_a_message_made_by_others_is_read_bit_for_bit(
    leg: str, sense: LegSense, command: LegCommand, frame: str, full: bool
) -> None:
    """What rclpy serializes, with any frame and the third array in use, reads as our own does."""

    def others(data: bytes, spare: str) -> bytes:
        message = deserialize_message(data, JointState)
        message.header.frame_id = frame.replace("\0", "")
        if full:
            setattr(message, spare, [0.5] * len(message.name))
        made: bytes = serialize_message(message)
        return made

    joints, contact = wire.SenseWire(leg, TICK_NS).pack(sense)
    read = read_sense(leg, others(joints, "effort"), others(contact, "velocity"))
    assert exactly(read) == exactly(sense)
    data = wire.CommandWire(leg, TICK_NS).pack(command)
    assert exactly(wire.CommandWire(leg, TICK_NS).read(others(data, "position"))) == exactly(
        command
    )


def test_the_extremes_of_doubles_survive() -> None:
    """Minus zero, subnormals and the largest doubles pass, also where their sum overflows."""
    assert exactly(
        read_sense("front_left", *wire.SenseWire("front_left", TICK_NS).pack(EXTREME))
    ) == exactly(EXTREME)
    most = EXTREME._replace(hip=1.7e308, knee=1.7e308, force_mean=1.7e308, force_peak=1.7e308)
    assert exactly(
        read_sense("front_left", *wire.SenseWire("front_left", TICK_NS).pack(most))
    ) == exactly(most)


@given(ticks, phases)
def test_a_beat_survives_bit_for_bit(tick: int, phase: float) -> None:
    """Any phase at any tick: the stamp and the phase are said apart; rclpy reads the same."""
    packed, beat = wire.BeatWire(TICK_NS), Beat(tick, phase)
    data = packed.pack(beat)
    assert exactly(packed.read(data)) == exactly(beat)
    message = deserialize_message(data, JointState)
    assert message.name == ["cpg"]
    assert exactly(tuple(message.position)) == exactly((phase,))
    assert not message.velocity
    assert not message.effort
    stamp = message.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == tick * TICK_NS
    assert exactly(packed.read(serialize_message(message))) == exactly(beat)


@given(st.integers(0, 2**53 - 1), st.sampled_from([4, 32, 1024]))
def test_a_phase_without_a_stamp_names_its_tick_exactly(tick: int, per_cycle: int) -> None:
    """Of older bags: a phase survives bit for bit, and the tick it stands for comes out of it."""
    phase = tick / per_cycle
    data = bare_phase(phase)
    assert deserialize_message(data, Float64).data == phase
    for each in (data, serialize_message(Float64(data=phase))):
        read = wire.read_bare_phase(each, per_cycle, "cpg/phase")
        assert exactly(read) == exactly(Beat(tick, phase))


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_a_clock_survives_to_the_nanosecond(ns: int) -> None:
    """A time comes out of its message as it went in, by our reader and by rclpy's."""
    data = cdr.pack_clock(ns)
    clock = deserialize_message(data, Clock).clock
    assert clock.sec * 10**9 + clock.nanosec == ns
    assert cdr.read_clock(data, "clock") == ns
    assert cdr.read_clock(serialize_message(Clock(clock=clock)), "clock") == ns


# -- what is refused ---------------------------------------------------------------------------

Change = Callable[[JointState], None]


def setting(field: str, value: Any) -> Change:
    """Return a change of a whole field."""
    return lambda message: setattr(message, field, value)


def putting(field: str, index: int, value: float) -> Change:
    """Return a change of one number."""

    def change(message: JointState) -> None:
        getattr(message, field)[index] = value

    return change


def stamped(sec: int, nanosec: int) -> Change:
    """Return a change of the stamp."""

    def change(message: JointState) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec

    return change


ANY_BAD = [
    (setting("name", ["hip", "toe"]), r"names \['hip', 'toe'\]"),
    (setting("name", ["hip", "hip"]), r"names \['hip', 'hip'\]"),
    (setting("name", []), r"names \[\]"),
    (setting("name", ["hip", "knee", "toe"]), "names|2 numbers in .*; 3, one per name"),
    (stamped(0, TICK_NS - 1), "stamp 15624999 ns"),
    (stamped(0, 1), "stamp 1 ns"),
    (stamped(-1, 0), "stamp -1000000000 ns"),
]
JOINTS_BAD = [
    *ANY_BAD,
    *[(putting("position", n, x), "position") for n in (0, 1) for x in (math.nan, math.inf)],
    *[(putting("velocity", n, x), "velocity") for n in (0, 1) for x in (math.nan, -math.inf)],
    (setting("position", [0.1]), "1 numbers in position"),
    (setting("position", []), "0 numbers in position"),
    (setting("velocity", [0.1] * 3), "3 numbers in velocity"),
    (setting("velocity", []), "0 numbers in velocity; 2, .*measured or commanded speeds"),
]
CONTACT_BAD = [
    *ANY_BAD,
    (putting("position", 0, math.nan), "position"),
    (putting("position", 1, math.inf), "position"),
    (putting("effort", 5, math.nan), "effort"),
    (putting("effort", 6, -math.inf), "effort"),
    (setting("position", [0.0] * 6), "6 numbers in position"),
    (setting("effort", []), "0 numbers in effort"),
    (setting("effort", [0.0] * 8), "8 numbers in effort"),
    *[(putting("position", 2, x), "hair") for x in (2.0, -1.0, 0.5, TINY)],
    *[(putting("position", 3, x), "touch") for x in (2.0, 0.999999)],
    *[(putting("position", 4, x), "restart") for x in (-0.5, 1e300)],
]
COMMAND_BAD = [
    *ANY_BAD,
    (putting("velocity", 0, math.nan), "velocity"),
    (putting("velocity", 1, math.inf), "velocity"),
    (putting("effort", 0, math.nan), "effort"),
    (putting("effort", 1, math.inf), "effort"),
    (setting("velocity", [0.0]), "1 numbers in velocity"),
    (setting("effort", []), "0 numbers in effort"),
    (putting("effort", 0, -1.0), "torque"),
    (putting("effort", 1, -TINY), "torque"),
]


BEAT_BAD = [
    (setting("name", ["cgp"]), r"names \['cgp'\]"),
    (setting("name", ["cpg", "cpg"]), r"names \['cpg', 'cpg'\]"),
    (setting("name", []), r"names \[\]"),
    (setting("position", []), "0 numbers in position"),
    (setting("position", [0.5, 0.5]), "2 numbers in position; 1, one per name"),
    (stamped(0, TICK_NS - 1), "stamp 15624999 ns .*same gait.period"),
    (stamped(-1, 0), "stamp -1000000000 ns"),
    *[(putting("position", 0, x), "not finite") for x in (math.nan, math.inf, -math.inf)],
    *[(putting("position", 0, x), "is no phase; 0 or more") for x in (-1.0, -TINY, 2.0**53)],
]


def turned_round(message: JointState) -> None:
    """Name the joints the other way round, as another driver may."""
    message.name = message.name[::-1]
    for field in ("position", "velocity", "effort"):
        setattr(message, field, getattr(message, field)[::-1])


def with_more(message: JointState) -> None:
    """Name joints of somebody else before and behind; what they read is nobody's concern."""
    message.name = ["ankle", *message.name, "tail"]
    for field in ("position", "velocity", "effort"):
        if values := list(getattr(message, field)):
            setattr(message, field, [math.nan, *values, math.inf])


def with_another_frame(message: JointState) -> None:
    """Say another frame than ours."""
    message.header.frame_id = "base_link"


def changed(data: bytes, change: Change) -> bytes:
    """Return a message's bytes after a change."""
    message = deserialize_message(data, JointState)
    change(message)
    made: bytes = serialize_message(message)
    return made


@pytest.mark.parametrize("change", [turned_round, with_more, with_another_frame])
def test_joints_are_found_by_name(change: Change) -> None:
    """Whatever the order and whoever else is named, each number is that of its joint."""
    senses, wired = wire.SenseWire("rear_left", TICK_NS), wire.CommandWire("rear_left", TICK_NS)
    sense = EXTREME._replace(hip=0.1, knee=0.2, hip_speed=0.3, knee_speed=0.4)
    joints, contact = senses.pack(sense)
    tick, first = senses.read_joints(changed(joints, change))
    _, second = senses.read_contact(changed(contact, change))
    assert repr(senses.sense(tick, first, second)) == repr(sense)
    command = LegCommand(3, 1.0, 2.0, 3.0, 4.0)
    assert wired.read(changed(wired.pack(command), change)) == command
    beats = wire.BeatWire(TICK_NS)
    assert beats.read(changed(beats.pack(Beat(3, 1.5)), change)) == Beat(3, 1.5)


def test_what_is_not_in_use_may_be_anything() -> None:
    """Joint states carry no effort that anybody reads: a driver may say nan, or more of them."""
    senses = wire.SenseWire("rear_left", TICK_NS)
    plain = senses.pack(EXTREME)[0]
    found = senses.read_joints(changed(plain, setting("effort", [math.nan, math.nan])))
    assert found == senses.read_joints(plain)


@pytest.mark.parametrize(("change", "names"), JOINTS_BAD)
def test_malformed_joint_states_are_refused(change: Change, names: str) -> None:
    """The error of a bad ``joint_states`` names the topic and the field."""
    senses = wire.SenseWire("rear_left", TICK_NS)
    with pytest.raises(SignalError, match=f"^rear_left/joint_states: .*{names}"):
        senses.read_joints(changed(senses.pack(EXTREME)[0], change))


@pytest.mark.parametrize(("change", "names"), CONTACT_BAD)
def test_malformed_contacts_are_refused(change: Change, names: str) -> None:
    """The error of a bad ``contact`` names the topic and the field."""
    senses = wire.SenseWire("rear_left", TICK_NS)
    with pytest.raises(SignalError, match=f"^rear_left/contact: .*{names}"):
        senses.read_contact(changed(senses.pack(EXTREME)[1], change))


@pytest.mark.parametrize(("change", "names"), COMMAND_BAD)
def test_malformed_commands_are_refused(change: Change, names: str) -> None:
    """The error of a bad ``command`` names the topic and the field."""
    wired = wire.CommandWire("rear_left", TICK_NS)
    with pytest.raises(SignalError, match=f"^rear_left/command: .*{names}"):
        wired.read(changed(wired.pack(LegCommand(3, 1.0, 2.0, 3.0, 4.0)), change))


@pytest.mark.parametrize(("change", "names"), BEAT_BAD)
def test_malformed_beats_are_refused(change: Change, names: str) -> None:
    """The error of a bad ``cpg/phase`` names the topic and what is wrong; a good one reads."""
    wired = wire.BeatWire(TICK_NS)
    good = wired.pack(Beat(3, 0.5))
    with pytest.raises(SignalError, match=f"^cpg/phase: .*{names}"):
        wired.read(changed(good, change))
    assert wired.read(good) == Beat(3, 0.5)


def test_a_phase_without_a_stamp_is_no_beat() -> None:
    """What nodes of before the stamp say is refused in words, and not read as something else."""
    for data in (bare_phase(0.5), serialize_message(Float64(data=0.5))):
        with pytest.raises(SignalError, match=r"^cpg/phase: 12 bytes are no JointState"):
            wire.BeatWire(TICK_NS).read(data)


PAID = Transition(3, 70, True, 8, (("height", 0.5), ("slip", -0.25)), 71, False, td_error=-0.125)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (setting("name", ["stance", *wire.TRANSITION[2:], "a", "b"]), "names"),
        (setting("name", list(wire.TRANSITION[:2])), "names"),
        (setting("name", ["stance", "state", "action", "height", "slip"]), "names .*'td_error'"),
        (setting("position", [0.0]), "1 numbers in position"),
        *[(putting("position", n, 0.5), r"state, action, next_state \(.*0\.5") for n in (0, 2, 3)],
        *[(putting("position", n, -2.0), r"state, action, next_state \(.*-2") for n in (0, 2, 3)],
        *[(putting("position", n, 2.0), r"stance, next_stance \(.*2\.0") for n in (1, 4)],
        *[(putting("position", n, math.nan), "position") for n in (0, 5, 6, 7)],
    ],
)
def test_malformed_transitions_are_refused(change: Change, names: str) -> None:
    """The error of a bad ``transition`` names the topic and what is wrong; a good one reads."""
    wired = wire.TransitionWire("rear_left", TICK_NS)
    good = wired.pack(PAID)
    with pytest.raises(SignalError, match=f"^rear_left/transition: .*{names}"):
        wired.read(changed(good, change))
    for cut in (0, 3, 12, 40, len(good) - 1):
        with pytest.raises(SignalError, match=r"^rear_left/transition: "):
            wired.read(good[:cut])
    assert wired.read(good) == PAID


def with_one(signal: Any, name: str, value: Any) -> Any:
    """Return a sense or a command with one field changed to anything."""
    return signal._replace(**{name: value})


@given(senses, commands, st.integers(0, 3), not_finite)
def test_our_own_layout_does_not_let_bad_numbers_pass(
    sense: LegSense, command: LegCommand, field: int, bad: float
) -> None:
    """The quick way, taken for bytes laid out as our own, refuses what the slow one refuses."""
    senses_wire, commands_wire = wire.SenseWire("leg", TICK_NS), wire.CommandWire("leg", TICK_NS)
    name = ("hip", "knee", "hip_speed", "knee_speed")[field]
    joints, _ = senses_wire.pack(with_one(sense, name, bad))
    with pytest.raises(SignalError, match=r"^leg/joint_states: .*(position|velocity)"):
        senses_wire.read_joints(joints)
    name = ("slip", "inclination", "force_mean", "force_peak")[field]
    _, contact = senses_wire.pack(with_one(sense, name, bad))
    with pytest.raises(SignalError, match=r"^leg/contact: .*(position|effort)"):
        senses_wire.read_contact(contact)
    name = ("hair", "contact", "first_tick")[field % 3]
    _, contact = senses_wire.pack(with_one(sense, name, 2))
    with pytest.raises(SignalError, match=r"^leg/contact: (hair|touch|restart) is 2"):
        senses_wire.read_contact(contact)
    name = ("hip_speed", "knee_speed", "hip_torque", "knee_torque")[field]
    order = commands_wire.pack(with_one(command, name, bad))
    with pytest.raises(SignalError, match=r"^leg/command: .*(velocity|effort)"):
        commands_wire.read(order)
    name = ("hip_torque", "knee_torque")[field % 2]
    order = commands_wire.pack(with_one(command, name, -TINY))
    with pytest.raises(SignalError, match=r"^leg/command: torque"):
        commands_wire.read(order)


@pytest.mark.parametrize(
    "phase", [math.nan, math.inf, -math.inf, -1.0, -TINY, TINY, 0.01, 1 / 64, 2.0**60]
)
def test_what_names_no_tick_is_no_phase_without_a_stamp(phase: float) -> None:
    """Of older bags: not finite, negative, between ticks, or too large to name a tick."""
    for data in (bare_phase(phase), serialize_message(Float64(data=phase))):
        with pytest.raises(SignalError, match=r"^cpg/phase: .* is no phase"):
            wire.read_bare_phase(data, TICKS, "cpg/phase")


def test_a_clock_before_the_start_is_refused() -> None:
    """Time begins at 0."""
    with pytest.raises(SignalError, match=r"^clock: -1 s is before the start"):
        cdr.read_clock(cdr.pack_clock(-1), "clock")


@given(
    st.binary(max_size=200)
    | st.builds(lambda tail: cdr.ENCAPSULATION + tail, st.binary(max_size=200))
)
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    """Any bytes at all are read or refused with a SignalError: nothing else comes out of them."""
    senses_wire, commands_wire = wire.SenseWire("leg", TICK_NS), wire.CommandWire("leg", TICK_NS)
    readers: list[Callable[[bytes], Any]] = [
        senses_wire.read_joints,
        senses_wire.read_contact,
        commands_wire.read,
        wire.BeatWire(TICK_NS).read,
        wire.TransitionWire("leg", TICK_NS).read,
    ]
    for reader in readers:  # random bytes never carry the names
        with pytest.raises(SignalError):
            reader(data)
    if len(data) < 12:
        with pytest.raises(SignalError, match="bytes are no Float64"):
            wire.read_bare_phase(data, TICKS, "cpg/phase")
        with pytest.raises(SignalError, match="bytes are no Clock"):
            cdr.read_clock(data, "clock")


@given(senses, st.data())
def test_a_message_cut_short_is_refused(sense: LegSense, data: st.DataObject) -> None:
    """Any true prefix of a message is refused: no number is made up for a missing one."""
    wired = wire.SenseWire("front_right", TICK_NS)
    joints, contact = wired.pack(sense)
    # The lengths of the unused arrays may be cut, with the padding before them.
    with pytest.raises(SignalError):
        wired.read_joints(joints[: data.draw(st.integers(0, len(joints) - 5))])
    with pytest.raises(SignalError):
        wired.read_contact(contact[: data.draw(st.integers(0, len(contact) - 5))])


# -- the table's services ----------------------------------------------------------------------


@given(pushes)
def test_a_push_survives_bit_for_bit(push: UpdateBatch) -> None:
    """A push comes out of its request with every bit it went in with."""
    assert exactly(calls.read_push(calls.write_push(push))) == exactly(push)


GOOD = UpdateBatch(
    2, "a run", 5, cells_sha256(Params()), (TDUpdate(160, 3, -0.0), TDUpdate(161, 4, 1 / 3))
)


def of(request: SetParametersAtomically.Request, name: str) -> ParameterValue:
    """Return the value of a field of a push."""
    (parameter,) = (p for p in request.parameters if p.name == name)
    return parameter.value


@pytest.mark.parametrize("name", ["leg", "run", "epoch", "cells_sha256", "tick", "cell", "target"])
def test_a_push_with_a_field_missing_twice_or_of_another_type_is_refused(name: str) -> None:
    """Each field must be there once and have its own type; the error names it."""
    request = calls.write_push(GOOD)
    request.parameters = [p for p in request.parameters if p.name != name]
    with pytest.raises(UpdateError, match=f"^push: {name} missing"):
        calls.read_push(request)
    request = calls.write_push(GOOD)
    request.parameters.append(Parameter(name=name, value=of(request, name)))
    with pytest.raises(UpdateError, match=f"^push: field '{name}' is unknown or repeated"):
        calls.read_push(request)
    for kind in range(12):
        request = calls.write_push(GOOD)
        value = of(request, name)
        if kind != value.type:
            value.type = kind
            with pytest.raises(UpdateError, match=f"^push: {name} has parameter type {kind}"):
                calls.read_push(request)


def test_a_push_with_an_unknown_field_is_refused() -> None:
    """The error names the field and those that are known."""
    request = calls.write_push(GOOD)
    value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True)
    request.parameters.append(Parameter(name="trust_me", value=value))
    with pytest.raises(UpdateError, match=r"'trust_me' is unknown .*leg, run, epoch"):
        calls.read_push(request)


@pytest.mark.parametrize("name", ["tick", "cell", "target"])
def test_a_push_of_unequal_lengths_is_refused(name: str) -> None:
    """Tick, cell and target are as many each."""
    request = calls.write_push(GOOD)
    value = of(request, name)
    if name == "target":
        value.double_array_value = array("d", [0.0])
    else:
        value.integer_array_value = array("q", [1, 2, 3])
    with pytest.raises(UpdateError, match=r"^push: tick, cell and target have"):
        calls.read_push(request)


def test_an_empty_push_is_no_push() -> None:
    """A request without fields names all that are missing."""
    with pytest.raises(UpdateError, match="leg, run, epoch, cells_sha256, tick, cell, target miss"):
        calls.read_push(SetParametersAtomically.Request())


@pytest.mark.parametrize(
    ("bad", "names"),
    [
        (GOOD._replace(cells_sha256="0" * 64), "cells"),
        (GOOD._replace(cells_sha256=""), "cells"),
        (GOOD._replace(leg=-1), "leg -1"),
        (GOOD._replace(leg=4), "leg 4"),
        (GOOD._replace(epoch=-1), "epoch -1"),
        (GOOD._replace(run=""), "run ''"),
        (GOOD._replace(updates=(TDUpdate(1, -1, 0.0),)), "cell -1 is not in"),
        (GOOD._replace(updates=(TDUpdate(1, 10**9, 0.0),)), "cell 1000000000 is not in"),
        (GOOD._replace(updates=(TDUpdate(1, 1, math.nan),)), "target of cell 1 at tick 1 is nan"),
        (GOOD._replace(updates=(TDUpdate(1, 1, -math.inf),)), "target of cell 1 at tick 1 is -inf"),
        (GOOD._replace(updates=(TDUpdate(-1, 1, 0.0),)), "tick -1"),
        (GOOD._replace(updates=(*GOOD.updates, TDUpdate(1, 2, math.nan))), "target of cell 2"),
    ],
)
def test_a_push_that_says_nonsense_is_refused_whole(bad: UpdateBatch, names: str) -> None:
    """Values that fit their types and mean nothing are refused; nothing of the push is taken."""
    params = Params()
    table = empty_table(params)
    shared = SharedTable(table, legs=4, cells=cells_sha256(params), rate=Params().walk.rate)
    before = table.sha256()
    with pytest.raises(UpdateError, match=names):
        shared.push(calls.read_push(calls.write_push(bad)))
    shared.merge()
    assert (table.sha256(), shared.version) == (before, 0)


@given(
    st.integers(0, 2**63 - 1),
    st.lists(st.tuples(st.integers(0, 999), numbers, st.integers(0, 2**63 - 1)), max_size=30),
    st.none() | st.integers(0, 2**62),
    st.integers(-1, 2**62),
)
def test_a_pull_survives_bit_for_bit(
    version: int, content: list[tuple[int, float, int]], since: int | None, upto: int
) -> None:
    """What is asked and what is answered come out as they went in."""
    cells, values, visits = zip(*content, strict=True) if content else ((), (), ())
    changes = Changes(
        version,
        np.array(cells, dtype=np.int64),
        np.array(values, dtype=np.float64),
        np.array(visits, dtype=np.int64),
    )
    asked_since, asked_upto, wanted = calls.read_pull(calls.write_pull(since, upto))
    assert (asked_since, asked_upto) == (-1 if since is None else since, upto)
    response = GetParameters.Response(
        values=calls.write_pull_response(wanted, changes, "meaning", str)
    )
    read = calls.read_changes(response, Table(1000, 1), "meaning")
    assert read.version == version
    for ours, theirs in zip(read[1:], changes[1:], strict=True):
        assert ours.dtype == theirs.dtype
        assert ours.tobytes() == theirs.tobytes()


def test_a_pull_of_the_whole_table_is_the_table() -> None:
    """Pulled without bounds, every cell comes with its value and its visits."""
    table = Table(5, 3)
    for cell in range(15):
        table.write(cell, -cell / 7, cell)
    table.write(3, -0.0, 1)
    shared = SharedTable(table, legs=4, cells="", rate=Params().walk.rate)
    request = GetParameters.Request(names=["about", "visits", "values", "cells", "version"])
    since, upto, wanted = calls.read_pull(request)
    assert (since, upto, wanted) == (None, None, request.names)
    about, visits, values, cells, version = calls.write_pull_response(
        wanted, shared.pull(since, upto), "meaning", lambda: "{}"
    )
    assert about.string_value == "{}"
    assert version.integer_value == 0
    assert list(cells.integer_array_value) == list(range(15))
    assert values.double_array_value.tobytes() == table.values.tobytes()
    assert visits.integer_array_value.tobytes() == table.visits.tobytes()


@pytest.mark.parametrize(
    "name",
    ["", "value", "since", "since=", "since=x", "since=1.5", "upto=--1", "version=1", "cells "],
)
def test_a_pull_of_something_unknown_is_refused(name: str) -> None:
    """The error names what was asked and what may be asked."""
    with pytest.raises(UpdateError, match=rf"^pull: '{name}' is unknown; .*cells_sha256, about"):
        calls.read_pull(GetParameters.Request(names=["version", name]))


@pytest.mark.parametrize("name", [f"since={2**63}", f"upto={2**63}", f"since=-{2**63 + 1}"])
def test_a_pull_with_a_bound_that_is_no_64_bit_integer_is_refused(name: str) -> None:
    """A bound that no version or epoch can have is refused, not passed on to raise elsewhere."""
    with pytest.raises(UpdateError, match=r"^pull: "):
        calls.read_pull(GetParameters.Request(names=[name, "version"]))


def test_an_empty_answer_to_a_pull_is_a_refusal() -> None:
    """A leg that is answered nothing says so, and takes nothing."""
    with pytest.raises(UpdateError, match="refused"):
        calls.read_changes(GetParameters.Response(), Table(5, 3), "meaning")


@pytest.mark.parametrize(
    ("changes", "meaning", "why"),
    [
        (Changes(1, *arrays([15], [0.5], [1])), "meaning", "cells outside 0 to 14"),
        (Changes(1, *arrays([-1], [0.5], [1])), "meaning", "cells outside 0 to 14"),
        (Changes(1, *arrays([3], [math.nan], [1])), "meaning", "not finite"),
        (Changes(1, *arrays([3], [math.inf], [1])), "meaning", "not finite"),
        (Changes(1, *arrays([3], [0.5], [-1])), "meaning", "negative visits"),
        (Changes(1, *arrays([3, 4], [0.5], [1])), "meaning", "differ in length"),
        (Changes(1, *arrays([3], [0.5], [1])), "another", "learned with other parameters"),
    ],
)
def test_an_answer_that_does_not_fit_a_leg_s_table_is_refused(
    changes: Changes, meaning: str, why: str
) -> None:
    """It is refused whole, before any cell is written."""
    _, _, wanted = calls.read_pull(calls.write_pull(None, 0))
    values = calls.write_pull_response(wanted, changes, meaning, str)
    with pytest.raises(UpdateError, match=why):
        calls.read_changes(GetParameters.Response(values=values), Table(5, 3), "meaning")


def test_a_pull_of_too_many_names_is_refused() -> None:
    """Three thousand times the values would be gigabytes."""
    for names in (["values"] * 2, [f"since={n}" for n in range(calls.MAX_NAMES + 1)]):
        with pytest.raises(UpdateError, match=f"up to {calls.MAX_NAMES}, each once"):
            calls.read_pull(GetParameters.Request(names=names))


def test_signals_have_no_field_that_wire_forgets() -> None:
    """Every field of every signal differs in what it does to the bytes."""
    sense, command = EXTREME, LegCommand(3, 1.0, 2.0, 3.0, 4.0)
    senses_wire, commands_wire = wire.SenseWire("leg", TICK_NS), wire.CommandWire("leg", TICK_NS)
    packed = {senses_wire.pack(sense)}
    for field in sense._fields:
        packed.add(senses_wire.pack(with_one(sense, field, 1 - getattr(sense, field))))
    assert len(packed) == 1 + len(sense._fields)
    orders = {commands_wire.pack(command)}
    for field in command._fields:
        orders.add(commands_wire.pack(with_one(command, field, getattr(command, field) + 1)))
    assert len(orders) == 1 + len(command._fields)
    beat, beats_wire = Beat(3, 0.5), wire.BeatWire(TICK_NS)
    beats = {beats_wire.pack(each) for each in (beat, Beat(4, 0.5), Beat(3, 1.5))}
    assert len(beats) == 1 + len(Beat._fields)
    paid_wire = wire.TransitionWire("leg", TICK_NS)
    other = Transition(4, 71, False, 7, (("height", 0.5), ("slip", 0.25)), 72, True, td_error=0.5)
    paid = {paid_wire.pack(PAID)}
    for field in PAID._fields:
        paid.add(paid_wire.pack(with_one(PAID, field, getattr(other, field))))
    assert len(paid) == 1 + len(PAID._fields)


def test_cells_that_mean_something_else_have_another_sha256() -> None:
    """A push learnt with another partition names other cells."""
    params = Params()
    other = dataclasses.replace(params, state=dataclasses.replace(params.state, hip_bins=16))
    assert cells_sha256(params) != cells_sha256(other)
