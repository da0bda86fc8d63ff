"""What was recorded is run again to the same bits, and learnt from again with other numbers."""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ember_ros import topics, wire
from ember_ros.bag.reader import Bag, Raw
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.run_writer import absolute
from ember_ros.bag.storage import BagOptions, read_metadata
from ember_ros.errors import BagError, ParameterError
from ember_ros.graph import by_graph
from ember_ros.loop import Loop
from ember_ros.offline.relearn import relearn
from ember_ros.offline.replay import Difference, Replayed, by_loop, conclusion_of, replay
from ember_ros.params import Params, replace
from ember_ros.run import run
from ember_ros.run_config import RunConfig
from ember_ros.signals import LegCommand
from leg_node.assembly import empty_table
from leg_node.table_file import load_table, save_table
from sim_node.fake import FakeWorld
from support import bags
from support.bags import SHIPPED_BAG, RecordedRun, write
from support.configs import small_config
from support.learning import TickSignals, reference_table
from support.legs import LEGS
from support.needs import needs_bags, needs_bullet
from support.ros import Ros

pytestmark = needs_bags

TICKS = Params().gait.ticks
TICK_NS = Params().gait.tick_ns
CYCLES = 6
FALLS = {50, 51, 128}
"""The last one is where an epoch and, with ``smooth_every`` of 4, a smoothed reading begin."""


def config(cycles: int = CYCLES, **options: Any) -> RunConfig:
    """Return a plan on a small table; options with ``__`` in their names are parameters."""
    return small_config(cycles, **options)


def record(bag: Path, config: RunConfig, **how: Any) -> RecordedRun:
    """Record a run of a plan in a world with falls."""
    return bags.record(bag, config, falls_at=FALLS, **how)


raws_of = functools.cache(bags.raws_of)


BACKENDS = {"loop": by_loop, "graph": by_graph}


def again(bag: Path, on: str = "loop") -> Replayed:
    """Replay a bag."""
    with Bag(bag) as opened:
        return replay(opened, run=BACKENDS[on])


def rewrite(made: RecordedRun, folder: Path, change: Callable[[Raw], bytes | None]) -> Path:
    """Copy a bag message by message; ``change`` returns what becomes of one, None for nothing."""
    changed = ((raw, change(raw)) for raw in raws_of(made.bag))
    return write(
        folder, (raw._replace(data=data) for raw, data in changed if data is not None), made.table
    )


def without(*left_out: tuple[str, int]) -> Callable[[Raw], bytes | None]:
    """Leave out these messages: topic and tick of each."""
    gone = {(absolute("", name), tick * TICK_NS) for name, tick in left_out}
    return lambda raw: None if (raw.topic, raw.ns) in gone else raw.data


