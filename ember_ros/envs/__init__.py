"""Environments for other reinforcement-learning libraries, without ROS and without a Q-table.

``WalkerEnv`` is a PettingZoo ``ParallelEnv`` with one agent per leg; ``TrainerEnv`` is a Gymnasium
``Env`` with one leg. Importing this package registers ``ember_ros/Trainer-v0`` with Gymnasium;
``gymnasium.make("ember_ros.envs:ember_ros/Trainer-v0")`` imports it and makes the environment.
Needs the extra ``envs``.

Both step like ``ember_ros.loop``: the same actions give the same senses and rewards, bit for bit.
"""

from ember_ros.errors import need

need("gymnasium", "pettingzoo", why="for environments")

import gymnasium  # noqa: E402

from ember_ros.envs.trainer_env import TrainerEnv  # noqa: E402
from ember_ros.envs.walker_env import WalkerEnv  # noqa: E402

__all__ = ["TRAINER_ID", "TrainerEnv", "WalkerEnv"]

TRAINER_ID = "ember_ros/Trainer-v0"
"""Id of ``TrainerEnv`` in the registry of Gymnasium."""

gymnasium.register(TRAINER_ID, entry_point="ember_ros.envs:TrainerEnv")
