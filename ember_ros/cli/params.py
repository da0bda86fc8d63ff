"""``ember params``: prints all parameters of the robot and its learning."""

from __future__ import annotations

import click

from ember_ros.params import SPECS, Params
from ember_ros.params_file import dump_params, range_of


@click.command("params")
@click.option("--describe", is_flag=True, help="Print unit, range and meaning instead of YAML.")
def params_command(describe: bool) -> None:
    """Print all parameters, as a file to edit or as a list to read.

    \b
    ember params > mine.yaml
    ember walk --params mine.yaml
    ros2 run ember_ros sim_node --ros-args --params-file mine.yaml
    """  # noqa: D301  click reads the backspace as: keep these lines as they are
    if not describe:
        click.echo(dump_params(Params()), nl=False)
        return
    for name, spec in SPECS.items():
        default = spec.default
        shown = ", ".join(map(str, default)) if isinstance(default, tuple) else str(default)
        click.echo(f"{name} = {shown} [{spec.unit}], {range_of(spec)}")
        click.echo(f"    {spec.doc}")