def of_tick(tick: int) -> list[tuple[str, int]]:
    """Return all messages of a tick, for ``without``."""
    makers = (topics.joint_states, topics.contact, topics.command, topics.transition)
    every = [topics.CLOCK, topics.ODOMETRY, topics.PHASE, *(m(leg) for m in makers for leg in LEGS)]
    return [(topic.name, tick) for topic in every]


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Record one run for all tests that only look at it."""
    return record(tmp_path_factory.mktemp("walked") / "bag", config(4))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, walked: RecordedRun) -> list[RecordedRun]:
    """Record three runs that know nothing of each other."""
    folder = tmp_path_factory.mktemp("runs")
    others = [config(2, seed=4, policy="random"), config(3, seed=5, policy="scripted")]
    return [walked, *(record(folder / f"{n}", each) for n, each in enumerate(others))]


# -- the same bits -----------------------------------------------------------------------------

RUNS: dict[str, dict[str, Any]] = {
    "learned": {},
    "learned, one table for all": {"walk__sync_every": 1},
    "learned, the end within an epoch": {"walk__sync_every": 48, "extra": 5},
    "learned, smoothed": {"walk__smooth": 0.3},
    "learned, smoothed, one table for all": {
        "walk__smooth": 0.3, "walk__sync_every": 1, "walk__smooth_every": 2,
    },
    "learned, from a table": {"table": True},
    "learned, from a table, smoothed": {"table": True, "walk__smooth": 0.3},
    "learned, from a table, one table for all": {"table": True, "walk__sync_every": 1},
    "learned, frozen": {"learning": False, "table": True},
    "learned, frozen, smoothed": {"learning": False, "table": True, "walk__smooth": 0.3},
    "learned, frozen, of nothing": {"learning": False},
    "scripted": {"policy": "scripted"},
    "scripted, one table for all": {"policy": "scripted", "walk__sync_every": 1},
    "scripted, frozen": {"policy": "scripted", "learning": False, "table": True},
    "random": {"policy": "random"},
    "random, one table for all": {"policy": "random", "walk__sync_every": 1},
    "random, frozen": {"policy": "random", "learning": False},
    "16 ticks": {"gait__ticks": 16, "gait__period": 0.25, "walk__sync_every": 32},
    "other cells": {"state__hip_bins": 5, "leg__knee_speeds": (-9.0, 0.0, 3.0, 9.0)},
    "trainer": {"world": "trainer"},
    "trainer, one table for all": {"world": "trainer", "train__sync_every": 1},
}  # fmt: skip


@pytest.fixture(scope="module")
def run_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], RecordedRun]:
    """Record one of ``RUNS``, once for all tests."""

    @functools.cache
    def made(name: str) -> RecordedRun:
        folder = tmp_path_factory.mktemp("run")
        options = dict(RUNS[name])
        extra = options.pop("extra", 0)
        if options.get("table"):
            before = config(3, seed=9, policy="random")
            loop = Loop(before, FakeWorld(LEGS, before.params))
            for _ in range(3 * TICKS):
                loop.tick()
            options["table"] = folder / "before.npz"
            save_table(options["table"], loop.finish(), before.params, 9)
        return record(folder / "bag", config(**options), extra=extra)

    return made


@pytest.mark.parametrize("name", RUNS)
def test_a_replay_is_the_run_bit_for_bit(run_of: Callable[[str], RecordedRun], name: str) -> None:
    """All commands come out again, and the table at the end; if the legs learnt, it is another."""
    made = run_of(name)
    with Bag(made.bag) as bag:
        assert bag.run_metadata is not None
        begun = bag.run_metadata.start_table_sha256
        done = replay(bag)
        assert sum(tick.body.falls == 1 for tick in bag.ticks()) == 1
    assert (done.difference, done.missing, done.unanswered) == (None, None, {})
    assert done.compared == made.ticks * len(made.config.legs)
    assert (done.ticks, done.cycles) == (made.ticks, made.ticks / made.config.params.gait.ticks)
    assert done.table.sha256() == done.recorded_sha256 == made.table
    assert done.equal
    assert (made.table != begun) == made.config.learning
    assert (begun != empty_table(made.config.params).sha256()) == (made.config.table is not None)


@needs_bullet
@pytest.mark.parametrize("world", ["walker", "trainer"])
def test_a_replay_of_a_real_world_is_the_run(tmp_path: Path, world: str) -> None:
    """What Bullet made of a body that falls is shown again without Bullet, to the same bits."""
    from ember_ros.worlds import make_world

    narrow = config(5, world=world, policy="random", walker__hip_half_width=0.02)
    made = record(tmp_path / "bag", narrow, world=make_world(world, narrow.params, narrow.seed))
    done = again(made.bag)
    assert done.equal
    assert (done.ticks, done.recorded_sha256) == (made.ticks, made.table)
    with Bag(made.bag) as bag:
        assert (list(bag.ticks())[-1].body.falls > 0) == (world == "walker")


def test_a_replay_can_be_done_again_and_again(walked: RecordedRun) -> None:
    """One open bag gives the same twice, and a replay leaves the bag as it was."""
    before = {file: file.read_bytes() for file in walked.bag.iterdir()}
    with Bag(walked.bag) as bag:
        one, other = replay(bag), replay(bag)
    assert one.table.sha256() == other.table.sha256() == walked.table
    assert one.compared == other.compared == 4 * walked.ticks
    assert {file: file.read_bytes() for file in walked.bag.iterdir()} == before


def test_a_replay_that_is_stopped_is_equal_up_to_there(walked: RecordedRun) -> None:
    """Half a run is held against half the record, and against no table."""
    with Bag(walked.bag) as bag:
        done = replay(bag, go_on=lambda ticks: ticks < 40)
    assert (done.ticks, done.compared) == (40, 160)
    assert done.recorded_sha256 is None
    assert done.equal


# -- what is not the same ----------------------------------------------------------------------


def altered(**changes: Any) -> Callable[[Raw], bytes | None]:
    """Change a field of rear_left's command of tick 70, and what comes of it later and behind."""
    where = {absolute("", topics.command(leg).name): leg for leg in LEGS}

    def change(raw: Raw) -> bytes:
        late = raw.ns > 90 * TICK_NS
        if raw.topic not in where or not (raw.ns == 70 * TICK_NS or late):
            return raw.data
        leg = where[raw.topic]
        if leg not in ("rear_left", "rear_right"):
            return raw.data
        commands = wire.CommandWire(leg, TICK_NS)
        return commands.pack(commands.read(raw.data)._replace(**changes))

    return change


def command_of(made: RecordedRun, tick: int, leg: str) -> LegCommand:
    """Return a recorded command."""
    where = absolute("", topics.command(leg).name), tick * TICK_NS
    (data,) = (raw.data for raw in raws_of(made.bag) if (raw.topic, raw.ns) == where)
    return wire.CommandWire(leg, TICK_NS).read(data)


