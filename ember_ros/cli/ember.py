"""The command ``ember``: its list of subcommands, and how errors and Ctrl-C end them.

It imports nothing heavier than click, so ``ember --help`` is fast.
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
    """The module and the short help of a command."""

    file: str
    """Module of this package; it defines the command as ``NAME_command``."""
    help: str
    """The first line of the command's own help."""


COMMANDS = {
    "bag": Command("bag", "Show the content of a bag, export it as CSV, or repair it."),
    "bench": Command("experiment", "Measure ticks per second and the time of each part of a tick."),
    "chaos": Command("chaos", "Inject faults into a running robot and measure how it recovers."),
    "demo": Command("run", "Train one leg, walk with four on the ROS graph, and plot both."),
    "experiment": Command("experiment", "Run an experiment over many seeds and write its report."),
    "node": Command("node", f"Start one node: {', '.join(NODES)}."),
    "params": Command("params", "Print all parameters, as a file to edit or as a list to read."),
    "play": Command("replay", "Publish the topics of a bag, for rviz, Foxglove or PlotJuggler."),
    "relearn": Command("replay", "Learn a table from bags with other parameters, offline."),
    "replay": Command("replay", "Repeat a recorded run and compare it with the record."),
    "train": Command("run", "Train one leg on the cantilever trainer."),
    "walk": Command("run", "Walk with four legs that carry a body and continue to learn."),
}
"""All commands by name."""


class _Ember(click.Group):
    """Imports a command when it is used, and prints errors of this package in one line.

    The exit code is 2 for an error and 130 for Ctrl-C at any time.
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
            formatter.write_dl([(name, command.help) for name, command in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        _escape_output()
        try:
            return super().invoke(ctx)
        except EmberError as error:
            click.echo(f"error: {error}", err=True)
            ctx.exit(error.code)
        except OSError as error:  # a full disk, a folder where a file should be
            if error.errno == errno.EPIPE:
                raise  # click handles it
            where = f": {error.filename}" if error.filename else ""
            click.echo(f"error: {error.strerror or error}{where}", err=True)
            ctx.exit(2)
        except KeyboardInterrupt:  # during an import, or before the command handles signals
            ctx.exit(INTERRUPTED)


def _escape_output() -> None:
    """Escape characters that the output's encoding lacks: a path may contain any bytes."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


@click.group(cls=_Ember, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version(), prog_name="ember_ros")
def main() -> None:
    """Legs that learn to walk, each an independent learner, on a ROS 2 graph.

    One leg learns alone on the trainer (`ember train`). Four legs with its table carry a body and
    continue to learn (`ember walk`). `ember demo` does both and draws a figure.

    After Jacob, Polani and Nehaniv, "Legs that can walk" (2005).
    """
