"""What every storage of a bag returns: topics, messages, and sources of messages. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias


class Connection(NamedTuple):
    """A topic with one type, as the files define it."""

    topic: str
    msgtype: str
    msgcount: int
    encoding: str
    """Of its messages: ``cdr``, or one that is not read here."""
    schema: tuple[str, bytes]
    """The format of its type's definition, ``ros2msg`` or ``ros2idl``, and the definition."""
    metadata: dict[str, str]
    """What else the file has on it: QoS profiles, the hash of its type."""


class Message(NamedTuple):
    """One message of a bag."""

    ns: int
    topic: str
    kind: str
    data: bytes


Key: TypeAlias = "tuple[str, str]"
"""A topic and its type."""


class Source(NamedTuple):
    """Messages in the order of their times; it is opened when its first message is next."""

    first: int
    messages: Callable[[], Iterator[Message]]
    size: int
    """Bytes of memory that it needs while it is open."""