@pytest.mark.parametrize("field", LegCommand._fields[1:])
def test_a_changed_command_is_told_with_both_values(
    tmp_path: Path, walked: RecordedRun, field: str
) -> None:
    """Tick, leg and field of the first difference, what was recorded, and what came out."""
    true = getattr(command_of(walked, 70, "rear_left"), field)
    done = again(rewrite(walked, tmp_path / "bag", altered(**{field: true + 0.25})))
    assert done.difference == Difference(70, "rear_left", field, true + 0.25, true)
    assert not done.equal
    for word in ("tick 70", "rear_left", field, str(true + 0.25), str(true)):
        assert word in str(done.difference)
    assert done.parts == {"senses": True, "commands": False, "rewards": True, "table": True}
    # All the rest is done, and the table came out as it was recorded.
    assert (done.ticks, done.compared) == (walked.ticks, 4 * walked.ticks)
    assert done.table.sha256() == done.recorded_sha256


def test_the_least_change_of_a_command_is_a_difference(tmp_path: Path, walked: RecordedRun) -> None:
    """One bit, the last of a number: nothing is held equal that is not."""
    true = command_of(walked, 70, "rear_left").hip_speed
    (near,) = struct.unpack(
        "<d", struct.pack("<q", struct.unpack("<q", struct.pack("<d", true))[0] ^ 1)
    )
    done = again(rewrite(walked, tmp_path / "bag", altered(hip_speed=near)))
    assert done.difference == Difference(70, "rear_left", "hip_speed", near, true)


NUMBERS = ("hip", "knee", "hip_speed", "knee_speed", "slip", "inclination", "load", "load_peak")


def place_of(name: str) -> tuple[topics.Topic, int]:
    """Return where the lowest byte of a number of rear_left's senses lies."""
    plain = wire.SenseWire("rear_left", TICK_NS)
    with_1, with_0 = ([float(name == each) for each in NUMBERS], [0.0] * len(NUMBERS))
    packed = []
    for hip, knee, hip_speed, knee_speed, slip, inclination, load, peak in (with_1, with_0):
        stamped = (
            plain._joints.pack(0, (hip, knee), (hip_speed, knee_speed)),
            plain._contact.pack(0, (slip, inclination, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0, load, peak)),
        )
        packed.append(stamped)
    for n, topic in enumerate((topics.joint_states("rear_left"), topics.contact("rear_left"))):
        changed = [
            i for i, (a, b) in enumerate(zip(packed[0][n], packed[1][n], strict=True)) if a != b
        ]
        if changed:
            return topic, changed[-1] - 7  # the highest byte of 1.0 is the last of its eight
    raise AssertionError(name)


def damaged(topic: topics.Topic, tick: int, at: int, bits: int) -> Callable[[Raw], bytes | None]:
    """Turn bits of one byte of one message round."""

    def change(raw: Raw) -> bytes:
        if (raw.topic, raw.ns) != (absolute("", topic.name), tick * TICK_NS):
            return raw.data
        data = bytearray(raw.data)
        data[at] ^= bits
        return bytes(data)

    return change


@pytest.mark.parametrize("name", NUMBERS)
def test_a_sense_with_one_bit_changed_is_told(
    tmp_path: Path, walked: RecordedRun, name: str
) -> None:
    """The lowest bit of any number a leg senses: tick and leg are told, by the recorded CRC."""
    topic, at = place_of(name)
    with Bag(rewrite(walked, tmp_path / "bag", damaged(topic, 70, at, 1))) as bag:
        done = replay(bag)
    assert done.difference is not None
    assert done.difference[:3] == (70, "rear_left", "CRC-32 of the senses")
    assert done.difference.recorded != done.difference.replayed
    assert not done.equal
    (damage,) = bag.damages
    assert (damage.tick, damage.leg) == (70, "rear_left")
    assert f"{damage.recorded:08x}" == done.difference.recorded
    assert f"{damage.found:08x}" == done.difference.replayed


def test_of_a_changed_sense_and_a_changed_command_the_first_is_told(
    tmp_path: Path, walked: RecordedRun
) -> None:
    """Whatever it is of, the earlier tick is told."""
    true = command_of(walked, 70, "rear_left").hip_torque
    commands = altered(hip_torque=true + 1.0)
    bags = []
    for tick in (66, 74):
        senses = damaged(*_first(place_of("hip"), tick), 1)
        bags.append(
            rewrite(
                walked,
                tmp_path / f"{tick}",
                lambda raw, senses=senses: senses(raw._replace(data=commands(raw) or b"")),  # type: ignore[misc]
            )
        )
    early, late = (again(bag).difference for bag in bags)
    assert early is not None
    assert early[:3] == (66, "rear_left", "CRC-32 of the senses")
    assert late is not None
    assert late[:3] == (70, "rear_left", "hip_torque")


def _first(place: tuple[topics.Topic, int], tick: int) -> tuple[topics.Topic, int, int]:
    return place[0], tick, place[1]


