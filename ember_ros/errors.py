"""Every error this package raises on purpose, under one base class.

A message names what is wrong, where, and what would be right.
"""

from __future__ import annotations

import reprlib
from typing import Any

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 2, 100, 100


def shown(value: Any) -> str:
    """Return how a value that somebody else gave is shown in a message: short, whatever it is."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python prints no number of more than 4300 digits
        return "a number of thousands of digits"


class EmberError(Exception):
    """Base of all errors that ember_ros raises on purpose."""


class ParameterError(EmberError):
    """A parameter is unknown, of the wrong type, or out of its range."""


class TableError(EmberError):
    """A Q-table file is missing, damaged, or was learnt with another meaning of its cells."""


class PushError(EmberError):
    """A push of learnt pairs is malformed and is refused as a whole."""


class SignalError(EmberError):
    """A message does not carry what its topic promises."""


class GraphError(EmberError):
    """The node graph did not come up, or a process of it ended before its time."""


class BagError(EmberError):
    """A bag is missing, damaged, of something else, or cannot be written."""
