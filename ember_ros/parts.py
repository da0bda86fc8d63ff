"""Imports the exchangeable parts of a robot by their dotted paths, and creates them.

``parts.reward: my_package.rewards.Mine`` in a parameter file, ``--set``, or ``ros2 run ... -p``
names a class, or a function that returns an object, in a module that can be imported where the
robot runs.
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
    "learner": ("q_values", "learn", "flush"),
    "policy": ("choose",),
    "world": ("legs", "over", "work", "observe", "step", "body", "reset", "close"),
}
"""The attributes that each part must have, as in its protocol."""


def find(path: str, name: str) -> Any:
    """Return the object that a dotted path names.

    Args:
        path: a module and a name in it, ``package.module.Class``.
        name: the parameter that holds the path, for the error message.

    Raises:
        ParameterError: the module cannot be imported, or has no such name.
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
    """Create a part of a robot.

    Args:
        params: ``params.parts`` holds its dotted path.
        part: a field of ``params.parts``.
        *args: arguments for the part's constructor.

    Raises:
        ParameterError: it cannot be imported or created, or lacks an attribute.
    """
    path, name = getattr(params.parts, part), f"parts.{part}"
    found = find(path, name)
    return build(found, part, f"{name} = {shown(path)}", *args)


def build(found: Any, part: str, where: str, *args: Any, **options: Any) -> Any:
    """Create a part and check that it has all attributes in ``FACES``.

    Args:
        found: its class, or a function that returns the part.
        part: the kind of part, a key of ``FACES``.
        where: the source of the name, for the error message.
        *args: arguments for ``found``.
        **options: keyword arguments for ``found``.

    Raises:
        ParameterError: it cannot be created, or lacks an attribute.
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
