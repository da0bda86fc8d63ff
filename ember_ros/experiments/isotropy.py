"""The experiment ``isotropy``: whether friction is the same in all directions.

Bullet computes friction along two axes that are fixed in the ground. In this package the ground,
and with it these axes, turns with the robot (``sim_node.bullet.Ground``). Both variants are
measured, by a body that slides to rest and by walkers that start with different headings.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ember_ros.experiments.reporting import Results, markdown_table
from ember_ros.experiments.runner import go_on, run_all, run_seeds
from ember_ros.experiments.study import (
    Size,
    learner_params,
    outdated_note,
    training_trial,
    write_page,
)
from ember_ros.experiments.trial import TABLE, code_sha256
from ember_ros.loop import Loop
from ember_ros.params import Params
from ember_ros.report.figures import AMBER, BLUE, INK, canvas, save
from ember_ros.report.run_statistics import RunStatistics
from ember_ros.run_config import RunConfig
from ember_ros.versions import versions

NAME = "isotropy"
AXES = ("world", "robot")
"""The frame of the friction axes: the world, as in Bullet, or the robot, as in this package."""
WALKERS = ("scripted", "trained")
SLIDE_HEADINGS, WALK_HEADINGS = 24, 8
"""Number of headings of sliding bodies, and of walkers."""
HEADING_STEP = math.radians(56.25)
"""Difference between the headings of two successive walkers, rad. The headings cover all directions
and each has another angle to the friction axes, modulo a quarter turn."""
SPEED = 1.0
"""Initial speed of a sliding body, m/s."""


def headings() -> list[float]:
    """Return the initial headings of the walkers, rad."""
    return [n * HEADING_STEP for n in range(WALK_HEADINGS)]


def slide(params: Params, heading: float, axes: str) -> tuple[float, float]:
    """Let a body slide to rest on four feet, with the mass and the contact parameters of a walker.

    Args:
        params: parameters of friction, contact, mass and time step.
        heading: direction of its initial velocity, rad.
        axes: frame of the friction axes, ``world`` or ``robot``.

    Returns:
        The distance that it slid, m, and the angle between that displacement and its heading, rad.
    """
    from sim_node.bullet import Ground, bullet, set_contact, set_up

    physics, foot = params.physics, params.leg.foot_radius
    client = bullet.connect(bullet.DIRECT)
    try:
        set_up(client, params)
        ground = Ground(client)
        ground.turn(heading if axes == "robot" else 0.0)
        arm = params.walker.hip_half_width
        feet = bullet.createCollisionShapeArray(
            shapeTypes=[bullet.GEOM_SPHERE] * 4,
            radii=[foot] * 4,
            collisionFramePositions=[(x, y, 0.0) for x in (-arm, arm) for y in (-arm, arm)],
            physicsClientId=client,
        )
        turned = bullet.getQuaternionFromEuler((0.0, 0.0, heading))
        body = bullet.createMultiBody(
            params.walker.mass, feet, -1, (0.0, 0.0, foot), turned, physicsClientId=client
        )
        set_contact(client, body, -1, physics)
        second = round(physics.substeps / params.gait.tick_s)
        for _ in range(second):  # until the contact forces are in equilibrium
            bullet.stepSimulation(client)
        (x0, y0, _), _ = bullet.getBasePositionAndOrientation(body, client)
        velocity = (SPEED * math.cos(heading), SPEED * math.sin(heading), 0.0)
        bullet.resetBaseVelocity(body, velocity, (0.0, 0.0, 0.0), client)
        for _ in range(second):
            bullet.stepSimulation(client)
        (x, y, _), _ = bullet.getBasePositionAndOrientation(body, client)
    finally:
        bullet.disconnect(client)
    off = math.remainder(math.atan2(y - y0, x - x0) - heading, math.tau)
    return math.hypot(x - x0, y - y0), off


def walk(
    params: Params, heading: float, axes: str, cycles: int, table: Path | None = None
) -> dict[str, Any]:
    """Walk without learning from a given initial heading.

    Args:
        params: parameters of the walker.
        heading: initial heading, rad.
        axes: frame of the friction axes, ``world`` or ``robot``.
        cycles: length of the walk.
        table: file of a trained table; without it the knee is scripted.

    Returns:
        ``turned_rad``: the change of heading since the start, at the end of each cycle, rad;
        ``distance_m``: the mean distance per cycle, m; ``falls``.
    """
    from sim_node.walker import WalkerWorld

    class WorldAxes(WalkerWorld):
        """A walker on ground that does not turn: the friction axes are fixed in the world."""

        def _heading(self) -> float:
            return 0.0

    config = RunConfig(
        "walker",
        cycles,
        params=params,
        policy="learned" if table else "scripted",
        learning=False,
        table=table,
    )
    world = {"world": WorldAxes, "robot": WalkerWorld}[axes](params, heading=heading)
    loop = Loop(config, world)
    try:
        recorder = RunStatistics(params, config.legs)
        for _ in range(cycles):
            if not go_on():
                break
            for _ in range(params.gait.ticks):
                loop.tick(recorder)
        recorder.finish(loop.world.observe(), loop.world.body())
    finally:
        loop.close()
    rows = recorder.body_rows()
    initial = math.remainder(heading, math.tau)
    return {
        "turned_rad": [round((row.yaw_rad or 0.0) - initial, 4) for row in rows],
        "distance_m": round(sum(row.distance_m or 0.0 for row in rows) / cycles, 5),
        "falls": loop.world.body().falls,
    }


def _walks(number: int, *, cycles: int, table: Path) -> dict[str, Any]:
    """Return the walks of all walkers with both friction axes from one initial heading."""
    heading = headings()[number]
    tables = {"scripted": None, "trained": table}
    return {
        f"{walker}/{axes}": walk(learner_params(), heading, axes, cycles, tables[walker])
        for walker in WALKERS
        for axes in AXES
    }


def isotropy_experiment(
    train: int,
    cycles: int,
    trials: Path,
    report_progress: Callable[[int, int], bool],
    command: str,
) -> Results | None:
    """Run all measurements and return the results.

    Args:
        train: cycles of the training on the trainer.
        cycles: length of each walk.
        trials: folder of all trials; the training is one of them.
        report_progress: is called regularly with the completed and the total number of parts; the
            run stops if it returns False.
        command: the command line, for the page.

    Returns:
        ``about``, ``slides`` and ``walks``; None if the run was stopped.
    """
    params, parts = learner_params(), WALK_HEADINGS + 1
    start = training_trial("ember", Size(1, train, cycles), 0)
    if not run_all([start], trials, lambda done, total: report_progress(0, parts)):
        return None
    job = functools.partial(_walks, cycles=cycles, table=trials / start.key / TABLE)
    walked = run_seeds(job, WALK_HEADINGS, lambda done, _: report_progress(done, parts))
    if len(walked) < WALK_HEADINGS:
        return None
    directions = [n * math.tau / SLIDE_HEADINGS for n in range(SLIDE_HEADINGS)]
    slides = {axes: [slide(params, heading, axes) for heading in directions] for axes in AXES}
    return {
        "about": {
            "command": command,
            "versions": versions(),
            "code_sha256": code_sha256(),
            "train": train,
            "walk": cycles,
        },
        "slides": {
            "heading_rad": [round(heading, 5) for heading in directions],
            **{
                axes: {
                    "way_m": [round(distance, 6) for distance, _ in each],
                    "off_rad": [round(off, 6) for _, off in each],
                }
                for axes, each in slides.items()
            },
        },
        "walks": {
            "heading_rad": [round(heading, 5) for heading in headings()],
            **{name: [each[name] for each in walked] for name in walked[0]},
        },
    }


def _range_text(values: Sequence[float], form: str) -> str:
    """Return the smallest and the largest value as text."""
    return f"{min(values):{form}} to {max(values):{form}}"


def page(results: Results) -> str:
    """Return the results as a Markdown page."""
    about, slides, walks = results["about"], results["slides"], results["walks"]
    installed = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    axes_names = {"world": "fixed in the world (Bullet)", "robot": "turning with the robot (ours)"}
    slide_rows = []
    for axes in AXES:
        distances = slides[axes]["way_m"]
        angle = max(map(abs, slides[axes]["off_rad"]))
        relative_range = (max(distances) - min(distances)) / min(distances)
        slide_rows.append(
            (
                axes_names[axes],
                _range_text(distances, ".4f"),
                f"{relative_range:.2%}",
                f"{angle:.4f}",
            )
        )
    walk_rows = []
    for walker in WALKERS:
        for axes in AXES:
            runs = walks[f"{walker}/{axes}"]
            turned = [run["turned_rad"][-1] for run in runs]
            walk_rows.append(
                (
                    walker,
                    axes_names[axes],
                    ", ".join(f"{each:+.2f}" for each in turned),
                    f"{max(turned) - min(turned):.2f}",
                    _range_text([run["distance_m"] for run in runs], ".3f"),
                    str(sum(run["falls"] for run in runs)),
                )
            )
    lines = [
        "# Isotropy: the same friction in every direction",
        "",
        *outdated_note(results, NAME),
        f"Written by `{about['command']}`, including every number below (all of them are in "
        f"`isotropy.json`). Versions: {installed}.",
        "",
        "Bullet computes friction along two axes that are fixed in the ground. If a foot slides at "
        "an angle to these axes, the friction force is smaller and not exactly opposite to the "
        "velocity. A walker on such ground therefore turns until its heading lies between the "
        "axes. In this package the ground turns with the robot, so that one axis always points "
        "along the robot's heading and the other one across it.",
        "",
        f"**Sliding body.** A body on four feet starts at {SPEED} m/s in each of {SLIDE_HEADINGS} "
        "directions and slides to rest:",
        "",
        *markdown_table(
            (
                "friction axes",
                "sliding distance, m",
                "(maximum - minimum) / minimum",
                "largest angle between displacement and heading, rad",
            ),
            slide_rows,
        ),
        "",
        f"**Walkers.** Walkers that do not learn start with {WALK_HEADINGS} headings, "
        f"{math.degrees(HEADING_STEP)} degrees apart, and walk {about['walk']} cycles: with the "
        f"scripted knee, and with the table of one leg after {about['train']} cycles on the "
        "trainer (seed 0). The change of heading from the start to the end is given for each "
        "initial heading:",
        "",
        *markdown_table(
            (
                "walker",
                "friction axes",
                "change of heading, rad",
                "maximum - minimum, rad",
                "distance per cycle, m",
                "falls",
            ),
            walk_rows,
        ),
        "",
        "The change of heading that remains is a property of the robot. Its legs step one after "
        "the other, and in the robot's own frame friction still depends on the angle between slip "
        "and heading. This is the same for every initial heading, except for rounding: rounding "
        "errors differ with the heading, and after some time two walks can differ visibly.",
        "",
        "![Isotropy](isotropy.png)",
    ]
    return "\n".join(lines) + "\n"


def draw(results: Results, file: Path) -> None:
    """Draw the sliding distance by heading, and the headings of the walkers over time."""
    figure, axes = canvas(1, 1 + len(WALKERS), width=12.0, height=3.4)
    slides, walks = results["slides"], results["walks"]
    colours = dict(zip(AXES, (AMBER, BLUE), strict=True))
    degrees = [math.degrees(heading) for heading in slides["heading_rad"]]
    for frame in AXES:
        distances, label = slides[frame]["way_m"], f"axes of the {frame}"
        axes[0, 0].plot(degrees, distances, "o-", ms=3, color=colours[frame], label=label)
        for column, walker in enumerate(WALKERS, 1):
            for n, run in enumerate(walks[f"{walker}/{frame}"]):
                turned = run["turned_rad"]
                name = label if n == 0 else None
                axes[0, column].plot(
                    range(1, len(turned) + 1), turned, color=colours[frame], lw=1.2, label=name
                )
            axes[0, column].set_title(f"{walker} walkers", loc="left", color=INK)
            axes[0, column].set_xlabel("cycles")
            axes[0, column].set_ylabel("change of heading, rad")
    axes[0, 0].set_title("Sliding body", loc="left", color=INK)
    axes[0, 0].set_xlabel("heading, degrees")
    axes[0, 0].set_ylabel("distance, m")
    axes[0, 0].set_ylim(0.0, 1.1 * max(max(slides[frame]["way_m"]) for frame in AXES))
    axes[0, 0].legend(frameon=False, loc="center")
    save(figure, file)


def write(results: Results, folder: Path) -> list[str]:
    """Write the page, the JSON file and the figure, and return the names of the files."""
    draw(results, folder / f"{NAME}.png")
    write_page(NAME, results, page(results), folder)
    return [f"{NAME}.md", f"{NAME}.json", f"{NAME}.png"]
