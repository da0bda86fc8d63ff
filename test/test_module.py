"""One leg module: it credits what it did in a tick with what came of it, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest

from ember_ros.errors import ParameterError
from ember_ros.params import TRAINER_LEG, Params, replace
from ember_ros.params_file import load_params
from ember_ros.signals import LegCommand, LegSense
from leg_node.assembly import empty_table
from leg_node.discretizer import PaperDiscretizer
from leg_node.gait import HipRamp
from leg_node.module import LegModule
from leg_node.reward import PaperReward
from leg_node.table import Table
from sim_node.fake import FakeWorld
from support.learning import paid
from support.legs import LEGS

PARAMS = load_params("plain")
TICKS = PARAMS.gait.ticks
SPEEDS = PARAMS.leg.knee_speeds


def module(
    leg: str = TRAINER_LEG, *, params: Params = PARAMS, shared: bool = False, **rest: object
) -> LegModule:
    """Return a leg with a table of its own."""
    return LegModule(params, leg, shared=shared, **rest)  # type: ignore[arg-type]


def live(
    leg: LegModule,
    ticks: int,
    *,
    world: FakeWorld | None = None,
    begin: int = 0,
    missed: Sequence[int] = (),
    seen: Callable[[LegSense, LegCommand], None] = lambda sense, command: None,
) -> list[LegCommand]:
    """Let a leg live in the fake world, without some ticks; return its commands."""
    world = world or FakeWorld((leg.leg,), PARAMS)
    commands = []
    for tick in range(begin, begin + ticks):
        phase = tick / TICKS
        (sense,) = world.observe()
        command = None
        if tick not in missed:
            command = leg.tick(sense, phase)
            commands.append(command)
            seen(sense, command)
        world.step(phase, [command])
    return commands


def visits(leg: LegModule) -> int:
    """Return the number of updates in a leg's table."""
    return int(leg.copy.table.visits.sum())


# -- learning ------------------------------------------------------------------------------------


def test_a_leg_is_q_learning() -> None:
    """400 ticks are one-step Q-learning, written here a second time from senses and commands."""
    leg, plain = module(seed=5), empty_table(PARAMS)
    partition, rewarder = PaperDiscretizer(PARAMS), PaperReward(PARAMS)
    gait, numbers = HipRamp(PARAMS.gait, TRAINER_LEG), PARAMS.walk
    before: list[tuple[int, int, bool]] = []

    def learn(sense: LegSense, command: LegCommand) -> None:
        stance = gait.stance(sense.tick / TICKS)
        state = partition.index(sense, stance)
        if before:
            old_state, old_action, old_stance = before.pop()
            target = paid(rewarder, sense, old_stance) + numbers.gamma * max(plain.row(state))
            plain.update(old_state * 9 + old_action, target, numbers.rate)
        before.append((state, SPEEDS.index(command.knee_speed), stance))
        assert leg.copy.table.sha256() == plain.sha256()

    live(leg, 400, seen=learn)
    assert visits(leg) == 399


def test_every_tick_but_the_first_is_credited() -> None:
    """At its first tick a leg has done nothing yet; from then on each tick is one update."""
    leg = module()
    counts: list[int] = []
    live(leg, 5, seen=lambda sense, command: counts.append(visits(leg)))
    assert counts == [0, 1, 2, 3, 4]


def test_nothing_is_credited_across_a_restart() -> None:
    """Picked up and put down: the senses after it are none of the leg's doing."""
    leg, world = module(), FakeWorld((TRAINER_LEG,), PARAMS, falls_at={10, 20})
    counts: list[int] = []
    live(leg, 30, world=world, seen=lambda sense, command: counts.append(visits(leg)))
    assert [b - a for a, b in pairwise(counts)] == [
        0 if tick in (10, 20) else 1 for tick in range(1, 30)
    ]


