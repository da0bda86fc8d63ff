"""The record of a run: a line a cycle, falls, and hashes that one bit changes."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from ember_ros.params import Params
from ember_ros.report.run_statistics import (
    BODY,
    CYCLES,
    MEASURED,
    TRACES,
    Row,
    RunStatistics,
    load_record,
)
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from leg_node.assembly import make_leg
from leg_node.reward import PaperReward
from sim_node.fake import FakeWorld
from support.gaits import ReferenceGait
from support.legs import LEGS, beat

PARAMS = Params()
TICKS = PARAMS.gait.ticks


class Tick(NamedTuple):
    """What a recorder hears of a tick."""

    beat: Beat
    senses: tuple[LegSense, ...]
    commands: tuple[LegCommand | None, ...]
    body: BodyState
    transitions: tuple[Transition | None, ...]


def run(ticks: int, *, falls_at: Sequence[int] = (), legs: Sequence[str] = LEGS) -> list[Tick]:
    """Return what is heard of a run in the fake world, the end of its last tick included.

    The body's pose is made up: it turns, nods and sinks a little, so that every column varies.
    """
    world = FakeWorld(legs, PARAMS, falls_at=falls_at)
    modules = [make_leg(PARAMS, leg, policy="random", shared=False) for leg in legs]
    received = []
    for tick in range(ticks + 1):
        senses = world.observe()
        commands = tuple(leg.tick(s, beat(tick)) for leg, s in zip(modules, senses, strict=True))
        wave = math.sin(tick)
        body = world.body()._replace(
            y=0.01 * tick,
            height=0.45 + 0.01 * wave,
            roll=0.1 * wave,
            pitch=-0.2 * wave,
            yaw=0.3,
        )
        paid = tuple(leg.last_transition for leg in modules)
        received.append(Tick(beat(tick), senses, commands, body, paid))
        world.step(beat(tick), commands)
    return received


def record(
    received: Sequence[Tick], folder: Path | None = None, changed: dict[int, Tick] | None = None
) -> RunStatistics:
    """Return the finished record of a run, some of its ticks changed."""
    every = [(changed or {}).get(n, tick) for n, tick in enumerate(received)]
    recorder = RunStatistics(PARAMS, LEGS[: len(received[0].senses)], folder)
    for tick in every[:-1]:
        recorder.tick(*tick)
    recorder.finish(every[-1].senses, every[-1].body)
    return recorder


def hashes(recorder: RunStatistics) -> tuple[str, str, str]:
    """Return the hashes of senses, commands and transitions."""
    summary = recorder.summary()
    return (
        summary["senses_sha256"],
        summary["commands_sha256"],
        summary["transitions_sha256"],
    )


# -- lines ---------------------------------------------------------------------------------------


def test_a_line_a_cycle_for_each_leg_and_the_body() -> None:
    """Three cycles of four legs: 15 lines, legs in order, then the body."""
    rows = record(run(3 * TICKS)).rows
    modules = [*LEGS, BODY]
    assert [(row.cycle, row.module) for row in rows] == [(c, m) for c in range(3) for m in modules]


def test_a_cycle_that_was_begun_has_its_line() -> None:
    """A run stopped in the middle of a cycle loses nothing: its last lines tell what there was."""
    received = run(2 * TICKS + 5)
    recorder = record(received)
    last = recorder.body_rows()[-1]
    assert last.cycle == 2
    assert last.distance_m is not None
    start, end = received[2 * TICKS].body, received[2 * TICKS + 5].body
    way = (end.x - start.x) * math.cos(0.3) + (end.y - start.y) * math.sin(0.3)
    assert last.distance_m == way
    assert len(recorder.traces) == 5 * (2 * TICKS + 5)


def test_the_legs_lines() -> None:
    """Peak force, mean reward, contact share and slip of each leg, written here a second time."""
    received = run(2 * TICKS, falls_at=[40])
    recorder, rewarder = record(received), PaperReward(PARAMS)
    assert sum(did is None or not did.credited for t in received[1:] for did in t.transitions) == 4
    for place, leg in enumerate(LEGS):
        gait = ReferenceGait(PARAMS, leg)
        for cycle in range(2):
            ends = [
                (
                    gait.stance(tick.beat.tick),
                    gait.rewarded_as_stance(tick.beat.tick, PARAMS.reward.lead),
                    after.senses[place],
                )
                for tick, after in zip(
                    received[cycle * TICKS : (cycle + 1) * TICKS],
                    received[cycle * TICKS + 1 :],
                    strict=False,
                )
            ]
            sensed = [each for each in ends if not each[2].first_tick]
            assert len(sensed) == TICKS - cycle
            (row,) = (r for r in recorder.rows if (r.cycle, r.module) == (cycle, leg))
            assert row.peak_force_n == max(sense.force_peak for *_, sense in sensed)
            assert row.reward == pytest.approx(
                sum(
                    sum(rewarder.terms(sense, paid).values())
                    for n, (_, paid, sense) in enumerate(sensed)
                    if (cycle, n) != (1, TICKS - 2)  # the run's last tick is paid for by nobody
                )
                / (TICKS - 2 * cycle)
            )
            assert row.contact_share == sum(s and x.force_mean > 0.0 for s, _, x in sensed) / 24
            assert row.duty_factor == sum(x.force_mean > 0.0 for *_, x in sensed) / TICKS
            assert row.slip_m == pytest.approx(sum(sense.slip for *_, sense in sensed))
            assert row[7:] == (None,) * 8


def test_a_leg_that_says_nothing_has_no_share() -> None:
    """Whose stance nobody knows has no share of it, and earned nothing; the others' mean stands."""
    received = run(TICKS)
    silent = {
        n: tick._replace(transitions=(*tick.transitions[:3], None))
        for n, tick in enumerate(received)
    }
    rows = record(received, changed=silent).rows
    assert rows[3].contact_share is None
    assert rows[3].reward == 0.0
    assert rows[3].duty_factor == record(received).rows[3].duty_factor
    shares = [row.contact_share for row in rows[:3] if row.contact_share is not None]
    assert rows[4].contact_share == sum(shares) / 3


