"""``ember chaos``: injects faults into a running robot and measures how it recovers."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import click

from ember_ros.cli import options
from ember_ros.params_file import load_params
from ember_ros.shipped import TABLE
from ember_ros.spinning import stop_signals
from ember_ros.terminal import console, progress


@click.command("chaos")
@click.option(
    "--minutes",
    type=options.FiniteRange(0.0, 24 * 60.0, min_open=True),
    default=2.0,
    show_default=True,
    help="Wall time of the campaign.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the faults.")
@options.PARAMS
@options.out("out/chaos", "chaos.json and chaos.md")
def chaos_command(
    minutes: float,
    seed: int,
    params_files: tuple[Path, ...],
    settings: tuple[str, ...],
    out: Path,
) -> None:
    """Inject faults into a running robot and measure how it recovers.

    Seven processes walk and learn, in the present ROS domain. They are killed, stopped, and
    disturbed by strange messages and requests, in an order drawn from the seed. The report counts
    faults, freezes, times to recover, and whether the table lost anything.
    """
    from ember_ros import chaos
    from ember_ros.run_config import RunConfig

    params = load_params(*params_files, settings=settings)
    config = RunConfig("walker", 1, seed=seed, params=params, table=Path(TABLE))
    files = [f" --params {file}" for file in params_files] + [f" --set {s}" for s in settings]
    command = f"ember chaos --minutes {minutes:g} --seed {seed}" + "".join(files)
    folder = Path(tempfile.mkdtemp(prefix="ember_chaos_"))
    with stop_signals() as stop, progress("chaos", 100) as update:

        def go_on(share: float, text: str) -> bool:
            update(100.0 * min(share, 1.0), text)
            return not stop.requested

        results = chaos.chaos(
            config, folder, minutes=minutes, seed=seed, go_on=go_on, command=command
        )
    names = chaos.write(results, out)
    if results["freezes"] or results["ended_by_themselves"] or results["cells_with_fewer_visits"]:
        console.print(f"Logs of all nodes: {folder / 'log'}")
    else:
        shutil.rmtree(folder)
    console.print(
        f"{results['faults']} faults, {results['freezes']} freezes, "
        f"{len(results['ended_by_themselves'])} processes ended by themselves, "
        f"{results['cells_with_fewer_visits']} cells lost visits"
    )
    console.print(f"In {out}: {', '.join(names)}")
