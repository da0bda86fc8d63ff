"""The walker as a PettingZoo environment with one agent per leg (paper, sections II, IV, VI)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from ember_ros.envs.observation import make_observation
from ember_ros.envs.robot import SteppedRobot, metadata_of
from ember_ros.errors import ParameterError, shown
from ember_ros.params import Params
from ember_ros.run_config import MAX_INTEGER
from ember_ros.signals import BodyState

PerAgent = dict[str, Any]
"""Values by agent."""


class WalkerEnv(ParallelEnv):  # type: ignore[misc]
    """A body on legs; each leg is an agent with local observations and a local reward.

    The agents are ``robot.legs`` of the parameters: four, or six with ``load_params("hexapod")``.
    Each has the action space, observation spaces, reward and info of ``TrainerEnv``, so that a
    policy of the trainer can be used for each leg. Legs affect each other only through the body.

    An episode starts at tick 0 and is truncated after ``max_cycles`` cycles of the CPG, for all
    agents at the same time. After a fall ``infos[agent]["first_tick"]`` is True: the robot was put
    back on its feet where it fell, the reward of the tick is 0, and no learner should use this
    transition. The episode continues, as in the paper, unless ``terminate_on_fall``.

    ``reset(seed=S)`` starts the same run as ``ember walk --seed S``; without a seed, one is
    drawn from the random generator of the environment. The walker does not depend on the
    seed, but another world may. ``env.body`` has the ground truth for reports; it is in no
    observation.
    """

    metadata = metadata_of(Params())

    def __init__(
        self,
        params: Params | None = None,
        *,
        world: str = "walker",
        observation: str = "senses",
        max_cycles: int = 100,
        terminate_on_fall: bool = False,
        render_mode: str | None = None,
    ) -> None:
        """Check the arguments; ``reset`` creates the world.

        Args:
            params: all parameters, including the names of the parts; None for the defaults.
            world: name or dotted path of a world.
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
        self.params, self.render_mode = self._robot.params, render_mode
        self.metadata = metadata_of(self.params)
        self.possible_agents = list(self._robot.legs)
        self.agents: list[str] = []
        self._observations = {
            leg: make_observation(observation, self.params) for leg in self.possible_agents
        }
        speeds = len(self.params.leg.knee_speeds)
        self.observation_spaces = {leg: each.space for leg, each in self._observations.items()}
        self.action_spaces = {leg: spaces.Discrete(speeds) for leg in self.possible_agents}
        self._rng: np.random.Generator | None = None

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's observation space, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's action space, always the same object."""
        return self.action_spaces[agent]

    @property
    def body(self) -> BodyState:
        """Return the ground truth of the body, for reports."""
        return self._robot.body

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[PerAgent, PerAgent]:
        """Start an episode at tick 0; ``options`` is not used.

        Returns:
            Observations and infos, by agent.
        """
        if seed is not None or self._rng is None:
            self._rng, _ = seeding.np_random(seed)
        self._robot.begin(int(self._rng.integers(MAX_INTEGER)) if seed is None else seed)
        self.agents = list(self.possible_agents)
        return self._observe(), self._infos()

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[PerAgent, PerAgent, PerAgent, PerAgent, PerAgent]:
        """Run one tick.

        Args:
            actions: index into ``leg.knee_speeds`` for each agent.

        Returns:
            Observations, rewards, terminations, truncations and infos, by agent; all empty after
            the end of the episode.

        Raises:
            ParameterError: an action is missing or invalid, or ``reset`` was not called.
        """
        robot = self._robot
        if not self.agents and robot.world:
            return {}, {}, {}, {}, {}
        if set(actions) != set(self.agents):
            raise ParameterError(
                f"actions of {shown(sorted(actions))}; one of each of {', '.join(self.agents)} "
                "would be right"
            )
        robot.step([actions[agent] for agent in self.agents])
        result = (
            self._observe(),
            {leg: each.transition.reward for leg, each in self._by_leg(robot.perceptions)},
            dict.fromkeys(self.agents, robot.terminated),
            dict.fromkeys(self.agents, robot.truncated),
            self._infos(),
        )
        if robot.terminated or robot.truncated:
            self.agents = []
        return result

    def _by_leg(self, values: Any) -> Any:
        return zip(self.possible_agents, values, strict=True)

    def _observe(self) -> PerAgent:
        return {
            leg: self._observations[leg].of(perception)
            for leg, perception in self._by_leg(self._robot.perceptions)
        }

    def _infos(self) -> PerAgent:
        return {leg: self._robot.info(n) for n, leg in enumerate(self.possible_agents)}

    def render(self) -> NDArray[np.uint8] | None:
        """Return an RGB picture, uint8 of shape ``(320, 480, 3)``; None unless ``rgb_array``."""
        return self._robot.render()

    def close(self) -> None:
        """Close the world and its physics server."""
        self._robot.close()
