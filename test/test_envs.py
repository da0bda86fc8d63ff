"""The environments keep to Gymnasium and PettingZoo, and give the loop's senses and rewards."""

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
    """The fake world as a registry makes it; all legs fall at ticks 40 and 70."""

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        super().__init__(params=params, falls_at=(40, 70))
        self.seed, self.gui, self.closed = seed, gui, False
        made.append(self)

    def close(self) -> None:
        self.closed = True


class OneLeg(Fake):
    """The same with the trainer's leg."""

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        FakeWorld.__init__(self, [TRAINER_LEG], params, falls_at=(40, 70))
        self.seed, self.gui, self.closed = seed, gui, False
        made.append(self)

    @staticmethod
    def legs_of(params: Params) -> Sequence[str]:
        return (TRAINER_LEG,)


made: list[Fake] = []


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let ``fakes.Fake`` be a world's dotted path."""
    monkeypatch.setitem(sys.modules, "fakes", sys.modules[__name__])
    made.clear()
    yield
    made.clear()


class Heard:
    """Keeps a loop's senses and transitions, tick by tick."""

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
        self.transitions.append(tuple(did for did in transitions if did is not None))


class Chosen:
    """A random policy that keeps what it chose: a tick that ends in a fall is told by nobody."""

    actions: dict[int, list[int]]

    def __init__(
        self, params: Params, learning_params: Any, q_values: Any, rng: Any, start: int
    ) -> None:
        self._rng, self._most = rng, len(params.leg.knee_speeds)

    def choose(self, sense: LegSense, gait: Any, state: int) -> int:
        action = int(self._rng.integers(self._most))
        chosen.setdefault(sense.tick, []).append(action)
        return action


chosen: dict[int, list[int]] = {}


def loop_of(config: RunConfig, ticks: int) -> Heard:
    """Run a loop whose legs act at random; what they chose is in ``chosen``."""
    chosen.clear()
    heard, loop = Heard(), Loop(config)
    for _ in range(ticks):
        loop.tick(heard)
    loop.close()
    return heard


def expected(sense: LegSense, stance: bool) -> list[float]:
    """Return the senses as an observation has them, but for ``ticks_to_stance``."""
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
def test_the_walker_gives_the_bits_of_the_loop(world: str, params: Params, falls: bool) -> None:
    """Senses, stance, state, reward and its terms, with the actions that the loop's legs chose.

    No sensor saturates; four legs with random knees fall, and go on.
    """
    config = RunConfig(world, 10, seed=5, params=params, policy="fakes.Chosen", learning=False)
    ticks = config.cycles * params.gait.ticks
    heard = loop_of(config, ticks)
    by_senses = WalkerEnv(params, world=world, max_cycles=1000)
    by_state = WalkerEnv(params, world=world, observation="state", max_cycles=1000)
    seen, infos = by_senses.reset(seed=5)
    states, _ = by_state.reset(seed=5)
    fell = 0
    rewards = dict.fromkeys(config.legs, 0.0)
    for tick in range(ticks):
        for n, leg in enumerate(config.legs):
            did, sense = heard.transitions[tick][n], heard.senses[tick][n]
            assert seen[leg][:-1].tolist() == expected(sense, did.next_stance)
            place = (tick / 32 + params.robot.offset[n]) % 1.0 * 32
            assert seen[leg][-1] == (32 - place if place >= 24 else 0.0)
            assert states[leg] == did.next_state
            assert rewards[leg] == did.reward
            assert infos[leg] == {"terms": dict(did.terms), "first_tick": sense.first_tick}
            fell += sense.first_tick
        actions = dict(zip(config.legs, chosen[tick], strict=True))
        seen, rewards, _, _, infos = by_senses.step(actions)
        states = by_state.step(actions)[0]
    assert len({did.reward for told in heard.transitions for did in told}) > 10
    assert (fell > 0) is falls
    by_senses.close()
    by_state.close()


