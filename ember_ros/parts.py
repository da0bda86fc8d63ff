"""The parts of a robot that can be swapped, found by their dotted paths.

``parts.reward: my_package.rewards.Mine`` in a parameter file, ``--set``, or ``ros2 run ... -p``
names a class (or a function that makes one) in a module that can be imported where the robot runs.
"""

from __future__ import annotations

import importlib
from typing import Any

from ember_ros.errors import ParameterError, shown
from ember_ros.params import Params


def find(path: str, name: str) -> Any:
    """Return what a dotted path names.

    Args:
        path: of a module and a name in it, ``package.module.Class``.
        name: of the parameter that it was given by, for the error.

    Raises:
        ParameterError: it cannot be imported, or the module has no such name.
    """
    module, _, attribute = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise ParameterError(
            f"{name} = {shown(path)}: there is no module {error.name!r} to be imported here; an "
            "installed package, or a folder in PYTHONPATH, would be right"
        ) from error
    except (ImportError, ValueError, AttributeError) as error:
        raise ParameterError(f"{name} = {shown(path)} cannot be used: {error}") from error


def make(params: Params, part: str, *args: Any) -> Any:
    """Return a new part of a robot.

    Args:
        params: that name it.
        part: a field of ``params.parts``.
        *args: that such a part is made with.

    Raises:
        ParameterError: it cannot be found, or made.
    """
    path, name = getattr(params.parts, part), f"parts.{part}"
    found = find(path, name)
    if not callable(found):
        raise ParameterError(f"{name} = {shown(path)} is no class; a class would be right")
    try:
        return found(*args)
    except TypeError as error:
        raise ParameterError(f"{name} = {shown(path)} cannot be made: {error}") from error
