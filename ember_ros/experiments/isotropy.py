"""Isotropy: whether the world is the same in every direction, with Bullet's friction and with ours.

Bullet works friction out along two axes of the world; here the ground, and these axes with it, is
turned with the robot (``sim_node.bullet.Ground``). Both are measured: a body that slides to rest,
and walkers that begin with different headings.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ember_ros.experiments.lab import each_seed, go_on, run_all
from ember_ros.experiments.study import Size, age, numbers, trained, write_page
from ember_ros.experiments.trial import TABLE, code_sha256
from ember_ros.experiments.words import Found, grid
from ember_ros.loop import Loop
from ember_ros.params import Params
from ember_ros.report.figures import AMBER, BLUE, INK, canvas, save
from ember_ros.report.run_statistics import RunStatistics
from ember_ros.run_config import RunConfig
from ember_ros.versions import versions

NAME = "isotropy"
AXES = ("world", "robot")
"""Whose axes friction has: the world's, as in Bullet, or the robot's, as here."""
WALKERS = ("scripted", "trained")
SLID, WALKED = 24, 8
"""Headings of sliding bodies, and of walkers."""
APART = math.radians(56.25)
"""Between the headings of walkers, rad: eight of them lie all around, and each has another angle to
the axes of friction, which repeat every quarter turn."""
SPEED = 1.0
"""Of a body that is let slide, m/s."""


def headings() -> list[float]:
    """Return where walkers head when they begin, rad."""
    return [n * APART for n in range(WALKED)]


def slide(params: Params, heading: float, axes: str) -> tuple[float, float]:
    """Let a body on four feet slide to rest, as heavy as a walker's and in contact as its feet are.

    Args:
        params: of friction, contact and the steps of the physics.
        heading: in which it is pushed, rad.
        axes: ``world`` or ``robot``.

    Returns:
        How far it went, m, and how far it came off its heading, rad.
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
        for _ in range(second):  # it sinks in
            bullet.stepSimulation(client)
        (x0, y0, _), _ = bullet.getBasePositionAndOrientation(body, client)
        push = (SPEED * math.cos(heading), SPEED * math.sin(heading), 0.0)
        bullet.resetBaseVelocity(body, push, (0.0, 0.0, 0.0), client)
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
    """Let a walker that learns nothing begin with a heading: scripted, or with a table.

    Args:
        params: of the walker.
        heading: where it begins, rad.
        axes: ``world`` or ``robot``.
        cycles: of the walk.
        table: of a walker that was trained.

    Returns:
        ``turned_rad``: how far it has turned since it began, in the end of each cycle;
        ``distance_m`` a cycle; ``falls``.
    """
    from sim_node.walker import WalkerWorld

    class WorldAxes(WalkerWorld):
        """The walker on ground that is never turned: friction has the world's axes."""

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
    began = math.remainder(heading, math.tau)
    return {
        "turned_rad": [round((row.yaw_rad or 0.0) - began, 4) for row in rows],
        "distance_m": round(sum(row.distance_m or 0.0 for row in rows) / cycles, 5),
        "falls": loop.world.body().falls,
    }


def _walks(number: int, *, cycles: int, table: Path) -> dict[str, Any]:
    """Return the walks of all walkers on all grounds that begin with one heading."""
    heading = headings()[number]
    tables = {"scripted": None, "trained": table}
    return {
        f"{walker}/{axes}": walk(numbers(), heading, axes, cycles, tables[walker])
        for walker in WALKERS
        for axes in AXES
    }


