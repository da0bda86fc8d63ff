"""Bags read back: every tick with all its bits, whoever wrote them; and what is wrong, in words."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import itertools
import json
import math
import random
import re
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros import cdr, topics, wire
from ember_ros.bag import inspection
from ember_ros.bag.reader import Bag, Raw, Tick
from ember_ros.bag.run_metadata import FORMAT, LegMetadata, RunMetadata, read_run_metadata
from ember_ros.bag.run_writer import FLUSH_TICKS, RunWriter, crc_of
from ember_ros.bag.storage import (
    INFORMATION,
    METADATA,
    STORAGES,
    BagOptions,
    McapWriter,
    definition,
    seal,
)
from ember_ros.bag.window import LATE, Window
from ember_ros.errors import BagError, ParameterError
from ember_ros.loop import Loop
from ember_ros.offline.replay import replay
from ember_ros.params import TRAINER_LEG, Params, as_dict, digest, params_sha256, replace
from ember_ros.report.run_statistics import BODY, Row, RunStatistics, load_record
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from ember_ros.worlds import legs_of
from leg_node.assembly import empty_table
from leg_node.discretizer import PaperDiscretizer
from leg_node.reward import PaperReward
from sim_node.fake import FakeWorld
from support import bags
from support.bags import raws_of
from support.configs import TINY as PARAMS
from support.legs import LEGS
from support.needs import needs_bags

pytestmark = needs_bags

TICKS, TICK_NS = PARAMS.gait.ticks, PARAMS.gait.tick_ns
NOON = 1_717_243_200_000_000_000
"""Wall-clock time, ns, at which others record."""

Spoil = Callable[[Path], Path]


# -- a run, and its bag --------------------------------------------------------------------------


class Nodding(FakeWorld):
    """A world in which every coordinate of the body changes."""

    def body(self) -> BodyState:
        """Return a body that turns, nods and sinks a little."""
        wave = math.sin(self._tick)
        return (
            super()
            .body()
            ._replace(
                y=0.01 * self._tick,
                height=0.45 + 0.01 * wave,
                roll=0.1 * wave,
                pitch=-0.2 * wave,
                yaw=0.3 + 0.001 * self._tick,
            )
        )


class Listener:
    """Keeps what every observer hears."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.received: list[Tick] = []

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Keep one tick."""
        told = tuple(senses), tuple(commands), body, tuple(transitions)
        self.received.append(Tick(beat.tick, beat, *told))


class Run(NamedTuple):
    """A run that was recorded."""

    bag: Path
    received: list[Tick]
    config: RunConfig
    rows: list[Row]
    """Of the ``cycles.csv`` that was written beside it."""

    def __repr__(self) -> str:
        """Return a name: all that was heard would be too much to print."""
        return f"Run({self.bag})"


def record(
    bag: Path,
    ticks: int,
    *,
    world: str = "walker",
    storage: str = "mcap",
    split_s: float = 0.0,
    namespace: str = "",
    falls_at: Sequence[int] = (),
    params: Params = PARAMS,
    seed: int = 0,
    writer: McapWriter | None = None,
) -> Run:
    """Record a run, as ``ember_ros.run`` does; into an open bag if a writer is given."""
    config = RunConfig(world, 1, seed=seed, params=params, policy="random")
    loop = Loop(config, Nodding(config.legs, params, falls_at=falls_at))
    listener, recorder = (
        Listener(),
        RunStatistics(params, config.legs, bag.with_name(f"{bag.name}-beside")),
    )
    into = writer or McapWriter(BagOptions(bag, split_s=split_s))
    try:
        table = loop.shared.table
        run_metadata = RunMetadata.of_config(config, table, {"ember_ros": "test"})
        recording = RunWriter(into, run_metadata, table, namespace=namespace)
        for _ in range(ticks):
            loop.tick(listener, recorder, recording)
        recording.finish()
        if writer is None:
            into.close()
    finally:
        recorder.finish(loop.world.observe(), loop.world.body())
        if writer is None:
            into.abandon()
        loop.close()
    if storage == "sqlite3":
        in_sqlite(bag)
    rows = load_record(bag.with_name(f"{bag.name}-beside")).rows
    return Run(bag, listener.received, config, rows)


def in_sqlite(bag: Path) -> Path:
    """Make a bag of MCAP files one of SQLite files, one for one, as `ros2 bag convert` does."""
    for file in sorted(bag.glob("*.mcap")):
        rewritten = write_as_others_do(bag / "new", raws_of(file), "sqlite3", run=True)
        (made,) = rewritten.glob("*.db3")
        made.rename(file.with_suffix(".db3"))
        shutil.rmtree(rewritten)
        file.unlink()
    content = yaml.safe_load((bag / METADATA).read_text())
    told = content[INFORMATION]
    told["storage_identifier"] = "sqlite3"
    told["relative_file_paths"] = [
        str(Path(name).with_suffix(".db3")) for name in told["relative_file_paths"]
    ]
    (bag / METADATA).write_text(yaml.safe_dump(content))
    return bag


def write(bag: Path, raws: Iterable[Raw], storage: str = "mcap") -> Path:
    """Write messages as they are, into a bag of ours."""
    bags.write(bag, raws)
    return in_sqlite(bag) if storage == "sqlite3" else bag


def write_as_others_do(
    bag: Path, raws: Iterable[Raw], storage: str = "mcap", *, run: bool = False
) -> Path:
    """Write messages with another library's writer, as any recorder would: no card, no CRC."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    with Writer(bag, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for raw in raws:
            if "/run/" in raw.topic and not run:
                continue
            if raw.topic not in connections:
                text, rihs01 = definition(raw.kind)[:2]
                connections[raw.topic] = writer.add_connection(
                    raw.topic, raw.kind, msgdef=text, rihs01=rihs01
                )
            writer.write(connections[raw.topic], raw.ns, raw.data)
    return bag


def heads_of(bag: Path) -> list[Raw]:
    """Return all messages of a bag of one MCAP file, in which there may be no tick."""
    from mcap.reader import make_reader

    (file,) = bag.glob("*.mcap")
    with file.open("rb") as raw:
        found = make_reader(raw).iter_messages(log_time_order=False)
        return [Raw(c.topic, s.name, m.log_time, m.data) for s, c, m in found if s is not None]


def read(bag: Path, namespace: str | None = None) -> list[Tick]:
    """Return all ticks of a bag in which nothing is damaged or left over."""
    with Bag(bag, namespace=namespace) as opened:
        ticks = list(opened.ticks())
        assert opened.damages == []
        assert opened.stale == 0
    return ticks


def senses_of(tick: Tick) -> list[LegSense]:
    """Return the senses of a tick of which none is missing."""
    senses = [sense for sense in tick.senses if sense is not None]
    assert len(senses) == len(tick.senses)
    return senses


