"""Every option that more than one command has, once.

What a node is told too (``ember_ros.options``) has its meaning, choices, range and default from
there.
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

Adds = Callable[[Any], Any]
"""What adds an option to a command."""


def together(*options: Adds) -> Adds:
    """Return what adds several options, which help tells in this order."""

    def add(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return add


# -- what a value may be -----------------------------------------------------------------------


class _Folder(click.Path):
    """A folder; no name is none: it would be this folder here."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return its path."""
        if value == "":
            self.fail("'' names no folder; `.` is the one you are in", param, ctx)
        return super().convert(value, param, ctx)


class FiniteRange(click.FloatRange):
    """A number in a range; ``nan`` and ``inf`` are in none."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the number."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is no finite number", param, ctx)
        return number


class _Namespace(click.ParamType):  # type: ignore[type-arg, unused-ignore]
    """The name of a robot: words as ROS has them, with slashes between them."""

    name = "namespace"

    def convert(self, value: str, param: Any, ctx: Any) -> str:
        """Return the namespace without slashes around it."""
        name = value.strip("/")
        if name and not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
            self.fail(f"{value!r} is no namespace; letters, digits and _ would be right: robot_2")
        return name


FILE, FOLDER = click.Path(path_type=Path), _Folder(path_type=Path, file_okay=False)


# -- what nodes are told too -------------------------------------------------------------------


def of_node(flag: str, *, also: str = "", **other: Any) -> Adds:
    """Return an option that nodes have too: it says the same and takes the same.

    Args:
        flag: its name, as ``--split-mb`` of the nodes' ``split_mb``.
        also: what is said behind the meaning.
        **other: what is not as nodes have it, as ``click.option`` takes it.
    """
    name = flag.removeprefix("--").replace("-", "_")
    option = OPTIONS[name]
    meaning = option.doc.partition("; ''")[0]  # here, none is an option that is not given
    given: dict[str, Any] = {
        "default": None if option.default == "" else option.default,
        "show_default": option.default != "",
        "help": f"{meaning[0].upper()}{meaning[1:]}{also}.",
    }
    if option.path:
        given["type"] = FILE
    elif option.choices:
        given["type"] = click.Choice(option.choices)
    elif isinstance(option.default, float):
        given["type"] = FiniteRange(float(MINIMA[name]))
    return click.option(flag, **{**given, **other})


TABLE = of_node("--table", also="; `trained` comes with the package. Default: an empty one")
SEED = of_node("--seed", type=int)  # the plan says its range
RECORD = together(
    of_node("--bag", also="; see `ember replay --help`"),
    of_node("--split-mb"),
    of_node("--split-s"),
)


# -- what the robot is ---------------------------------------------------------------------------


def _settings(
    context: click.Context, parameter: click.Parameter, given: tuple[str, ...]
) -> tuple[str, ...]:
    read_settings(given)  # what is wrong with one is said before anything is opened
    return given


PARAMS = together(
    click.option(
        "--params",
        "params_files",
        multiple=True,
        type=FILE,
        help="A ROS parameter file (section /**; `ember params` prints one), or the name of one "
        f"that comes with the package: {', '.join(config_names())}. May be given more than once; "
        "what a later one says wins.",
    ),
    click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="GROUP.FIELD=VALUE",
        callback=_settings,
        help="One parameter, on top of --params; may be given more than once.",
    ),
)
NAMESPACE = click.option(
    "--namespace",
    type=_Namespace(),
    default="",
    help="Of all nodes, as robot_2: beside another robot on the same graph.",
)


# -- how a command is done -----------------------------------------------------------------------


def cycles(default: int | None, text: str, *, least: int | None = None, flag: str = "") -> Adds:
    """Return the option of how many cycles are run.

    Args:
        default: shown where there is one.
        text: what help says.
        least: fewest cycles; the plan says its own for None.
        flag: its name where it is not ``--cycles``.
    """
    kind = int if least is None else click.IntRange(least)
    shown = default is not None
    return click.option(
        flag or "--cycles", type=kind, default=default, show_default=shown, help=text
    )


def on(ways: Sequence[str], default: str, text: str) -> Adds:
    """Return the option of what runs it, handed on as ``way``."""
    return click.option(
        "--on", "way", type=click.Choice(ways), default=default, show_default=True, help=text
    )


def out(default: str, holds: str) -> Adds:
    """Return the option of the folder that is written into."""
    return click.option(
        "--out", type=FOLDER, default=default, show_default=True, help=f"Folder for {holds}."
    )


def force(text: str = "Replace an earlier run in --out, once the new one has begun.") -> Adds:
    """Return the option that lets something be replaced."""
    return click.option("--force", is_flag=True, help=text)


# -- which bag -----------------------------------------------------------------------------------

BAG = click.argument("bag", type=FILE)


def robot(also: str = "") -> Adds:
    """Return the option of which robot in a bag is meant."""
    text = f"Of the robot, where the bag holds more than one{also}."
    return click.option("--namespace", type=_Namespace(), help=text)
