"""Every error this package raises on purpose, under one base class.

A message names what is wrong, where, and what would be right.
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
"""What pip calls the libraries that may be missing, by the name they are imported under."""
APT = ("click", "matplotlib", "numpy", "pandas", "rich", "scipy", "yaml")
"""Those of them that Ubuntu has as well, each as ``python3-<name>``."""

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 2, 100, 100


def shown(value: Any) -> str:
    """Return how a value that somebody else gave is shown in a message: short, whatever it is."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python prints no number of more than 4300 digits
        return "a number of thousands of digits"


class EmberError(Exception):
    """Base of all errors that ember_ros raises on purpose.

    A message is short and can be printed, whatever a file or a message of others put into it.
    """

    MAX_LENGTH = 2000
    """Characters; of a longer message the middle is left out."""
    code = 2
    """With which a command ends that says it."""

    def __str__(self) -> str:
        """Return the message."""
        text, half = super().__str__(), self.MAX_LENGTH // 2 - 3
        if len(text) > self.MAX_LENGTH:
            text = f"{text[:half]} ... {text[-half:]}"
        # What a terminal would obey, and what no encoding has, is spelt out.
        return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class ParameterError(EmberError):
    """A parameter is unknown, of the wrong type, or out of its range."""


class TableError(EmberError):
    """A Q-table file is missing, damaged, or was learnt with another meaning of its cells."""


class RunError(EmberError):
    """A folder holds no finished run, or a run nothing of what is asked of it."""


class UpdateError(EmberError):
    """A push of learnt pairs is malformed and is refused as a whole."""


class SignalError(EmberError):
    """A message does not carry what its topic promises."""


class GraphError(EmberError):
    """The node graph did not come up, or a process of it ended before its time."""


class BagError(EmberError):
    """A bag is missing, damaged, of something else, or cannot be written."""


class StoppedError(EmberError):
    """A run was stopped by Ctrl-C before there was anything to keep."""

    code = 130


class MissingError(EmberError):
    """A library is not installed."""

    def __init__(self, name: str, why: str = "") -> None:
        """Say how to get the library that is imported as ``name``, and what for if that helps."""
        apt = f" or `sudo apt install python3-{name}`" if name in APT else ""
        needed = f", and is needed {why}" if why else ""
        super().__init__(f"{name} is not installed{needed}: `pip install {PIP[name]}`{apt}")


def need(*names: str, why: str) -> None:
    """Look for libraries for the sake of the error: now, and not when all has been worked out.

    Raises:
        MissingError: one is not installed.
    """
    for name in names:
        try:
            found = importlib.util.find_spec(name)
        except ModuleNotFoundError:
            found = None
        if found is None:
            raise MissingError(name, why)


def no_ros(error: ModuleNotFoundError) -> EmberError:
    """Return what to say of a module of ROS that is missing; one of our own is raised as it is."""
    if (error.name or "").partition(".")[0] in ("ember_ros", "leg_node", "sim_node", "cpg_node"):
        raise error
    return ParameterError(
        f"ROS 2 is not here ({error}): `pip install 'ember_ros[ros]'`, or source an installed "
        "Jazzy, with the Python that it is built for; `--on loop` needs none"
    )
