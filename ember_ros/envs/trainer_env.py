"""One leg on the trainer as a Gymnasium environment (paper, sections II, III, VI)."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ember_ros.envs.observation import make_observation
from ember_ros.envs.robot import SteppedRobot, metadata_of
from ember_ros.errors import ParameterError
from ember_ros.params import Params
from ember_ros.run_config import MAX_INTEGER
from ember_ros.signals import BodyState


class TrainerEnv(gymnasium.Env[Any, Any]):  # type: ignore[misc]
    """One leg learns to step on the cantilever trainer.

    ## Action space
    ``Discrete(9)``: which of ``leg.knee_speeds`` the knee is driven at for one tick (1/64 s). The
    hip is driven by the leg's gait, as in ``leg_node``.

    ## Observation space
    ``observation="senses"``: ``Box(12,)`` of float64, what is mounted on the leg and reads there,
    and where its own gait stands; ``ember_ros.envs.observation.sensors_of`` lists units and bounds,
    ``ember_ros.signals`` tells the frames: hip, knee [rad], hip_speed, knee_speed [rad/s],
    force_mean, force_peak [N], inclination [rad], slip [m], hair, contact, stance [0 or 1],
    ticks_to_stance [tick].
    ``observation="state"``: ``Discrete``, the state that the leg's discretizer makes of these.

    ## Reward
    Of the tick that ended: the sum of the terms of ``parts.reward``, each in ``info["terms"]``.

    ## Episode
    Begins at tick 0 and is truncated after ``max_cycles`` cycles of the CPG. A fall is told in
    ``info["first_tick"]``: the robot was put back on its feet, this tick's reward is 0, and nothing
    should be learnt across it; it goes on, as in the paper, unless ``terminate_on_fall``. The
    trainer's leg cannot fall.

    ``reset(seed=S)`` begins the run that ``ember train --seed S`` begins; without a seed the next
    one is drawn from the last. Not in the observation, for reports: ``env.unwrapped.body``.
    """

    metadata = metadata_of(Params())

    def __init__(
        self,
        params: Params | None = None,
        *,
        world: str = "trainer",
        observation: str = "senses",
        max_cycles: int = 100,
        terminate_on_fall: bool = False,
        render_mode: str | None = None,
    ) -> None:
        """Check what is asked for; the world is built by ``reset``.

        Args:
            params: every number, and which parts; the defaults for None.
            world: name or dotted path of one with one leg.
            observation: ``senses`` or ``state``.
            max_cycles: of the CPG, ``gait.ticks`` steps each.
            terminate_on_fall: whether a fall ends the episode.
            render_mode: ``human``, a window in a robot's own time; ``rgb_array``; None.

        Raises:
            ParameterError: one of them cannot be used.
        """
        self._robot = SteppedRobot(
            world,
            params or Params(),
            max_cycles=max_cycles,
            terminate_on_fall=terminate_on_fall,
            render_mode=render_mode,
        )
        if len(self._robot.legs) != 1:
            raise ParameterError(
                f"world = {world!r} has the legs {', '.join(self._robot.legs)}; one with a single "
                "leg, or WalkerEnv, would be right"
            )
        self.params, self.render_mode = self._robot.params, render_mode
        self.metadata = metadata_of(self.params)
        self._observation = make_observation(observation, self.params)
        self.observation_space = self._observation.space
        self.action_space = spaces.Discrete(len(self.params.leg.knee_speeds))

    @property
    def body(self) -> BodyState:
        """Return the truth about what the leg carries, for reports."""
        return self._robot.body

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin at tick 0; there are no options."""
        super().reset(seed=seed)
        self._robot.begin(int(self.np_random.integers(MAX_INTEGER)) if seed is None else seed)
        return self._observation.of(self._robot.seen[0]), self._robot.info(0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run one tick; return observation, reward, terminated, truncated and info.

        Raises:
            ParameterError: there is no such action.
        """
        robot = self._robot
        robot.step([action])
        (seen,) = robot.seen
        return (
            self._observation.of(seen),
            seen.transition.reward,
            robot.terminated,
            robot.truncated,
            robot.info(0),
        )

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture, ``(320, 480, 3)`` RGB, by ``render_mode="rgb_array"``."""
        return self._robot.render()

    def close(self) -> None:
        """Let go of the physics server."""
        self._robot.close()
