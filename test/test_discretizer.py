"""The partition of a leg's senses: total, in range, and each state reached by one kind of sense."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros.params import Params, replace
from ember_ros.signals import LegSense
from leg_node.assembly import empty_table
from leg_node.discretizer import PaperDiscretizer, states_of

PARAMS = Params()
PARTITION = PaperDiscretizer(PARAMS)
STATE, LOAD = PARAMS.state, PARAMS.leg.load
AT_REST = LegSense(0, 0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False, False, False)

finite = st.floats(allow_nan=False, allow_infinity=False)
senses = st.builds(
    LegSense,
    tick=st.integers(0, 2**40),
    hip=finite,
    knee=finite,
    hip_speed=finite,
    knee_speed=finite,
    force_mean=finite,
    force_peak=finite,
    inclination=finite,
    slip=finite,
    hair=st.booleans(),
    contact=st.booleans(),
    first_tick=st.booleans(),
)


def bins(index: int, partition: PaperDiscretizer = PARTITION) -> tuple[int, ...]:
    """Return the bins of hip, force, inclination, swing and hair of a state."""
    return tuple(int(n) for n in np.unravel_index(index, partition.shape))


def hip_bin(hip: float) -> int:
    """Return the bin of a hip angle."""
    return bins(PARTITION.index(AT_REST._replace(hip=hip), True))[0]


def force_bin(force: float) -> int:
    """Return the bin of a mean force."""
    return bins(PARTITION.index(AT_REST._replace(force_mean=force), True))[1]


def inclination_bin(inclination: float) -> int:
    """Return the bin of an inclination."""
    return bins(PARTITION.index(AT_REST._replace(inclination=inclination), True))[2]


def test_the_paper_s_partition_is_the_default() -> None:
    """17 x 8 x 8 x 2 x 2 states, as many as the table has rows."""
    assert PARTITION.shape == (17, 8, 8, 2, 2)
    assert states_of(PARTITION) == 17 * 8 * 8 * 2 * 2
    assert empty_table(PARAMS).states == states_of(PARTITION)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(sense=senses, stance=st.booleans())
def test_every_sense_has_a_state(sense: LegSense, stance: bool) -> None:
    """Any finite sense, however wild, has one state within the table."""
    index = PARTITION.index(sense, stance)
    assert type(index) is int
    assert 0 <= index < states_of(PARTITION)


def test_every_state_has_a_sense() -> None:
    """From the middle of each combination of bins, all states are reached, each once."""
    width = (STATE.hip_high - STATE.hip_low) / STATE.hip_bins
    hips = [STATE.hip_low + (n + 0.5) * width for n in range(STATE.hip_bins)]
    forces = [0.0, *(edge * LOAD * 1.01 for edge in STATE.force_edges)]
    inclinations = [-2.0, *(edge + 0.01 for edge in STATE.inclination_edges)]
    seen = [
        PARTITION.index(
            AT_REST._replace(hip=hip, force_mean=force, inclination=inclination, hair=hair), stance
        )
        for hip, force, inclination, stance, hair in itertools.product(
            hips, forces, inclinations, (True, False), (False, True)
        )
    ]
    assert seen == list(range(states_of(PARTITION)))


def test_states_are_row_major() -> None:
    """The index is the one that numpy gives to (hip, force, inclination, swing, hair)."""
    sense = AT_REST._replace(hip=STATE.hip_high, force_mean=1.0 * LOAD, inclination=0.0, hair=True)
    assert bins(PARTITION.index(sense, False)) == (16, 4, 6, 1, 1)
    assert bins(PARTITION.index(sense._replace(hair=False), True)) == (16, 4, 6, 0, 0)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(sense=senses, stance=st.booleans(), other=finite)
def test_each_feature_moves_its_own_bin_upward(sense: LegSense, stance: bool, other: float) -> None:
    """A larger value never has a smaller bin, and moves no other feature's bin."""
    before = bins(PARTITION.index(sense, stance))
    for place, name in enumerate(("hip", "force_mean", "inclination")):
        change: dict[str, Any] = {name: other}
        after = bins(PARTITION.index(sense._replace(**change), stance))
        if other >= getattr(sense, name):
            assert after[place] >= before[place]
        else:
            assert after[place] <= before[place]
        assert [*after[:place], *after[place + 1 :]] == [*before[:place], *before[place + 1 :]]


@settings(max_examples=100, deadline=None, derandomize=True)
@given(sense=senses, other=senses, stance=st.booleans())
def test_only_five_senses_count(sense: LegSense, other: LegSense, stance: bool) -> None:
    """Two senses that agree in hip, force, inclination and hair are one state."""
    alike = other._replace(
        hip=sense.hip,
        force_mean=sense.force_mean,
        inclination=sense.inclination,
        hair=sense.hair,
    )
    assert PARTITION.index(alike, stance) == PARTITION.index(sense, stance)


@pytest.mark.parametrize("place", range(7))
def test_a_value_on_an_edge_is_in_the_upper_bin(place: int) -> None:
    """An edge belongs to the bin above it, the number next to it to the one below."""
    force = STATE.force_edges[place] * LOAD
    assert force_bin(force) == place + 1
    assert force_bin(math.nextafter(force, -math.inf)) == place
    inclination = STATE.inclination_edges[place]
    assert inclination_bin(inclination) == place + 1
    assert inclination_bin(math.nextafter(inclination, -math.inf)) == place


def test_hip_bins_are_equal_and_open_outward() -> None:
    """17 bins of one width over the hip's range; what is beyond is in the outer ones."""
    width = (STATE.hip_high - STATE.hip_low) / STATE.hip_bins
    for n in range(STATE.hip_bins):
        assert hip_bin(STATE.hip_low + (n + 1e-9) * width) == n
        assert hip_bin(STATE.hip_low + (n + 1 - 1e-9) * width) == n
    assert hip_bin(STATE.hip_low) == 0
    assert hip_bin(math.nextafter(STATE.hip_low, -9.0)) == hip_bin(-1e308) == 0
    assert hip_bin(STATE.hip_high) == hip_bin(1e308) == 16


def test_a_foot_in_the_air_has_a_bin_of_its_own() -> None:
    """No force is in the lowest bin; a foot that bears a leg's load is in the middle."""
    assert force_bin(0.0) == 0
    assert force_bin(LOAD) == 4


def test_another_partition() -> None:
    """The number of bins follows the parameters, and so does the table."""
    params = replace(
        PARAMS,
        {"state.hip_bins": 3, "state.force_edges": (0.5,), "state.inclination_edges": (-0.5, 0.0)},
    )
    partition = PaperDiscretizer(params)
    assert partition.shape == (3, 2, 3, 2, 2)
    assert states_of(partition) == empty_table(params).states == 72
    top = AT_REST._replace(hip=9.0, force_mean=99.0, inclination=9.0, hair=True)
    assert partition.index(top, False) == 71
