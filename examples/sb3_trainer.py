"""PPO of Stable-Baselines3 on the trainer's leg, then four copies of it on the body.

The same senses (as numbers), actions, reward and discount as our Q-learning has. Prints, seed by
seed, how many strides (cycles of the CPG) and how much time it took until the policy walks as far a
stride as ours does after `ember train`; then lets four copies carry the body, each leg with its own
observation, frozen, and then learning on together (one network, four legs: parameter sharing).
Some minutes a seed; --strides, --walk-strides and --cpu-s end it sooner:

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


class UntilItWalks(BaseCallback):  # type: ignore[misc]
    """Lets the policy walk now and then; ends the learning where it walks far enough, or time's up.

    Of time, only what learning took is counted: wall and CPU, s.
    """

    def __init__(self, norm: VecNormalize, world: str, target: float, cpu_s: float) -> None:
        super().__init__()
        self.norm, self.world, self.target, self.cpu_s = norm, world, target, cpu_s
        self.ticks = norm.num_envs * norm.venv.env.params.gait.ticks  # of a stride, in SB3's count
        self.reached, self.last = False, -(10**9)
        self.curve: list[dict[str, float]] = []

    def _now(self) -> Any:
        return np.array([time.monotonic(), time.process_time()])

    def _on_training_start(self) -> None:
        self.began, self.paused = self._now(), np.zeros(2)

    def _on_rollout_start(self, least: int = 64) -> None:
        """Look at the policy as the last update left it, every 64 strides of a leg."""
        before, strides = self._now(), self.num_timesteps // self.ticks
        wall, self.cpu = (float(each) for each in before - self.began - self.paused)
        if strides - self.last >= least:
            self.last, walked = strides, walk(self.model, self.norm, self.world, 24)
            self.curve.append(
                {"strides": strides, "wall_s": wall, "cpu_s": self.cpu, **walked._asdict()}
            )
            print(f"  {self.world}, {strides} strides: {walked.m:.3f} m a stride", flush=True)
            self.reached = walked.m >= self.target and not walked.falls
        self.paused += self._now() - before

    def _on_step(self) -> bool:
        return not self.reached and self.cpu < self.cpu_s

    def _on_training_end(self) -> None:
        self._on_rollout_start(least=1)


def learn(
    world: str, strides: int, target: float, seed: int, cpu_s: float, start: Any = None
) -> tuple[PPO, VecNormalize, UntilItWalks]:
    """Learn in a world until a target, m a stride, is reached, or strides or CPU time are over.

    All is as SB3 has it but our discount; 64 strides between two updates, of one leg or of all
    together. With ``start``, what was learnt before: its policy and its normalization.
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
    watch = UntilItWalks(norm, world, target, cpu_s)
    model.learn(strides * params.gait.ticks * legs.num_envs, callback=watch)
    watch.falls = legs.env.body.falls  # while it learnt
    legs.close()
    return model, norm, watch


def main() -> None:
    """Run all seeds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--target", type=float, default=0.43, help="m a stride, of `ember train`")
    parser.add_argument("--strides", type=int, default=20000, help="at most, on the trainer")
    parser.add_argument("--walk-strides", type=int, default=500, help="on the body, learning")
    parser.add_argument("--cpu-s", type=float, default=900.0, help="at most, on the trainer")
    args = parser.parse_args()
    for seed in args.seeds:
        model, norm, watch = learn("trainer", args.strides, args.target, seed, args.cpu_s)
        best = watch.curve[-1] if watch.reached else max(watch.curve, key=lambda each: each["m"])
        said = "reached" if watch.reached else f"{args.target} m not reached; at best"
        print(
            f"seed {seed}, trainer: {said} {best['m']:.3f} m a stride after {best['strides']} "
            f"strides, {best['wall_s']:.0f} s, {best['cpu_s']:.0f} s of CPU"
        )
        walked = walk(model, norm, "walker", 100)
        print(f"seed {seed}, four frozen copies: {walked.m:.3f} m, {walked.falls} falls in 100")
        if args.walk_strides:
            body = learn("walker", args.walk_strides, math.inf, seed, math.inf, (model, norm))
            last = body[2].curve[-1]
            print(
                f"seed {seed}, learning on together: {last['m']:.3f} m a stride after "
                f"{last['strides']}, {body[2].falls} falls on the way"
            )


if __name__ == "__main__":
    main()
