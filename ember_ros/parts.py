"""The parts of a robot that can be swapped, found by their dotted paths.

``parts.reward: my_package.rewards.Mine`` in a parameter file, ``--set``, or ``ros2 run ... -p``
names a class (or a function that makes one) in a module that can be imported where the robot runs.
"""

from __future__ import annotations

import importlib
from typing import Any

from ember_ros.errors import ParameterError, shown
from ember_ros.params import Params

FACES = {
    "cpg": ("step",),
    "gait": ("step",),
    "discretizer": ("shape", "neighbours", "index"),
    "reward": ("names", "terms"),
    "value": ("q_values",),
    "learner": ("q_values", "learn", "reset"),
    "policy": ("choose",),
    "world": ("legs", "over", "work", "observe", "step", "body", "reset", "close"),
}
"""What each part has, as its protocol says."""


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
        own = module == "__main__"
        why = (
            "what a notebook or a script defines is known in its own process alone, once it is "
            "defined; a class in a module that can be imported would be right"
        )
        raise ParameterError(
            f"{name} = {shown(path)} cannot be used: {why if own else error}"
        ) from error


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
    return build(found, part, f"{name} = {shown(path)}", *args)


def build(found: Any, part: str, where: str, *args: Any, **options: Any) -> Any:
    """Return a new part, held to having what others use of it.

    Args:
        found: its class, or a function that makes one.
        part: what it is to be, one of ``FACES``.
        where: it was named, for the error.
        *args: that such a part is made with.
        **options: the same, by name.

    Raises:
        ParameterError: it cannot be made, or lacks something.
    """
    if not callable(found):
        raise ParameterError(f"{where} is no class; a class would be right")
    try:
        made = found(*args, **options)
    except TypeError as error:
        raise ParameterError(f"{where} cannot be made: {error}") from error
    if missing := [name for name in FACES[part] if not hasattr(made, name)]:
        raise ParameterError(
            f"{where} makes a {type(made).__name__} without {', '.join(missing)}; a {part} has "
            f"{', '.join(FACES[part])}"
        )
    return made
