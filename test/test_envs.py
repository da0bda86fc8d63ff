"""The environments follow Gymnasium and PettingZoo, and return the loop's senses and rewards."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ember_ros.errors import ParameterError
from ember_ros.loop import Loop
from ember_ros.params import TRAINER_LEG, Params, replace
from ember_ros.params_file import load_params
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from sim_node.fake import FakeWorld

if find_spec("gymnasium") is None or find_spec("pettingzoo") is None:
    pytest.skip("the extra envs is missing", allow_module_level=True)

import gymnasium
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

from ember_ros.envs import TRAINER_ID, TrainerEnv, WalkerEnv, robot
from ember_ros.envs.observation import sensors_of

ROOT = Path(__file__).resolve().parents[1]
LEG_FIELDS = [sensor.name for sensor in sensors_of(Params())]
physics = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is missing")


class Fake(FakeWorld):
    """The fake world with the constructor of a world; the robot falls at ticks 40 and 70."""

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        super().__init__(params=params, falls_at=(40, 70))
        self.seed, self.gui, self.closed = seed, gui, False
        created_worlds.append(self)

    def close(self) -> None:
        self.closed = True


class OneLeg(Fake):
    """The same with only the leg of the trainer."""

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        FakeWorld.__init__(self, [TRAINER_LEG], params, falls_at=(40, 70))
        self.seed, self.gui, self.closed = seed, gui, False
        created_worlds.append(self)

    @staticmethod
    def legs_of(params: Params) -> Sequence[str]:
        return (TRAINER_LEG,)


created_worlds: list[Fake] = []


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make ``fakes.Fake`` a valid dotted path."""
    monkeypatch.setitem(sys.modules, "fakes", sys.modules[__name__])
    created_worlds.clear()
    yield
    created_worlds.clear()


class SignalLog:
    """Observer that keeps the senses and transitions of each tick of a loop."""

    def __init__(self) -> None:
        self.senses: list[tuple[LegSense, ...]] = []
        self.transitions: list[tuple[Transition, ...]] = []

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        self.senses.append(tuple(senses))
        self.transitions.append(
            tuple(transition for transition in transitions if transition is not None)
        )


class LoggedRandom:
    """A random policy that logs its actions, also of ticks without a transition (before a fall)."""

    def __init__(
        self, params: Params, learning_params: Any, q_values: Any, rng: Any, start: int
    ) -> None:
        self._rng, self._actions = rng, len(params.leg.knee_speeds)

    def choose(self, sense: LegSense, gait: Any, state: int) -> int:
        action = int(self._rng.integers(self._actions))
        chosen_actions.setdefault(sense.tick, []).append(action)
        return action


chosen_actions: dict[int, list[int]] = {}


def loop_of(config: RunConfig, ticks: int) -> SignalLog:
    """Run a loop with random actions; their actions are in ``chosen_actions``."""
    chosen_actions.clear()
    log, loop = SignalLog(), Loop(config)
    for _ in range(ticks):
        loop.tick(log)
    loop.close()
    return log


def expected(sense: LegSense, stance: bool) -> list[float]:
    """Return the expected observation, without ``ticks_to_stance``."""
    values = {**sense._asdict(), "stance": stance}
    return [float(values[name]) for name in LEG_FIELDS[:-1]]


def modulated() -> Params:
    return load_params("modulated")


CASES = [
    pytest.param("walker", Params(), True, id="quadruped", marks=physics),
    pytest.param("walker", load_params("hexapod"), False, id="hexapod", marks=physics),
    pytest.param("fakes.Fake", Params(), True, id="fake"),
    pytest.param(
        "fakes.Fake", replace(Params(), {"reward.lead": 0, "leg.load": 30.0}), True, id="other"
    ),
]


