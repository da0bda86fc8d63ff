"""PPO beside our Q-learning, seed by seed: the same senses, actions, reward and discount.

PPO sees the senses as numbers, Q-learning its 17 x 8 x 8 x 2 x 2 states. Both learn on the trainer,
then carry the body: frozen, and learning on. PPO has as many strides as Q-learning; --strides gives
it more. Writes ppo.json and ppo.md; half an hour of CPU:

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

from sb3_legs import Walked, walk
from sb3_trainer import learn

from ember_ros.loop import Loop
from ember_ros.params import Params, replace
from ember_ros.run_config import RunConfig
from ember_ros.versions import provenance, versions
from leg_node.table import Table
from leg_node.table_file import save_table

LOOK = 64
"""Strides between two looks at what was learnt on the trainer."""
GREEDY = replace(Params(), {"train.epsilon_start": 0.0, "train.epsilon_end": 0.0})


class Paid:
    """Adds up what the legs are paid."""

    def __init__(self) -> None:
        self.total, self.ticks = 0.0, 0

    def tick(self, beat: Any, senses: Any, commands: Any, body: Any, transitions: Any) -> None:
        self.total += statistics.fmean(did.reward for did in transitions)
        self.ticks += 1


def q_walk(table: Table, world: str, strides: int, seed: int, *, learning: bool) -> Walked:
    """Let legs with a table walk, as ``sb3_legs.walk`` lets them with a network."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "table.npz"
        save_table(file, table, GREEDY, seed)
        loop = Loop(RunConfig(world, strides, seed, GREEDY, learning=learning, table=file))
    ways, paid = [], Paid()
    for stride in range(strides):
        begin = loop.world.body()
        for _ in range(GREEDY.gait.ticks):
            loop.tick(*[paid] if stride >= strides // 4 else [])
        end, yaw = loop.world.body(), begin.yaw
        ways.append((end.x - begin.x) * math.cos(yaw) + (end.y - begin.y) * math.sin(yaw))
    loop.close()
    return Walked(statistics.fmean(ways[strides // 4 :]), paid.total / paid.ticks, end.falls)


def q_learn(strides: int, seed: int) -> tuple[Table, list[dict[str, float]]]:
    """Train one leg as ``ember train`` does; return its table, and looks at it on the way."""
    loop, curve, spent, wall = Loop(RunConfig("trainer", strides, seed)), [], 0.0, 0.0
    table = loop.shared.table
    for done in [*range(0, strides, LOOK), strides]:
        cpu, now = time.process_time(), time.monotonic()
        while loop.now < done * GREEDY.gait.ticks:
            loop.tick()
        spent, wall = spent + time.process_time() - cpu, wall + time.monotonic() - now
        seen = loop.shared.preview()
        walked = q_walk(seen, "trainer", 24, seed, learning=False)
        curve.append({"strides": done, "wall_s": wall, "cpu_s": spent, **walked._asdict()})
    table = loop.finish()
    loop.close()
    return table, curve


def first(curve: list[dict[str, float]], what: str, least: float) -> str:
    """Return after how many strides a leg first walked so far or was paid so much, and the time."""
    found = next((each for each in curve if each[what] >= least), None)
    if found is None:
        return f"not in {curve[-1]['strides']}"
    return f"{found['strides']} ({found['wall_s']:.0f} s, {found['cpu_s']:.0f} s)"


def measure(seed: int, args: argparse.Namespace) -> dict[str, Any]:
    """Return all figures of a seed."""
    table, q_curve = q_learn(args.q_strides, seed)
    model, norm, watch = learn("trainer", args.strides, args.target, seed, args.cpu_s)
    frozen = walk(model, norm, "walker", args.frozen_strides)
    body = learn("walker", args.walk_strides, math.inf, seed, args.cpu_s, (model, norm))
    on = q_walk(table, "walker", args.walk_strides, seed, learning=True)
    return {
        "seed": seed,
        "q": {
            "curve": q_curve,
            "frozen": q_walk(table, "walker", args.frozen_strides, seed, learning=False)._asdict(),
            "falls_learning": on.falls,
            "learnt_on": on._asdict(),
        },
        "ppo": {
            "curve": watch.curve,
            "frozen": frozen._asdict(),
            "falls_learning": body[2].falls,
            "learnt_on": walk(body[0], body[1], "walker", args.frozen_strides)._asdict(),
        },
    }


def page(result: dict[str, Any]) -> str:
    """Return what came of it, in Markdown."""
    told = result["arguments"]
    target = told["target"]
    lines = [
        "# PPO beside Q-learning",
        "",
        f"Made by `python examples/ppo_against_q.py --out docs/results`: Q-learning (`ember`) for "
        f"{told['q_strides']} strides on the trainer, and PPO of Stable-Baselines3, with its "
        f"defaults but our discount, until it walks as far, for at most {told['strides']} strides "
        f"and {told['cpu_s']:.0f} s of CPU. Both have the same senses, actions and reward; PPO "
        "sees the senses as numbers, Q-learning as one of its states. A stride is a cycle of the "
        f"CPG, 32 actions of a leg. As far: {target} m a stride, with which our training ends by "
        f"seed 0, in 24 strides of best actions, the first 6 left out; looked at every {LOOK} "
        "strides, in brackets wall and CPU time of learning. Then four copies carry the body, "
        "frozen and learning on together. Distances are ahead, rewards a tick. Neither learner is "
        "paid for distance, and a leg can earn more by shorter strides; that it walks far at one "
        "look may be luck, and PPO stops there. Versions: "
        + ", ".join(f"{name} {each}" for name, each in result["versions"].items())
        + f". On {result['provenance']['cpu']}, {result['provenance']['date']}, one thread.",
        "",
        "| learner, seed | strides to the target | strides to the reward that Q-learning ends with "
        "| at the end: strides | m | reward | four frozen copies: m | reward "
        f"| falls in {told['frozen_strides']} | learning on for {told['walk_strides']}: falls "
        "| m | reward |",
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
    """Measure all seeds and write what came of it, after each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--target", type=float, default=0.43, help="m a stride, of `ember train`")
    parser.add_argument("--strides", type=int, default=6000, help="of PPO, at most")
    parser.add_argument("--q-strides", type=int, default=6000, help="of Q-learning, all of them")
    parser.add_argument("--walk-strides", type=int, default=500, help="on the body, learning")
    parser.add_argument("--frozen-strides", type=int, default=200, help="on the body, frozen")
    parser.add_argument("--cpu-s", type=float, default=900.0, help="of PPO's training, at most")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    names = ("stable-baselines3", "torch", "gymnasium", "pettingzoo")
    result: dict[str, Any] = {
        "arguments": {name: each for name, each in vars(args).items() if name != "out"},
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
