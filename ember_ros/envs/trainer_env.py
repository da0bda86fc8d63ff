"""The trainer with one leg as a Gymnasium environment (paper, sections II, III, VI)."""

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
    """One leg on the cantilever trainer.

    ## Action space
    ``Discrete(9)``: index into ``leg.knee_speeds``, the speed of the knee for one tick (1/64 s).
    The gait drives the hip, as in ``leg_node``.

    ## Observation space
    ``observation="senses"``: ``Box(12,)`` of float64, the sensor readings of the leg and the state
    of its gait. ``ember_ros.envs.observation.sensors_of`` lists units and bounds,
    ``ember_ros.signals`` defines the frames. Elements: hip, knee [rad], hip_speed,
    knee_speed [rad/s], force_mean, force_peak [N], inclination [rad], slip [m], hair, contact,
    stance [0 or 1], ticks_to_stance [tick].
    ``observation="state"``: ``Discrete``, the index of the state by ``parts.discretizer``.

    ## Reward
    The sum of the reward terms of ``parts.reward`` for the tick that ended; ``info["terms"]`` has
    each term.

    ## Episode
    Starts at tick 0 and is truncated after ``max_cycles`` cycles of the CPG. After a fall
    ``info["first_tick"]`` is True: the robot was put back on its feet, the reward of the tick is 0,
    and no learner should use this transition. The episode continues, as in the paper, unless
    ``terminate_on_fall``. The leg of the trainer cannot fall.

    ``reset(seed=S)`` starts the same run as ``ember train --seed S``; without a seed, one is
    drawn from the random generator of the environment. ``env.unwrapped.body`` has the ground
    truth for reports; it is not in the observation.
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
        """Check the arguments; ``reset`` creates the world.

        Args:
            params: all parameters, including the names of the parts; None for the defaults.
            world: name or dotted path of a world with one leg.
            observation: ``senses`` or ``state``.
            max_cycles: length of an episode in cycles of the CPG, ``gait.ticks`` steps each.
            terminate_on_fall: whether a fall ends the episode.
            render_mode: ``human`` (a window, in real time), ``rgb_array`` or None.

        Raises:
            ParameterError: an argument is invalid.
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
        """Return the ground truth of the body that the leg carries, for reports."""
        return self._robot.body

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode at tick 0; ``options`` is not used."""
        super().reset(seed=seed)
        self._robot.begin(int(self.np_random.integers(MAX_INTEGER)) if seed is None else seed)
        return self._observation.of(self._robot.perceptions[0]), self._robot.info(0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run one tick.

        Args:
            action: index into ``leg.knee_speeds``.

        Returns:
            Observation, reward, terminated, truncated and info.

        Raises:
            ParameterError: the action is invalid.
        """
        robot = self._robot
        robot.step([action])
        (perception,) = robot.perceptions
        return (
            self._observation.of(perception),
            perception.transition.reward,
            robot.terminated,
            robot.truncated,
            robot.info(0),
        )

    def render(self) -> NDArray[np.uint8] | None:
        """Return an RGB picture, uint8 of shape ``(320, 480, 3)``; None unless ``rgb_array``."""
        return self._robot.render()

    def close(self) -> None:
        """Close the world and its physics server."""
        self._robot.close()