@pytest.mark.parametrize(("world", "params", "falls"), CASES)
def test_walker_env_returns_the_bits_of_the_loop(world: str, params: Params, falls: bool) -> None:
    """Senses, stance, state, reward and its terms are equal for the same actions.

    No value is clipped. A robot with random actions falls, and the episode continues.
    """
    config = RunConfig(
        world, 10, seed=5, params=params, policy="fakes.LoggedRandom", learning=False
    )
    ticks = config.cycles * params.gait.ticks
    log = loop_of(config, ticks)
    by_senses = WalkerEnv(params, world=world, max_cycles=1000)
    by_state = WalkerEnv(params, world=world, observation="state", max_cycles=1000)
    observations, infos = by_senses.reset(seed=5)
    states, _ = by_state.reset(seed=5)
    fell = 0
    rewards = dict.fromkeys(config.legs, 0.0)
    for tick in range(ticks):
        for n, leg in enumerate(config.legs):
            transition, sense = log.transitions[tick][n], log.senses[tick][n]
            assert observations[leg][:-1].tolist() == expected(sense, transition.next_stance)
            place = (tick / 32 + params.robot.offset[n]) % 1.0 * 32
            assert observations[leg][-1] == (32 - place if place >= 24 else 0.0)
            assert states[leg] == transition.next_state
            assert rewards[leg] == transition.reward
            assert infos[leg] == {"terms": dict(transition.terms), "first_tick": sense.first_tick}
            fell += sense.first_tick
        actions = dict(zip(config.legs, chosen_actions[tick], strict=True))
        observations, rewards, _, _, infos = by_senses.step(actions)
        states = by_state.step(actions)[0]
    assert len({transition.reward for row in log.transitions for transition in row}) > 10
    assert (fell > 0) is falls
    by_senses.close()
    by_state.close()


@physics
def test_trainer_env_returns_the_bits_of_the_loop() -> None:
    """With a modulated stop, whose heights depend on the seed; rendering changes nothing."""
    params = modulated()
    config = RunConfig(
        "trainer", 8, seed=6, params=params, policy="fakes.LoggedRandom", learning=False
    )
    log = loop_of(config, config.cycles * params.gait.ticks)
    env = TrainerEnv(params, max_cycles=8, render_mode="rgb_array")
    observation, info = env.reset(seed=6)
    reward, credited = 0.0, 0
    for tick, (senses, (transition,)) in enumerate(zip(log.senses, log.transitions, strict=True)):
        assert observation[:-1].tolist() == expected(senses[0], transition.next_stance)
        assert reward == transition.reward
        assert info["terms"] == dict(transition.terms)
        credited += transition.credited
        if tick % 16 == 0:
            assert env.render() is not None
        observation, reward, terminated, truncated, info = env.step(chosen_actions[tick][0])
        assert (terminated, truncated) == (False, tick == len(log.senses) - 1)
    assert credited == len(log.senses) - 1
    env.close()


@physics
def test_an_episode_depends_only_on_its_seed() -> None:
    """The same seed gives the same episode, in a new or a used environment; another seed does not.

    Without a seed, one is drawn from the generator of the environment.
    """

    def episode(env: Any, seed: int | None) -> list[Any]:
        values = [env.reset(seed=seed)[0].tolist()]
        for tick in range(64):
            observation, reward, *_ = env.step(tick % 9)
            values += [reward, observation.tolist()]
        return values

    one, other = TrainerEnv(modulated()), TrainerEnv(modulated())
    first, second, third = episode(one, 3), episode(one, None), episode(one, None)
    assert episode(other, 3) == first
    assert episode(other, None) == second
    assert second not in (first, third)
    assert episode(one, 3) == first
    assert episode(one, 4) != first
    one.close()
    other.close()


@pytest.mark.parametrize("observation", ["senses", "state"])
@pytest.mark.parametrize("world", ["fakes.Fake", pytest.param("walker", marks=physics)])
def test_pettingzoo_checks_pass(world: str, observation: str) -> None:
    """PettingZoo's tests of the interface and of seeds."""

    def make() -> WalkerEnv:
        return WalkerEnv(world=world, observation=observation, max_cycles=2)

    parallel_api_test(make(), num_cycles=200)
    parallel_seed_test(make, num_cycles=40)


