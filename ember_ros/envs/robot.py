"""A robot that is stepped with actions from outside. Pure.

It does the same as ``ember_ros.loop.Loop.tick`` in the same order, but the actions are arguments.
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
"""Size of a rendered picture, pixels."""


class SteppedRobot:
    """A world, its central pattern generator, and the decision processes of its legs."""

    def __init__(
        self,
        world: str,
        params: Params,
        *,
        max_cycles: int,
        terminate_on_fall: bool,
        render_mode: str | None,
    ) -> None:
        """Check the arguments; ``begin`` creates the world.

        Raises:
            ParameterError: an unknown world, part or render mode, or ``max_cycles`` is under 1.
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
            ParameterError: there is no world: before the first ``begin``, or after ``close``.
        """
        if self._world is None:
            raise ParameterError("the environment is not reset; call reset() first")
        return self._world

    @property
    def body(self) -> BodyState:
        """Return the ground truth of the body, for reports; it is in no observation."""
        return self.world.body()

    def begin(self, seed: int) -> None:
        """Start an episode at tick 0 and reset all legs; ``seed`` determines every bit of it."""
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
        self.perceptions = [
            task.perceive(sense, self._beat)
            for task, sense in zip(self._tasks, senses, strict=True)
        ]
        """Perception of each leg at the present tick, in the order of ``legs``."""

    def step(self, actions: Sequence[Any]) -> None:
        """Run one tick.

        Args:
            actions: one per leg, in the order of ``legs``: indices into ``leg.knee_speeds``.

        Raises:
            ParameterError: an action is invalid, or ``begin`` was not called.
        """
        world, max_action = self.world, len(self.params.leg.knee_speeds) - 1
        for leg, action in zip(self.legs, actions, strict=True):
            if not isinstance(action, (int, np.integer)) or not 0 <= action <= max_action:
                raise ParameterError(
                    f"action of {leg} = {shown(action)}; a whole number, 0 to {max_action}, would "
                    "be right"
                )
        commands = [
            task.act(perception, int(action))
            for task, perception, action in zip(self._tasks, self.perceptions, actions, strict=True)
        ]
        world.step(self._beat, commands)
        self._tick += 1
        self._perceive()
        if self._mode == "human":
            self._pace()

    def _pace(self) -> None:
        """Sleep so that a tick takes ``gait.tick_s`` of wall time; lost time is not made up."""
        now = time.monotonic()
        self._due = max(self._due + self.params.gait.tick_s, now)
        time.sleep(self._due - now)

    @property
    def fell(self) -> bool:
        """Return whether the robot fell in the last tick and was put back on its feet."""
        return any(perception.sense.first_tick for perception in self.perceptions)

    @property
    def terminated(self) -> bool:
        """Return whether a fall ended the episode."""
        return self._terminate_on_fall and self.fell

    @property
    def truncated(self) -> bool:
        """Return whether ``max_cycles`` is reached, or the world has ended."""
        return self._tick >= self._last_tick or self.world.over

    def info(self, n: int) -> dict[str, Any]:
        """Return the ``info`` of a leg: reward terms by name, and whether it is a first tick.

        Args:
            n: index of the leg in ``legs``.
        """
        perception = self.perceptions[n]
        return {
            "terms": dict(perception.transition.terms),
            "first_tick": perception.sense.first_tick,
        }

    def render(self) -> NDArray[np.uint8] | None:
        """Return an RGB picture, uint8 of shape ``(HEIGHT, WIDTH, 3)``.

        None unless the render mode is ``rgb_array``.

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
        """Close the world; a second call does nothing."""
        if self._world is not None:
            self._world.close()
            self._world = None


def metadata_of(params: Params) -> dict[str, Any]:
    """Return the metadata of an environment: render modes, and frames (ticks) per second."""
    return {
        "name": "ember_ros_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1.0 / params.gait.tick_s),
    }