@physics
def test_the_trainer_gives_the_bits_of_the_loop() -> None:
    """With a modulated stop, whose heights the seed decides; drawn at every tick, too."""
    params = modulated()
    config = RunConfig("trainer", 8, seed=6, params=params, policy="fakes.Chosen", learning=False)
    heard = loop_of(config, config.cycles * params.gait.ticks)
    env = TrainerEnv(params, max_cycles=8, render_mode="rgb_array")
    seen, info = env.reset(seed=6)
    reward, paid = 0.0, 0
    for tick, (senses, (did,)) in enumerate(zip(heard.senses, heard.transitions, strict=True)):
        assert seen[:-1].tolist() == expected(senses[0], did.next_stance)
        assert reward == did.reward
        assert info["terms"] == dict(did.terms)
        paid += did.credited
        if tick % 16 == 0:
            assert env.render() is not None
        seen, reward, terminated, truncated, info = env.step(chosen[tick][0])
        assert (terminated, truncated) == (False, tick == len(heard.senses) - 1)
    assert paid == len(heard.senses) - 1
    env.close()


@physics
def test_a_seed_decides_every_bit() -> None:
    """The same seed, the same episode, in a new environment or in one that went on; another not.

    Without a seed the next one is drawn from the last.
    """

    def episode(env: Any, seed: int | None) -> list[Any]:
        told = [env.reset(seed=seed)[0].tolist()]
        for tick in range(64):
            seen, reward, *_ = env.step(tick % 9)
            told += [reward, seen.tolist()]
        return told

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
def test_pettingzoo_finds_nothing_wrong(world: str, observation: str) -> None:
    """Its own tests of the interface and of seeds."""

    def make() -> WalkerEnv:
        return WalkerEnv(world=world, observation=observation, max_cycles=2)

    parallel_api_test(make(), num_cycles=200)
    parallel_seed_test(make, num_cycles=40)


@physics
@pytest.mark.parametrize("observation", ["senses", "state"])
def test_gymnasium_finds_nothing_wrong(observation: str) -> None:
    """Its own checker; without windows, which a test has not. A warning would fail it."""
    made = gymnasium.make(TRAINER_ID, observation=observation)
    assert made.spec is not None
    check_env(made.unwrapped, skip_render_check=True)
    made.close()


def test_observations_share_no_memory() -> None:
    """What was given stays as it was, and writing into it changes nothing that follows."""
    env, untouched = (WalkerEnv(world="fakes.Fake") for _ in range(2))
    (seen, infos), (same, _) = env.reset(seed=0), untouched.reset(seed=0)
    kept = [seen]
    for n in range(48):
        before = [{leg: each.copy() for leg, each in told.items()} for told in kept]
        actions = dict.fromkeys(env.agents, n % 9)
        seen, _, _, _, infos = env.step(actions)
        same, _, _, _, told = untouched.step(actions)
        for leg in env.agents:
            np.testing.assert_array_equal(seen[leg], same[leg])
            assert infos[leg] == told[leg]
            infos[leg]["terms"].clear()
        for old, copy in zip(kept, before, strict=True):
            for leg in env.agents:
                np.testing.assert_array_equal(old[leg], copy[leg])
        kept.append(seen)
        for leg in env.agents:
            seen[leg][:] = seen[leg] * 0.0 - 1.0
    arrays = [each for told in kept for each in told.values()]
    assert not any(
        np.shares_memory(one, other) for n, one in enumerate(arrays) for other in arrays[n + 1 :]
    )


@pytest.mark.parametrize("ends", [False, True])
def test_a_fall_is_told_and_ends_an_episode_only_by_argument(ends: bool) -> None:
    """The fake's legs are put down at ticks 40 and 70; nothing is paid for the tick that fell."""
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
def test_a_picture_shows_the_robot() -> None:
    """Pixels of the right shape, of many colours, that change as the robot moves."""
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
    silent = TrainerEnv()
    silent.reset(seed=0)
    assert silent.render() is None
    silent.close()


