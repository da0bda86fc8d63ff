"""CDR byte by byte: alignment, strings, stamps, and messages of one value or array.

``ember_ros.wire`` builds on it to convert the robot's messages. A message with the layout that this
file writes is read with ``struct``; any other layout goes through ``deserialize``, the only
function here that needs ROS.

Readers raise a ``SignalError`` that names what, where, and what would be right.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from typing import Any

from ember_ros import topics
from ember_ros.errors import ParameterError, SignalError

NS_PER_S = 1_000_000_000
ENCAPSULATION = b"\x00\x01\x00\x00"
"""The first four bytes of every message: plain CDR, little endian."""

Bytes = bytes | bytearray | memoryview

_CLOCK = struct.Struct("<4siI")


# -- parts of a message ----------------------------------------------------------------------


def deserialize(data: Bytes, kind: str, where: str) -> Any:
    """Return the message object in bytes of any layout.

    Raises:
        SignalError: they are no message of type ``kind``.
        ParameterError: ROS is not installed.
    """
    try:
        from rclpy.serialization import deserialize_message
    except ModuleNotFoundError as error:
        raise ParameterError(
            f"{where}: the message has not the layout of ember_ros, and only ROS 2 reads others: "
            "`pip install 'ember_ros[ros]'`, or source an installed Jazzy"
        ) from error
    try:
        return deserialize_message(bytes(data), topics.class_of(kind))
    except Exception as error:  # rclpy raises its own RCLError and RuntimeError
        name = kind.rpartition("/")[2]
        raise SignalError(f"{where}: {len(data)} bytes are no {name}") from error


def pad(data: bytes, size: int) -> bytes:
    """Return data padded with zeros to a multiple of ``size`` bytes: CDR aligns every number."""
    return data + bytes(-len(data) % size)


def append_string(data: bytes, text: str) -> bytes:
    """Return data with a CDR string appended."""
    coded = text.encode() + b"\0"
    return pad(data, 4) + struct.pack("<I", len(coded)) + coded


def set_stamp(stamp: Any, ns: int) -> None:
    """Set a message object's stamp to ``ns``."""
    stamp.sec, stamp.nanosec = divmod(ns, NS_PER_S)


def stamp_of(data: Bytes, where: str) -> int:
    """Return the stamp, ns, of any message that begins with a std_msgs/Header.

    Raises:
        SignalError: it is too short, or not plain little-endian CDR.
    """
    if len(data) < _CLOCK.size or data[:4] != ENCAPSULATION:
        raise SignalError(f"{where}: {len(data)} bytes have no stamp in plain little-endian CDR")
    _, sec, nanosec = _CLOCK.unpack_from(data)
    return int(sec * NS_PER_S + nanosec)


def joint_names(data: Bytes, where: str) -> Iterator[str]:
    """Yield the names in a sensor_msgs/JointState of plain little-endian CDR.

    Raises:
        SignalError: it is no such message.
    """
    content, at = bytes(data[4:]), 8
    try:
        if data[:4] != ENCAPSULATION:
            raise ValueError
        (length,) = struct.unpack_from("<I", content, at)
        at += 4 + length
        at += -at % 4
        (count,) = struct.unpack_from("<I", content, at)
        at += 4
        for _ in range(count):
            at += -at % 4
            (length,) = struct.unpack_from("<I", content, at)
            at += 4 + length
            if at > len(content):
                raise ValueError
            yield content[at - length : at].decode().removesuffix("\0")
    except (struct.error, ValueError) as error:
        raise SignalError(f"{where}: {len(content)} bytes are no plain JointState") from error


# -- complete messages -----------------------------------------------------------------------


def pack_clock(ns: int) -> bytes:
    """Return a rosgraph_msgs/Clock."""
    return _CLOCK.pack(ENCAPSULATION, *divmod(ns, NS_PER_S))