def hold_equal(ticks: Sequence[Tick], received: Sequence[Tick]) -> None:
    """Hold that ticks are equal: all bits, but for angles that went through a quaternion."""
    # A float's repr names its bits, the sign of a zero too; and a bool is not a float in it.
    assert [repr(tick[:4]) for tick in ticks] == [repr(tick[:4]) for tick in received]
    for tick, other in zip(ticks, received, strict=True):
        assert repr(tick.body[:3]) == repr(other.body[:3])
        assert tuple(tick.body) == pytest.approx(tuple(other.body), abs=1e-9)


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Record four legs for three cycles and a half, with two falls, once for all tests."""
    folder = tmp_path_factory.mktemp("walked")
    return record(folder / "bag", 3 * TICKS + 16, falls_at=[20, 64])


@pytest.fixture(scope="module")
def messages(walked: Run) -> list[Raw]:
    """Return its messages."""
    return raws_of(walked.bag)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    """Record a short run in each storage."""
    folder = tmp_path_factory.mktemp("short")
    return {storage: record(folder / storage / "bag", 4, storage=storage) for storage in STORAGES}


@pytest.fixture
def bag(short: dict[str, Run], tmp_path: Path) -> Path:
    """Return a copy of one that a test may spoil."""
    return shutil.copytree(short["mcap"].bag, tmp_path / "bag")


# -- the window ----------------------------------------------------------------------------------

PARTS = ("a", "b", "c")


@st.composite
def arrivals(draw: st.DrawFn, most: int) -> list[tuple[int, str]]:
    """Draw parts of ticks in the order in which they come, none ``most`` ticks late."""
    first, ticks = draw(st.sampled_from([0, 7])), draw(st.integers(1, 12))
    every = [(tick, part) for tick in range(first, first + ticks) for part in PARTS]
    delays = draw(st.lists(st.integers(0, most - 1), min_size=len(every), max_size=len(every)))
    order = draw(st.permutations(range(len(every))))
    keyed = sorted((every[n][0] + delays[n], place, every[n]) for place, n in enumerate(order))
    come = [each for _, _, each in keyed]
    come.remove(begin := (first, draw(st.sampled_from(PARTS))))
    return [begin, *come]


@given(come=arrivals(4), take=st.lists(st.booleans(), max_size=36))
def test_parts_may_come_in_any_order(come: list[tuple[int, str]], take: list[bool]) -> None:
    """Within the lateness, in any order, taken whenever: every tick whole, once, and in order."""
    window = Window(PARTS, late=4)
    out: list[tuple[int, dict[str, Any]]] = []
    for (tick, part), now in zip(come, itertools.chain(take, itertools.repeat(True)), strict=False):
        assert window.put(tick, part, (tick, part))
        if now:
            out += window.pop_complete()
    out += window.pop_rest()
    assert out == [
        (tick, {part: (tick, part) for part in PARTS}) for tick in sorted({t for t, _ in come})
    ]
    assert window.last == out[-1][0]


def test_the_first_tick_may_come_after_the_second() -> None:
    """All of it, even: a run begins with tick 0, and what begins later is waited for as ever."""
    window = Window(PARTS)
    for tick in (1, 0):
        for part in PARTS:
            assert window.put(tick, part, tick)
            if tick:
                assert list(window.pop_complete()) == []
    assert [tick for tick, _ in window.pop_complete()] == [0, 1]


@given(
    lost=st.dictionaries(
        st.integers(0, 30), st.sets(st.sampled_from(PARTS), min_size=1), max_size=6
    )
)
def test_what_does_not_come_is_waited_for_and_then_left_out(lost: dict[int, set[str]]) -> None:
    """Ticks with lost parts come out as they are, in order, when LATE newer ones have begun."""
    window = Window(PARTS)
    out: dict[int, int] = {}
    ticks = 40 + LATE
    for tick in range(ticks):
        for part in PARTS:
            if part not in lost.get(tick, ()):
                assert window.put(tick, part, part)
        for each, parts in window.pop_complete():
            assert set(parts) == set(PARTS) - lost.get(each, set())
            out[each] = tick
    for each, _ in window.pop_rest():
        out[each] = -1
    gone = {tick for tick, parts in lost.items() if parts == set(PARTS)}
    assert list(out) == [tick for tick in range(ticks) if tick not in gone]
    if not lost:
        assert all(tick == when for tick, when in out.items())
    elif (first := min(lost)) not in gone:
        assert out[first] == first + LATE
        assert all(out[tick] == tick for tick in range(first))
    elif first > 0:  # all of it is lost: whoever follows is waited with
        following = min(tick for tick in out if tick > first)
        assert out[following] == following + LATE


def test_a_tick_that_stays_incomplete_comes_out_after_so_many_newer_ones() -> None:
    """Not one tick earlier, not one later; and those that waited behind it come with it."""
    window = Window(PARTS)
    window.put(0, "a", 0)
    for tick in range(1, LATE + 1):
        assert list(window.pop_complete()) == []
        for part in PARTS:
            window.put(tick, part, tick)
    taken = list(window.pop_complete())
    assert taken[0] == (0, {"a": 0})
    assert [tick for tick, _ in taken] == list(range(LATE + 1))


def test_what_is_left_comes_in_order() -> None:
    """At the end nobody is waited for."""
    window = Window(PARTS)
    for tick in (9, 3, 5):
        window.put(tick, "b", tick)
    assert list(window.pop_rest()) == [(3, {"b": 3}), (5, {"b": 5}), (9, {"b": 9})]
    assert list(window.pop_rest()) == []
    assert list(window.pop_complete()) == []


def test_stale_parts_are_refused() -> None:
    """A part of a tick that came out is not kept, and never makes the tick come out again."""
    window = Window(PARTS)
    for tick in range(3):
        for part in PARTS:
            assert window.put(tick, part, "first")
    assert [tick for tick, _ in window.pop_complete()] == [0, 1, 2]
    for tick in range(3):
        assert not window.put(tick, "a", "again")
    assert list(window.pop_complete()) == []
    assert list(window.pop_rest()) == []
    assert window.last == 2


def test_parts_that_nobody_waits_for_may_come_too() -> None:
    """They are given with their tick, and none waits for them."""
    window = Window(["a"])
    window.put(0, "a", 1)
    window.put(0, "x", 2)
    window.put(1, "a", 3)
    assert list(window.pop_complete()) == [(0, {"a": 1, "x": 2}), (1, {"a": 3})]


def test_a_tick_may_need_more_than_its_parts() -> None:
    """What else must hold is asked, and holds the tick and all behind it back until it does."""
    ready: list[bool] = []
    window = Window(["a"], is_complete=lambda parts: bool(ready) and parts["a"] == 0)
    for tick in range(3):
        window.put(tick, "a", tick)
    assert list(window.pop_complete()) == []
    ready.append(True)
    assert [tick for tick, _ in window.pop_complete()] == [0]
    assert [tick for tick, _ in window.pop_rest()] == [1, 2]


FAR = [LATE + 60, 10**6, 2**53]


@pytest.mark.parametrize("far", FAR)
@pytest.mark.parametrize("lying", [["a"], ["b"], ["c"], ["d", "e"]], ids=lambda each: "".join(each))
@pytest.mark.parametrize("at", [0, 20, 39])
def test_a_part_far_ahead_of_all_others_is_not_waited_for(
    far: int, lying: list[str], at: int
) -> None:
    """One wrong stamp, or two of one leg, costs its own tick and no other, wherever it is."""
    window = Window("abcde")
    out: dict[int, Any] = {}
    for tick in range(40 + LATE):
        for part in "abcde":
            window.put(far if tick == at and part in lying else tick, part, tick)
            out.update(window.pop_complete())
    out.update(window.pop_rest())
    assert list(out) == list(range(40 + LATE))
    assert {tick: set("abcde") - parts.keys() for tick, parts in out.items() if len(parts) < 5} == {
        at: set(lying)
    }
    assert window.displaced == len(lying)


def test_a_leg_whose_clock_is_wrong_for_good_ends_nothing() -> None:
    """All others go on here, so time is here."""
    window = Window("abcd")
    out: dict[int, Any] = {}
    for tick in range(500):
        for part in "abcd":
            window.put(tick + 10**9 * (part == "c"), part, tick)
            out.update(window.pop_complete())
        assert len(window._ahead) <= LATE + 2
    out.update(window.pop_rest())
    assert list(out) == list(range(500))
    assert all(parts.keys() == set("abd") for parts in out.values())
    assert window.displaced == 500


@pytest.mark.parametrize("parts", ["a", "ab", "abc", "abcdef"])
@pytest.mark.parametrize("first", [0, 5000])
@pytest.mark.parametrize("far", [*FAR, LATE + 2])
def test_a_gap_is_gone_over(parts: str, first: int, far: int) -> None:
    """When all are far ahead, they are believed, and no part of them is lost."""
    window = Window(parts)
    out: dict[int, Any] = {}
    ticks = [*range(first, first + 3), *range(first + far, first + far + 3)]
    for tick in ticks:
        for part in parts:
            assert window.put(tick, part, tick)
            out.update(window.pop_complete())
    out.update(window.pop_rest())
    assert out == {tick: dict.fromkeys(parts, tick) for tick in ticks}
    assert window.displaced == 0


# -- the card ------------------------------------------------------------------------------------

weights = st.floats(-1e6, 1e6, allow_nan=False)
every_params = st.builds(
    lambda changes: replace(Params(), changes),
    st.fixed_dictionaries(
        {},
        optional={
            "reward.slip": weights,
            "reward.term_low": st.floats(allow_nan=False, allow_infinity=False),
            "gait.period": st.sampled_from([0.5, 0.48, 1.0]),
            "gait.hip_front": st.floats(0.0, 1.5),
            "leg.load": st.floats(0.01, 1e9),
            "state.hip_bins": st.integers(1, 20),
            "state.force_edges": st.lists(
                st.floats(0.0, 10.0), min_size=1, max_size=5, unique=True
            ).map(sorted),
            "train.epsilon_cycles": st.integers(1, 10**9),
            "walk.gamma": st.floats(0.0, 1.0),
            "walker.mass": st.floats(0.01, 1000.0),
        },
    ),
)
configs = st.builds(
    RunConfig,
    st.sampled_from(["walker", "trainer"]),
    st.integers(0, 10**6),
    seed=st.integers(0, 2**63 - 1),
    params=every_params,
    policy=st.sampled_from(["learned", "scripted", "random"]),
    learning=st.booleans(),
    table=st.none() | st.just(Path("some/table.npz")),
)


@settings(max_examples=60)
@given(
    config=configs, versions=st.dictionaries(st.text(max_size=9), st.text(max_size=9), max_size=3)
)
def test_a_card_says_the_whole_plan(config: RunConfig, versions: dict[str, str]) -> None:
    """Through JSON and back: the same card, to the bit, and the plan that it was made of."""
    table = empty_table(config.params)
    run_metadata = RunMetadata.of_config(config, table, versions)
    again = read_run_metadata(run_metadata.to_json(), "here")
    assert again == run_metadata
    assert repr(as_dict(again.params)) == repr(as_dict(config.params))
    assert again.start_table_sha256 == table.sha256()
    assert list(again.legs) == list(config.legs)
    assert again.config(config.cycles, config.table) == config
    content = json.loads(run_metadata.to_json())
    assert content["params_sha256"] == params_sha256(config.params)


def _told(run_metadata: RunMetadata, leg: str, **changes: Any) -> dict[str, LegMetadata]:
    return {**run_metadata.legs, leg: run_metadata.legs[leg]._replace(**changes)}


WHOLE = RunMetadata.of_config(
    RunConfig("walker", 1, params=PARAMS), empty_table(PARAMS), {"numpy": "2"}
)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"first_tick": 5}, ("tick 5", "start the recorder before the world")),
        ({"start_table_sha256": None}, ("table at its start", "not requested in time")),
        ({"legs": _told(WHOLE, "rear_left", seed=7)}, ("different", "rear_left", "7")),
        ({"legs": _told(WHOLE, "front_right", policy="random")}, ("different", "'random'")),
        ({"legs": _told(WHOLE, "front_left", learning=False)}, ("different", "learning")),
        ({"legs": _told(WHOLE, "front_left", stage="train")}, ("different", "'train'")),
        (
            {"legs": {leg: told._replace(shared=False) for leg, told in WHOLE.legs.items()}},
            ("shared no table",),
        ),
        (
            {"legs": {leg: WHOLE.legs[leg] for leg in LEGS[:2]}},
            ("rear_left, rear_right", "not leg nodes of ember_ros"),
        ),
        ({"legs": {}}, (", ".join(LEGS), "not leg nodes of ember_ros")),
    ],
)
def test_what_cannot_be_replayed_says_why(changes: dict[str, Any], reason: Sequence[str]) -> None:
    """A run whose beginning, table or legs are not known has no plan; the message names it."""
    run_metadata = dataclasses.replace(WHOLE, **changes)
    again = read_run_metadata(run_metadata.to_json(), "here")
    assert again == run_metadata
    with pytest.raises(BagError, match="cannot be replayed") as refused:
        again.config(1, None)
    for each in reason:
        assert each in str(refused.value)


def test_a_card_without_a_table_keeps_the_rest() -> None:
    """Only what nobody knows is left out."""
    run_metadata = WHOLE.without_table()
    assert run_metadata.start_table_sha256 is None
    assert dataclasses.replace(run_metadata, start_table_sha256=WHOLE.start_table_sha256) == WHOLE


@pytest.mark.parametrize("format", [FORMAT + 1, 0, -1, "1", None, [1]])
def test_a_card_of_another_format_is_not_guessed_at(format: Any) -> None:
    """Its number is said, and the one that is known, and who would know it."""
    text = json.dumps({**json.loads(WHOLE.to_json()), "format": format})
    with pytest.raises(BagError, match="newer ember_ros") as refused:
        read_run_metadata(text, "the bag: /run/card")
    assert "the bag: /run/card" in str(refused.value)
    assert repr(format) in str(refused.value)
    assert f"reads {FORMAT}" in str(refused.value)


@given(length=st.integers(0, len(WHOLE.to_json()) - 1))
def test_a_card_that_was_cut_off_is_none(length: int) -> None:
    """Wherever it ends: refused, and it is said where it was."""
    with pytest.raises(BagError, match="the bag: /run/card"):
        read_run_metadata(WHOLE.to_json()[:length], "the bag: /run/card")


@pytest.mark.parametrize("text", ["", "null", "[]", "7", '"format"', "{}", "{'format': 1}", "\0"])
def test_other_json_is_no_card(text: str) -> None:
    """Whatever it is: refused in words."""
    with pytest.raises(BagError, match="is no card of a run"):
        read_run_metadata(text, "here")


@pytest.mark.parametrize("key", sorted(json.loads(WHOLE.to_json()).keys() - {"params_sha256"}))
def test_a_card_without_a_key_is_not_whole(key: str) -> None:
    """The key that is missing is named."""
    content = json.loads(WHOLE.to_json())
    del content[key]
    with pytest.raises(BagError, match=key):
        read_run_metadata(json.dumps(content), "here")


@pytest.mark.parametrize(
    "key", [n for n in LegMetadata._fields if n not in LegMetadata._field_defaults]
)
def test_a_leg_on_a_card_without_a_key_is_not_whole(key: str) -> None:
    """The key that is missing is named."""
    content = json.loads(WHOLE.to_json())
    del content["legs"]["rear_left"][key]
    with pytest.raises(BagError, match=key):
        read_run_metadata(json.dumps(content), "here")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("world", "moon"),
        ("world", ["walker"]),
        ("legs", []),
        ("legs", {"front_left": 3}),
        ("legs", {"front_left": {**WHOLE.legs["front_left"]._asdict(), "stage": "run"}}),
        ("legs", {"front_left": {**WHOLE.legs["front_left"]._asdict(), "seed": math.inf}}),
        ("params", []),
        ("params", {"gait": 3}),
        ("params", {"gait": {"period": "long"}}),
        ("params", {"gait": {"period": 99.0}}),
        ("start_table_sha256", 5),
        ("first_tick", "first"),
        ("first_tick", None),
        ("first_tick", math.inf),
        ("versions", 3),
        ("versions", None),
    ],
)
def test_a_card_with_a_value_of_another_kind_is_not_whole(key: str, value: Any) -> None:
    """Whoever reads a card can rely on the types of what it says."""
    text = json.dumps({**json.loads(WHOLE.to_json()), key: value})
    with pytest.raises(BagError, match="no complete card"):
        read_run_metadata(text, "here")


def test_a_card_with_parameters_that_were_changed_is_damaged() -> None:
    """Its SHA-256 is that of what was stored, names that nobody knows among it."""
    text = json.dumps({**json.loads(WHOLE.to_json()), "params": {"gait": {"perod": 0.5}}})
    with pytest.raises(BagError, match="damaged: its parameters do not have the SHA-256"):
        read_run_metadata(text, "here")


def test_a_leg_on_an_older_card_started_at_cycle_0() -> None:
    """A card of before a run could go on says no start cycle."""
    content = json.loads(WHOLE.to_json())
    del content["legs"]["rear_left"]["start_cycle"]
    assert read_run_metadata(json.dumps(content), "here").legs["rear_left"].start_cycle == 0


# -- what was recorded is read back --------------------------------------------------------------


@pytest.mark.parametrize(
    ("namespace", "split_s"),
    [("", 0.0), ("robots/second", 0.2)],
    ids=["one file", "namespace, split"],
)
@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("world", ["walker", "trainer"])
def test_every_tick_comes_back_with_all_its_bits(
    tmp_path: Path, world: str, storage: str, namespace: str, split_s: float
) -> None:
    """Senses, phase, commands and falls equal to the last bit, however the bag was written."""
    run = record(
        tmp_path / "bag",
        TICKS + 7,
        world=world,
        storage=storage,
        split_s=split_s,
        namespace=namespace,
        falls_at=[9, 30],
    )
    assert len(list(run.bag.glob(f"*{STORAGES[storage]}"))) == (3 if split_s else 1)
    hold_equal(read(run.bag), run.received)
    with Bag(run.bag) as opened:
        assert (opened.world, opened.legs) == (world, legs_of(world, PARAMS))
        assert opened.namespace == namespace
        assert opened.params == PARAMS
        assert opened.run_metadata is not None
        assert opened.run_metadata.config(1, None) == run.config
        assert opened.table is not None
        assert opened.table.sha256() == opened.run_metadata.start_table_sha256
        assert opened.messages(topics.PHASE) == len(run.received)
        assert opened.start_ns == 0
        assert [raw.ns for raw in opened.raw()][-1] == (len(run.received) - 1) * TICK_NS


@pytest.mark.parametrize("storage", STORAGES)
def test_one_file_is_read_like_its_folder(tmp_path: Path, storage: str) -> None:
    """A file that was copied out of its bag is one, too."""
    run = record(tmp_path / "bag", TICKS, storage=storage)
    (file,) = run.bag.glob(f"*{STORAGES[storage]}")
    hold_equal(read(Path(shutil.copy(file, tmp_path / f"alone{file.suffix}"))), run.received)


def test_a_bag_can_be_read_again_and_again(walked: Run) -> None:
    """Two passes through one open bag give the same ticks, a pass that was left off is no harm."""
    with Bag(walked.bag) as opened:
        assert next(opened.ticks()).tick == 0
        assert list(opened.ticks()) == list(opened.ticks())
    opened.close()  # closing twice is once


def test_a_start_table_that_was_learnt_before_comes_back(tmp_path: Path) -> None:
    """All values and visits of it."""
    config = RunConfig("trainer", 1, params=PARAMS)
    table = empty_table(PARAMS)
    table.values[:] = [math.sin(n) for n in range(len(table))]
    table.visits[:] = range(len(table))
    writer = McapWriter(BagOptions(tmp_path / "bag"))
    RunWriter(writer, RunMetadata.of_config(config, table, {}), table).finish()
    writer.close()
    run = record(tmp_path / "run", 3, world="trainer")
    head = [raw for raw in heads_of(tmp_path / "bag") if "/run/" in raw.topic]
    body = [raw for raw in raws_of(run.bag) if "/run/" not in raw.topic]
    with Bag(write(tmp_path / "both", [*head, *body])) as opened:
        assert opened.table is not None
        assert opened.table.values.tobytes() == table.values.tobytes()
        assert opened.table.visits.tobytes() == table.visits.tobytes()


def test_the_sha_of_the_last_table_is_found(bag: Path) -> None:
    """What was sealed into the metadata is read; before, nothing is made up."""
    with Bag(bag) as opened:
        assert opened.table_sha256 is None
    seal(bag, table_sha256="f00d")
    with Bag(bag) as opened:
        assert opened.table_sha256 == "f00d"


def test_commands_that_nobody_gave_are_none(tmp_path: Path) -> None:
    """A leg that was absent has no command in its ticks, and in no other."""
    run = record(tmp_path / "bag", TICKS)
    absent = {(3, 0), (3, 2), (17, 1)}
    received = [
        tick._replace(
            commands=tuple(
                None if (tick.tick, n) in absent else command
                for n, command in enumerate(tick.commands)
            )
        )
        for tick in run.received
    ]
    writer = McapWriter(BagOptions(tmp_path / "again"))
    table = empty_table(PARAMS)
    recording = RunWriter(writer, RunMetadata.of_config(run.config, table, {}), table)
    for tick, whole in zip(received, run.received, strict=True):
        recording.tick(tick.beat, senses_of(whole), tick.commands, tick.body, tick.transitions)
    recording.finish()
    writer.close()
    hold_equal(read(tmp_path / "again"), received)


def test_raw_messages_are_all_there_in_the_order_of_their_times(walked: Run) -> None:
    """Nothing is added or left out; a start leaves out what is before it."""
    with Bag(walked.bag) as opened:
        every = list(opened.raw())
        counts = Counter(raw.topic for raw in every)
        assert counts == {topic: c.msgcount for topic, c in opened.connections.items()}
        assert [raw.ns for raw in every] == sorted(raw.ns for raw in every)
        start = 40 * TICK_NS
        assert list(opened.raw(start)) == [raw for raw in every if raw.ns >= start]


@pytest.mark.slow
@settings(max_examples=10)
@given(
    spread=st.sampled_from([0.0, 0.9, 5.0, 40.0, LATE - 2.0]),
    seed=st.integers(0, 10**6),
    storage=st.sampled_from(sorted(STORAGES)),
)
def test_order_and_log_times_do_not_matter(
    walked: Run,
    tmp_path_factory: pytest.TempPathFactory,
    spread: float,
    seed: int,
    storage: str,
) -> None:
    """Topics late in any way, wall-clock times, no card, no CRC, by another writer: the same."""
    draw, received = random.Random(seed), dict[str, float]()
    come: list[tuple[float, int, Raw]] = []
    for n, raw in enumerate(raws_of(walked.bag)):
        # A topic's own messages keep their order: it has one publisher, and nothing overtakes.
        at = max(received.get(raw.topic, 0.0), raw.ns / TICK_NS + draw.uniform(0.0, spread))
        received[raw.topic] = at
        come.append((at, n, raw))
    shuffled = [
        raw._replace(ns=NOON + place * 1_000_003) for place, (*_, raw) in enumerate(sorted(come))
    ]
    folder = tmp_path_factory.mktemp("others") / "bag"
    hold_equal(read(write_as_others_do(folder, shuffled, storage)), walked.received)
    with Bag(folder) as opened:
        assert opened.run_metadata is None
        assert opened.table is None
        assert opened.params == Params()
        assert opened.table_sha256 is None


def test_a_bag_may_begin_in_the_middle(walked: Run, messages: list[Raw], tmp_path: Path) -> None:
    """Who came late recorded the rest: it begins where it does; falls count from there."""
    late = [raw for raw in messages if raw.ns >= 50 * TICK_NS]
    ticks = read(write_as_others_do(tmp_path / "bag", late))
    rest = [
        tick._replace(body=tick.body._replace(falls=int(tick.tick >= 64)))
        for tick in walked.received
    ]
    hold_equal(ticks, rest[50:])


def test_bags_without_clock_or_odometry_are_read(
    walked: Run, messages: list[Raw], tmp_path: Path
) -> None:
    """A real leg has neither: its body is nowhere, all else is there."""
    without = [raw for raw in messages if raw.topic not in ("/clock", "/odometry", "/falls")]
    ticks = read(write_as_others_do(tmp_path / "bag", without))
    nowhere = BodyState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
    hold_equal(
        ticks,
        [t._replace(body=nowhere._replace(falls=t.body.falls)) for t in walked.received],
    )


def test_numbers_of_another_gait_are_read_with_its_parameters(tmp_path: Path) -> None:
    """The card says them; for a bag without one they are given, or it is said what is off."""
    slow = replace(PARAMS, {"gait.period": 1.0})
    run = record(tmp_path / "bag", TICKS, params=slow)
    hold_equal(read(run.bag), run.received)
    others = write_as_others_do(tmp_path / "others", raws_of(run.bag))
    with Bag(others, params=slow) as opened:
        assert opened.params == slow
        hold_equal(list(opened.ticks()), run.received)
    faster = replace(PARAMS, {"gait.period": 0.48})
    with Bag(others, params=faster) as opened, pytest.raises(BagError, match=r"gait\.period"):
        list(opened.ticks())


# -- what is lost --------------------------------------------------------------------------------


class Database:
    """A bag of one SQLite file, of which single messages are changed or lost, and back."""

    def __init__(self, run: Run) -> None:
        """Read where each message lies."""
        (self.file,) = run.bag.glob("*.db3")
        self._whole = self.file.read_bytes()
        self.run = run
        with contextlib.closing(sqlite3.connect(self.file)) as database:
            rows = database.execute(
                "SELECT messages.id, name, timestamp, data FROM messages "
                "JOIN topics ON topics.id = topic_id"
            )
            self.messages = {
                (topic, ns // TICK_NS): (number, data) for number, topic, ns, data in rows
            }

    def change(self, changes: dict[tuple[str, int], bytes | None]) -> Path:
        """Return the file with these messages, by topic and tick, changed or (None) lost."""
        self.file.write_bytes(self._whole)
        with contextlib.closing(sqlite3.connect(self.file)) as database:
            for which, data in changes.items():
                number, _ = self.messages[which]
                if data is None:
                    database.execute("DELETE FROM messages WHERE id = ?", [number])
                else:
                    database.execute("UPDATE messages SET data = ? WHERE id = ?", [data, number])
            database.commit()
        return self.file


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Database:
    """Record a run of which single messages can be changed."""
    folder = tmp_path_factory.mktemp("database")
    return Database(record(folder / "bag", 2 * FLUSH_TICKS + 5, storage="sqlite3", falls_at=[12]))


of_leg = (topics.joint_states, topics.contact, topics.command)
losses = st.sets(
    st.tuples(st.integers(0, 2 * FLUSH_TICKS + 4), st.sampled_from(of_leg), st.sampled_from(LEGS)),
    max_size=12,
)


@settings(max_examples=20)
@given(lost=losses)
def test_lost_messages_are_none_in_their_tick_and_leg(
    database: Database, lost: set[tuple[int, Any, str]]
) -> None:
    """And nowhere else; a CRC speaks against no others."""
    received = database.run.received
    file = database.change({(f"/{make(leg).name}", tick): None for tick, make, leg in lost})
    blind = {(tick, leg) for tick, make, leg in lost if make is not topics.command}
    mute = {(tick, leg) for tick, make, leg in lost if make is topics.command}
    with Bag(file) as opened:
        ticks = list(opened.ticks())
        assert {(damage.tick, damage.leg) for damage in opened.damages} <= blind
    expected = [
        tick._replace(
            senses=tuple(
                None if (tick.tick, leg) in blind else sense
                for leg, sense in zip(LEGS, tick.senses, strict=True)
            ),
            commands=tuple(
                None if (tick.tick, leg) in mute else command
                for leg, command in zip(LEGS, tick.commands, strict=True)
            ),
        )
        for tick in received
    ]
    assert [repr(tick[:4]) for tick in ticks] == [repr(tick[:4]) for tick in expected]


def test_a_tick_without_its_phase_is_left_out(database: Database) -> None:
    """Nobody knows what legs did in it; all others are there."""
    with Bag(database.change({("/cpg/phase", 7): None})) as opened:
        ticks = list(opened.ticks())
    hold_equal(ticks, [tick for tick in database.run.received if tick.tick != 7])


def test_lost_ticks_are_a_gap(messages: list[Raw], walked: Run, tmp_path: Path) -> None:
    """Whole ticks that are missing, the first too: the rest comes as it was, in order."""
    gone = {0, 33, 34, 35, 60}
    left = [raw for raw in messages if raw.ns // TICK_NS not in gone or "/run/" in raw.topic]
    with Bag(write(tmp_path / "bag", left)) as opened:
        ticks = list(opened.ticks())
    expected = [tick for tick in walked.received if tick.tick not in gone]
    assert [repr(tick[:4]) for tick in ticks] == [repr(tick[:4]) for tick in expected]


# -- what is changed -----------------------------------------------------------------------------


def hold_found(
    file: Path, topic: str, tick: int, leg: str, recorded: int, moved: int | None = None
) -> None:
    """Hold that a changed message is found: as damage, or in words with its topic and tick.

    ``moved`` is the tick that the message now names, if it names one.
    """
    said = ""
    with Bag(file) as opened:
        try:
            ticks = list(opened.ticks())
        except BagError as error:
            said = str(error)
    if said:
        assert topic in said
        named = set(map(int, re.findall(r"tick (\d+)", said)))
        assert named & {tick - 1, tick, moved}, said
    else:
        (damage,) = (d for d in opened.damages if (d.tick, d.leg) == (tick, leg))
        assert damage.recorded == recorded != damage.found
        assert len(ticks) > tick


@settings(max_examples=80)
@given(
    tick=st.integers(0, 2 * FLUSH_TICKS + 4),
    leg=st.sampled_from(LEGS),
    make=st.sampled_from(of_leg[:2]),
    place=st.floats(0.0, 1.0, exclude_max=True),
    flip=st.integers(1, 255),
)
@pytest.mark.slow
def test_a_changed_byte_never_passes(
    database: Database,
    tick: int,
    leg: str,
    make: Callable[[str], topics.Topic],
    place: float,
    flip: int,
) -> None:
    """Any byte of any leg's senses: damage in that tick and leg, or an error that names it."""
    topic = f"/{make(leg).name}"
    _, data = database.messages[topic, tick]
    at = int(place * len(data))
    changed = bytearray(data)
    changed[at] ^= flip
    file = database.change({(topic, tick): bytes(changed)})
    both = (database.messages[f"/{each(leg).name}", tick][1] for each in of_leg[:2])
    hold_found(file, topic, tick, leg, crc_of(*both))