@physics
@pytest.mark.parametrize("observation", ["senses", "state"])
def test_gymnasium_checks_pass(observation: str) -> None:
    """Gymnasium's checker without rendering, which needs a window. A warning fails the test."""
    env = gymnasium.make(TRAINER_ID, observation=observation)
    assert env.spec is not None
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_observations_share_no_memory() -> None:
    """Earlier history do not change, and writing into them changes no later one."""
    env, untouched = (WalkerEnv(world="fakes.Fake") for _ in range(2))
    (observations, infos), (same, _) = env.reset(seed=0), untouched.reset(seed=0)
    history = [observations]
    for n in range(48):
        before = [{leg: each.copy() for leg, each in old.items()} for old in history]
        actions = dict.fromkeys(env.agents, n % 9)
        observations, _, _, _, infos = env.step(actions)
        same, _, _, _, same_infos = untouched.step(actions)
        for leg in env.agents:
            np.testing.assert_array_equal(observations[leg], same[leg])
            assert infos[leg] == same_infos[leg]
            infos[leg]["terms"].clear()
        for old, copy in zip(history, before, strict=True):
            for leg in env.agents:
                np.testing.assert_array_equal(old[leg], copy[leg])
        history.append(observations)
        for leg in env.agents:
            observations[leg][:] = observations[leg] * 0.0 - 1.0
    arrays = [each for old in history for each in old.values()]
    assert not any(
        np.shares_memory(one, other) for n, one in enumerate(arrays) for other in arrays[n + 1 :]
    )


@pytest.mark.parametrize("ends", [False, True])
def test_a_fall_sets_first_tick_and_ends_the_episode_only_if_asked_for(ends: bool) -> None:
    """The fake robot falls at ticks 40 and 70; the reward of these ticks is 0."""
    env = WalkerEnv(world="fakes.Fake", terminate_on_fall=ends, max_cycles=3)
    alone = TrainerEnv(world="fakes.OneLeg", terminate_on_fall=ends, max_cycles=3)
    legs = list(env.reset(seed=0)[0])
    alone.reset(seed=0)
    for tick in range(1, 97):
        _, rewards, terminated, truncated, infos = env.step(dict.fromkeys(legs, 5))
        one = alone.step(5)
        fell, last = tick in (40, 70), tick == 96
        assert terminated == dict.fromkeys(legs, ends and fell)
        assert truncated == dict.fromkeys(legs, last)
        assert [infos[leg]["first_tick"] for leg in legs] == [fell] * 4
        assert (one[2], one[3], one[4]["first_tick"]) == (ends and fell, last, fell)
        if fell:
            assert set(rewards.values()) == {0.0}
        if (ends and fell) or last:
            break
        assert env.agents == legs
    assert tick == (40 if ends else 96)
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})


@physics
def test_rendered_pictures_show_the_moving_robot() -> None:
    """Pictures have the documented shape and many colours, and differ after the robot moved."""
    walker, trainer = WalkerEnv(render_mode="rgb_array"), TrainerEnv(render_mode="rgb_array")
    for env, act in ((walker, dict.fromkeys(walker.possible_agents, 8)), (trainer, 8)):
        env.reset(seed=0)
        first = env.render()
        assert first is not None
        for _ in range(16):
            env.step(act)  # type: ignore[arg-type]
        second = env.render()
        for picture in (first, second):
            assert picture is not None
            assert picture.shape == (320, 480, 3)
            assert picture.dtype == np.uint8
            assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
        assert (first != second).any()
        assert env.metadata["render_fps"] == 64
        env.close()
    without_rendering = TrainerEnv()
    without_rendering.reset(seed=0)
    assert without_rendering.render() is None
    without_rendering.close()


