"""The options that several commands share.

Options that nodes have too take their meaning, choices, range and default from
``ember_ros.options``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from ember_ros.options import MINIMA, OPTIONS
from ember_ros.params_file import config_names, read_settings

Decorator = Callable[[Any], Any]
"""A decorator that adds an option to a command."""


def combined(*options: Decorator) -> Decorator:
    """Return a decorator that adds several options, listed by ``--help`` in this order."""

    def add(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return add


# -- types of values ---------------------------------------------------------------------------


class _Folder(click.Path):
    """A folder; an empty name, which would be the working directory, is refused."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return its path."""
        if value == "":
            self.fail("'' is not a folder; `.` is the working directory", param, ctx)
        return super().convert(value, param, ctx)


class _ChoiceOrPath(click.Choice):  # type: ignore[type-arg, unused-ignore]
    """One of some names, or the dotted path of a class."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the name or the path; whether there is such a class is seen when it is made."""
        return value if "." in value else super().convert(value, param, ctx)


class FiniteRange(click.FloatRange):
    """A number in a range; ``nan`` and ``inf`` are refused."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the number."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


class _Namespace(click.ParamType):  # type: ignore[type-arg, unused-ignore]
    """A ROS namespace: names of letters, digits and _, separated by slashes."""

    name = "namespace"

    def convert(self, value: str, param: Any, ctx: Any) -> str:
        """Return the namespace without slashes around it."""
        name = value.strip("/")
        if name and not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
            self.fail(
                f"{value!r} is not a namespace; letters, digits and _ would be right: robot_2"
            )
        return name


FILE, FOLDER = click.Path(path_type=Path), _Folder(path_type=Path, file_okay=False)


# -- options that nodes have too ---------------------------------------------------------------


def shared_with_nodes(flag: str, *, also: str = "", **other: Any) -> Decorator:
    """Return an option that nodes have too, with the same meaning, type and default.

    Args:
        flag: its name: ``--split-mb`` for the nodes' ``split_mb``.
        also: text after the meaning.
        **other: arguments of ``click.option`` that differ from the node's option.
    """
    name = flag.removeprefix("--").replace("-", "_")
    option = OPTIONS[name]
    meaning = option.doc.partition("; ''")[0]  # on the command line, one leaves the option out
    arguments: dict[str, Any] = {
        "default": None if option.default == "" else option.default,
        "show_default": option.default != "",
        "help": f"{meaning[0].upper()}{meaning[1:]}{also}.",
    }
    if option.path:
        arguments["type"] = FILE
    elif option.choices:
        arguments["type"] = (
            _ChoiceOrPath(option.choices) if option.dotted else click.Choice(option.choices)
        )
    elif isinstance(option.default, float):
        arguments["type"] = FiniteRange(float(MINIMA[name]))
    return click.option(flag, **{**arguments, **other})


TABLE = shared_with_nodes(
    "--table", also="; `trained` comes with the package. Default: an empty one"
)
SEED = shared_with_nodes("--seed", type=int)  # RunConfig checks its range
RECORD = combined(
    shared_with_nodes("--bag", also="; see `ember replay --help`"),
    shared_with_nodes("--split-mb"),
    shared_with_nodes("--split-s"),
)


# -- the robot -----------------------------------------------------------------------------------


def _settings(
    context: click.Context, parameter: click.Parameter, settings: tuple[str, ...]
) -> tuple[str, ...]:
    read_settings(settings)  # report a wrong one before any file is opened
    return settings


PARAMS = combined(
    click.option(
        "--params",
        "params_files",
        multiple=True,
        type=FILE,
        help="A ROS parameter file (section /**; `ember params` prints one), or the name of one "
        f"that comes with the package: {', '.join(config_names())}. May be repeated; later files "
        "override earlier ones.",
    ),
    click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="GROUP.FIELD=VALUE",
        callback=_settings,
        help="One parameter, which overrides --params. May be repeated.",
    ),
)
NAMESPACE = click.option(
    "--namespace",
    type=_Namespace(),
    default="",
    help="Namespace of all nodes, such as robot_2, to run beside another robot on the graph.",
)


# -- how a command runs --------------------------------------------------------------------------


def cycles(
    default: int | None, text: str, *, minimum: int | None = None, flag: str = ""
) -> Decorator:
    """Return the option for the number of cycles.

    Args:
        default: shown by ``--help`` unless it is None.
        text: the help text.
        minimum: fewest cycles; checked by ``RunConfig`` for None.
        flag: its name, if it is not ``--cycles``.
    """
    kind = int if minimum is None else click.IntRange(minimum)
    shown = default is not None
    return click.option(
        flag or "--cycles", type=kind, default=default, show_default=shown, help=text
    )


def backend(backends: Sequence[str], default: str, text: str) -> Decorator:
    """Return the option ``--on``; the command receives it as ``backend``."""
    return click.option(
        "--on",
        "backend",
        type=click.Choice(backends),
        default=default,
        show_default=True,
        help=text,
    )


def out(default: str, holds: str) -> Decorator:
    """Return the option for the output folder."""
    return click.option(
        "--out", type=FOLDER, default=default, show_default=True, help=f"Folder for {holds}."
    )


def force(
    text: str = "Replace an earlier run in --out once the new one has finished a cycle.",
) -> Decorator:
    """Return the option that allows a command to replace files."""
    return click.option("--force", is_flag=True, help=text)


# -- bags ----------------------------------------------------------------------------------------

BAG = click.argument("bag", type=FILE)


def namespace_in_bag(also: str = "") -> Decorator:
    """Return the option that selects a robot in a bag by its namespace."""
    text = f"Namespace of the robot, if the bag holds more than one{also}."
    return click.option("--namespace", type=_Namespace(), help=text)