@pytest.mark.parametrize("what", ["joint_states", "contact"])
@pytest.mark.slow
def test_a_sense_that_is_no_message_any_more_is_told(
    tmp_path: Path, walked: RecordedRun, what: str
) -> None:
    """A byte of a joint's name changed: the bag is damaged, and topic and tick are told."""
    topic = getattr(topics, what)("rear_left")
    data = next(raw.data for raw in raws_of(walked.bag) if raw.topic == "/" + topic.name)
    at = data.index(b"hip" if what == "joint_states" else b"slip")
    bad = rewrite(walked, tmp_path / "bag", damaged(topic, 70, at, 1))
    with pytest.raises(BagError, match=rf"/rear_left/{what} near tick 70 is damaged"):
        again(bad)


# -- what is missing ---------------------------------------------------------------------------

ways = pytest.mark.parametrize("on", ["loop", pytest.param("graph", marks=needs_bullet)])


@pytest.fixture
def on_graph(on: str, request: pytest.FixtureRequest) -> str:
    """Give a replay on the graph a domain of its own."""
    if on == "graph":
        request.getfixturevalue("ros")
    return on


def test_a_run_that_ended_within_a_cycle_is_replayed_to_its_end(tmp_path: Path) -> None:
    """Its last tick is the last one, and the table is the one it ended with."""
    made = record(tmp_path / "bag", config(2), extra=9)
    done = again(made.bag)
    assert (done.ticks, done.cycles) == (73, 73 / 32)
    assert (done.missing, done.difference) == (None, None)
    assert done.recorded_sha256 == done.table.sha256() == made.table
    assert done.equal


@ways
@pytest.mark.slow
def test_a_bag_that_was_cut_off_is_equal_up_to_there(
    tmp_path: Path, walked: RecordedRun, on_graph: str
) -> None:
    """Messages up to the middle of a tick's commands: that tick too, as far as it is there."""
    kept = [raw for raw in raws_of(walked.bag) if raw.ns <= 77 * TICK_NS][:-7]
    done = again(write(tmp_path / "bag", kept), on_graph)
    assert (done.ticks, done.missing, done.difference) == (78, None, None)
    assert done.compared == 4 * 77 + 1
    assert done.unanswered == dict.fromkeys(LEGS[1:], 1)
    assert done.recorded_sha256 is None
    assert done.equal


MISSING: dict[str, tuple[list[tuple[str, int]], str]] = {
    "joints": (
        [("rear_left/joint_states", 70)],
        "the senses of rear_left at tick 70 are not in the bag",
    ),
    "contact": (
        [("front_right/contact", 70)],
        "the senses of front_right at tick 70 are not in the bag",
    ),
    "phase": ([("cpg/phase", 70)], "tick 70 is not in the bag, tick 71 follows"),
    "tick": (of_tick(70), "tick 70 is not in the bag, tick 71 follows"),
    "two ticks": ([*of_tick(70), *of_tick(71)], "tick 70 is not in the bag, tick 72 follows"),
}


@pytest.mark.parametrize(
    ("what", "on"),
    [
        *((what, "loop") for what in MISSING),
        *(pytest.param(what, "graph", marks=needs_bullet) for what in ("contact", "two ticks")),
    ],
)
@pytest.mark.slow
def test_a_record_with_a_hole_is_replayed_up_to_it(
    tmp_path: Path, walked: RecordedRun, what: str, on_graph: str
) -> None:
    """Where it ended is told, on loop and graph; up to there all is equal."""
    gone, reason = MISSING[what]
    done = again(rewrite(walked, tmp_path / "bag", without(*gone)), on_graph)
    assert done.missing == reason
    assert done.difference is None
    assert (done.ticks, done.compared, done.unanswered) == (70, 280, {})
    assert not done.equal


def test_a_table_of_the_end_is_not_held_against_one_of_a_hole(
    tmp_path: Path, walked: RecordedRun
) -> None:
    """A replay that ends at a hole has no recorded table to be equal to."""
    done = again(rewrite(walked, tmp_path / "bag", without(*of_tick(70))))
    assert done.recorded_sha256 is None


def test_a_record_without_a_beginning_says_so(tmp_path: Path, walked: RecordedRun) -> None:
    """If tick 0 is missing there is nothing to be replayed from."""
    bag = rewrite(walked, tmp_path / "bag", without(*of_tick(0)))
    with pytest.raises(BagError, match="nothing to replay: tick 0 is not in the bag"):
        again(bag)


@ways
def test_a_missing_command_is_counted_and_is_no_difference(
    tmp_path: Path, walked: RecordedRun, on_graph: str
) -> None:
    """The leg that replays says what was not heard: everything else is equal, the table too."""
    gone = [("rear_left/command", tick) for tick in (0, 31, 32, 70)]
    gone += [("front_right/command", walked.ticks - 1)]
    done = again(rewrite(walked, tmp_path / "bag", without(*gone)), on_graph)
    assert done.unanswered == {"front_right": 1, "rear_left": 4}
    assert (done.difference, done.missing) == (None, None)
    assert (done.ticks, done.compared) == (walked.ticks, 4 * walked.ticks - 5)
    assert done.recorded_sha256 == done.table.sha256()
    assert done.equal