def test_human_rendering_runs_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tick sleeps for the rest of its 1/64 s; lost time is not made up."""
    now, slept = 100.0, []
    durations = iter([0.0, 0.005, 0.5, 0.0])

    class Clock:
        @staticmethod
        def monotonic() -> float:
            nonlocal now
            now += next(durations)
            return now

        @staticmethod
        def sleep(s: float) -> None:
            nonlocal now
            now += s
            slept.append(s)

    monkeypatch.setattr(robot, "time", Clock)
    env = TrainerEnv(world="fakes.OneLeg", render_mode="human")
    env.reset(seed=0)
    assert created_worlds[-1].gui
    for _ in range(4):
        env.step(0)
    tick = env.params.gait.tick_s
    assert slept == pytest.approx([0.0, tick - 0.005, 0.0, tick])
    assert env.render() is None


def test_a_world_is_reused_for_the_same_seed_and_closed_otherwise() -> None:
    """The same seed resets the world; another seed closes it and creates a new one."""
    env = WalkerEnv(world="fakes.Fake")
    for seed in (1, 1, 2):
        env.reset(seed=seed)
    assert [(each.seed, each.closed) for each in created_worlds] == [(1, True), (2, False)]
    env.close()
    env.close()
    assert created_worlds[-1].closed
    env.reset(seed=2)
    assert len(created_worlds) == 3


def test_each_agent_has_its_own_spaces() -> None:
    """Always the same objects, so that seeding one space does not affect another."""
    env = WalkerEnv(world="fakes.Fake")
    observations, _ = env.reset(seed=0)
    for leg, space in env.observation_spaces.items():
        assert space.contains(observations[leg])
        assert space is env.observation_space(leg)
    assert len({id(space) for space in env.observation_spaces.values()}) == 4


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WalkerEnv(observation="all"), "observation = 'all'; 'senses' or 'state'"),
        (lambda: WalkerEnv(render_mode="ansi"), "render_mode = 'ansi'"),
        (lambda: TrainerEnv(max_cycles=0), "max_cycles = 0; 1 or more"),
        (lambda: TrainerEnv(world="walker"), "front_left.*WalkerEnv"),
        (lambda: WalkerEnv(world="moon"), "there is no world 'moon'"),
        (lambda: WalkerEnv().step({}), r"call reset\(\) first"),
        (lambda: TrainerEnv(world="fakes.OneLeg").body, r"call reset\(\) first"),
    ],
)
def test_invalid_arguments_are_refused(make: Any, message: str) -> None:
    """The error names the argument and valid values."""
    with pytest.raises(ParameterError, match=message):
        make()


@pytest.mark.parametrize("action", [9, -1, 1.0, None])
def test_an_invalid_action_is_refused(action: Any) -> None:
    """No leg moves before all actions are checked."""
    env = WalkerEnv(world="fakes.Fake")
    env.reset(seed=0)
    good = dict.fromkeys(env.agents, 0)
    with pytest.raises(ParameterError, match=r"action of rear_right = .*; a whole number, 0 to 8"):
        env.step({**good, "rear_right": action})
    with pytest.raises(ParameterError, match="one of each of front_left"):
        env.step({"front_left": 0})
    assert created_worlds[-1].observe()[0].tick == 0


def test_rendering_a_world_without_pictures_is_refused() -> None:
    """A user's world needs the method ``picture`` only for rendering."""
    env = TrainerEnv(world="fakes.OneLeg", render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(ParameterError, match=r"'fakes.OneLeg' cannot be drawn; .*picture"):
        env.render()


@pytest.mark.parametrize("library", ["gymnasium", "pettingzoo"])
def test_without_the_extra_the_import_error_names_it(library: str) -> None:
    """The rest of the package can be imported."""
    code = (
        "import importlib.abc, sys\n"
        "class Blocker(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.split('.')[0] == {library!r}:\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Blocker())\n"
        "import ember_ros.loop\n"
        "from ember_ros.errors import MissingError\n"
        "try:\n"
        "    import ember_ros.envs\n"
        "except MissingError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == (
        f"{library} is not installed, and is needed for environments: "
        "`pip install 'ember_ros[envs]'`\n"
    )