@pytest.mark.parametrize("storage", STORAGES)
def test_every_block_of_crcs_is_held_against_its_ticks(
    walked: Run, messages: list[Raw], tmp_path: Path, storage: str
) -> None:
    """In the first, a middle and the last, unfinished one: the very ticks and legs that changed."""
    changed = {(0, LEGS[0]), (15, LEGS[3]), (16, LEGS[0]), (50, LEGS[2]), (111, LEGS[1])}

    def spoilt(raw: Raw) -> Raw:
        for tick, leg in changed:
            if (raw.topic, raw.ns) == (f"/{leg}/contact", tick * TICK_NS):
                contact = wire.JointWire(f"{leg}_foot", wire.CONTACT, "position", "effort")
                ns, (slip, *rest), effort = contact.read(raw.data, "")
                slid = math.nextafter(slip, math.inf)  # no reader could see it
                return raw._replace(data=contact.pack(ns, (slid, *rest), effort))
        return raw

    with Bag(write(tmp_path / "bag", map(spoilt, messages), storage)) as opened:
        ticks = list(opened.ticks())
        assert {(damage.tick, damage.leg) for damage in opened.damages} == changed
        assert len(ticks) == len(walked.received)
        list(opened.ticks())
        assert len(opened.damages) == len(changed)  # of the last pass only


