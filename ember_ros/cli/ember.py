"""``ember`` itself: which commands there are, and how a mistake and Ctrl-C end them.

It imports click and nothing heavy: ``ember --help`` is there at once.
"""

from __future__ import annotations

import errno
import importlib
import sys
from typing import Any, NamedTuple

import click

from ember_ros.cli.codes import INTERRUPTED
from ember_ros.entry_points import NODES
from ember_ros.errors import EmberError
from ember_ros.versions import version


class Command(NamedTuple):
    """Where a command is, and what it is for."""

    file: str
    """Of this folder; the command is ``NAME_command`` in it."""
    says: str
    """The first line of its own help."""


COMMANDS = {
    "bag": Command("bag", "Look into a bag, write it as CSV, or repair one that was cut off."),
    "bench": Command("experiment", "Measure ticks a second and what a tick costs."),
    "demo": Command("run", "Train a leg, walk on four on the graph, draw it all."),
    "experiment": Command(
        "experiment",
        "Run an experiment over many seeds, two runs at once, and write what came of it.",
    ),
    "node": Command("node", f"Start one node: {', '.join(NODES)}."),
    "params": Command("params", "Print every parameter, as a file to edit or as a list to read."),
    "play": Command("replay", "Publish a bag's topics again, for rviz, Foxglove, PlotJuggler."),
    "relearn": Command(
        "replay", "Learn a table from bags, with other numbers, without one new tick."
    ),
    "replay": Command("replay", "Run a recorded run again, and hold it against the record."),
    "train": Command("run", "Train one leg on the cantilever trainer."),
    "walk": Command("run", "Let four legs carry a body, still learning."),
}
"""Every command by its name."""


class _Ember(click.Group):
    """Imports a command when it is asked for, and says errors of ours in one line, as click does.

    The exit code is 2 for a mistake and 130 for Ctrl-C, whenever it comes.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        module = importlib.import_module(f"ember_ros.cli.{COMMANDS[name].file}")
        command: click.Command = getattr(module, f"{name}_command")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, command.says) for name, command in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        _say_all_paths()
        try:
            return super().invoke(ctx)
        except EmberError as error:
            click.echo(f"error: {error}", err=True)
            ctx.exit(error.code)
        except OSError as error:  # a full disk, a folder where a file should be
            if error.errno == errno.EPIPE:
                raise  # click's own
            where = f": {error.filename}" if error.filename else ""
            click.echo(f"error: {error.strerror or error}{where}", err=True)
            ctx.exit(2)
        except KeyboardInterrupt:  # while a command is imported, or before it listens itself
            ctx.exit(INTERRUPTED)


def _say_all_paths() -> None:
    """Have what an encoding has no letters for spelt out: a path may be anything."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


@click.group(cls=_Ember, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version(), prog_name="ember_ros")
def main() -> None:
    """Legs that learn to walk, each a module of its own, on a ROS 2 graph.

    A leg learns alone on the trainer (`ember train`); four legs with what it learnt carry a body
    and go on learning (`ember walk`). `ember demo` does both and draws a picture.

    After Jacob, Polani and Nehaniv, "Legs that can walk" (2005).
    """