def isotropy_experiment(
    train: int, cycles: int, trials: Path, say: Callable[[int, int], bool], command: str
) -> Found | None:
    """Measure all, and return what came of it: ``about``, ``slides``, ``walks``.

    Args:
        train: cycles on the trainer of the walkers that are trained.
        cycles: that are walked.
        trials: folder of all trials; the training is one of them.
        say: told how much is done of how much; returns whether to go on.
        command: what was typed.

    Returns:
        None where it was stopped.
    """
    params, of = numbers(), WALKED + 1
    start = trained("ember", Size(1, train, cycles), 0)
    if not run_all([start], trials, lambda done, of: say(0, WALKED + 1)):
        return None
    job = functools.partial(_walks, cycles=cycles, table=trials / start.key / TABLE)
    walked = each_seed(job, WALKED, lambda done, _: say(done, of))
    if len(walked) < WALKED:
        return None
    around = [n * math.tau / SLID for n in range(SLID)]
    slides = {axes: [slide(params, heading, axes) for heading in around] for axes in AXES}
    return {
        "about": {
            "command": command,
            "versions": versions(),
            "code_sha256": code_sha256(),
            "train": train,
            "walk": cycles,
        },
        "slides": {
            "heading_rad": [round(heading, 5) for heading in around],
            **{
                axes: {
                    "way_m": [round(way, 6) for way, _ in each],
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


def _from_to(values: Sequence[float], form: str) -> str:
    return f"{min(values):{form}} to {max(values):{form}}"


def page(found: Found) -> str:
    """Return the results as a Markdown page."""
    about, slides, walks = found["about"], found["slides"], found["walks"]
    known = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    whose = {"world": "the world's (Bullet's own)", "robot": "the robot's (here)"}
    slid = []
    for axes in AXES:
        way = slides[axes]["way_m"]
        off = max(map(abs, slides[axes]["off_rad"]))
        apart = (max(way) - min(way)) / min(way)
        slid.append((whose[axes], _from_to(way, ".4f"), f"{apart:.2%}", f"{off:.4f}"))
    walked = []
    for walker in WALKERS:
        for axes in AXES:
            runs = walks[f"{walker}/{axes}"]
            turned = [run["turned_rad"][-1] for run in runs]
            way = [run["distance_m"] for run in runs]
            walked.append(
                (
                    walker,
                    whose[axes],
                    ", ".join(f"{each:+.2f}" for each in turned),
                    f"{max(turned) - min(turned):.2f}",
                    _from_to(way, ".3f"),
                    str(sum(run["falls"] for run in runs)),
                )
            )
    lines = [
        "# The same in every direction",
        "",
        *age(found, NAME),
        f"Made by `{about['command']}`; every number below is written by it (`isotropy.json` holds "
        f"them all). Versions: {known}.",
        "",
        "Bullet works friction out along two axes of the world. Where a foot slides at an angle to "
        "them, the force is smaller and does not point straight against its slip: a walker on "
        "such ground turns until it heads between the axes. Here the ground is turned with the "
        "robot, so the axes lie along its heading and across it, whatever that is.",
        "",
        f"**A body on four feet** is pushed at {SPEED} m/s along each of {SLID} headings and "
        "slides to rest:",
        "",
        *grid(
            (
                "axes of friction",
                "it slides, m",
                "farthest less shortest, % of the shortest",
                "largest angle to its heading, rad",
            ),
            slid,
        ),
        "",
        f"**Walkers** that learn nothing begin with {WALKED} headings, {math.degrees(APART)} "
        f"degrees apart, and walk {about['walk']} cycles: with the knee written by hand, and with "
        f"the table of one leg that learnt {about['train']} cycles on the trainer (seed 0). How "
        "far they have turned in the end, rad, one heading after the other:",
        "",
        *grid(
            (
                "walker",
                "axes of friction",
                "turned, rad",
                "largest less least",
                "distance a cycle, m",
                "falls",
            ),
            walked,
        ),
        "",
        "What remains is the robot's own: its legs go one after the other, and in its own frame "
        "a slip askew to its heading is still held otherwise than one along it. It is the same for "
        "every heading, until rounding, which differs with the heading, has led two walks apart.",
        "",
        "![Isotropy](isotropy.png)",
    ]
    return "\n".join(lines) + "\n"


def draw(found: Found, file: Path) -> None:
    """Draw how far bodies slide by heading, and how walkers turn over time."""
    figure, axes = canvas(1, 1 + len(WALKERS), width=12.0, height=3.4)
    slides, walks = found["slides"], found["walks"]
    colours = dict(zip(AXES, (AMBER, BLUE), strict=True))
    degrees = [math.degrees(heading) for heading in slides["heading_rad"]]
    for whose in AXES:
        way, label = slides[whose]["way_m"], f"the {whose}'s axes"
        axes[0, 0].plot(degrees, way, "o-", ms=3, color=colours[whose], label=label)
        for column, walker in enumerate(WALKERS, 1):
            for n, run in enumerate(walks[f"{walker}/{whose}"]):
                turned = run["turned_rad"]
                name = label if n == 0 else None
                axes[0, column].plot(
                    range(1, len(turned) + 1), turned, color=colours[whose], lw=1.2, label=name
                )
            axes[0, column].set_title(f"{walker} walkers", loc="left", color=INK)
            axes[0, column].set_xlabel("cycles")
            axes[0, column].set_ylabel("turned, rad")
    axes[0, 0].set_title("A body on four feet slides", loc="left", color=INK)
    axes[0, 0].set_xlabel("heading, degrees")
    axes[0, 0].set_ylabel("distance, m")
    axes[0, 0].set_ylim(0.0, 1.1 * max(max(slides[whose]["way_m"]) for whose in AXES))
    axes[0, 0].legend(frameon=False, loc="center")
    save(figure, file)


def write(found: Found, folder: Path) -> list[str]:
    """Write the page, the numbers and the figure, and return the names of the files."""
    draw(found, folder / f"{NAME}.png")
    write_page(NAME, found, page(found), folder)
    return [f"{NAME}.md", f"{NAME}.json", f"{NAME}.png"]
