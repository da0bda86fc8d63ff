"""A robot whose legs wait for actions: the loop's tick, cut where a leg chooses. Pure.

The values and their order are those of ``ember_ros.loop.Loop.tick``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpg_node.cpg import Beats
from ember_ros import parts
from ember_ros.errors import ParameterError, shown
from ember_ros.params import Params
from ember_ros.signals import BodyState
from ember_ros.worlds import World, legs_of, make_world
from leg_node.assembly import make_task

RENDER_MODES = ("human", "rgb_array")
WIDTH, HEIGHT = 480, 320
"""Of a picture, pixels."""


class SteppedRobot:
    """A world, its oscillator, and the decision processes of its legs."""

    def __init__(
        self,
        world: str,
        params: Params,
        *,
        max_cycles: int,
        terminate_on_fall: bool,
        render_mode: str | None,
    ) -> None:
        """Check what is asked for; nothing is built before ``begin``.

        Raises:
            ParameterError: there is no such world, part or render mode, or no cycle to run.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ParameterError(
                f"render_mode = {shown(render_mode)}; None, "
                f"{' or '.join(map(repr, RENDER_MODES))} would be right"
            )
        if max_cycles < 1:
            raise ParameterError(f"max_cycles = {max_cycles}; 1 or more would be right")
        self.legs = legs_of(world, params)
        self.params = params
        self._name, self._mode = world, render_mode
        self._last_tick = max_cycles * params.gait.ticks
        self._terminate_on_fall = terminate_on_fall
        self._world: World | None = None
        self._seed = -1
        self._due = 0.0
        self._make_legs()

    def _make_legs(self) -> None:
        self._beats = Beats(parts.make(self.params, "cpg", self.params))
        self._tasks = [make_task(self.params, leg) for leg in self.legs]

    @property
    def world(self) -> World:
        """Return the world.

        Raises:
            ParameterError: there is none before the first ``begin``, or after ``close``.
        """
        if self._world is None:
            raise ParameterError("the environment has not begun; reset() first would be right")
        return self._world

    @property
    def body(self) -> BodyState:
        """Return the truth about the body, for reports; no agent is given it."""
        return self.world.body()

    def begin(self, seed: int) -> None:
        """Begin at tick 0, all legs' own memory included; ``seed`` decides every bit."""
        if self._world is not None and seed == self._seed:
            self._world.reset()
        else:
            self.close()
            self._world = make_world(self._name, self.params, seed, gui=self._mode == "human")
            self._seed = seed
        self._make_legs()
        self._tick = 0
        self._perceive()

    def _perceive(self) -> None:
        senses = self.world.observe()
        self._beat = self._beats.at(self._tick, senses)
        self.seen = [
            task.perceive(sense, self._beat)
            for task, sense in zip(self._tasks, senses, strict=True)
        ]
        """What each leg knows at the present tick, in the order of ``legs``."""

    def step(self, actions: Sequence[Any]) -> None:
        """Run one tick with one action a leg, each an index into ``leg.knee_speeds``.

        Raises:
            ParameterError: there is no such action, or the robot has not begun.
        """
        world, most = self.world, len(self.params.leg.knee_speeds) - 1
        for leg, action in zip(self.legs, actions, strict=True):
            if not isinstance(action, (int, np.integer)) or not 0 <= action <= most:
                raise ParameterError(
                    f"action of {leg} = {shown(action)}; a whole number, 0 to {most}, would be "
                    "right"
                )
        commands = [
            task.act(seen, int(action))
            for task, seen, action in zip(self._tasks, self.seen, actions, strict=True)
        ]
        world.step(self._beat, commands)
        self._tick += 1
        self._perceive()
        if self._mode == "human":
            self._pace()

    def _pace(self) -> None:
        """Let a tick on the screen last as long as it does for the robot."""
        now = time.monotonic()
        self._due = max(self._due + self.params.gait.tick_s, now)
        time.sleep(self._due - now)

    @property
    def fell(self) -> bool:
        """Return whether the robot was put back on its feet just now."""
        return any(seen.sense.first_tick for seen in self.seen)

    @property
    def terminated(self) -> bool:
        """Return whether the episode ended by a fall."""
        return self._terminate_on_fall and self.fell

    @property
    def truncated(self) -> bool:
        """Return whether the cycles are done, or the world has no further tick."""
        return self._tick >= self._last_tick or self.world.over

    def info(self, n: int) -> dict[str, Any]:
        """Return what is told of a leg beside its observation.

        Args:
            n: position of the leg.
        """
        seen = self.seen[n]
        return {"terms": dict(seen.transition.terms), "first_tick": seen.sense.first_tick}

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture, ``(HEIGHT, WIDTH, 3)``; None where a window shows the robot, or nobody.

        Raises:
            ParameterError: the world cannot be drawn.
        """
        if self._mode != "rgb_array":
            return None
        draw = getattr(self.world, "picture", None)
        if draw is None:
            raise ParameterError(
                f"the world {shown(self._name)} cannot be drawn; a method picture(width, height) "
                "that returns pixels would be right"
            )
        picture: NDArray[np.uint8] = draw(WIDTH, HEIGHT)
        return picture

    def close(self) -> None:
        """Let go of the world; safe to call twice."""
        if self._world is not None:
            self._world.close()
            self._world = None


def metadata_of(params: Params) -> dict[str, Any]:
    """Return an environment's metadata: its render modes, and frames per second of a robot's time.

    A tick is a frame.
    """
    return {
        "name": "ember_ros_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1.0 / params.gait.tick_s),
    }