@pytest.fixture(scope="module")
def longer(tmp_path_factory: pytest.TempPathFactory) -> Database:
    """Record more than two seconds, of which single messages can be changed."""
    folder = tmp_path_factory.mktemp("longer")
    return Database(record(folder / "bag", 5 * TICKS, storage="sqlite3", world="trainer"))


@pytest.mark.parametrize("seconds", [-2, -1, 1, 2**24, 2**30])
@pytest.mark.parametrize("part", ["joint_states", "contact"])
def test_a_stamp_that_names_another_tick_is_found(
    longer: Database, seconds: int, part: str
) -> None:
    """Moved to an earlier tick, to a later one, or out of the run: where it is missing is told."""
    tick, topic = 140 if seconds < 0 else 30, f"/leg/{part}"
    ns = tick * TICK_NS + seconds * 10**9
    _, data = longer.messages[topic, tick]
    changed = data[:4] + cdr.pack_clock(ns)[4:12] + data[12:]
    both = (longer.messages[f"/leg/{each}", tick][1] for each in ("joint_states", "contact"))
    file = longer.change({(topic, tick): changed})
    hold_found(file, topic, tick, "leg", crc_of(*both), ns // TICK_NS)


def test_an_error_in_a_bag_of_others_names_the_tick(messages: list[Raw], tmp_path: Path) -> None:
    """Log times are of another clock there: the tick that is named is near all the same."""
    spoilt = [
        raw._replace(
            ns=NOON + raw.ns,
            data=raw.data[:-8] + b"\xff" * 8
            if (raw.topic, raw.ns) == ("/rear_left/command", 70 * TICK_NS)
            else raw.data,
        )
        for raw in messages
    ]
    with (
        Bag(write_as_others_do(tmp_path / "bag", spoilt)) as opened,
        pytest.raises(BagError, match="/rear_left/command") as error,
    ):
        list(opened.ticks())
    named = [int(number) for number in re.findall(r"tick (\d+)", str(error.value))]
    assert any(abs(tick - 70) <= LATE for tick in named), str(error.value)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\0\1\0\0",
        cdr.pack_array("I", ("tick",), (4,), bytes(16)),
        cdr.pack_array("I", ("tick", "leg"), (2, 2), bytes(16)),
        cdr.pack_array("I", ("tick", "leg"), (16, 3), bytes(200), offset=2),
        cdr.pack_array("I", ("tick", "leg", "bit"), (16, 4, 1), bytes(264), offset=2),
    ],
    ids=["nothing", "no array", "one dimension", "no first tick", "three legs", "more dimensions"],
)
def test_crcs_in_another_form_are_refused(messages: list[Raw], tmp_path: Path, data: bytes) -> None:
    """What does not say what it should is said to be damaged, and nothing is taken from it."""
    changed = [raw._replace(data=data) if raw.topic == "/run/crc" else raw for raw in messages]
    with (
        Bag(write(tmp_path / "bag", changed)) as opened,
        pytest.raises(BagError, match=r"/run/crc"),
    ):
        list(opened.ticks())


