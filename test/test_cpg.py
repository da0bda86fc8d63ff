"""The beat: a phase that is exact at a fixed period, and held to its promises at any other."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import pytest

from cpg_node.cpg import Beats, FixedPeriod
from ember_ros import parts
from ember_ros.errors import ParameterError
from ember_ros.loop import Loop
from ember_ros.params import Params, replace
from ember_ros.phase import PhaseRate
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, LegSense
from sim_node.fake import FakeWorld
from support.runs import SignalLog

PARAMS = Params()


class Listed:
    """An oscillator whose phases are written down; it keeps what it heard."""

    hears_legs = False

    def __init__(self, phases: Iterable[float]) -> None:
        """Take the phases of the ticks from 0 on."""
        self._phases = list(phases)
        self.received: list[int] = []

    def step(self, tick: int, feedback: Sequence[LegSense]) -> float:
        """Return the phase of a tick."""
        self.received.append(len(feedback))
        return self._phases[tick]


class Listening(Listed):
    """One that is given what legs sense."""

    hears_legs = True


class SlowsUnderLoad:
    """A CPG of one's own, named by its path: it stands still while any foot bears two loads."""

    hears_legs = True

    def __init__(self, params: Params) -> None:
        """Begin at the start of a cycle."""
        self._growth, self._most = 1.0 / params.gait.ticks, 2.0 * params.leg.load
        self._phase = -self._growth

    def step(self, tick: int, feedback: Sequence[LegSense]) -> float:
        """Return the phase."""
        if not tick or max(sense.force_mean for sense in feedback) < self._most:
            self._phase += self._growth
        return self._phase


# -- a fixed period ------------------------------------------------------------------------------


@pytest.mark.parametrize("ticks", [4, 32, 1024])
def test_phase_is_exact_at_every_tick(ticks: int) -> None:
    """A phase is tick / ticks with no rounding, over years of ticks: it names its tick."""
    params = replace(PARAMS, {"gait.ticks": ticks, "gait.period": 0.512, "gait.stance_share": 0.5})
    beats = Beats(FixedPeriod(params))
    for tick in (*range(1000), 10**9 + 7, 2**40 + 1):
        beat = beats.at(tick)
        assert beat == Beat(tick, tick / ticks)
        assert beat.phase * ticks == tick


def test_the_default_is_the_fixed_period() -> None:
    """Its class hears nobody, as the paper's does not."""
    cpg = parts.make(PARAMS, "cpg", PARAMS)
    assert type(cpg) is FixedPeriod
    assert Beats(cpg).hears_legs is False


# -- any oscillator ------------------------------------------------------------------------------


def test_a_phase_may_grow_as_it_likes() -> None:
    """Unevenly, not at all, by cycles at once, and over ticks that were left out."""
    phases = [0.0, 0.0, 0.1, 0.1, 7.25, 7.25, 7.5]
    beats = Beats(Listed(phases))
    for tick in (0, 1, 2, 4, 6):
        assert beats.at(tick) == Beat(tick, phases[tick])


@pytest.mark.parametrize("tick", [2, 3])
def test_a_phase_never_runs_backwards(tick: int) -> None:
    """By the last bit, over a tick that was left out too; the error says who, when, and what."""
    beats = Beats(Listed([0.0, 0.5, math.nextafter(0.5, 0.0), 0.25]))
    beats.at(0)
    beats.at(1)
    with pytest.raises(ParameterError, match=rf"Listed says phase 0\.\d+ at tick {tick}; 0\.5 or"):
        beats.at(tick)


@pytest.mark.parametrize("wrong", [math.nan, -1e-300, -1.0, math.inf, -math.inf, 2.0**53])
def test_a_phase_is_finite_and_not_negative(wrong: float) -> None:
    """At the first tick and at a later one; 2^53 cycles are more than a float counts by ones."""
    for before in ([], [0.0, 0.25]):
        beats = Beats(Listed([*before, wrong]))
        for tick in range(len(before)):
            beats.at(tick)
        with pytest.raises(
            ParameterError, match=r"parts\.cpg: Listed says phase .* would be right"
        ):
            beats.at(len(before))


