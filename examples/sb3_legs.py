"""Legs for Stable-Baselines3: all legs of a robot learn one policy together.

Each leg is one environment of an SB3 vector environment. This is parameter sharing: one network,
but an observation and a reward for each leg. A module for sb3_trainer.py and ppo_against_q.py:

    PPO("MlpPolicy", Legs("walker")).learn(100_000)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from ember_ros.envs import WalkerEnv


class Legs(VecEnv):  # type: ignore[misc]
    """A vector environment of Stable-Baselines3 in which each leg is one environment."""

    def __init__(self, world: str, seed: int = 0) -> None:
        self.env, self.start_seed = WalkerEnv(world=world, max_cycles=10**9), seed
        self.legs = self.env.possible_agents
        leg = self.legs[0]
        super().__init__(
            len(self.legs), self.env.observation_space(leg), self.env.action_space(leg)
        )

    def reset(self) -> Any:
        observations, _ = self.env.reset(seed=self.start_seed)
        return np.stack([observations[leg] for leg in self.legs])

    def step_async(self, actions: Any) -> None:
        self.actions = dict(zip(self.legs, actions, strict=True))

    def step_wait(self) -> Any:
        by_leg, rewards, _, _, infos = self.env.step(self.actions)
        info_list = [infos[leg] for leg in self.legs]
        # For SB3 a fall ends an episode, so that no value is estimated across it.
        dones = np.array([info["first_tick"] for info in info_list])
        observations = np.stack([by_leg[leg] for leg in self.legs])
        for info, observation in zip(info_list, observations, strict=True):
            info["terminal_observation"] = observation
        return observations, np.array([rewards[leg] for leg in self.legs]), dones, info_list

    def close(self) -> None:
        self.env.close()

    def get_attr(self, name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, name)] * self.num_envs

    def set_attr(self, name: str, value: Any, indices: Any = None) -> None:
        setattr(self.env, name, value)

    def env_method(self, name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [getattr(self.env, name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class WalkResult(NamedTuple):
    """The result of a walk; means are without its first quarter."""

    m: float
    """Mean forward distance per stride, m."""
    reward: float
    """Mean reward per tick and leg."""
    falls: int
    """Falls of the whole walk."""


def walk(model: PPO, norm: VecNormalize, world: str, strides: int) -> WalkResult:
    """Evaluate a policy with its best actions, without learning."""
    legs = Legs(world)
    observations, distances, rewards = legs.reset(), [], []
    for _ in range(strides):
        start = legs.env.body
        for _ in range(legs.env.params.gait.ticks):
            actions, _ = model.predict(norm.normalize_obs(observations), deterministic=True)
            observations, reward, *_ = legs.step(actions)
            rewards.append(reward.mean())
        end, yaw = legs.env.body, start.yaw
        distances.append((end.x - start.x) * math.cos(yaw) + (end.y - start.y) * math.sin(yaw))
    legs.close()
    late_distances, late_rewards = distances[strides // 4 :], rewards[len(rewards) // 4 :]
    return WalkResult(float(np.mean(late_distances)), float(np.mean(late_rewards)), end.falls)