# -- what is no bag ------------------------------------------------------------------------------


def _missing(bag: Path) -> Path:
    return bag / "none"


def _text(bag: Path) -> Path:
    file = bag / "notes.txt"
    file.write_text("a text")
    return file


def _empty_folder(bag: Path) -> Path:
    (bag / "empty").mkdir()
    return bag / "empty"


def _no_metadata(bag: Path) -> Path:
    (bag / METADATA).unlink()
    return bag


def _metadata(text: str) -> Spoil:
    def spoil(bag: Path) -> Path:
        (bag / METADATA).write_text(text)
        return bag

    return spoil


def _unreadable_metadata(bag: Path) -> Path:
    (bag / METADATA).unlink()
    (bag / METADATA).mkdir()
    return bag


def _information(**changes: Any) -> Spoil:
    def spoil(bag: Path) -> Path:
        content = yaml.safe_load((bag / METADATA).read_text())
        content[INFORMATION].update(changes)
        (bag / METADATA).write_text(yaml.safe_dump(content))
        return bag

    return spoil


def _file_of(bag: Path) -> Path:
    (file,) = bag.glob("*.mcap")
    return file


def _cut(share: float) -> Spoil:
    def spoil(bag: Path) -> Path:
        data = _file_of(bag).read_bytes()
        _file_of(bag).write_bytes(data[: int(share * len(data))])
        return bag

    return spoil


def _file_gone(bag: Path) -> Path:
    _file_of(bag).unlink()
    return bag


def _garbage(bag: Path) -> Path:
    file = bag / "garbage.db3"
    file.write_bytes(b"SQLite format 3\0" + bytes(range(256)) * 20)
    return file


def _rewritten(change: Callable[[Raw], Raw | None]) -> Spoil:
    def spoil(bag: Path) -> Path:
        changed = (change(raw) for raw in heads_of(bag))
        return write(bag.with_name("spoilt"), [raw for raw in changed if raw is not None])

    return spoil


def _without(topic: str) -> Spoil:
    return _rewritten(lambda raw: None if raw.topic == topic else raw)


def _of_type(topic: str, kind: str) -> Spoil:
    return _rewritten(lambda raw: raw._replace(kind=kind) if raw.topic == topic else raw)


def _elsewhere(raw: Raw) -> Raw | None:
    return raw._replace(topic="/chatter") if raw.topic == "/clock" else None


def _later_card(raw: Raw) -> Raw:
    if raw.topic != "/run/card":
        return raw
    content = {**json.loads(cdr.read_text(raw.data, "")), "format": 2}
    return raw._replace(data=cdr.pack_text(json.dumps(content)))


def _broken_card(raw: Raw) -> Raw:
    return raw._replace(data=raw.data[:-100]) if raw.topic == "/run/card" else raw


def _bit_of(topic: str) -> Callable[[Raw], Raw]:
    def change(raw: Raw) -> Raw:
        last = bytes([raw.data[-1] ^ 1])
        return raw._replace(data=raw.data[:-1] + last) if raw.topic == topic else raw

    return change


def _short_table(raw: Raw) -> Raw:
    data = cdr.pack_array("d", ("state", "action"), (2, 2), bytes(32))
    return raw._replace(data=data) if raw.topic == "/run/values" else raw


JOINTS = "sensor_msgs/msg/JointState"

