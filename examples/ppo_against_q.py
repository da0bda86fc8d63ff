"""Comparison of PPO and our Q-learning, with the same senses, actions, reward and discount.

PPO observes the senses as continuous values, Q-learning its 17 x 8 x 8 x 2 x 2 states. Both learn
on the trainer; then the legs walk, once without learning (frozen) and once with. PPO has as many
strides as Q-learning; --strides changes that. Writes ppo.json and ppo.md; needs half an hour of
CPU:

    nice python examples/ppo_against_q.py --out docs/results
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sb3_legs import WalkResult, walk
from sb3_trainer import learn

from ember_ros.loop import Loop
from ember_ros.params import Params, replace
from ember_ros.run_config import RunConfig
from ember_ros.versions import provenance, versions
from leg_node.table import Table
from leg_node.table_file import save_table

EVALUATION_STRIDES = 64
"""Strides between two evaluations during the training."""
GREEDY = replace(Params(), {"train.epsilon_start": 0.0, "train.epsilon_end": 0.0})


class RewardSum:
    """Observer that sums the mean reward of the legs over ticks."""

    def __init__(self) -> None:
        self.total, self.ticks = 0.0, 0

    def tick(self, beat: Any, senses: Any, commands: Any, body: Any, transitions: Any) -> None:
        self.total += statistics.fmean(transition.reward for transition in transitions)
        self.ticks += 1


def q_walk(table: Table, world: str, strides: int, seed: int, *, learning: bool) -> WalkResult:
    """Evaluate a table, as ``sb3_legs.walk`` evaluates a network."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "table.npz"
        save_table(file, table, GREEDY, seed)
        loop = Loop(RunConfig(world, strides, seed, GREEDY, learning=learning, table=file))
    distances, rewards = [], RewardSum()
    for stride in range(strides):
        start = loop.world.body()
        for _ in range(GREEDY.gait.ticks):
            loop.tick(*[rewards] if stride >= strides // 4 else [])
        end, yaw = loop.world.body(), start.yaw
        distances.append((end.x - start.x) * math.cos(yaw) + (end.y - start.y) * math.sin(yaw))
    loop.close()
    return WalkResult(
        statistics.fmean(distances[strides // 4 :]), rewards.total / rewards.ticks, end.falls
    )


def q_learn(strides: int, seed: int) -> tuple[Table, list[dict[str, float]]]:
    """Train one leg as ``ember train`` does; return its table and the evaluations."""
    loop, curve = Loop(RunConfig("trainer", strides, seed)), []
    cpu_s = wall_s = 0.0
    table = loop.shared.table
    for done in [*range(0, strides, EVALUATION_STRIDES), strides]:
        cpu_start, wall_start = time.process_time(), time.monotonic()
        while loop.now < done * GREEDY.gait.ticks:
            loop.tick()
        cpu_s += time.process_time() - cpu_start
        wall_s += time.monotonic() - wall_start
        table_now = loop.shared.preview()
        walked = q_walk(table_now, "trainer", 24, seed, learning=False)
        curve.append({"strides": done, "wall_s": wall_s, "cpu_s": cpu_s, **walked._asdict()})
    table = loop.finish()
    loop.close()
    return table, curve


def first(curve: list[dict[str, float]], key: str, minimum: float) -> str:
    """Return after how many strides a value first reached a minimum, and wall and CPU time."""
    found = next((each for each in curve if each[key] >= minimum), None)
    if found is None:
        return f"not in {curve[-1]['strides']}"
    return f"{found['strides']} ({found['wall_s']:.0f} s, {found['cpu_s']:.0f} s)"


def measure(seed: int, args: argparse.Namespace) -> dict[str, Any]:
    """Return all results of a seed."""
    table, q_curve = q_learn(args.q_strides, seed)
    model, norm, callback = learn("trainer", args.strides, args.target, seed, args.cpu_s)
    frozen = walk(model, norm, "walker", args.frozen_strides)
    body = learn("walker", args.walk_strides, math.inf, seed, args.cpu_s, (model, norm))
    learning_on = q_walk(table, "walker", args.walk_strides, seed, learning=True)
    return {
        "seed": seed,
        "q": {
            "curve": q_curve,
            "frozen": q_walk(table, "walker", args.frozen_strides, seed, learning=False)._asdict(),
            "falls_learning": learning_on.falls,
            "learnt_on": learning_on._asdict(),
        },
        "ppo": {
            "curve": callback.curve,
            "frozen": frozen._asdict(),
            "falls_learning": body[2].falls,
            "learnt_on": walk(body[0], body[1], "walker", args.frozen_strides)._asdict(),
        },
    }


def page(result: dict[str, Any]) -> str:
    """Return the results as a Markdown page."""
    arguments = result["arguments"]
    target = arguments["target"]
    lines = [
        "# Comparison of PPO and Q-learning",
        "",
        f"Made by `python examples/ppo_against_q.py --out docs/results`: Q-learning (`ember`) for "
        f"{arguments['q_strides']} strides on the trainer, and PPO of Stable-Baselines3, with its "
        "defaults except our discount factor, until it reaches the target, for at most "
        f"{arguments['strides']} strides and {arguments['cpu_s']:.0f} s of CPU. Both have the same "
        "senses, actions and reward; PPO observes the senses as continuous values, Q-learning as "
        "one of its states. A stride is a cycle of the CPG, 32 actions of a leg. The target is "
        f"{target} m per stride, the result of our training with seed 0. Every "
        f"{EVALUATION_STRIDES} strides the policy is evaluated with its best actions for 24 "
        "strides, without the first 6; in brackets wall and CPU time of learning. Then four copies "
        "carry the body, frozen and with further common learning. Distances are forward, rewards "
        "are per tick. Neither learner is rewarded for distance, and shorter strides can have a "
        "higher reward; that one evaluation reaches the target may be chance, and PPO stops there. "
        "Versions: "
        + ", ".join(f"{name} {each}" for name, each in result["versions"].items())
        + f". On {result['provenance']['cpu']}, {result['provenance']['date']}, one thread.",
        "",
        "| learner, seed | strides to the target | strides to the reward that Q-learning ends with "
        "| at the end: strides | m | reward | four frozen copies: m | reward "
        f"| falls in {arguments['frozen_strides']} "
        f"| learning on for {arguments['walk_strides']}: falls | m | reward |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in ("q", "ppo"):
        for run in result["runs"]:
            one, ends = run[name], run["q"]["curve"][-1]["reward"]
            last, frozen, on = one["curve"][-1], one["frozen"], one["learnt_on"]
            lines.append(
                f"| {name}, {run['seed']} | {first(one['curve'], 'm', target)} "
                f"| {first(one['curve'], 'reward', ends)} | {last['strides']} | {last['m']:.3f} "
                f"| {last['reward']:.3f} | {frozen['m']:.3f} | {frozen['reward']:.3f} "
                f"| {frozen['falls']} | {one['falls_learning']} | {on['m']:.3f} "
                f"| {on['reward']:.3f} |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run all seeds; write the results after each of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument(
        "--target", type=float, default=0.43, help="m per stride, that of `ember train`"
    )
    parser.add_argument("--strides", type=int, default=6000, help="of PPO, maximum")
    parser.add_argument("--q-strides", type=int, default=6000, help="of Q-learning")
    parser.add_argument("--walk-strides", type=int, default=500, help="on the body, learning")
    parser.add_argument("--frozen-strides", type=int, default=200, help="on the body, frozen")
    parser.add_argument(
        "--cpu-s", type=float, default=900.0, help="of the training of PPO, maximum"
    )
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    names = ("stable-baselines3", "torch", "gymnasium", "pettingzoo")
    result: dict[str, Any] = {
        "arguments": {name: value for name, value in vars(args).items() if name != "out"},
        "versions": versions() | {name: version(name) for name in names},
        "provenance": provenance(),
        "runs": [],
    }
    args.out.mkdir(parents=True, exist_ok=True)
    for seed in args.seeds:
        result["runs"].append(measure(seed, args))
        for name, text in (("ppo.json", json.dumps(result, indent=1)), ("ppo.md", page(result))):
            (args.out / f"{name}.new").write_text(text, encoding="utf-8")
            os.replace(args.out / f"{name}.new", args.out / name)
        print(page(result).splitlines()[-1], flush=True)


if __name__ == "__main__":
    main()
