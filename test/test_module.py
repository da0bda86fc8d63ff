"""One leg module: it credits what it did in a tick with what came of it, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest

from ember_ros.errors import ParameterError
from ember_ros.params import TRAINER_LEG, Params, replace
from ember_ros.params_file import load_params
from ember_ros.randomness import generator
from ember_ros.signals import LegCommand, LegSense, TDUpdate, Transition
from leg_node.assembly import empty_table, make_leg, make_task, position_of
from leg_node.discretizer import PaperDiscretizer
from leg_node.module import LegModule
from leg_node.policy import Random
from leg_node.reward import PaperReward
from leg_node.table import Table
from sim_node.fake import FakeWorld
from support.gaits import ReferenceGait
from support.learning import reward_of
from support.legs import LEGS, beat

PARAMS = load_params("plain")
TICKS = PARAMS.gait.ticks
SPEEDS = PARAMS.leg.knee_speeds


def module(
    leg: str = TRAINER_LEG, *, params: Params = PARAMS, shared: bool = False, **rest: object
) -> LegModule:
    """Return a leg with a table of its own."""
    return make_leg(params, leg, shared=shared, **rest)  # type: ignore[arg-type]


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
        (sense,) = world.observe()
        command = None
        if tick not in missed:
            command = leg.tick(sense, beat(tick))
            commands.append(command)
            seen(sense, command)
        world.step(beat(tick), [command])
    return commands


def visits(leg: LegModule) -> int:
    """Return the number of updates in a leg's table."""
    return int(leg.copy.table.visits.sum())


# -- learning ------------------------------------------------------------------------------------


def test_a_leg_is_q_learning() -> None:
    """400 ticks are one-step Q-learning, written here a second time from senses and commands."""
    leg, plain = module(seed=5), empty_table(PARAMS)
    partition, rewarder = PaperDiscretizer(PARAMS), PaperReward(PARAMS)
    gait, learning_params = ReferenceGait(PARAMS), PARAMS.walk
    before: list[tuple[int, int, bool]] = []

    def learn(sense: LegSense, command: LegCommand) -> None:
        stance = gait.stance(sense.tick)
        state = partition.index(sense, stance)
        if before:
            old_state, old_action, old_stance = before.pop()
            target = reward_of(rewarder, sense, old_stance) + learning_params.gamma * max(
                plain.row(state)
            )
            plain.update(old_state * 9 + old_action, target, learning_params.rate)
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
    stance = ReferenceGait(PARAMS).stance(10)
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
    leg.reset(31, "another life")
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
    assert frozen.copy.oldest_unacknowledged() is None


@pytest.mark.parametrize("policy", ["scripted", "random"])
def test_policies_without_a_table_are_rewarded_too(policy: str) -> None:
    """Whoever chooses, what the actions were worth is learnt: a script can teach."""
    leg = module(policy=policy)
    live(leg, 100)
    assert visits(leg) == 99


def test_the_stage_decides_the_learning_parameters() -> None:
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
    gait = ReferenceGait(PARAMS)

    def earn(sense: LegSense, command: LegCommand) -> None:
        if sense.tick:
            earned.append(reward_of(rewarder, sense, gait.stance(sense.tick - 1)))

    live(leg, 300 * TICKS, seen=earn)
    first, last = earned[: 30 * TICKS], earned[-30 * TICKS :]
    assert sum(last) / len(last) > sum(first) / len(first) + 0.3


# -- transitions ---------------------------------------------------------------------------------


def transitions(
    leg: LegModule, ticks: int, *, falls_at: Sequence[int] = (), missed: Sequence[int] = ()
) -> list[tuple[Transition, LegSense, LegCommand]]:
    """Return what a leg says of each tick, with the senses and the command of it."""
    told = []

    def look(sense: LegSense, command: LegCommand) -> None:
        told.append((leg.last_transition, sense, command))

    world = FakeWorld((leg.leg,), PARAMS, falls_at=falls_at)
    live(leg, ticks, world=world, missed=missed, seen=look)
    return told