def test_what_is_done_after_a_restart_is_credited() -> None:
    """The first action on its feet again is credited in the next tick, to the state put down in."""
    leg, world = module(), FakeWorld((TRAINER_LEG,), PARAMS, falls_at={10})
    live(leg, 11, world=world)
    before = leg.copy.table.visits.copy()
    (sense,) = world.observe()
    live(leg, 1, world=world, begin=11)
    changed = (leg.copy.table.visits - before).nonzero()[0]
    (put_down,) = FakeWorld((TRAINER_LEG,), PARAMS).observe()
    stance = HipRamp(PARAMS.gait, TRAINER_LEG).stance(10 / TICKS)
    assert sense.tick == 11
    assert [cell // 9 for cell in changed] == [PaperDiscretizer(PARAMS).index(put_down, stance)]


@pytest.mark.parametrize("missed", [(10,), (10, 11, 12), tuple(range(5, 25))])
def test_nothing_is_credited_across_missed_ticks(missed: tuple[int, ...]) -> None:
    """After a gap of one tick or many, the first tick back credits nothing, the next one does."""
    leg = module()
    credited: list[int] = []
    count = 0

    def look(sense: LegSense, command: LegCommand) -> None:
        nonlocal count
        if visits(leg) > count:
            credited.append(sense.tick)
        count = visits(leg)

    live(leg, 30, missed=missed, seen=look)
    back = missed[-1] + 1
    assert credited == [tick for tick in range(1, 30) if tick not in (*missed, back)]


def test_nothing_is_credited_across_lives() -> None:
    """What was done before a restart of the leg is forgotten, even if ticks seem to go on."""
    leg, world = module(), FakeWorld((TRAINER_LEG,), PARAMS)
    live(leg, 32, world=world)
    leg.restart(31, "another life")
    live(leg, 1, world=world, begin=32)
    assert visits(leg) == 31
    live(leg, 1, world=world, begin=33)
    assert visits(leg) == 32


def test_with_learning_off_the_table_never_changes() -> None:
    """Frozen: it acts on what it knows, in any world, over restarts, and learns nothing."""
    learnt = module(seed=2, stage="train")
    live(learnt, 500)
    table = empty_table(PARAMS)
    table.copy_from(learnt.copy.table)
    frozen = module(seed=3, table=table, learning=False)
    live(frozen, 300, world=FakeWorld((TRAINER_LEG,), PARAMS, falls_at={40}))
    assert frozen.copy.table.sha256() == learnt.copy.table.sha256()
    assert frozen.copy.push_due() is None


@pytest.mark.parametrize("policy", ["scripted", "random"])
def test_policies_without_a_table_are_rewarded_too(policy: str) -> None:
    """Whoever chooses, what the actions were worth is learnt: a script can teach."""
    leg = module(policy=policy)
    live(leg, 100)
    assert visits(leg) == 99


def test_the_stage_decides_the_learning_numbers() -> None:
    """With ``train`` the floor and gamma of training hold, with ``walk`` those of walking."""
    other = {"walk.alpha_ceiling": 1.0, "walk.alpha_floor": 1.0, "walk.gamma": 0.0}
    params = replace(PARAMS, other)
    tables = {
        stage: module(params=params, stage=stage, policy="scripted") for stage in ("train", "walk")
    }
    for leg in tables.values():
        live(leg, 200)
    train, walk = (tables[stage].copy.table for stage in ("train", "walk"))
    assert train.visits.tolist() == walk.visits.tolist()
    assert train.values.tolist() != walk.values.tolist()


def test_a_leg_learns() -> None:
    """In the fake world, 300 cycles of training earn more a tick than the first ones did."""
    leg, rewarder, earned = module(stage="train", seed=1), PaperReward(PARAMS), []
    gait = HipRamp(PARAMS.gait, TRAINER_LEG)

    def earn(sense: LegSense, command: LegCommand) -> None:
        if sense.tick:
            earned.append(paid(rewarder, sense, gait.stance((sense.tick - 1) / TICKS)))

    live(leg, 300 * TICKS, seen=earn)
    first, last = earned[: 30 * TICKS], earned[-30 * TICKS :]
    assert sum(last) / len(last) > sum(first) / len(first) + 0.3


# -- acting --------------------------------------------------------------------------------------


def test_commands_are_of_their_tick_and_within_what_a_motor_has() -> None:
    """Tick, a knee speed of the list, a hip speed up to its limit, the motors' own torques."""
    gait = HipRamp(PARAMS.gait, TRAINER_LEG)

    def look(sense: LegSense, command: LegCommand) -> None:
        assert command.tick == sense.tick
        assert command.knee_speed in SPEEDS
        assert abs(command.hip_speed) <= PARAMS.leg.hip_speed_max
        assert (command.hip_torque, command.knee_torque) == (
            PARAMS.leg.hip_torque,
            PARAMS.leg.knee_torque,
        )
        wanted = (gait.hip_goal(sense.tick / TICKS) - sense.hip) / PARAMS.gait.tick_s
        limit = PARAMS.leg.hip_speed_max
        assert command.hip_speed == max(-limit, min(limit, wanted))

    live(module(), 100, seen=look)


def test_the_hip_follows_its_ramp() -> None:
    """A hip that obeys is where the ramp says after each tick, once it has caught up."""
    gait = HipRamp(PARAMS.gait, "front_right")

    def look(sense: LegSense, command: LegCommand) -> None:
        if sense.tick > TICKS:
            assert sense.hip == pytest.approx(gait.hip_goal((sense.tick - 1) / TICKS), abs=1e-12)

    live(module("front_right"), 3 * TICKS, seen=look)


# -- determinism ---------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["learned", "scripted", "random"])
def test_the_same_inputs_give_the_same_commands(policy: str) -> None:
    """Two legs of one name and seed in two worlds: the same commands and table, to the bit."""
    one, other = (module("rear_left", seed=9, policy=policy) for _ in range(2))
    assert live(one, 500) == live(other, 500)
    assert one.copy.table.sha256() == other.copy.table.sha256()


def test_another_seed_acts_differently() -> None:
    """The seed of the run reaches a leg's choices."""
    one, other = (module("rear_left", seed=seed) for seed in (1, 2))
    assert live(one, 100) != live(other, 100)


def test_legs_of_one_run_draw_their_own_numbers() -> None:
    """Four legs at random, one seed: no two choose alike."""
    chosen = set()
    for name in LEGS:
        commands = live(module(name, seed=1, policy="random"), 40)
        chosen.add(tuple(command.knee_speed for command in commands))
    assert len(chosen) == 4


def test_legs_do_not_know_of_each_other() -> None:
    """A leg acts the same alone as among others in the same process."""
    alone = live(module("rear_right", seed=4, policy="random"), 60)
    world = FakeWorld(LEGS, PARAMS)
    legs = [module(name, seed=4, policy="random") for name in LEGS]
    among = []
    for tick in range(60):
        commands = [leg.tick(s, tick / TICKS) for leg, s in zip(legs, world.observe(), strict=True)]
        among.append(commands[3])
        world.step(tick / TICKS, commands)
    assert among == alone


# -- making --------------------------------------------------------------------------------------


def test_a_leg_takes_up_what_was_learnt() -> None:
    """A table given is used from the first tick on, and becomes this leg's own."""
    table: Table = empty_table(PARAMS)
    table.values[5::9] = 1.0  # the sixth speed is the best everywhere
    leg = module(table=table, params=replace(PARAMS, {"walk.epsilon_start": 0.0}))
    assert leg.copy.table is table
    assert live(leg, 1)[0].knee_speed == SPEEDS[5] == 0.0


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"leg": "middle"}, r"no leg 'middle'.*front_left.*leg"),
        ({"stage": "run"}, r"no stage 'run'.*train or walk"),
        ({"policy": "best"}, r"no policy 'best'.*learned, scripted, random"),
    ],
)
def test_a_wrong_name_is_refused(wrong: dict[str, str], says: str) -> None:
    """A leg, stage or policy that does not exist: the message lists those that do."""
    with pytest.raises(ParameterError, match=says):
        LegModule(PARAMS, **{"leg": "leg", **wrong})  # type: ignore[arg-type]


def test_a_leg_knows_its_place() -> None:
    """Positions are those of the order of legs; the trainer's leg is the first."""
    assert [module(name).position for name in (*LEGS, TRAINER_LEG)] == [0, 1, 2, 3, 0]


def test_a_leg_that_shares_keeps_its_pairs() -> None:
    """With sharing on, an epoch's updates are due as one push, and not before its last tick."""
    leg, due = module("front_right", shared=True), []
    live(leg, TICKS - 1)
    leg.copy.close_epoch(TICKS - 2)
    assert leg.copy.push_due() is None
    leg.copy.close_epoch(TICKS - 1)
    due.append(leg.copy.push_due())
    assert due[0] is not None
    assert (due[0].leg, due[0].epoch) == (1, 0)
    assert [pair.tick for pair in due[0].pairs] == list(range(1, TICKS - 1))
