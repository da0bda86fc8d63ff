"""The values that pass between the rooms: immutable, plain, and of a width that hashes rely on."""

from __future__ import annotations

from struct import Struct
from typing import Any, NamedTuple, get_type_hints

import pytest

from ember_ros.params import TRAINER_LEG
from ember_ros.report import run_statistics
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, TDUpdate, Transition
from support.legs import LEGS

SIGNALS = (Beat, LegSense, LegCommand, TDUpdate, BodyState)


@pytest.mark.parametrize("signal", SIGNALS)
def test_signals_are_plain_numbers(signal: type[NamedTuple]) -> None:
    """Every field is a float, an int or a bool: nothing that could share memory or be ROS."""
    assert set(get_type_hints(signal).values()) <= {float, int, bool}


def test_signals_cannot_be_changed() -> None:
    """Whoever is handed a signal cannot change it for somebody else."""
    command = LegCommand(0, 1.0, 2.0, 3.0, 4.0)
    with pytest.raises(AttributeError):
        command.tick = 1  # type: ignore[misc]


@pytest.mark.parametrize("signal", [Beat, LegSense, LegCommand, TDUpdate, Transition])
def test_signals_name_their_tick_first(signal: type[NamedTuple]) -> None:
    """A value of one tick can never be taken for one of another: the tick is in it."""
    assert signal._fields[0] == "tick"
    assert get_type_hints(signal)["tick"] is int


@pytest.mark.parametrize(
    ("signal", "layout"), [(LegSense, run_statistics._SENSE), (LegCommand, run_statistics._COMMAND)]
)
def test_hashes_cover_every_field(signal: type[NamedTuple], layout: Struct) -> None:
    """The bytes that are hashed hold each field in its full width, in order, without padding."""
    codes = {int: "q", float: "d", bool: "?"}
    wanted = "<" + "".join(codes[kind] for kind in get_type_hints(signal).values())
    sizes = {"q": 8, "d": 8, "?": 1}
    assert layout.size == sum(sizes[code] for code in wanted[1:])
    values = tuple(kind(n % 2 + n) for n, kind in enumerate(get_type_hints(signal).values()))
    assert layout.unpack(layout.pack(*values)) == values


def test_a_transition_is_hashed_whole() -> None:
    """All of it but the names of its terms, with the tick first and its terms last."""
    hints = get_type_hints(Transition)
    assert hints.pop("terms") == tuple[tuple[str, float], ...]
    assert set(hints.values()) <= {float, int, bool}
    sizes = {int: 8, float: 8, bool: 1}
    assert run_statistics._TRANSITION.size == sum(sizes[kind] for kind in hints.values())


def transition(**changes: Any) -> Transition:
    """Return a transition."""
    terms = (("height", 0.1), ("slip", 0.2), ("force", 0.3))
    return Transition(5, 7, True, 3, terms, 8, False, -0.5)._replace(**changes)


def test_a_reward_is_the_terms_added_in_their_order() -> None:
    """One after the other, which rounds otherwise than Python 3.12's ``sum`` does."""
    assert transition().reward == 0.0 + 0.1 + 0.2 + 0.3 == 0.6000000000000001
    assert transition(terms=()).reward == 0.0


def test_what_has_no_action_is_not_credited() -> None:
    """-1 says that there was nothing to credit; 0 is the first knee speed."""
    assert transition(action=0).credited
    assert not transition(action=-1).credited


def test_legs_have_names_of_their_own() -> None:
    """Five legs, five names, usable as parts of topic names."""
    assert len({*LEGS, TRAINER_LEG}) == 5
    assert all(name.isidentifier() for name in (*LEGS, TRAINER_LEG))