BAD: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "nothing there": (_missing, ("there is no bag", "none", "--bag")),
    "a text": (_text, ("notes.txt is no bag", METADATA, ".mcap", ".db3")),
    "an empty folder": (_empty_folder, ("is no bag", METADATA)),
    "cut off": (_no_metadata, (f"no {METADATA}", "cut off", "ember bag repair")),
    "no YAML": (_metadata("{"), (METADATA, "no metadata of a bag", "ember bag repair")),
    "empty metadata": (_metadata(""), (METADATA, "no metadata of a bag", "ember bag repair")),
    "a list for metadata": (_metadata("[1, 2]"), (METADATA, "no metadata of a bag")),
    "no date": (_metadata(f"{INFORMATION}: 2024-99-99"), (METADATA, "no metadata of a bag")),
    "without its key": (_metadata("version: 9"), (INFORMATION, "no metadata of a bag")),
    "a text for information": (_metadata(f"{INFORMATION}: x"), (INFORMATION, "no metadata")),
    "a folder for metadata": (_unreadable_metadata, ("cannot read", METADATA)),
    "version 10": (_information(version=10), ("version 10", "up to 9")),
    "version nine": (_information(version="nine"), ("version 'nine'", "up to 9")),
    "an unknown storage": (_information(storage_identifier="tape"), ("tape",)),
    "no files": (_information(relative_file_paths=None), ("damaged", "ember bag repair")),
    "nothing of a file": (_cut(0.0), ("damaged", "empty", "ember bag repair")),
    "a tenth of a file": (_cut(0.1), ("damaged", "ember bag repair")),
    "half a file": (_cut(0.5), ("damaged", "ember bag repair")),
    "nearly all of a file": (_cut(0.999), ("damaged", "ember bag repair")),
    "a file gone": (_file_gone, ("bag_0.mcap", "missing")),
    "garbage": (_garbage, ("garbage.db3", "damaged")),
    "something else": (
        _rewritten(_elsewhere),
        ("no robot", "/front_left/joint_states", "/cpg/phase", "/chatter"),
    ),
    "no phase": (_without("/cpg/phase"), (f"no /cpg/phase ({JOINTS})", "--bag")),
    "no command": (
        _without("/rear_left/command"),
        (f"no /rear_left/command ({JOINTS})", "recorder_node"),
    ),
    "no joint states": (
        _without("/front_right/joint_states"),
        (f"no /front_right/joint_states ({JOINTS})", "recorder_node"),
    ),
    "no contact": (_without("/front_left/contact"), (f"no /front_left/contact ({JOINTS})",)),
    "a phase of another type": (
        _of_type("/cpg/phase", "std_msgs/msg/Float32"),
        ("/cpg/phase is of type std_msgs/msg/Float32", f"{JOINTS} would be right"),
    ),
    "senses of another type": (
        _of_type("/rear_right/contact", "std_msgs/msg/Float64"),
        ("/rear_right/contact is of type std_msgs/msg/Float64", f"{JOINTS} would be right"),
    ),
    "a clock of another type": (
        _of_type("/clock", "std_msgs/msg/Int64"),
        ("/clock is of type std_msgs/msg/Int64", "rosgraph_msgs/msg/Clock would be right"),
    ),
    "odometry of another type": (
        _of_type("/odometry", "geometry_msgs/msg/Pose"),
        ("/odometry is of type geometry_msgs/msg/Pose", "nav_msgs/msg/Odometry would be right"),
    ),
    "a card of another type": (
        _of_type("/run/card", "std_msgs/msg/Int64"),
        ("/run/card is of type std_msgs/msg/Int64", "std_msgs/msg/String would be right"),
    ),
    "a card of a later format": (
        _rewritten(_later_card),
        ("/run/card", "format 2", "newer ember_ros"),
    ),
    "half a card": (_rewritten(_broken_card), ("/run/card", "no card of a run")),
    "another value at the start": (
        _rewritten(_bit_of("/run/values")),
        ("table at the start", "not the one that was recorded", "SHA-256"),
    ),
    "another visit at the start": (
        _rewritten(_bit_of("/run/visits")),
        ("table at the start", "not the one that was recorded", "SHA-256"),
    ),
    "a small table at the start": (
        _rewritten(_short_table),
        ("table at the start is damaged",),
    ),
}


@pytest.mark.parametrize(("spoil", "reason"), BAD.values(), ids=BAD)
def test_what_cannot_be_read_says_why(bag: Path, spoil: Spoil, reason: Sequence[str]) -> None:
    """What is wrong, where, and what would be right; and no file is left open."""
    path = spoil(bag)
    with pytest.raises(BagError) as refused, Bag(path):
        pass
    for each in (str(path), *reason):
        assert each in str(refused.value), str(refused.value)
    assert "\n" not in str(refused.value)


@settings(max_examples=20)
@given(share=st.floats(0.0, 1.0, exclude_max=True), storage=st.sampled_from(sorted(STORAGES)))
def test_a_truncated_file_is_never_taken_for_a_whole_one(
    short: dict[str, Run],
    tmp_path_factory: pytest.TempPathFactory,
    share: float,
    storage: str,
) -> None:
    """Wherever it ends, metadata or not: a BagError, before a wrong tick is given."""
    run = short[storage]
    bag = shutil.copytree(run.bag, tmp_path_factory.mktemp("cut") / run.bag.name)
    (file,) = bag.glob(f"*{STORAGES[storage]}")
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    try:
        with Bag(bag) as opened:
            ticks = list(opened.ticks())
    except BagError as error:
        said = str(error)
    else:  # in the last page of a database there may be nothing that a reader needs
        assert storage == "sqlite3"
        hold_equal(ticks, run.received)
        said = "damaged"
    assert "damaged" in said


@pytest.mark.parametrize(
    "changes",
    [
        {"custom_data": "a text"},
        {"custom_data": ["a list"]},
        {"files": 3},
        {"topics_with_message_count": 3},
    ],
    ids=str,
)
def test_metadata_of_another_form_are_refused(bag: Path, changes: dict[str, Any]) -> None:
    """What a bag says of itself is a BagError, or of no weight: never another exception."""
    _information(**changes)(bag)
    with contextlib.suppress(BagError), Bag(bag) as opened:
        assert opened.table_sha256 is None
        inspection.info(opened)


def test_counts_that_are_no_numbers_are_refused(bag: Path) -> None:
    """So are counts in the metadata that nobody can count with."""
    content = yaml.safe_load((bag / METADATA).read_text())
    content[INFORMATION]["topics_with_message_count"][0]["message_count"] = "many"
    (bag / METADATA).write_text(yaml.safe_dump(content))
    with pytest.raises(BagError, match="damaged"), Bag(bag) as opened:
        inspection.info(opened)


# -- more than one -------------------------------------------------------------------------------


def test_of_two_robots_one_is_chosen(tmp_path: Path) -> None:
    """Not guessed: both are named, and each is read as if it were alone."""
    writer = McapWriter(BagOptions(tmp_path / "bag"))
    runs = {
        name: record(tmp_path / name, 40, namespace=name, seed=seed, writer=writer)
        for seed, name in enumerate(["robot_1", "robot_2"])
    }
    writer.close()
    with pytest.raises(BagError, match="--namespace") as refused:
        Bag(tmp_path / "bag")
    assert "/robot_1, /robot_2" in str(refused.value)
    for name, run in runs.items():
        hold_equal(read(tmp_path / "bag", name), run.received)
        with Bag(tmp_path / "bag", namespace=f"/{name}/") as opened:
            assert opened.namespace == name
            assert opened.robots() == ["robot_1", "robot_2"]
            assert opened.messages(topics.PHASE) == 40
            assert opened.run_metadata is not None
            assert opened.run_metadata.config(1, None) == run.config
    assert runs["robot_1"].received != runs["robot_2"].received


def test_the_robot_of_no_namespace_can_be_chosen(tmp_path: Path) -> None:
    """It is called by the root: /."""
    writer = McapWriter(BagOptions(tmp_path / "bag"))
    first = record(tmp_path / "first", 5, writer=writer)
    record(tmp_path / "second", 5, namespace="other", seed=1, writer=writer)
    writer.close()
    with pytest.raises(BagError, match="--namespace"):
        Bag(tmp_path / "bag")
    hold_equal(read(tmp_path / "bag", "/"), first.received)


def test_a_namespace_that_is_not_there_is_said(walked: Run, tmp_path: Path) -> None:
    """With those that are."""
    named = record(tmp_path / "bag", 3, namespace="robot_1")
    for path, there in ((walked.bag, "it has /"), (named.bag, "it has /robot_1")):
        with pytest.raises(BagError, match=there) as refused:
            Bag(path, namespace="robot_7")
        assert "no robot in robot_7" in str(refused.value)


@pytest.mark.parametrize("first", [3 * TICKS, TICKS + 8, 5], ids=lambda n: f"{n} ticks first")
@pytest.mark.parametrize("others", [False, True], ids=["ours", "others"])
def test_two_runs_in_one_bag_are_refused(
    messages: list[Raw], tmp_path: Path, first: int, others: bool
) -> None:
    """One after the other, however short the first was: they are never taken for one run."""
    begun = [raw for raw in messages if raw.ns < first * TICK_NS]
    again = [raw._replace(ns=raw.ns + 1000 * TICK_NS) for raw in messages]
    into = write_as_others_do if others else write
    with (
        pytest.raises(BagError, match="two runs"),
        Bag(into(tmp_path / "bag", [*begun, *again])) as opened,
    ):
        list(opened.ticks())


