"""PPO of Stable-Baselines3 on the leg of the trainer, then four copies of it on the walker.

Senses (as continuous values), actions, reward and discount are those of our Q-learning. Prints for
each seed how many strides (cycles of the CPG) and how much time PPO needs until the distance per
stride is that of `ember train`. Then four copies walk, each with the observation of its leg: first
frozen, then with further common learning (one network for four legs: parameter sharing).
Some minutes per seed; --strides, --walk-strides and --cpu-s make it shorter:

    pip install 'ember_ros[examples]'
    python examples/sb3_trainer.py --seeds 0 1 2 --target 0.43
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any

import numpy as np
import torch
from sb3_legs import Legs, walk
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize


class StopAtTarget(BaseCallback):  # type: ignore[misc]
    """Evaluates the policy regularly; stops learning at a target distance or a limit of CPU time.

    Wall and CPU time, s, are those of learning, without the evaluations.
    """

    def __init__(self, norm: VecNormalize, world: str, target: float, cpu_s: float) -> None:
        super().__init__()
        self.norm, self.world, self.target, self.cpu_s = norm, world, target, cpu_s
        # SB3 counts a time step for each environment, here for each leg.
        self.steps_per_stride = norm.num_envs * norm.venv.env.params.gait.ticks
        self.reached, self.last_strides = False, -(10**9)
        self.curve: list[dict[str, float]] = []

    def _now(self) -> Any:
        return np.array([time.monotonic(), time.process_time()])

    def _on_training_start(self) -> None:
        self.start, self.paused = self._now(), np.zeros(2)

    def _on_rollout_start(self, min_strides: int = 64) -> None:
        """Evaluate the present policy if the last evaluation is 64 or more strides ago."""
        evaluation_start, strides = self._now(), self.num_timesteps // self.steps_per_stride
        wall, self.cpu = (float(each) for each in evaluation_start - self.start - self.paused)
        if strides - self.last_strides >= min_strides:
            self.last_strides, result = strides, walk(self.model, self.norm, self.world, 24)
            self.curve.append(
                {"strides": strides, "wall_s": wall, "cpu_s": self.cpu, **result._asdict()}
            )
            print(f"  {self.world}, {strides} strides: {result.m:.3f} m per stride", flush=True)
            self.reached = result.m >= self.target and not result.falls
        self.paused += self._now() - evaluation_start

    def _on_step(self) -> bool:
        return not self.reached and self.cpu < self.cpu_s

    def _on_training_end(self) -> None:
        self._on_rollout_start(min_strides=1)


def learn(
    world: str, strides: int, target: float, seed: int, cpu_s: float, start: Any = None
) -> tuple[PPO, VecNormalize, StopAtTarget]:
    """Learn until a target, m per stride, or a limit of strides or CPU time is reached.

    The hyperparameters are the defaults of SB3, except our discount factor and 64 strides between
    two updates, summed over legs. ``start`` is a policy and a normalization to continue from.
    """
    torch.set_num_threads(1)
    legs = Legs(world, seed)
    norm, params = VecNormalize(legs, norm_reward=False), legs.env.params
    steps = 64 * params.gait.ticks // legs.num_envs
    gamma = params.train.gamma
    model = PPO("MlpPolicy", norm, n_steps=steps, gamma=gamma, seed=seed, device="cpu")
    if start is not None:
        model.set_parameters(start[0].get_parameters())
        norm.obs_rms = start[1].obs_rms
    callback = StopAtTarget(norm, world, target, cpu_s)
    model.learn(strides * params.gait.ticks * legs.num_envs, callback=callback)
    callback.falls = legs.env.body.falls
    legs.close()
    return model, norm, callback


def main() -> None:
    """Run all seeds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument(
        "--target", type=float, default=0.43, help="m per stride, that of `ember train`"
    )
    parser.add_argument("--strides", type=int, default=20000, help="maximum, on the trainer")
    parser.add_argument("--walk-strides", type=int, default=500, help="on the body, learning")
    parser.add_argument("--cpu-s", type=float, default=900.0, help="maximum, on the trainer")
    args = parser.parse_args()
    for seed in args.seeds:
        model, norm, callback = learn("trainer", args.strides, args.target, seed, args.cpu_s)
        best = (
            callback.curve[-1]
            if callback.reached
            else max(callback.curve, key=lambda each: each["m"])
        )
        outcome = "reached" if callback.reached else f"{args.target} m not reached; at best"
        print(
            f"seed {seed}, trainer: {outcome} {best['m']:.3f} m per stride after {best['strides']} "
            f"strides, {best['wall_s']:.0f} s, {best['cpu_s']:.0f} s of CPU"
        )
        result = walk(model, norm, "walker", 100)
        print(f"seed {seed}, four frozen copies: {result.m:.3f} m, {result.falls} falls in 100")
        if args.walk_strides:
            body = learn("walker", args.walk_strides, math.inf, seed, math.inf, (model, norm))
            last = body[2].curve[-1]
            print(
                f"seed {seed}, learning on together: {last['m']:.3f} m per stride after "
                f"{last['strides']}, {body[2].falls} falls"
            )


if __name__ == "__main__":
    main()