@ways
def test_what_is_told_is_the_same_on_loop_and_graph(
    tmp_path: Path, walked: RecordedRun, on_graph: str
) -> None:
    """The first difference is found by real nodes too."""
    true = command_of(walked, 70, "rear_left").knee_speed
    done = again(rewrite(walked, tmp_path / "bag", altered(knee_speed=0.125)), on_graph)
    assert done.difference == Difference(70, "rear_left", "knee_speed", 0.125, true)
    assert done.ticks == walked.ticks


def test_a_bag_of_another_recorder_is_not_replayed(tmp_path: Path, walked: RecordedRun) -> None:
    """Without its card nobody knows what determined a run; learnt from it can be all the same."""
    bag = rewrite(walked, tmp_path / "bag", lambda raw: None if "/run/" in raw.topic else raw.data)
    with pytest.raises(BagError, match=r"does not say what determined the run"):
        again(bag)
    assert relearn([bag], params=walked.config.params).table.sha256() == walked.table


@pytest.mark.parametrize("name", ["values", "visits"])
def test_a_run_whose_first_table_is_lost_is_not_replayed_from_another(
    tmp_path: Path, run_of: Callable[[str], RecordedRun], name: str
) -> None:
    """A start table that the card names and the bag does not hold is not taken to be empty."""
    made = run_of("learned, from a table")
    bag = rewrite(made, tmp_path / "other", without((f"run/{name}", 0)))
    with pytest.raises(BagError, match="table at its start"):
        again(bag)


# -- learning again ----------------------------------------------------------------------------

LEARNT = [
    name
    for name, options in RUNS.items()
    if options.get("learning", True) and "table" not in options
]


@pytest.mark.parametrize("name", LEARNT)
def test_relearning_with_a_run_s_own_numbers_gives_its_table(
    run_of: Callable[[str], RecordedRun], name: str
) -> None:
    """Whatever the policy was, the epochs, the readings and the falls: the SHA-256 of the run."""
    made = run_of(name)
    learnt = relearn([made.bag])
    assert learnt.table.sha256() == made.table
    assert learnt.params == made.config.params
    assert (learnt.ticks, learnt.skipped) == (made.ticks, 0)
    falls = sum(tick < made.ticks for tick in FALLS)
    assert learnt.falls == falls
    assert learnt.updates == len(made.config.legs) * (made.ticks - 1 - falls)
    assert learnt.updates == learnt.table.visits.sum()


def test_relearning_from_the_table_of_the_run_gives_its_table(
    run_of: Callable[[str], RecordedRun],
) -> None:
    """A run that went on from a table is learnt again from that table."""
    made = run_of("learned, from a table, smoothed")
    assert made.config.table is not None
    start, _ = load_table(made.config.table, made.config.params)
    before = int(start.visits.sum())
    learnt = relearn([made.bag], table=start)
    assert learnt.table.sha256() == made.table
    assert learnt.updates == learnt.table.visits.sum() - before


def seen(bag: Path) -> list[TickSignals]:
    """Return what legs could see in a bag."""
    with Bag(bag) as opened:
        return [(tick.beat, tick.senses, tick.commands) for tick in opened.ticks()]


def test_relearning_with_other_numbers_is_what_would_have_been_learnt(
    runs: list[RecordedRun],
) -> None:
    """Worked out by other means, with one table for all: the same table, bit for bit."""
    changes = {
        "walk.smooth": 0.0, "walk.prior": 0.0, "reward.lead": 0,
        "walk.sync_every": 1, "walk.gamma": 0.7, "walk.alpha_floor": 0.2, "reward.slip": 2.0,
        "reward.swing_strike": -0.25, "state.hip_bins": 7, "state.force_edges": [0.1, 1.0],
    }  # fmt: skip
    own = replace(runs[0].config.params, changes)
    bags = [made.bag for made in runs]
    learnt = relearn(bags, changes)
    assert learnt.params == own
    assert learnt.table.sha256() == reference_table(map(seen, bags), own).sha256()


def test_many_bags_are_learnt_from_one_after_the_other(runs: list[RecordedRun]) -> None:
    """All in one go is the first, then the second with its table, and so on; sums add up."""
    params = runs[0].config.params
    together = relearn([made.bag for made in runs])
    table, alone = None, []
    for made in runs:
        alone.append(relearn([made.bag], params=params, table=table))
        table = alone[-1].table
    assert table is not None
    assert together.table.sha256() == table.sha256()
    assert together.ticks == sum(each.ticks for each in alone) == sum(m.ticks for m in runs)
    assert together.updates == sum(each.updates for each in alone)
    assert together.falls == sum(each.falls for each in alone)


def test_the_order_of_bags_is_kept_and_matters(runs: list[RecordedRun]) -> None:
    """Another order is another table with as many updates; the same order gives the same bits."""
    one, other = (made.bag for made in runs[:2])
    params = runs[0].config.params
    orders = ([one, other], [other, one], [other, one])
    first, second, third = (relearn(bags, params=params) for bags in orders)
    assert first.updates == second.updates
    assert first.table.sha256() != second.table.sha256()
    assert second.table.sha256() == third.table.sha256()