def test_a_refused_phase_changes_nothing() -> None:
    """What comes next is held to the last good beat."""
    beats = Beats(Listed([0.5, math.nan, 0.25, 0.75]))
    beats.at(0)
    for tick in (1, 2):
        with pytest.raises(ParameterError):
            beats.at(tick)
    assert beats.at(3) == Beat(3, 0.75)


def test_time_may_begin_anew() -> None:
    """A tick before the last one may have a lesser phase, never a negative one."""
    beats = Beats(Listed([0.0, 0.5, 1.0]))
    assert [beats.at(tick).phase for tick in (0, 1, 2, 0, 1)] == [0.0, 0.5, 1.0, 0.0, 0.5]
    beats = Beats(Listed([-0.5, 1.0]))
    beats.at(1)
    with pytest.raises(ParameterError, match=r"phase -0\.5 at tick 0; 0\.0 or more"):
        beats.at(0)


@pytest.mark.parametrize(("kind", "received"), [(Listed, [0, 0]), (Listening, [1, 1])])
def test_only_who_asks_hears_the_legs(kind: type[Listed], received: list[int]) -> None:
    """Without ``hears_legs`` an oscillator is given nothing."""
    cpg, (sense,) = kind([0.0, 0.1]), FakeWorld(("leg",)).observe()
    beats = Beats(cpg)
    assert beats.hears_legs is kind.hears_legs
    for tick in range(2):
        beats.at(tick, [sense])
    assert cpg.received == received


def test_an_oscillator_that_hears_the_legs_walks_a_robot() -> None:
    """Named by its path: the beats that legs, world and observers hear are its own."""
    params = replace(PARAMS, {"parts.cpg": f"{__name__}.SlowsUnderLoad"})
    loop, received = (
        Loop(RunConfig("walker", 4, params=params, policy="random"), FakeWorld()),
        SignalLog(),
    )
    for _ in range(4 * 32):
        loop.tick(received)
    held = [
        tick
        for tick, senses in enumerate(received.senses)
        if tick and max(sense.force_mean for sense in senses) >= 2.0 * params.leg.load
    ]
    assert held
    ways = [b.phase - a.phase for a, b in zip(received.phases, received.phases[1:], strict=False)]
    assert [tick + 1 for tick, way in enumerate(ways) if way == 0.0] == held
    assert {way for way in ways if way} == {1 / 32}


# -- what a listener foresees --------------------------------------------------------------------


def test_a_fixed_period_is_foreseen_exactly() -> None:
    """Phase and growth add up to the next phase, to the bit, from the first beat on."""
    rate = PhaseRate(1.0 / 32)
    for tick in (*range(200), *range(2**40, 2**40 + 50)):
        assert tick / 32 + rate.per_tick(Beat(tick, tick / 32)) == (tick + 1) / 32


def test_the_growth_is_that_of_the_last_tick() -> None:
    """The first beat tells none, so the first prediction is what was given."""
    rate = PhaseRate(0.5)
    phases = [0.0, 0.25, 0.25, 1.25]
    assert [rate.per_tick(Beat(n, phase)) for n, phase in enumerate(phases)] == [
        0.5, 0.25, 0.0, 1.0,
    ]  # fmt: skip


def test_missed_ticks_count_with_their_mean() -> None:
    """Four ticks and half a cycle later, an eighth a tick."""
    rate = PhaseRate(0.5)
    assert rate.per_tick(Beat(3, 0.25)) == 0.5
    assert rate.per_tick(Beat(7, 0.75)) == 0.125


def test_a_beat_heard_twice_tells_nothing_new() -> None:
    """The prediction stays."""
    rate = PhaseRate(0.5)
    rate.per_tick(Beat(0, 0.0))
    assert rate.per_tick(Beat(1, 0.25)) == 0.25
    assert rate.per_tick(Beat(1, 0.25)) == 0.25


@pytest.mark.parametrize("again", [Beat(0, 0.0), Beat(9, 0.75), Beat(9, 1.25), Beat(11, 0.75)])
def test_the_prediction_begins_anew_where_time_does(again: Beat) -> None:
    """An earlier tick, or a lesser phase: what went before says nothing of it."""
    rate = PhaseRate(0.5)
    rate.per_tick(Beat(9, 0.75))
    assert rate.per_tick(Beat(10, 1.0)) == 0.25
    assert rate.per_tick(again) == 0.5
    assert rate.per_tick(Beat(again.tick + 1, again.phase + 0.125)) == 0.125
