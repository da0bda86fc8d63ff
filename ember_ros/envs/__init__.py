"""Environments for other reinforcement-learning libraries; neither ROS nor a Q-table is in them.

``WalkerEnv`` is a PettingZoo ``ParallelEnv``, one agent a leg; ``TrainerEnv`` a Gymnasium ``Env``
of one leg. Importing this registers ``ember_ros/Trainer-v0`` with Gymnasium, so that
``gymnasium.make("ember_ros.envs:ember_ros/Trainer-v0")`` does both. Needs the extra ``envs``.

Both step as ``ember_ros.loop`` does: the actions of a loop's legs give its senses and rewards, to
the bit.
"""

from ember_ros.errors import need

need("gymnasium", "pettingzoo", why="for environments")

import gymnasium  # noqa: E402

from ember_ros.envs.trainer_env import TrainerEnv  # noqa: E402
from ember_ros.envs.walker_env import WalkerEnv  # noqa: E402

__all__ = ["TRAINER_ID", "TrainerEnv", "WalkerEnv"]

TRAINER_ID = "ember_ros/Trainer-v0"
"""Of ``TrainerEnv`` in Gymnasium's registry."""

gymnasium.register(TRAINER_ID, entry_point="ember_ros.envs:TrainerEnv")
