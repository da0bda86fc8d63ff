"""The exceptions of this package, under one base class.

A message states what is wrong, where, and what would be right.
"""

from __future__ import annotations

import importlib.util
import reprlib
from typing import Any

PIP = {
    "click": "click",
    "gymnasium": "'ember_ros[envs]'",
    "matplotlib": "matplotlib",
    "mcap": "mcap",
    "numpy": "numpy",
    "pandas": "pandas",
    "pettingzoo": "'ember_ros[envs]'",
    "pybullet": "pybullet",
    "rich": "rich",
    "rosbags": "'rosbags<0.12'",
    "scipy": "scipy",
    "yaml": "PyYAML",
}
"""Import name of each library that may be missing: what pip installs it by."""
APT = ("click", "matplotlib", "numpy", "pandas", "rich", "scipy", "yaml")
"""Those of them that Ubuntu packages as ``python3-<name>``."""

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 2, 100, 100


def shown(value: Any) -> str:
    """Return a short form of a value of any size from outside, for a message."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python does not print integers of more than 4300 digits
        return "a number with thousands of digits"


class EmberError(Exception):
    """Base class of all errors of this package.

    The message is short and printable, even if it contains text from a file or a ROS message.
    """

    MAX_LENGTH = 2000
    """Maximum number of characters; a longer message is shortened in the middle."""
    code = 2
    """Exit code of a command that ends with this error."""

    def __str__(self) -> str:
        """Return the message."""
        text, half = super().__str__(), self.MAX_LENGTH // 2 - 3
        if len(text) > self.MAX_LENGTH:
            text = f"{text[:half]} ... {text[-half:]}"
        # Control characters and characters that cannot be encoded are escaped.
        return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class ParameterError(EmberError):
    """A parameter is unknown, has the wrong type, or is out of range."""


class TableError(EmberError):
    """A Q-table file is missing, is damaged, or its cells have another meaning."""


class RunError(EmberError):
    """A folder holds no finished run, or the run does not have the requested data."""


class UpdateError(EmberError):
    """A push of table updates, or a pull, is malformed and is refused as a whole."""


class SignalError(EmberError):
    """A message does not have the content that its topic requires."""


class GraphError(EmberError):
    """The node graph did not start, or one of its processes ended too early."""


class BagError(EmberError):
    """A bag is missing, is damaged, has other content, or cannot be written."""


class StoppedError(EmberError):
    """A run was stopped by Ctrl-C before it had any result."""

    code = 130


class MissingError(EmberError):
    """A library is not installed."""

    def __init__(self, name: str, why: str = "") -> None:
        """Build the message with the command that installs the library.

        Args:
            name: its import name, a key of ``PIP``.
            why: what it is needed for, as ``to draw figures``.
        """
        apt = f" or `sudo apt install python3-{name}`" if name in APT else ""
        needed = f", and is needed {why}" if why else ""
        super().__init__(f"{name} is not installed{needed}: `pip install {PIP[name]}`{apt}")


def need(*names: str, why: str) -> None:
    """Check before a long computation that libraries are installed.

    Raises:
        MissingError: one is not installed.
    """
    for name in names:
        try:
            spec = importlib.util.find_spec(name)
        except ModuleNotFoundError:
            spec = None
        if spec is None:
            raise MissingError(name, why)


def no_ros(error: ModuleNotFoundError) -> EmberError:
    """Return the error for a missing ROS module; a missing module of this package is raised."""
    if (error.name or "").partition(".")[0] in ("ember_ros", "leg_node", "sim_node", "cpg_node"):
        raise error
    return ParameterError(
        f"ROS 2 is not available ({error}): `pip install 'ember_ros[ros]'`, or source an installed "
        "Jazzy, with the Python that it is built for; `--on loop` does not need ROS"
    )