def read_clock(data: Bytes, where: str) -> int:
    """Return the time in a rosgraph_msgs/Clock, ns.

    Raises:
        SignalError: it is no Clock, or before the start.
    """
    if len(data) == _CLOCK.size and data[:4] == ENCAPSULATION:
        _, sec, nanosec = _CLOCK.unpack(data)
    else:
        clock = deserialize(data, topics.CLOCK.kind, where).clock
        sec, nanosec = clock.sec, clock.nanosec
    if sec < 0:
        raise SignalError(f"{where}: {sec} s is before the start")
    return int(sec * NS_PER_S + nanosec)


_INT = struct.Struct("<4sq")


def pack_int(number: int) -> bytes:
    """Return a std_msgs/Int64."""
    return _INT.pack(ENCAPSULATION, number)


def read_int(data: Bytes, where: str, least: int = 0) -> int:
    """Return the number in a std_msgs/Int64.

    Raises:
        SignalError: it is no Int64, or less than ``least``.
    """
    if len(data) == _INT.size and data[:4] == ENCAPSULATION:
        number = int(_INT.unpack(data)[1])
    else:
        number = int(deserialize(data, topics.FALLS.kind, where).data)
    if number < least:
        raise SignalError(f"{where}: {number}; {least} or more would be right")
    return number


def pack_text(text: str) -> bytes:
    """Return a std_msgs/String."""
    return ENCAPSULATION + append_string(b"", text)


def read_text(data: Bytes, where: str) -> str:
    """Return the text in a std_msgs/String.

    Raises:
        SignalError: it is no String.
    """
    data = bytes(data)
    if data[:4] != ENCAPSULATION or len(data) < 8:
        raise SignalError(f"{where}: {len(data)} bytes are no String")
    (length,) = struct.unpack_from("<I", data, 4)
    try:
        return data[8 : 8 + length].decode().removesuffix("\0")
    except UnicodeDecodeError as error:
        raise SignalError(f"{where}: the text is no UTF-8") from error


MAX_DIMENSIONS = 4
_WIDTHS = {"d": 8, "q": 8, "I": 4}


def pack_array(
    code: str, labels: Sequence[str], shape: Sequence[int], numbers: bytes, offset: int = 0
) -> bytes:
    """Return a std_msgs/Float64MultiArray, Int64MultiArray or UInt32MultiArray.

    Args:
        code: ``struct``'s format of a number: ``d``, ``q`` or ``I``.
        labels: of the dimensions.
        shape: their sizes; the strides are row-major, as std_msgs defines them.
        numbers: all, little endian; ``offset`` of them are before the array.
        offset: ``layout.data_offset``.
    """
    data = struct.pack("<I", len(shape))
    for n, (label, size) in enumerate(zip(labels, shape, strict=True)):
        data = pad(append_string(data, label), 4)
        data += struct.pack("<II", size, math.prod(shape[n:]))
    data += struct.pack("<II", offset, len(numbers) // _WIDTHS[code])
    return ENCAPSULATION + pad(data, _WIDTHS[code]) + numbers


def read_array(data: Bytes, code: str, where: str) -> tuple[tuple[int, ...], bytes, bytes]:
    """Return the shape, the numbers before the array, and those of the array, little endian.

    Raises:
        SignalError: it is no such array.
    """
    data, width = bytes(data)[4:] if data[:4] == ENCAPSULATION else b"", _WIDTHS[code]
    try:
        (dims,) = struct.unpack_from("<I", data, 0)
        at, shape = 4, []
        for _ in range(min(dims, MAX_DIMENSIONS + 1)):
            (length,) = struct.unpack_from("<I", data, at)
            at += 4 + length
            at += -at % 4
            shape.append(struct.unpack_from("<II", data, at)[0])
            at += 8
        offset, count = struct.unpack_from("<II", data, at)
        at += 8
        at += -at % width
    except struct.error as error:
        raise SignalError(f"{where}: {len(data)} bytes are no array") from error
    if dims > MAX_DIMENSIONS:
        raise SignalError(
            f"{where}: an array of {dims} dimensions; up to {MAX_DIMENSIONS} would be right"
        )
    numbers = data[at : at + width * count]
    if len(numbers) != width * count or count != offset + math.prod(shape):
        raise SignalError(
            f"{where}: {len(numbers) // width} numbers; {offset} and {shape} would be right"
        )
    return tuple(shape), numbers[: width * offset], numbers[width * offset :]