@pytest.mark.parametrize("seconds", [-1, 10, 2**30])
@pytest.mark.parametrize("topic", ["/clock", "/cpg/phase", "/rear_left/command"])
@pytest.mark.slow
def test_one_message_of_another_time_ends_nothing(
    walked: Run, messages: list[Raw], tmp_path: Path, topic: str, seconds: int
) -> None:
    """What follows it is read as ever; only its own tick goes without it."""
    at = 70
    stamp = cdr.pack_clock(at * TICK_NS + seconds * 10**9)
    spoilt = [
        raw
        if (raw.topic, raw.ns) != (topic, at * TICK_NS)
        else raw._replace(data=stamp if topic == "/clock" else stamp + raw.data[12:])
        for raw in messages
    ]
    assert spoilt != messages
    with Bag(write_as_others_do(tmp_path / "bag", spoilt)) as opened:
        found = {tick.tick: tick for tick in opened.ticks()}
        assert opened.stale == (topic != "/clock" and 1)
    with Bag(walked.bag) as opened:
        expected = {tick.tick: tick for tick in opened.ticks()}
    assert found.keys() == expected.keys() - ({at} if topic == "/cpg/phase" else set())
    assert all(found[tick] == expected[tick] for tick in found if tick != at)


# -- a look inside -------------------------------------------------------------------------------


def hold_rows_equal(rows: Sequence[Row], expected: Sequence[Row]) -> None:
    """Hold that lines are equal: all bits, but for what was made of the body's angles."""
    assert [repr(row[:7]) for row in rows] == [repr(row[:7]) for row in expected]
    for row, other in zip(rows, expected, strict=True):
        if row.module == BODY:
            assert row[7:] == pytest.approx(other[7:], abs=1e-9)
            assert (row.height_min_m, row.falls) == (other.height_min_m, other.falls)
        else:
            assert row[7:] == (None,) * 8


@pytest.mark.parametrize("world", ["walker", "trainer"])
def test_lines_are_those_that_were_written_beside_the_run(tmp_path: Path, world: str) -> None:
    """The same cycles.csv, but for the last tick: how that one ended is in no bag."""
    run = record(tmp_path / "bag", 5 * TICKS, world=world, falls_at=[20, 64, 65])
    with Bag(run.bag) as opened:
        _, rows = inspection.info(opened)
    modules = [*run.config.legs, BODY]
    whole = 4 * len(modules)
    hold_rows_equal(rows[:whole], run.rows[:whole])
    last = run.received[-1]
    recorder = RunStatistics(PARAMS, run.config.legs)
    for tick in run.received:
        recorder.tick(tick.beat, senses_of(tick), tick.commands, tick.body, tick.transitions)
    ended = [each._replace(tick=each.tick + 1, first_tick=True) for each in senses_of(last)]
    recorder.finish(ended, last.body)
    hold_rows_equal(rows, recorder.rows)
    assert [(row.cycle, row.module) for row in rows] == [(c, m) for c in range(5) for m in modules]


def test_info_counts_what_is_there(walked: Run) -> None:
    """Ticks, seconds, cycles, falls, distance, messages, files, provenance: all as it was."""
    with Bag(walked.bag) as opened:
        found, rows = inspection.info(opened)
    ticks, bodies = len(walked.received), [tick.body for tick in walked.received]
    assert found["bag"] == str(walked.bag)
    assert (found["namespace"], found["world"]) == ("/", "walker")
    assert (found["first_tick"], found["ticks"]) == (0, ticks)
    assert found["seconds"] == pytest.approx(ticks * 0.5 / 32)
    assert found["cycles"] == ticks / TICKS
    assert found["falls"] == 2
    assert (found["lost_ticks"], found["gaps"]) == (0, [])
    assert found["ticks_without_senses"] == {}
    assert found["ticks_without_command"] == {}
    assert found["stale_messages"] == 0
    assert found["damaged"] == []
    assert found["table_sha256"] is None
    way = 0.0
    for start in range(0, ticks, TICKS):
        one, other = bodies[start], bodies[min(start + TICKS, ticks - 1)]
        way += (other.x - one.x) * math.cos(one.yaw) + (other.y - one.y) * math.sin(one.yaw)
    assert found["distance_m"] == pytest.approx(way, abs=1e-9)
    body = [row.reward for row in rows if row.module == BODY]
    assert found["reward"] == pytest.approx(sum(body) / len(body))
    every = [
        topics.PHASE, topics.CLOCK, topics.ODOMETRY,
        *(make(leg) for leg in LEGS for make in of_leg),
    ]  # fmt: skip
    for topic in every:
        assert found["messages"][f"/{topic.name}"] == ticks
    assert found["messages"]["/falls"] == 3
    assert found["messages"]["/run/card"] == found["messages"]["/run/values"] == 1
    assert found["messages"]["/run/crc"] == -(-ticks // FLUSH_TICKS)
    assert found["storage"] == "mcap"
    assert found["files"] == {file.name: file.stat().st_size for file in walked.bag.glob("*.mcap")}
    assert found["card"]["params_sha256"] == params_sha256(PARAMS)
    assert found["card"]["start_table_sha256"] == empty_table(PARAMS).sha256()
    assert found["card"]["first_tick"] == 0
    assert found["card"]["versions"] == {"ember_ros": "test"}
    assert found["card"]["legs"]["rear_left"]["policy"] == "random"
    json.dumps(found)


def with_parts(messages: Sequence[Raw], bag: Path, **parts: str) -> Path:
    """Write a bag whose card names other parts, as it was stored where these are."""

    def change(raw: Raw) -> Raw:
        if raw.topic != "/run/card":
            return raw
        content = json.loads(cdr.read_text(raw.data, "card"))
        content["params"]["parts"] |= parts
        content["params_sha256"] = digest(content["params"])
        return raw._replace(data=cdr.pack_text(json.dumps(content)))

    return write(bag, map(change, messages))


@pytest.mark.parametrize("path", ["no_such_package.Mine", "builtins.exit", "builtins.input"])
def test_who_looks_into_a_bag_runs_nothing_that_it_names(
    walked: Run, messages: list[Raw], tmp_path: Path, path: str
) -> None:
    """Nor needs it: parts of one's own are where the robot runs, not where its bag is read."""
    parts = dict.fromkeys(as_dict(PARAMS)["parts"], path)
    with Bag(with_parts(messages, tmp_path / "bag", **parts)) as opened, Bag(walked.bag) as ours:
        assert (opened.table is None) == (ours.table is None)
        assert list(opened.ticks()) == list(ours.ticks())
        assert inspection.info(opened)[1] == inspection.info(ours)[1]


@pytest.mark.parametrize("path", ["no_such_package.Mine", "builtins.exit"])
def test_who_looks_into_a_bag_runs_no_world_that_it_names(
    walked: Run, messages: list[Raw], tmp_path: Path, path: str
) -> None:
    """Which legs there are is in the card."""

    def change(raw: Raw) -> Raw:
        if raw.topic != "/run/card":
            return raw
        content = json.loads(cdr.read_text(raw.data, "card")) | {"world": path}
        return raw._replace(data=cdr.pack_text(json.dumps(content)))

    folder = write(tmp_path / "bag", map(change, messages))
    with Bag(folder) as opened, Bag(walked.bag) as ours:
        assert (opened.world, opened.legs, opened.stage) == (path, ours.legs, ours.stage)
        assert list(opened.ticks()) == list(ours.ticks())


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("no_such_package.Mine", "there is no module 'no_such_package'"),
        ("builtins.print", "makes a NoneType without shape"),
        ("math.pi", "is no class"),
        ("math.Mine", "cannot be used"),
    ],
)
def test_a_replay_says_which_part_is_not_here(
    messages: list[Raw], tmp_path: Path, path: str, reason: str
) -> None:
    """In one line with its name, as wherever a robot is put together."""
    folder = with_parts(messages, tmp_path / "bag", discretizer=path)
    with (
        Bag(folder) as opened,
        pytest.raises(ParameterError, match=rf"^parts\.discretizer = '{path}'.*{reason}"),
    ):
        replay(opened)