def test_a_window_is_shown_in_a_robots_own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tick waits for what is left of its 1/64 s; a late one is not caught up with."""
    now, slept = 100.0, []
    took = iter([0.0, 0.005, 0.5, 0.0])

    class Clock:
        @staticmethod
        def monotonic() -> float:
            nonlocal now
            now += next(took)
            return now

        @staticmethod
        def sleep(s: float) -> None:
            nonlocal now
            now += s
            slept.append(s)

    monkeypatch.setattr(robot, "time", Clock)
    env = TrainerEnv(world="fakes.OneLeg", render_mode="human")
    env.reset(seed=0)
    assert made[-1].gui
    for _ in range(4):
        env.step(0)
    tick = env.params.gait.tick_s
    assert slept == pytest.approx([0.0, tick - 0.005, 0.0, tick])
    assert env.render() is None


def test_a_world_is_built_once_a_seed_and_closed() -> None:
    """The same seed puts the world back; another one builds it anew, and closes the one before."""
    env = WalkerEnv(world="fakes.Fake")
    for seed in (1, 1, 2):
        env.reset(seed=seed)
    assert [(each.seed, each.closed) for each in made] == [(1, True), (2, False)]
    env.close()
    env.close()
    assert made[-1].closed
    env.reset(seed=2)
    assert len(made) == 3


def test_each_agent_has_spaces_of_its_own() -> None:
    """Always the same objects, so that the seed of one draws nothing from another."""
    env = WalkerEnv(world="fakes.Fake")
    seen, _ = env.reset(seed=0)
    for leg, space in env.observation_spaces.items():
        assert space.contains(seen[leg])
        assert space is env.observation_space(leg)
    assert len({id(space) for space in env.observation_spaces.values()}) == 4


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: WalkerEnv(observation="all"), "observation = 'all'; 'senses' or 'state'"),
        (lambda: WalkerEnv(render_mode="ansi"), "render_mode = 'ansi'"),
        (lambda: TrainerEnv(max_cycles=0), "max_cycles = 0; 1 or more"),
        (lambda: TrainerEnv(world="walker"), "front_left.*WalkerEnv"),
        (lambda: WalkerEnv(world="moon"), "there is no world 'moon'"),
        (lambda: WalkerEnv().step({}), r"reset\(\) first"),
        (lambda: TrainerEnv(world="fakes.OneLeg").body, r"reset\(\) first"),
    ],
)
def test_what_cannot_be_used_is_refused(make: Any, says: str) -> None:
    """An error names what is wrong and what would be right."""
    with pytest.raises(ParameterError, match=says):
        make()


@pytest.mark.parametrize("action", [9, -1, 1.0, None])
def test_an_action_that_is_none_is_refused(action: Any) -> None:
    """No leg moves before all actions were looked at."""
    env = WalkerEnv(world="fakes.Fake")
    env.reset(seed=0)
    good = dict.fromkeys(env.agents, 0)
    with pytest.raises(ParameterError, match=r"action of rear_right = .*; a whole number, 0 to 8"):
        env.step({**good, "rear_right": action})
    with pytest.raises(ParameterError, match="one of each of front_left"):
        env.step({"front_left": 0})
    assert made[-1].observe()[0].tick == 0


def test_a_world_that_cannot_be_drawn_says_so() -> None:
    """A world of one's own needs no camera, until it is asked for a picture."""
    env = TrainerEnv(world="fakes.OneLeg", render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(ParameterError, match=r"'fakes.OneLeg' cannot be drawn; .*picture"):
        env.render()


@pytest.mark.parametrize("library", ["gymnasium", "pettingzoo"])
def test_without_the_extra_one_line_names_it(library: str) -> None:
    """And the rest of the package is none the worse."""
    code = (
        "import importlib.abc, sys\n"
        "class Wall(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.split('.')[0] == {library!r}:\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Wall())\n"
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
