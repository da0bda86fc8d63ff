"""Every example runs with small settings and has the documented result."""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from ember_ros.loop import Loop
from ember_ros.params import Params
from ember_ros.params_file import load_params
from ember_ros.run_config import RunConfig
from sim_node.contract import check_world

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"


def missing(*names: str) -> pytest.MarkDecorator:
    """Return a mark that skips a test if a library is not installed."""
    missing_names = [name for name in names if find_spec(name) is None]
    return pytest.mark.skipif(
        bool(missing_names), reason=f"not installed: {', '.join(missing_names)}"
    )


PHYSICS = missing("pybullet")
ENVS = missing("gymnasium", "pettingzoo", "pybullet")
SB3 = missing("stable_baselines3", "torch", "gymnasium", "pettingzoo", "pybullet")


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make the examples importable; remove them from ``sys.modules`` afterwards."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    names = {file.stem for file in EXAMPLES.glob("*.py")}
    yield
    for name in names & set(sys.modules):
        del sys.modules[name]


def run(*args: str, domain: int = 0) -> str:
    """Run Python with the examples on its path; return its standard output."""
    paths = os.pathsep.join(map(str, (EXAMPLES, ROOT)))
    done = subprocess.run(
        [sys.executable, *args],
        env={**os.environ, "PYTHONPATH": paths, "ROS_DOMAIN_ID": str(domain)},
        capture_output=True,
        text=True,
        check=False,
        timeout=900.0,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_readme_lists_all_examples() -> None:
    """Each file is listed, and starts with a description."""
    readme = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    files = [file for file in EXAMPLES.iterdir() if file.suffix in (".py", ".yaml")]
    assert len(files) > 5
    for file in files:
        assert f"`{file.name}`" in readme
        assert file.read_text(encoding="utf-8").startswith(('"""', "# "))


@ENVS
def test_the_code_in_the_readme_runs() -> None:
    """Unchanged except for fewer cycles."""
    readme = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    assert "max_cycles=100" in code
    x, falls = run("-c", code.replace("max_cycles=100", "max_cycles=2")).split()
    assert float(x) != 0.0
    assert int(falls) >= 0


@PHYSICS
@pytest.mark.slow
def test_the_user_defined_reward_is_used_and_recorded(tmp_path: Path) -> None:
    """Its term is in the summary and negative, since the knee moves."""
    out = tmp_path / "mine"
    run(
        "-m", "ember_ros", "train", "--set", "parts.reward=own_reward.Mine",
        "--cycles", "4", "--on", "loop", "--out", str(out),
    )  # fmt: skip
    rewards_by_term = json.loads((out / "summary.json").read_text())["last"]["reward_by_term"]
    assert list(rewards_by_term)[-1] == "calm"
    assert rewards_by_term["calm"] < -0.005


@PHYSICS
def test_the_new_body_walks() -> None:
    """Eight legs with the scripted policy walk forward without a fall."""
    params = load_params(EXAMPLES / "new_body.yaml")
    loop = Loop(RunConfig("walker", 12, params=params, policy="scripted", learning=False))
    assert len(loop.legs) == 8
    for _ in range(12 * params.gait.ticks):
        loop.tick()
    body = loop.world.body()
    loop.close()
    assert body.falls == 0
    assert body.x > 12 * 0.25


@ENVS
def test_independent_learners_learn(examples: None, capsys: pytest.CaptureFixture[str]) -> None:
    """The reward on the trainer increases; then four copies run."""
    example: Any = importlib.import_module("independent_q")
    args = example.Args(train_cycles=60, walk_cycles=4, report_cycles=30)
    env = example.WalkerEnv(world="trainer", observation="state", max_cycles=61)
    learner = example.QLearner(*(int(s.n) for s in spaces(env)), args, [1])
    first, last = (rewards(env, learner, example, args) for _ in range(2))
    assert last > first + 0.1
    distance = example.main(example.Args(train_cycles=2, walk_cycles=2, report_cycles=1))
    assert math.isfinite(distance)
    output = capsys.readouterr().out
    assert "4 copies of it on the body" in output
    assert output.count("falls") >= 4


def spaces(env: Any) -> tuple[Any, Any]:
    """Return the spaces of an environment's first agent."""
    leg = env.possible_agents[0]
    return env.observation_space(leg), env.action_space(leg)


def rewards(env: Any, learner: Any, example: Any, args: Any) -> float:
    """Let one leg learn for 60 cycles; return its mean reward."""
    received: list[float] = []
    learn = learner.learn

    def log_and_learn(state: int, action: int, reward: float, next_state: int) -> None:
        received.append(reward)
        learn(state, action, reward, next_state)

    learner.learn = log_and_learn
    epsilon = learner.epsilon
    example.run(env, {env.possible_agents[0]: learner}, args.train_cycles, args)
    learner.epsilon, learner.learn = epsilon, learn
    return sum(received) / len(received)


@SB3
def test_ppo_learns_on_one_leg_and_on_four() -> None:
    """64 strides on the trainer, then four legs, frozen and learning."""
    args = ("--seeds", "3", "--strides", "64", "--walk-strides", "16")
    lines = run(str(EXAMPLES / "sb3_trainer.py"), *args).splitlines()
    assert [line.split(":")[0] for line in lines if line.startswith("seed")] == [
        "seed 3, trainer", "seed 3, four frozen copies", "seed 3, learning on together",
    ]  # fmt: skip
    assert [line.split(":")[0] for line in lines if line.startswith("  ")] == [
        f"  {world} strides" for world in ("trainer, 0", "trainer, 64", "walker, 0", "walker, 16")
    ]


@SB3
def test_legs_are_many_environments_to_sb3(examples: None) -> None:
    """Each leg has its own observation, reward and info; the robot continues after a fall."""
    import numpy as np

    legs: Any = importlib.import_module("sb3_legs").Legs("walker", seed=2)
    first = legs.reset()
    assert first.shape == (4, *legs.observation_space.shape)
    rng, fell = np.random.default_rng(0), 0
    for _ in range(10 * 32):
        observations, rewards, dones, infos = legs.step(rng.integers(9, size=4))
        fell += bool(dones.all())
        assert dones.tolist() == [info["first_tick"] for info in infos]
        assert len({tuple(leg) for leg in observations}) == 4 or dones.all()
        assert rewards.tolist() == [sum(info["terms"].values()) for info in infos]
    assert legs.env.body.falls == fell > 0
    assert legs.get_attr("render_mode") == [None] * 4
    legs.close()


@SB3
def test_the_comparison_writes_json_and_markdown(tmp_path: Path) -> None:
    """The page has one row per learner and seed, with the values of the JSON file."""
    run(
        str(EXAMPLES / "ppo_against_q.py"), "--out", str(tmp_path), "--seeds", "1",
        "--strides", "64", "--q-strides", "64", "--walk-strides", "16", "--frozen-strides", "8",
    )  # fmt: skip
    results = json.loads((tmp_path / "ppo.json").read_text())
    (one,) = results["runs"]
    assert [each["strides"] for each in one["q"]["curve"]] == [0, 64]
    assert [each["strides"] for each in one["ppo"]["curve"]] == [0, 64]
    page = (tmp_path / "ppo.md").read_text()
    for name in ("q", "ppo"):
        assert page.count(f"| {name}, 1 | ") == 1
        assert f"{one[name]['frozen']['m']:.3f}" in page


def test_the_hardware_world_fulfils_the_contract_of_worlds(examples: None) -> None:
    """``check_world`` passes, and a leg learns in it."""
    example: Any = importlib.import_module("leg_driver")
    check_world(lambda: example.HardwareLeg(Params()))
    loop = Loop(RunConfig("leg_driver.HardwareLeg", 8))
    for _ in range(8 * 32):
        loop.tick()
    assert int(loop.finish().visits.sum()) == 8 * 32 - 1
    loop.close()


@missing("rclpy")
@pytest.mark.slow
def test_the_leg_driver_learns_on_a_graph(free_domain: int) -> None:
    """Senses, commands and the table go over topics and services."""
    output = run(str(EXAMPLES / "leg_driver.py"), "--cycles", "3", domain=free_domain)
    assert output == "96 ticks of leg; 95 updates learnt\n"