@pytest.mark.slow
def test_a_pass_is_all_bags_once(runs: list[RecordedRun]) -> None:
    """Two passes are the bags named twice, in their order; sums are twice as much."""
    one, other = (made.bag for made in runs[:2])
    params = runs[0].config.params
    twice = relearn([one, other], passes=2)
    assert twice.table.sha256() == relearn([one, other, one, other]).table.sha256()
    once = relearn([one, other], params=params)
    assert (twice.ticks, twice.updates, twice.falls) == (
        2 * once.ticks,
        2 * once.updates,
        2 * once.falls,
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("reward.slip", 2.0),
        ("state.hip_bins", 25),
        ("walk.gamma", 0.5),
        ("walk.alpha_floor", 0.9),
        ("walk.smooth_every", 1),
    ],
)
def test_a_changed_number_changes_the_table_and_the_parameters(
    tmp_path: Path, walked: RecordedRun, name: str, value: Any
) -> None:
    """What was changed is in what was learnt and beside it; the table's file goes with both."""
    learnt = relearn([walked.bag], {name: value})
    assert learnt.params == replace(walked.config.params, {name: value})
    assert learnt.params != walked.config.params
    assert learnt.table.sha256() != walked.table
    assert learnt.updates == 4 * (walked.ticks - 1 - 2)
    # What belongs together works together: the table loads, and a robot walks on with it.
    file = tmp_path / "table.npz"
    save_table(file, learnt.table, learnt.params, 0)
    assert load_table(file, learnt.params)[0].sha256() == learnt.table.sha256()
    going_on = RunConfig("walker", 1, params=learnt.params, table=file)
    made = record(tmp_path / "bag", going_on)
    assert again(made.bag).equal


def test_a_number_of_the_other_stage_changes_nothing_unless_it_is_asked_for(
    walked: RecordedRun,
) -> None:
    """A walker's bag is learnt from with ``walk``; ``stage`` says otherwise."""
    changes = {"train.gamma": 0.3}
    assert relearn([walked.bag], changes).table.sha256() == walked.table
    train = relearn([walked.bag], changes, stage="train").table.sha256()
    assert train != walked.table
    assert train != relearn([walked.bag], stage="train").table.sha256()


def test_the_partition_can_have_another_size(walked: RecordedRun) -> None:
    """Fewer edges are fewer states: the table has the size that its parameters ask for."""
    changes = {"state.hip_bins": 3, "state.force_edges": [0.5], "state.inclination_edges": [0.0]}
    learnt = relearn([walked.bag], changes)
    assert learnt.table.states == 3 * 2 * 2 * 4
    assert len(learnt.table) == len(empty_table(learnt.params))
    assert learnt.table.visits.sum() == learnt.updates


def test_what_is_not_there_is_skipped_and_not_guessed(tmp_path: Path, walked: RecordedRun) -> None:
    """A leg without senses or command of a tick loses two updates and no other; it is counted."""
    gone = [
        ("rear_left/command", 20),
        ("rear_left/command", 31),  # the end of an epoch
        ("front_left/joint_states", 32),  # the beginning of one
        ("front_right/contact", 70),
        ("rear_right/contact", 100),
        ("rear_right/joint_states", 100),
        ("rear_right/command", 100),
        ("rear_right/command", walked.ticks - 1),  # costs one: its end was never sensed
    ]
    learnt = relearn([rewrite(walked, tmp_path / "bag", without(*gone))])
    whole = relearn([walked.bag])
    assert (learnt.ticks, learnt.skipped) == (walked.ticks, 6)
    assert learnt.updates == whole.updates - 2 * 5 - 1
    assert learnt.table.visits.sum() == learnt.updates


def test_a_lost_tick_is_not_credited_over(tmp_path: Path, walked: RecordedRun) -> None:
    """Nothing is learnt across a hole: each leg loses the tick's end and the next one's."""
    learnt = relearn([rewrite(walked, tmp_path / "bag", without(*of_tick(70)))])
    assert (learnt.ticks, learnt.skipped) == (walked.ticks - 1, 0)
    assert learnt.updates == relearn([walked.bag]).updates - 8


# -- what cannot be learnt from ----------------------------------------------------------------


def test_a_knee_speed_that_is_no_action_is_refused(tmp_path: Path, walked: RecordedRun) -> None:
    """What a leg of other speeds did is in no cell: tick, leg and speed are told."""
    bag = rewrite(walked, tmp_path / "bag", altered(knee_speed=0.125))
    with pytest.raises(BagError, match=r"tick 70, rear_left: a knee speed of 0\.125 rad/s is none"):
        relearn([bag])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gait.period", 0.25),
        ("robot.offset", [0.0, 0.5, 0.25, 0.0]),
        ("leg.load", 30.0),
        ("leg.knee_speeds", [-1.0, 0.0, 1.0]),
    ],
)
def test_another_gait_or_leg_is_refused(
    walked: RecordedRun, runs: list[RecordedRun], name: str, value: Any
) -> None:
    """The parameter is named, whether it is a change or what the numbers given say."""
    with pytest.raises(BagError, match=rf"{walked.bag} was recorded with {name} = "):
        relearn([walked.bag], {name: value})
    with pytest.raises(BagError, match=rf"was recorded with {name} = "):
        relearn([runs[1].bag], params=replace(Params(), {name: value}))


