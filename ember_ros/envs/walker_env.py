"""A body on its legs as a PettingZoo environment: one agent a leg (paper, sections II, IV, VI)."""

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
"""By agent."""


class WalkerEnv(ParallelEnv):  # type: ignore[misc]
    """Legs carry a body, each an agent that knows and is paid for nothing but its own doings.

    Agents are ``robot.legs`` of the parameters, four or any number: ``load_params("hexapod")``.
    Each has the action space, the observation spaces, the reward and the infos of ``TrainerEnv``,
    so that a policy of one leg on the trainer is one of a leg here. Legs affect each other through
    the body alone.

    Begins at tick 0 and is truncated after ``max_cycles`` cycles of the CPG, for all agents at
    once. After a fall ``infos[agent]["first_tick"]`` is True: the robot was put back on its feet
    where it fell, this tick's reward is 0, and nothing should be learnt across it; it goes on, as
    in the paper, unless ``terminate_on_fall``.

    ``reset(seed=S)`` begins the run that ``ember walk --seed S`` begins; without a seed the next
    one is drawn from the last. Nothing in the walker hangs on the seed, a world of your own may.
    Not in any observation, for reports: ``env.body``.
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
        """Check what is asked for; the world is built by ``reset``.

        Args:
            params: every number, and which parts; the defaults for None.
            world: name, or dotted path of one of your own.
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
        """Return the truth about the body, for reports."""
        return self._robot.body

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[PerAgent, PerAgent]:
        """Begin at tick 0; there are no options.

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
        """Run one tick with an action of every agent.

        Returns:
            Observations, rewards, terminations, truncations and infos, by agent; all empty after
            the episode's end.

        Raises:
            ParameterError: an action is missing or there is no such one, or ``reset`` is due.
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
        told = (
            self._observe(),
            {leg: each.transition.reward for leg, each in self._each(robot.seen)},
            dict.fromkeys(self.agents, robot.terminated),
            dict.fromkeys(self.agents, robot.truncated),
            self._infos(),
        )
        if robot.terminated or robot.truncated:
            self.agents = []
        return told

    def _each(self, values: Any) -> Any:
        return zip(self.possible_agents, values, strict=True)

    def _observe(self) -> PerAgent:
        return {leg: self._observations[leg].of(seen) for leg, seen in self._each(self._robot.seen)}

    def _infos(self) -> PerAgent:
        return {leg: self._robot.info(n) for n, leg in enumerate(self.possible_agents)}

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture, ``(320, 480, 3)`` RGB, by ``render_mode="rgb_array"``."""
        return self._robot.render()

    def close(self) -> None:
        """Let go of the physics server."""
        self._robot.close()