def test_transitions_are_a_chain() -> None:
    """The state and stance in which one ends are those in which the next one begins."""
    told = transitions(module(policy="random"), 100)
    partition, gait = PaperDiscretizer(PARAMS), ReferenceGait(PARAMS)
    for did, sense, _ in told:
        assert did.tick == sense.tick
        assert did.next_stance is gait.stance(sense.tick)
        assert did.next_state == partition.index(sense, did.next_stance)
    for (before, _, command), (did, *_) in pairwise(told):
        assert did.credited
        assert (did.state, did.stance) == (before.next_state, before.next_stance)
        assert SPEEDS[did.action] == command.knee_speed


def test_where_the_chain_breaks_there_is_nothing_to_credit() -> None:
    """At the first tick, after a restart and after a gap: where the leg is, and that is all."""
    told = transitions(module(policy="random"), 40, falls_at=(10,), missed=(20, 21))
    broken = {did.tick: did for did, *_ in told if not did.credited}
    assert list(broken) == [0, 10, 22]
    for did in broken.values():
        assert (did.state, did.stance, did.action, did.td_error) == (-1, False, -1, 0.0)
        assert did.terms == tuple((name, 0.0) for name in PaperReward.names)
        assert did.reward == 0.0
        assert did.next_state >= 0
        assert did.next_stance is ReferenceGait(PARAMS).stance(did.tick)


def test_the_error_is_the_target_less_the_value_before() -> None:
    """What each update was worth, worked out from the table as it was."""
    leg, before = module(seed=3), empty_table(PARAMS)
    world = FakeWorld((TRAINER_LEG,), PARAMS)
    for tick in range(200):
        live(leg, 1, world=world, begin=tick)
        did = leg.last_transition
        if did.credited:
            believed = before.read(did.state * 9 + did.action)[0]
            best = max(before.row(did.next_state))
            assert did.td_error == did.reward + PARAMS.walk.gamma * best - believed
        before.copy_from(leg.copy.table)
    assert before.visits.sum() == 199


def test_without_learning_there_is_a_reward_and_no_error() -> None:
    """A frozen leg says what it did and what that was worth, and learns nothing of it."""
    told = transitions(module(learning=False, policy="random"), 60)
    assert {did.td_error for did, *_ in told} == {0.0}
    assert sum(did.credited for did, *_ in told) == 59
    assert any(did.reward for did, *_ in told)


class Remembering:
    """A learner that updates one tick late, and says what it was asked for."""

    def __init__(self) -> None:
        """Begin with nothing to learn."""
        self.waiting: list[TDUpdate] = []
        self.asked: list[str] = []

    def q_values(self, tick: int, state: int) -> list[float]:
        """Return equal values."""
        return [0.0] * len(SPEEDS)

    def learn(self, transition: Transition) -> list[TDUpdate]:
        """Return the update of the transition before."""
        self.asked.append(f"learn {transition.tick}")
        due, self.waiting = self.waiting, [TDUpdate(transition.tick, transition.tick, 1.0)]
        return due

    def flush(self) -> list[TDUpdate]:
        """Return the update that waits."""
        self.asked.append("flush")
        due, self.waiting = self.waiting, []
        return due


def remembering(learning: bool = True) -> tuple[LegModule, Remembering]:
    """Return a leg with such a learner, and the learner."""
    learner, like = Remembering(), module(shared=True)
    leg = LegModule(
        make_task(PARAMS, TRAINER_LEG),
        learner=learner,
        policy=Random(PARAMS, PARAMS.walk, learner.q_values, generator(0, 0)),
        copy=like.copy,
        learning=learning,
        shared=True,
    )
    return leg, learner


def test_what_waits_is_learnt_where_the_chain_breaks() -> None:
    """Before a leg that was put down goes on, in its old life, and at its end: nothing is lost."""
    leg, learner = remembering()
    world = FakeWorld((TRAINER_LEG,), PARAMS, falls_at={4})
    live(leg, 7, world=world)
    assert learner.asked == [
        "flush", "learn 1", "learn 2", "learn 3", "flush", "learn 5", "learn 6",
    ]  # fmt: skip
    assert leg.copy.table.visits.nonzero()[0].tolist() == [1, 2, 3, 5]
    leg.finish()
    assert leg.copy.table.visits.nonzero()[0].tolist() == [1, 2, 3, 5, 6]
    leg.finish()
    assert visits(leg) == 5