def test_a_second_bag_of_another_leg_is_refused(tmp_path: Path, walked: RecordedRun) -> None:
    """Bags that are learnt from together are of one leg and one gait; the bag is named."""
    other = record(tmp_path / "other", config(1, leg__load=30.0))
    with pytest.raises(BagError, match=rf"{other.bag} was recorded with leg\.load = 30\.0"):
        relearn([walked.bag, other.bag])


@pytest.mark.parametrize("life", [100, 40, 3])
def test_two_runs_in_one_bag_are_not_taken_for_one(
    tmp_path: Path, runs: list[RecordedRun], life: int
) -> None:
    """Others' recorders go on when time begins anew: it is said, however short the first run."""
    first = [raw for raw in raws_of(runs[0].bag) if raw.ns < life * TICK_NS]
    then = [raw._replace(ns=raw.ns + life * TICK_NS) for raw in raws_of(runs[2].bag)]
    both = [raw for raw in first + then if "/run/" not in raw.topic]
    with pytest.raises(BagError, match="there are two runs in this bag"):
        relearn([write(tmp_path / "bag", both)], params=runs[0].config.params)


def test_a_change_that_is_none_is_refused(walked: RecordedRun) -> None:
    """An unknown parameter, or a value out of its range, is a ParameterError."""
    with pytest.raises(ParameterError, match=r"reward\.slipp"):
        relearn([walked.bag], {"reward.slipp": 1.0})
    with pytest.raises(ParameterError, match=r"walk\.gamma"):
        relearn([walked.bag], {"walk.gamma": 1.5})


def test_nothing_to_learn_from_and_a_stop_are_said(tmp_path: Path, walked: RecordedRun) -> None:
    """No bag, one that is not there, and one that is given up half way: each is a BagError."""
    with pytest.raises(BagError, match="there is no bag to learn from"):
        relearn([])
    with pytest.raises(BagError, match=r"there is no bag .*none"):
        relearn([walked.bag, tmp_path / "none"])
    with pytest.raises(BagError, match="stopped"):
        relearn([walked.bag], go_on=lambda ticks, falls: ticks < 10)


# -- a whole run, three ways -------------------------------------------------------------------

WALK = config(4, seed=3)


def mcap_of(bag: Path) -> dict[str, bytes]:
    """Return the files of a bag but its metadata."""
    return {file.name: file.read_bytes() for file in bag.iterdir() if file.suffix == ".mcap"}


@pytest.mark.slow
@needs_bullet
def test_loop_graph_and_processes_write_the_same_bytes(ros: Ros, tmp_path: Path) -> None:
    """One plan, three ways: MCAP files are equal, and replay equal on loop and on graph."""
    bags, summaries = {}, {}
    for way in ("loop", "graph", "processes"):
        options = BagOptions(tmp_path / way / "bag")
        _, summary = run(WALK, way, tmp_path / way, lambda *done: True, "test", options)
        bags[way], summaries[way] = options.folder, summary
    files = mcap_of(bags["loop"])
    assert list(files) == ["bag_0.mcap"]
    assert mcap_of(bags["graph"]) == files
    assert mcap_of(bags["processes"]) == files
    for way, bag in bags.items():
        metadata = read_metadata(bag)
        known = metadata.pop("custom_data")
        assert known["table_sha256"] == summaries[way]["table_sha256"]
        assert known["planned_cycles"] == str(WALK.cycles)
        where = summaries[way]["provenance"]
        assert {**where, "date": known["date"]}.items() <= known.items()
        assert metadata == {k: v for k, v in read_metadata(bags["loop"]).items() if k in metadata}
    for on in ("loop", "graph"):
        done = again(bags["processes"], on)
        assert done.equal
        assert done.recorded_sha256 == summaries["loop"]["table_sha256"]
        assert (done.ticks, done.compared) == (4 * TICKS, 16 * TICKS)


@pytest.mark.slow
@needs_bullet
def test_a_graph_that_is_stopped_leaves_a_whole_bag(ros: Ros, tmp_path: Path) -> None:
    """Its commands come out again; which table it ended with nobody can say, and nobody does."""
    bag = BagOptions(tmp_path / "bag")
    endless = config(10**6, walk__sync_every=48)
    _, summary = run(endless, "graph", tmp_path, lambda cycles, falls: cycles < 2, "test", bag)
    assert not summary["complete"]
    metadata = read_metadata(bag.folder)
    assert "table_sha256" not in metadata["custom_data"]
    assert metadata["custom_data"]["planned_cycles"] == str(10**6)
    for on in ("loop", "graph"):
        done = again(bag.folder, on)
        assert done.ticks >= 2 * TICKS
        assert done.compared == 4 * done.ticks
        assert done.recorded_sha256 is None
        assert done.equal