@pytest.mark.parametrize(
    ("rate", "cycles"),
    [
        (0.5, [(0, 64), (1, 36)]),
        (2.0, [(n, 16) for n in range(6)] + [(6, 4)]),
        (48.0, [(n // 2 + n, 1) for n in range(100)]),
    ],
)
def test_cycles_are_those_of_the_phase(rate: float, cycles: list[tuple[int, int]]) -> None:
    """A phase of half or twice the rate has cycles of twice or half the ticks; some may be passed.

    Each line is of the ticks that were in its cycle.
    """
    received = [tick._replace(beat=Beat(n, rate * n / TICKS)) for n, tick in enumerate(run(100))]
    recorder = record(received)
    rows = recorder.body_rows()
    assert [row.cycle for row in rows] == [cycle for cycle, _ in cycles]
    start = 0
    for row, (_, ticks) in zip(rows, cycles, strict=True):
        before, after = received[start].body, received[start + ticks].body
        way = (after.x - before.x) * math.cos(0.3) + (after.y - before.y) * math.sin(0.3)
        assert row.distance_m == pytest.approx(way)
        start += ticks
    assert recorder.summary()["cycles"] == len(cycles)


def test_contact_share_is_of_stance_only() -> None:
    """Always on the ground is 1, never is 0, and contact in swing does not count."""
    received = run(TICKS)
    gait = ReferenceGait(PARAMS, LEGS[0])
    for pattern, wanted in (("always", 1.0), ("never", 0.0), ("swing", 0.0), ("stance", 1.0)):
        changed = []
        for n, tick in enumerate(received):
            stance = gait.stance(n - 1) if n else True
            force = {
                "always": 9.0,
                "never": 0.0,
                "swing": 9.0 * (not stance),
                "stance": 9.0 * stance,
            }
            senses = tuple(sense._replace(force_mean=force[pattern]) for sense in tick.senses)
            changed.append(tick._replace(senses=senses))
        row = record(changed).rows[0]
        assert row.module == LEGS[0]
        assert row.contact_share == wanted


def test_the_body_s_line() -> None:
    """Means over legs, progress along the heading, spread of roll and pitch, extremes."""
    received = run(TICKS)
    recorder = record(received)
    *legs, body = recorder.rows
    assert body.peak_force_n == max(leg.peak_force_n for leg in legs)
    for name in ("reward", "contact_share", "slip_m"):
        mean = sum(getattr(leg, name) for leg in legs) / 4
        assert getattr(body, name) == pytest.approx(mean, rel=1e-12)
    poses = [tick.body for tick in received[:-1]]
    rolls, pitches = [p.roll for p in poses], [p.pitch for p in poses]
    end = received[-1].body
    assert body.distance_m == pytest.approx(end.x * math.cos(0.3) + end.y * math.sin(0.3))
    assert body.roll_sd_rad == pytest.approx(np.std(rolls))
    assert body.pitch_sd_rad == pytest.approx(np.std(pitches))
    assert body.tilt_max_rad == max(map(abs, rolls + pitches))
    assert body.height_min_m == min(p.height for p in poses)
    assert body.falls == 0


def test_falls_are_counted_in_their_cycle() -> None:
    """One in cycle 1, none in cycle 2, two in cycle 3, the last of them at its very last tick."""
    falls = [TICKS + 5, 3 * TICKS + 1, 4 * TICKS]
    recorder = record(run(5 * TICKS, falls_at=falls))
    assert [row.falls for row in recorder.body_rows()] == [0, 1, 0, 2, 0]
    summary = recorder.summary()
    assert summary["falls"] == 3
    assert summary["first_fall"] == 1


def test_no_fall_is_none() -> None:
    """A run without falls has no first one."""
    summary = record(run(2 * TICKS)).summary()
    assert (summary["falls"], summary["first_fall"]) == (0, None)


def test_a_tick_that_ended_in_a_fall_earns_nothing() -> None:
    """Senses after being put down say nothing of the tick before: no slip, no force, no reward."""
    received = run(TICKS, falls_at=[7])
    wild = tuple(
        sense._replace(slip=99.0, force_peak=9e9, force_mean=9e9) for sense in received[7].senses
    )
    rows = record(received, changed={7: received[7]._replace(senses=wild)}).rows
    assert rows == record(received).rows


@pytest.mark.parametrize(
    ("cycles", "window"),
    [
        (1, 1),
        (3, 1),
        (4, 2),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((399, 199), (401, 200))),
    ],
)
def test_summary_speaks_of_first_and_last_cycles(cycles: int, window: int) -> None:
    """Totals and windows follow from the body's lines; the windows share no cycle."""
    recorder = record(run(cycles * TICKS, falls_at=[20]))
    summary, rows = recorder.summary(), recorder.body_rows()
    assert summary["cycles"] == cycles
    for told, spoken_of in ((summary["first"], rows[:window]), (summary["last"], rows[-window:])):
        assert told["cycles"] == window
        assert told["falls"] == sum(row.falls or 0 for row in spoken_of)
        assert told["reward"] == pytest.approx(sum(row.reward for row in spoken_of) / window)
    json.dumps(summary, allow_nan=False)


def test_totals_are_over_all_cycles() -> None:
    """Not over the two windows."""
    recorder = record(run(3 * TICKS, falls_at=[50]))
    summary, rows = recorder.summary(), recorder.body_rows()
    assert summary["falls"] == 1
    distances = [row.distance_m or 0.0 for row in rows]
    assert summary["distance_per_cycle_m"] == pytest.approx(sum(distances) / 3)


def test_absent_ticks_are_counted_by_leg() -> None:
    """A leg without a command is absent in that tick, and only it."""
    received = run(TICKS)
    without = {
        n: received[n]._replace(commands=(*received[n].commands[:2], None, received[n].commands[3]))
        for n in (3, 4, 20)
    }
    summary = record(received, changed=without).summary()
    assert summary["absent_ticks"] == dict(zip(LEGS, (0, 0, 3, 0), strict=True))


# -- hashes --------------------------------------------------------------------------------------


def test_equal_runs_have_equal_hashes() -> None:
    """The same values give the same hashes, wherever the record is kept."""
    received = run(TICKS + 3)
    assert hashes(record(received)) == hashes(record(received))
    assert hashes(record(received)) != hashes(record(run(TICKS + 2)))


def next_to(value: Any) -> Any:
    """Return the value that differs in the last bit."""
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else math.nextafter(value, math.inf)


@pytest.mark.parametrize("name", LegSense._fields)
@pytest.mark.parametrize("at", [0, TICKS - 1, TICKS + 2])
def test_one_bit_of_a_sense_changes_the_hash(name: str, at: int) -> None:
    """Any field of any leg, first tick or last of a begun cycle: only the hash of senses moves."""
    received = run(TICKS + 3)
    sense = received[at].senses[2]
    change: dict[str, Any] = {name: next_to(getattr(sense, name))}
    other = received[at]._replace(
        senses=(*received[at].senses[:2], sense._replace(**change), received[at].senses[3])
    )
    before, after = hashes(record(received)), hashes(record(received, changed={at: other}))
    assert after[0] != before[0]
    assert after[1] == before[1]


@pytest.mark.parametrize("name", LegCommand._fields)
def test_one_bit_of_a_command_changes_the_hash(name: str) -> None:
    """Any field: only the hash of commands moves, and lines do not."""
    received = run(TICKS)
    first = received[9].commands[0]
    assert first is not None
    change: dict[str, Any] = {name: next_to(getattr(first, name))}
    other = received[9]._replace(commands=(first._replace(**change), *received[9].commands[1:]))
    one, two = record(received), record(received, changed={9: other})
    assert hashes(one)[0] == hashes(two)[0]
    assert hashes(one)[1] != hashes(two)[1]
    assert one.rows == two.rows


@pytest.mark.parametrize("name", [*Transition._fields, "a term"])
def test_one_bit_of_a_transition_changes_the_hash(name: str) -> None:
    """Any field, the next state and the error too: only the hash of transitions moves."""
    received = run(TICKS)
    first = received[9].transitions[0]
    assert first is not None
    if name == "a term":
        (term, value), *rest = first.terms
        change: dict[str, Any] = {"terms": ((term, next_to(value)), *rest)}
    elif name == "terms":
        change = {name: first.terms[:-1]}
    else:
        change = {name: next_to(getattr(first, name))}
    told = (first._replace(**change), *received[9].transitions[1:])
    one, two = (
        record(received),
        record(received, changed={9: received[9]._replace(transitions=told)}),
    )
    assert hashes(one)[:2] == hashes(two)[:2]
    assert hashes(one)[2] != hashes(two)[2]


def test_no_command_is_not_a_command_of_nothing() -> None:
    """An absent leg and one that asks for zero speed are told apart."""
    received = run(TICKS)
    none = received[9]._replace(commands=(None, *received[9].commands[1:]))
    zero = received[9]._replace(
        commands=(LegCommand(0, 0.0, 0.0, 0.0, 0.0), *received[9].commands[1:])
    )
    assert (
        len({hashes(record(received, changed={9: tick}))[1] for tick in (received[9], none, zero)})
        == 3
    )


def test_legs_that_change_places_change_the_hash() -> None:
    """The same values in another order are another run."""
    received = run(TICKS)
    turned = received[5]._replace(
        senses=received[5].senses[::-1], commands=received[5].commands[::-1]
    )
    before, after = hashes(record(received)), hashes(record(received, changed={5: turned}))
    assert before[0] != after[0]
    assert before[1] != after[1]


def test_what_comes_after_the_last_tick_is_not_hashed() -> None:
    """Senses after the run close its last cycle; nobody acted on them."""
    received = run(TICKS)
    wild = tuple(sense._replace(slip=9.0) for sense in received[-1].senses)
    other = record(received, changed={TICKS: received[-1]._replace(senses=wild)})
    assert hashes(other) == hashes(record(received))


def test_hashes_are_the_same_on_every_machine() -> None:
    """The bytes hashed, written down by hand: little-endian, 64 bits a number, fields in order."""
    sense = LegSense(3, 0.5, 1.0, -1.0, 2.0, 24.5, 30.0, -0.5, 0.001, True, True, False)
    body = BodyState(0.0, 0.0, 0.45, 0.0, 0.0, 0.0, 0)
    recorder = RunStatistics(PARAMS, LEGS[:1])
    paid = Transition(3, 70, True, 8, (("height", 0.5), ("slip", -0.25)), 71, False, -0.125)
    recorder.tick(beat(3), [sense], [LegCommand(3, -0.25, 8.0, 12.0, 16.0)], body, [paid])
    recorder.tick(beat(4), [sense._replace(tick=4)], [None], body, [None])
    recorder.finish([sense._replace(tick=5)], body)
    numbers = struct.pack("<8d", 0.5, 1.0, -1.0, 2.0, 24.5, 30.0, -0.5, 0.001)
    senses = b"".join(struct.pack("<q", n) + numbers + b"\x01\x01\x00" for n in (3, 4))
    commands = struct.pack("<q4d", 3, -0.25, 8.0, 12.0, 16.0) + b"\x00"
    transitions = struct.pack("<2q?2q?3d", 3, 70, True, 8, 71, False, -0.125, 0.5, -0.25) + b"\x00"
    assert hashes(recorder) == tuple(
        hashlib.sha256(each).hexdigest() for each in (senses, commands, transitions)
    )


# -- files ---------------------------------------------------------------------------------------


def test_the_file_holds_the_rows(tmp_path: Path) -> None:
    """Line for line, digit for digit, what is in memory."""
    recorder = record(run(2 * TICKS + 3, falls_at=[10]), tmp_path)
    with (tmp_path / CYCLES).open(newline="") as file:
        head, *lines = csv.reader(file)
    assert tuple(head) == Row._fields
    assert lines == [["" if x is None else str(x) for x in row] for row in recorder.rows]
    assert len(lines) == 15


def test_a_finished_record_is_read_back(tmp_path: Path) -> None:
    """Rows, traces and summary come back from the folder as they were, to the bit."""
    recorder = record(run(2 * TICKS), tmp_path)
    back = load_record(tmp_path)
    assert back.rows == recorder.rows
    assert back.body_rows() == recorder.body_rows()
    assert back.traces.tobytes() == recorder.traces.tobytes()
    assert back.traces.shape == (2 * TICKS, 5)
    assert back.measured == recorder.summary()
    assert {path.name for path in tmp_path.iterdir()} == {CYCLES, MEASURED, TRACES}


def test_whole_cycles_are_in_the_file_at_once(tmp_path: Path) -> None:
    """A run that dies loses at most the cycle it was in: each is written when it ends."""
    received = run(2 * TICKS)
    recorder = RunStatistics(PARAMS, LEGS, tmp_path)
    lines = []
    for tick in received:
        recorder.tick(*tick)
        lines.append((tmp_path / CYCLES).read_text().splitlines()[1:])
    recorder.finish(received[-1].senses, received[-1].body)
    assert [len(each) for each in lines] == [0] * TICKS + [5] * TICKS + [10]
    assert all(line.count(",") == len(Row._fields) - 1 for line in lines[-1])


def test_traces_are_the_body_at_every_tick() -> None:
    """x, y, roll, pitch and yaw at the start of each tick."""
    received = run(TICKS)
    wanted = [(t.body.x, t.body.y, t.body.roll, t.body.pitch, t.body.yaw) for t in received[:-1]]
    assert record(received).traces.tolist() == [x for pose in wanted for x in pose]


def test_a_heading_counts_whole_turns() -> None:
    """Yaw that jumps from half a turn to the left to half a turn to the right goes on."""
    received = [
        tick._replace(body=tick.body._replace(yaw=math.remainder(0.25 * n, math.tau)))
        for n, tick in enumerate(run(2 * TICKS))
    ]
    recorder = record(received)
    wanted = [0.25 * n for n in range(2 * TICKS)]
    assert recorder.traces.tolist()[4::5] == pytest.approx(wanted)
    assert [row.yaw_rad for row in recorder.body_rows()] == pytest.approx([8.0, 16.0])
    assert recorder.summary()["heading_change_rad"] == pytest.approx(16.0)


def test_finishing_twice_is_finishing_once(tmp_path: Path) -> None:
    """A signal after the end adds no line and does not fail."""
    received = run(TICKS)
    recorder = record(received, tmp_path)
    rows, files = list(recorder.rows), (tmp_path / CYCLES).read_bytes()
    recorder.finish(received[-1].senses, received[-1].body)
    assert recorder.rows == rows
    assert (tmp_path / CYCLES).read_bytes() == files


def test_a_run_of_no_tick(tmp_path: Path) -> None:
    """Stopped before it began: a whole record of nothing, not an error."""
    recorder = RunStatistics(PARAMS, LEGS, tmp_path)
    (first,) = run(0)
    recorder.finish(first.senses, first.body)
    summary = recorder.summary()
    assert summary["cycles"] == 0
    assert summary["distance_per_cycle_m"] is None
    back = load_record(tmp_path)
    assert back.rows == []
    assert back.traces.shape == (0, 5)


def test_looking_on_does_not_disturb() -> None:
    """A summary asked for in the middle of a run changes nothing in it."""
    received = run(TICKS + 9)
    recorder = RunStatistics(PARAMS, LEGS)
    for tick in received[:-1]:
        recorder.tick(*tick)
        recorder.summary()
    recorder.finish(received[-1].senses, received[-1].body)
    assert hashes(recorder) == hashes(record(received))
    assert recorder.rows == record(received).rows
