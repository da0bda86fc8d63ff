"""Legs for Stable-Baselines3: one policy, learnt by all legs of a robot at once.

To SB3 each leg is one of many environments, which is parameter sharing: one network, and for each
leg its own observation and reward. Not run by itself; sb3_trainer.py and ppo_against_q.py use it:

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
    """Legs as Stable-Baselines3 sees many environments: each leg is one, all learn one policy."""

    def __init__(self, world: str, seed: int = 0) -> None:
        self.env, self.start = WalkerEnv(world=world, max_cycles=10**9), seed
        self.legs = self.env.possible_agents
        leg, of = self.legs[0], self.env
        super().__init__(len(self.legs), of.observation_space(leg), of.action_space(leg))

    def reset(self) -> Any:
        seen, _ = self.env.reset(seed=self.start)
        return np.stack([seen[leg] for leg in self.legs])

    def step_async(self, actions: Any) -> None:
        self.actions = dict(zip(self.legs, actions, strict=True))

    def step_wait(self) -> Any:
        seen, rewards, _, _, infos = self.env.step(self.actions)
        told = [infos[leg] for leg in self.legs]
        # Nothing is learnt across a fall: it ends what SB3 calls an episode, but the robot goes on.
        ends = np.array([info["first_tick"] for info in told])
        observations = np.stack([seen[leg] for leg in self.legs])
        for info, observation in zip(told, observations, strict=True):
            info["terminal_observation"] = observation
        return observations, np.array([rewards[leg] for leg in self.legs]), ends, told

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


class Walked(NamedTuple):
    """What came of a walk, its first quarter left out but for falls."""

    m: float
    """Ahead, a stride."""
    reward: float
    """A tick, mean over legs."""
    falls: int


def walk(model: PPO, norm: VecNormalize, world: str, strides: int) -> Walked:
    """Let the policy as it is walk by its best actions."""
    legs = Legs(world)
    seen, ways, rewards = legs.reset(), [], []
    for _ in range(strides):
        begin = legs.env.body
        for _ in range(legs.env.params.gait.ticks):
            actions, _ = model.predict(norm.normalize_obs(seen), deterministic=True)
            seen, reward, *_ = legs.step(actions)
            rewards.append(reward.mean())
        end, yaw = legs.env.body, begin.yaw
        ways.append((end.x - begin.x) * math.cos(yaw) + (end.y - begin.y) * math.sin(yaw))
    legs.close()
    late, late_ticks = ways[strides // 4 :], rewards[len(rewards) // 4 :]
    return Walked(float(np.mean(late)), float(np.mean(late_ticks)), end.falls)