@needs_bullet
def test_a_loop_that_is_stopped_knows_its_table(tmp_path: Path) -> None:
    """The loop stops between two ticks: the bag says what it ended with, and a replay agrees."""
    bag = BagOptions(tmp_path / "bag")
    _, summary = run(config(100), "loop", tmp_path, lambda cycles, falls: cycles < 2, "test", bag)
    assert not summary["complete"]
    done = again(bag.folder)
    assert done.ticks == 2 * TICKS
    assert done.recorded_sha256 == summary["table_sha256"]
    assert done.equal


@needs_bullet
def test_a_run_never_writes_over_a_bag(tmp_path: Path) -> None:
    """A bag that is there is said before anything of the last run is touched."""
    bag = BagOptions(tmp_path / "bag")
    run(config(1), "loop", tmp_path / "out", lambda *done: True, "test", bag)
    before = {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}
    with pytest.raises(BagError, match="is there already"):
        run(config(2), "loop", tmp_path / "out", lambda *done: True, "test", bag)
    assert {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()} == before


# -- the bag that comes with the package -------------------------------------------------------


@pytest.mark.parametrize(
    "on", ["loop", pytest.param("graph", marks=[needs_bullet, pytest.mark.slow])]
)
def test_the_bag_that_comes_with_the_package_is_replayed(on: str) -> None:
    """Recorded by another process, at another time: every command and the table come out equal."""
    with Bag(SHIPPED_BAG) as bag:
        assert bag.damages == []
        done = replay(bag, run=BACKENDS[on])
    assert done.equal
    assert done.recorded_sha256 == done.table.sha256()
    assert done.cycles >= 20
    assert done.compared == done.ticks * len(LEGS)
    assert done.unanswered == {}


def test_the_bag_that_comes_with_the_package_is_small_and_whole() -> None:
    """Under 3 MB, its first file with the name that reindexing looks for, and with a card."""
    files = sorted(file.name for file in SHIPPED_BAG.iterdir())
    assert files == ["metadata.yaml", "walk_0.mcap"]
    assert sum(file.stat().st_size for file in SHIPPED_BAG.iterdir()) < 3_000_000
    with Bag(SHIPPED_BAG) as bag:
        assert bag.run_metadata is not None
        assert sum(1 for _ in bag.ticks()) == bag.messages(topics.PHASE)
        assert bag.damages == []


def test_a_stopped_replay_says_that_it_was_stopped(tmp_path: Path) -> None:
    """What was compared is told; the table of half a run is held against nothing."""
    with Bag(SHIPPED_BAG) as bag:
        done = replay(bag, go_on=lambda ticks: ticks < 100)
    assert done.stopped
    assert done.ticks == 100
    assert done.difference is None
    assert done.recorded_sha256 is None


def test_legs_of_another_stage_are_not_replayed_as_of_this_one() -> None:
    """A card whose legs had other learning parameters than its world has is refused in words."""
    with Bag(SHIPPED_BAG) as bag:
        assert bag.run_metadata is not None
        legs = {leg: told._replace(stage="train") for leg, told in bag.run_metadata.legs.items()}
        bag.run_metadata = RunMetadata(
            bag.run_metadata.world,
            legs,
            bag.run_metadata.params,
            bag.run_metadata.start_table_sha256,
            0,
            {},
        )
        assert bag.stage == "train"
        with pytest.raises(BagError, match="stage 'train'"):
            replay(bag)


@pytest.mark.parametrize("senses", [True, False])
@pytest.mark.parametrize("commands", [True, False, None])
@pytest.mark.parametrize("rewards", [True, False, None])
@pytest.mark.parametrize("table", [True, False, None])
def test_a_verdict_names_each_part_once(
    senses: bool, commands: bool | None, rewards: bool | None, table: bool | None
) -> None:
    """In every combination: under equal, different or not recorded, and with one meaning."""
    parts = {"senses": senses, "commands": commands, "rewards": rewards, "table": table}
    said = conclusion_of(parts)
    assert said.startswith("Result: ")
    heads = {True: "equal: ", False: "different: ", None: "not recorded, or not to its end: "}
    found: dict[str, bool | None] = {}
    for section in said.removeprefix("Result: ").partition(".")[0].split("; "):
        for value, head in heads.items():
            if section.startswith(head):
                found |= dict.fromkeys(section.removeprefix(head).split(", "), value)
    assert found == parts
    assert ("bit for bit" in said) is (
        False not in parts.values() and any((commands, rewards, table))
    )
    assert ("was changed" in said) is (not senses)
    altered = senses and table and False in (commands, rewards)
    assert ("was modified" in said) is bool(altered)
    assert ("so far" in conclusion_of(parts, complete=False)) is ("bit for bit" in said)
    assert "bit for bit" not in conclusion_of(parts, complete=False)