def test_a_new_life_ends_the_old_one_first() -> None:
    """What waited is pushed by the life that did it."""
    leg, _ = remembering()
    live(leg, 4)
    leg.reset(3, "another life")
    push = leg.copy.oldest_unacknowledged()
    assert push is not None
    assert push.run == "run"
    assert [update.cell for update in push.updates] == [1, 2, 3]


def test_the_error_is_of_the_last_update_that_was_made() -> None:
    """Where a learner updates late, 0 while it waits, then that of what it updates."""
    leg, _ = remembering()
    errors = []
    live(leg, 4, seen=lambda sense, command: errors.append(leg.last_transition.td_error))
    assert errors == [0.0, 0.0, 1.0, 1.0]


def test_a_learner_that_is_off_is_never_asked() -> None:
    """Not to learn, not to end."""
    leg, learner = remembering(learning=False)
    live(leg, 5)
    leg.finish()
    leg.reset(4, "another life")
    assert learner.asked == []


# -- acting --------------------------------------------------------------------------------------


def test_commands_are_of_their_tick_and_within_what_a_motor_has() -> None:
    """Tick, a knee speed of the list, a hip speed up to its limit, the motors' own torques."""
    gait = ReferenceGait(PARAMS)

    def look(sense: LegSense, command: LegCommand) -> None:
        assert command.tick == sense.tick
        assert command.knee_speed in SPEEDS
        assert abs(command.hip_speed) <= PARAMS.leg.hip_speed_max
        assert (command.hip_torque, command.knee_torque) == (
            PARAMS.leg.hip_torque,
            PARAMS.leg.knee_torque,
        )
        wanted = (gait.hip_goal(sense.tick) - sense.hip) / PARAMS.gait.tick_s
        limit = PARAMS.leg.hip_speed_max
        assert command.hip_speed == max(-limit, min(limit, wanted))

    live(module(), 100, seen=look)


def test_the_hip_follows_its_ramp() -> None:
    """A hip that obeys is where the ramp says after each tick, once it has caught up."""
    gait = ReferenceGait(PARAMS, "front_right")

    def look(sense: LegSense, command: LegCommand) -> None:
        if sense.tick > TICKS:
            assert sense.hip == pytest.approx(gait.hip_goal(sense.tick - 1), abs=1e-12)

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
        commands = [leg.tick(s, beat(tick)) for leg, s in zip(legs, world.observe(), strict=True)]
        among.append(commands[3])
        world.step(beat(tick), commands)
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
    ("wrong", "reason"),
    [
        ({"leg": "middle"}, r"no leg 'middle'.*front_left.*leg"),
        ({"stage": "run"}, r"no stage 'run'.*train or walk"),
        ({"policy": "best"}, r"no policy 'best'.*learned, scripted, random"),
    ],
)
def test_a_wrong_name_is_refused(wrong: dict[str, str], reason: str) -> None:
    """A leg, stage or policy that does not exist: the message lists those that do."""
    with pytest.raises(ParameterError, match=reason):
        make_leg(PARAMS, **{"leg": "leg", **wrong})  # type: ignore[arg-type]


def test_a_leg_knows_its_place() -> None:
    """Positions are those of the order of legs; the trainer's leg is the first."""
    assert [position_of(PARAMS, name) for name in (*LEGS, TRAINER_LEG)] == [0, 1, 2, 3, 0]


def test_a_leg_that_shares_keeps_its_pairs() -> None:
    """With sharing on, an epoch's updates are due as one push, and not before its last tick."""
    leg, due = module("front_right", shared=True), []
    live(leg, TICKS - 1)
    leg.copy.close_epoch(TICKS - 2)
    assert leg.copy.oldest_unacknowledged() is None
    leg.copy.close_epoch(TICKS - 1)
    due.append(leg.copy.oldest_unacknowledged())
    assert due[0] is not None
    assert (due[0].leg, due[0].epoch) == (1, 0)
    assert [update.tick for update in due[0].updates] == list(range(1, TICKS - 1))