def test_info_counts_what_is_not_there(messages: list[Raw], tmp_path: Path) -> None:
    """Gaps, lost ticks, senses and commands that are missing: each in its place."""
    gone = {10, 11, 12, 70}
    lost = {
        ("/rear_left/contact", 25), ("/rear_left/joint_states", 25),
        ("/rear_left/joint_states", 26), ("/front_left/command", 30),
        ("/front_left/command", 31), ("/rear_right/command", 30),
    }  # fmt: skip
    left = [
        raw
        for raw in messages
        if "/run/" in raw.topic
        or (raw.ns // TICK_NS not in gone and (raw.topic, raw.ns // TICK_NS) not in lost)
    ]
    with Bag(write(tmp_path / "bag", left)) as opened:
        found, _ = inspection.info(opened)
    assert found["ticks"] == 3 * TICKS + 16 - len(gone)
    assert found["lost_ticks"] == len(gone)
    assert found["gaps"] == [(10, 12), (70, 70)]
    assert found["ticks_without_senses"] == {"rear_left": 2}
    assert found["ticks_without_command"] == {"front_left": 2, "rear_right": 1}
    assert found["falls"] == 2
    damaged = {(each["tick"], each["leg"]) for each in found["damaged"]}
    assert damaged <= {(25, "rear_left"), (26, "rear_left")}
    assert found["messages"]["/front_left/command"] == 3 * TICKS + 16 - len(gone) - 2


@pytest.mark.parametrize("lost", ["tick", "senses"])
def test_a_cycle_whose_first_tick_is_lost_is_a_cycle(
    messages: list[Raw], tmp_path: Path, lost: str
) -> None:
    """What is missing at the border of two cycles makes not one of them."""
    left = [
        raw
        for raw in messages
        if raw.ns != 2 * TICKS * TICK_NS or (lost == "senses" and raw.topic != "/rear_left/contact")
    ]
    with Bag(write(tmp_path / "bag", left)) as opened:
        _, rows = inspection.info(opened)
    assert [row.cycle for row in rows if row.module == BODY] == [0, 1, 2, 3]


def test_a_bag_of_others_is_looked_into_as_well(
    walked: Run, messages: list[Raw], tmp_path: Path
) -> None:
    """The same lines; and no provenance is made up."""
    others = write_as_others_do(
        tmp_path / "bag", [raw._replace(ns=NOON + raw.ns) for raw in messages], "sqlite3"
    )
    with Bag(others) as opened, Bag(walked.bag) as ours:
        (found, rows), (_, expected) = inspection.info(opened), inspection.info(ours)
    assert rows == expected
    assert "card" not in found
    assert found["storage"] == "sqlite3"
    assert found["table_sha256"] is None


def test_a_bag_without_a_tick_is_a_bag(tmp_path: Path) -> None:
    """A run of no cycles leaves one: nothing is in it, and that is said."""
    run = record(tmp_path / "bag", 0)
    with Bag(run.bag) as opened:
        found, rows = inspection.info(opened)
    assert (found["ticks"], found["first_tick"], found["falls"]) == (0, None, 0)
    assert (found["distance_m"], found["reward"]) == (0, None)
    assert rows == []


# -- as CSV --------------------------------------------------------------------------------------


STANCE = int(PARAMS.gait.stance_share * TICKS)
OFFSETS = {
    leg: int(offset * TICKS)
    for leg, offset in zip(PARAMS.robot.legs, PARAMS.robot.offset, strict=True)
}
"""Of each leg's phase, ticks."""


def lines_of(file: Path) -> list[dict[str, str]]:
    """Return the lines of a CSV file."""
    with file.open(newline="") as lines:
        return list(csv.DictReader(lines))


def hold_line(line: dict[str, str], run: Run, tick: Tick, after: Tick | None, leg: str) -> None:
    """Hold that a line says what was heard, to the bit."""
    n = run.config.legs.index(leg)
    sense, command = tick.senses[n], tick.commands[n]
    at = (tick.tick + (0 if leg == TRAINER_LEG else OFFSETS[leg])) % TICKS
    stance = at < STANCE
    paid = stance or TICKS - at <= PARAMS.reward.lead
    assert int(line["tick"]) == tick.tick
    assert float(line["time_s"]) == tick.tick * PARAMS.gait.tick_s
    assert float(line["phase"]) == tick.tick / TICKS
    for name in LegSense._fields[1:]:
        if sense is None:
            assert line[name] == ""
        else:
            value = getattr(sense, name)
            assert repr(type(value)(float(line[name]))) == repr(value)
    for name in LegCommand._fields[1:]:
        said = line[f"command_{name}"]
        assert said == "" if command is None else repr(float(said)) == repr(getattr(command, name))
    if tick.transitions[n] is None:
        assert line["stance"] == line["state"] == ""
    else:
        assert int(line["stance"]) == stance
        if sense is not None:
            assert line["state"] == str(PaperDiscretizer(PARAMS).index(sense, stance))
    speeds, rewarder = PARAMS.leg.knee_speeds, PaperReward(PARAMS)
    transition = None if after is None else after.transitions[n]
    if after is None or transition is None or not transition.credited:
        assert line["action"] == line["reward"] == line["td_error"] == ""
        assert {line[f"reward_{name}"] for name in rewarder.names} == {""}
    else:
        if command is not None:
            assert line["action"] == str(speeds.index(command.knee_speed))
        assert repr(float(line["td_error"])) == repr(transition.td_error)
        then = after.senses[n]
        if then is not None:
            terms = dict.fromkeys(rewarder.names, 0.0) | rewarder.terms(then, paid)
            assert {name: float(line[f"reward_{name}"]) for name in terms} == terms
            total = 0.0
            for value in terms.values():
                total += value
            assert repr(float(line["reward"])) == repr(total)
    for name in BodyState._fields:
        value = getattr(tick.body, name)
        assert float(line[f"body_{name}"]) == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize("world", ["walker", "trainer"])
def test_a_line_a_tick_and_leg(tmp_path: Path, world: str) -> None:
    """Every sense and command equal bit for bit when parsed, state, action and reward as learnt."""
    run = record(tmp_path / "bag", TICKS + 9, world=world, falls_at=[20])
    with Bag(run.bag) as opened:
        files = inspection.write_csv(opened, tmp_path / "deep" / "csv")
    with Bag(run.bag) as opened:
        _, rows = inspection.info(opened)
    assert files == [tmp_path / "deep/csv" / name for name in ("cycles.csv", "ticks.csv")]
    lines = lines_of(files[1])
    terms = (f"reward_{name}" for name in PaperReward.names)
    assert tuple(lines[0]) == (*inspection.TICK_COLUMNS, *terms)
    assert len(lines) == len(run.received) * len(run.config.legs)
    rest = iter(lines)
    for tick, after in zip(run.received, [*run.received[1:], None], strict=True):
        for leg, line in zip(run.config.legs, rest, strict=False):
            assert line["leg"] == leg
            hold_line(line, run, tick, after, leg)
    assert len({line["td_error"] for line in lines}) > TICKS // 2  # not one number for all
    with files[0].open(newline="") as file:
        cells = list(csv.reader(file))
    assert tuple(cells[0]) == Row._fields
    assert cells[1:] == [["" if value is None else str(value) for value in row] for row in rows]
    assert len(rows) == 2 * (len(run.config.legs) + 1)


def test_what_is_missing_is_empty_in_its_line(
    walked: Run, messages: list[Raw], tmp_path: Path
) -> None:
    """Lost senses, an absent command, what a leg was paid, a lost tick: empty there alone."""
    left = [
        raw
        for raw in messages
        if (raw.topic, raw.ns) != ("/rear_left/contact", 5 * TICK_NS)
        and (raw.topic, raw.ns) != ("/front_left/command", 8 * TICK_NS)
        and (raw.topic, raw.ns) != ("/rear_right/transition", 9 * TICK_NS)
        and (raw.ns != 22 * TICK_NS)
    ]
    with Bag(write(tmp_path / "bag", left)) as opened:
        files = inspection.write_csv(opened, tmp_path / "csv")
    received = {tick.tick: tick for tick in walked.received if tick.tick != 22}
    received[5] = received[5]._replace(
        senses=(*received[5].senses[:2], None, received[5].senses[3])
    )
    received[8] = received[8]._replace(commands=(None, *received[8].commands[1:]))
    received[9] = received[9]._replace(transitions=(*received[9].transitions[:3], None))
    lines = lines_of(files[1])
    assert len(lines) == 4 * len(received)
    for line in lines:
        tick = received[int(line["tick"])]
        hold_line(line, walked, tick, received.get(tick.tick + 1), line["leg"])
    empty = [(line["tick"], line["leg"]) for line in lines if line["reward"] == ""]
    assert ("8", "rear_right") in empty
    assert not {("4", "rear_left"), ("8", "front_left")} & set(empty)
    assert [leg for tick, leg in empty if tick == "21"] == list(LEGS)
    assert [leg for tick, leg in empty if tick == "63"] == list(LEGS)  # a fall


@pytest.mark.parametrize("there", [["cycles.csv"], ["ticks.csv"], ["cycles.csv", "ticks.csv"]])
def test_csv_files_are_never_written_over(walked: Run, tmp_path: Path, there: list[str]) -> None:
    """One that is there is left as it is, and nothing is put beside it."""
    for name in there:
        (tmp_path / name).write_text("mine")
    with Bag(walked.bag) as opened, pytest.raises(BagError, match="is there already") as refused:
        inspection.write_csv(opened, tmp_path)
    assert "--out" in str(refused.value)
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == dict.fromkeys(
        there, "mine"
    )


def test_a_damaged_bag_leaves_no_half_csv(database: Database, tmp_path: Path) -> None:
    """What could not be read to its end does not lie there as if it had been."""
    _, data = database.messages["/rear_left/command", 20]
    file = database.change({("/rear_left/command", 20): data[:-8] + b"\xff" * 8})
    with Bag(file) as opened, pytest.raises(BagError, match="/rear_left/command"):
        inspection.write_csv(opened, tmp_path / "csv")
    assert not list((tmp_path / "csv").glob("*"))


def test_a_folder_that_cannot_be_written_is_said(walked: Run, tmp_path: Path) -> None:
    """In words, with its name."""
    (tmp_path / "file").write_text("")
    with Bag(walked.bag) as opened, pytest.raises(BagError, match="file"):
        inspection.write_csv(opened, tmp_path / "file" / "csv")
    with Bag(walked.bag) as opened, pytest.raises(BagError, match="/proc"):
        inspection.write_csv(opened, Path("/proc/ember"))
