"""``ember node``: runs one node in this process."""

from __future__ import annotations

import click

from ember_ros.entry_points import NODES, run_node


@click.command("node", context_settings={"ignore_unknown_options": True})
@click.argument("name", type=click.Choice(list(NODES)), metavar="NAME")
@click.argument("args", nargs=-1, type=click.UNPROCESSED, metavar="[--ros-args ...]")
def node_command(name: str, args: tuple[str, ...]) -> None:
    """Start one node: sim_node, leg_node, cpg_node, table_node, recorder_node.

    It is the same as `ros2 run ember_ros NAME`.

    \b
    ember node sim_node --help       description and parameters of the node
    ember node leg_node --ros-args -p leg:=front_left -r __node:=leg_front_left
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    run_node(name, list(args))
