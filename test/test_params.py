"""Every number of the robot: documented, in range, refused by name, and hashed."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ember_ros.errors import EmberError, ParameterError
from ember_ros.params import (
    SPECS,
    Gait,
    LearningParams,
    Leg,
    Params,
    State,
    Trainer,
    as_dict,
    cells_sha256,
    check,
    flat,
    params_sha256,
    replace,
)
from ember_ros.shipped import shipped_table
from leg_node.table_file import load_about

LISTS = [name for name, spec in SPECS.items() if isinstance(spec.default, tuple)]
TEXTS = [name for name, spec in SPECS.items() if spec.form and name not in LISTS]
NUMBERS = [name for name in SPECS if name not in (*LISTS, *TEXTS)]
INTEGERS = [name for name in NUMBERS if isinstance(SPECS[name].default, int)]
NAME_LISTS = [name for name in LISTS if SPECS[name].form]
NUMBER_LISTS = [name for name in LISTS if name not in NAME_LISTS]

# What gives a row or a column of the table its meaning; nothing else does.
CELLS = {
    *(name for name in SPECS if name.startswith(("state.", "parts."))),
    "leg.load",
    "leg.knee_speeds",
    "gait.stance_share",
} - {"parts.cpg"}


def another(name: str) -> Any:
    """Return a value of a parameter that is allowed and not the default."""
    special = {
        "gait.ticks": 64,
        "gait.period": 1.0,
        "gait.stance_share": 0.5,
        "robot.segments": ("front", "rear", "tail"),
        "robot.segment": ("front", "front", "rear", "front"),
        "robot.side": (1.0, -1.0, 1.0, 1.0),
    }
    if name in special:
        return special[name]
    spec, default = SPECS[name], SPECS[name].default
    if name in TEXTS:
        return "my_package.module.Mine"
    if name in NAME_LISTS:
        return tuple(f"my_{each}" for each in default)  # type: ignore[union-attr]
    if isinstance(default, tuple):
        return (*default[:-1], float(default[-1]) + 0.125)
    assert isinstance(default, (int, float))
    if isinstance(default, int):
        return default + 1
    smaller = name in ("leg.operating_height", "trainer.stop_low")
    step = -0.001 if smaller or default + 0.001 > spec.high else 0.001
    return default + step


def test_every_group_is_reached() -> None:
    """The list of all parameters is neither empty nor short of a group."""
    groups = [
        "gait", "leg", "physics", "trainer", "walker", "robot", "parts", "state", "reward",
        "script", "train", "walk",
    ]  # fmt: skip
    assert list(dict.fromkeys(name.split(".")[0] for name in SPECS)) == groups
    assert dict(flat(Params())) == {name: spec.default for name, spec in SPECS.items()}


@pytest.mark.parametrize("name", SPECS)
def test_every_parameter_is_described(name: str) -> None:
    """Each has a unit, a meaning, and a range or a form that holds its default."""
    spec = SPECS[name]
    assert spec.unit.strip()
    assert spec.doc.strip()
    assert spec.low <= spec.high
    items = spec.default if isinstance(spec.default, tuple) else (spec.default,)
    for item in items:
        assert isinstance(item, str) == bool(spec.form)
        assert isinstance(item, str) or spec.low <= item <= spec.high
    assert check(name, spec.default) == spec.default


def test_parameters_cannot_be_changed() -> None:
    """Nobody who is handed parameters can change them for somebody else."""
    params = Params()
    with pytest.raises(FrozenInstanceError):
        params.gait.period = 1.0  # type: ignore[misc]
    with pytest.raises(FrozenInstanceError):
        params.gait = Gait()  # type: ignore[misc]


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("gait.perod", "gait.period"),
        ("leg.knee_speed", "leg.knee_speeds"),
        ("walk.epsilon", "walk.epsilon_end"),
    ],
)
def test_a_misspelt_name_gets_a_hint(wrong: str, right: str) -> None:
    """Whoever mistypes a name is told which one is meant."""
    with pytest.raises(ParameterError, match=rf"'{wrong}'.*did you mean.*{right}"):
        replace(Params(), {wrong: 1.0})


@pytest.mark.parametrize("name", ["", "zzz", "gait", "period", "gait.period.more"])
def test_a_name_that_is_not_there_is_refused(name: str) -> None:
    """A name like no other is refused too, with a way to find the right one."""
    with pytest.raises(ParameterError, match=r"did you mean|ember params"):
        check(name, 1.0)


def test_errors_have_one_base() -> None:
    """A caller can catch everything the package says with one class."""
    assert issubclass(ParameterError, EmberError)


@pytest.mark.parametrize("name", [*NUMBERS, *NUMBER_LISTS])
def test_what_is_not_finite_is_refused(name: str) -> None:
    """NaN and infinity are refused everywhere, within lists too, with the parameter's name."""
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(ParameterError, match=name):
            check(name, (0.0, value) if name in LISTS else value)


@pytest.mark.parametrize("name", NUMBERS)
def test_a_wrong_type_is_refused(name: str) -> None:
    """Truth values, texts and lists are no numbers."""
    for value in (True, False, "1", None, [1.0], 1j, b"1"):
        with pytest.raises(ParameterError, match=f"{name} must be a number"):
            check(name, value)


@pytest.mark.parametrize("name", NUMBER_LISTS)
def test_a_list_of_a_wrong_type_is_refused(name: str) -> None:
    """One number, or a text, is no list; each item is checked as a number is."""
    for value in (1.0, "0.0", None, b"1", True):
        with pytest.raises(ParameterError, match=f"{name} must be a list"):
            check(name, value)
    for item in (True, "1", None, [0.0]):
        with pytest.raises(ParameterError, match=f"{name} must be a number"):
            check(name, (0.0, item))


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_must_have_its_form(name: str) -> None:
    """A dotted path of a module and a name in it; what is no path is refused by name."""
    for path in ("a.b", "my_package.module.Mine", "_a.B1", "päckchen.Größe"):
        assert check(name, path) == path
    wrong: list[Any] = [
        "", "Mine", ".Mine", "a.", "a..b", "a b.c", "a.b ", "a.b\n", "1a.b", "a.1b", "a-b.c", "a:b",
        "a.b:c", "a/b.c", None, 1, 1.0, True, ["a.b"], b"a.b",
    ]  # fmt: skip
    for value in wrong:
        with pytest.raises(ParameterError, match=rf"^{name} must be a dotted path.*, not "):
            check(name, value)


@pytest.mark.parametrize("name", NAME_LISTS)
def test_a_list_of_names_must_be_one(name: str) -> None:
    """Names as of topics, in a list, each by itself; a text is no list of its letters."""
    names = ("a", "front_left", "leg_2", "a1_b2")
    assert check(name, list(names)) == names
    for value in ("front", b"front", None, 1, 1.0, True):
        with pytest.raises(ParameterError, match=f"{name} must be a list of names"):
            check(name, value)
    for item in (
        "",
        "Front",
        "2a",
        "_a",
        "a_",
        "a__b",
        "a b",
        "a/b",
        "a.b",
        "a\n",
        "é",
        1,
        None,
        ["a"],
    ):
        with pytest.raises(ParameterError, match=rf"^{name} must be a name in lower case.*, not "):
            check(name, ("a", item))


@pytest.mark.parametrize("name", LISTS)
def test_a_list_must_not_be_empty(name: str) -> None:
    """There is always one knee speed, and one edge between bins."""
    with pytest.raises(ParameterError, match=f"{name} must not be empty"):
        check(name, ())


@pytest.mark.parametrize("name", INTEGERS)
def test_a_whole_number_must_be_one(name: str) -> None:
    """Half a tick is refused; a whole number written as a float is taken and made an int."""
    default = SPECS[name].default
    assert isinstance(default, int)
    with pytest.raises(ParameterError, match=f"{name} must be a whole number"):
        check(name, default + 0.5)
    taken = check(name, float(default))
    assert taken == default
    assert type(taken) is int


@pytest.mark.parametrize("name", NUMBERS)
def test_what_is_out_of_range_is_refused(name: str) -> None:
    """The ends of a range are in it, the numbers next to them are not; the message says both."""
    spec = SPECS[name]
    for end, way in ((spec.low, -1), (spec.high, 1)):
        if math.isinf(end):
            continue
        assert check(name, end) == end
        beyond = end + way if name in INTEGERS else math.nextafter(end, way * math.inf)
        with pytest.raises(ParameterError) as refused:
            check(name, beyond)
        for part in (name, repr(beyond), str(spec.low), str(spec.high), spec.unit):
            assert part in str(refused.value)


@pytest.mark.parametrize("name", ["leg.load", "gait.ticks", "reward.force"])
def test_a_number_too_large_for_a_double_is_refused(name: str) -> None:
    """An int that no double holds, as a YAML file may have, is refused like any other."""
    with pytest.raises(ParameterError, match=name):
        check(name, 10**400)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    name=st.sampled_from(sorted(SPECS)),
    value=st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=3)
    | st.from_regex(r"[a-z_.1]{1,9}", fullmatch=True)
    | st.lists(st.integers() | st.floats() | st.none() | st.text(max_size=3), max_size=3),
)
def test_a_value_is_taken_or_refused_by_name(name: str, value: object) -> None:
    """Whatever a file may hold: a finite value of the right type, or an error with the name."""
    try:
        taken = check(name, value)
    except ParameterError as error:
        refusal = str(error)
    else:
        refusal = ""
        assert type(taken) is type(SPECS[name].default)
        items = taken if isinstance(taken, tuple) else (taken,)
        for item in items:
            assert isinstance(item, str) == bool(SPECS[name].form)
            assert isinstance(item, str) or math.isfinite(item)
    assert not refusal or name in refusal


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"gait.ticks": 33}, "gait.ticks = 33 must be a power of two"),
        ({"gait.period": 1 / 3}, "gait.period = 0.33"),
        ({"gait.hip_rear": 0.8}, "gait.hip_front = 0.7 must be greater"),
        ({"gait.hip_rear": 0.7}, "gait.hip_front = 0.7 must be greater"),
        ({"gait.stance_share": 0.76}, "gait.stance_share = 0.76"),
        ({"gait.ticks": 4, "gait.stance_share": 0.95}, "gait.stance_share = 0.95"),
        ({"leg.knee_speeds": (-1.0, 1.0)}, "leg.knee_speeds"),
        ({"leg.knee_speeds": (1.0, 0.0)}, "leg.knee_speeds"),
        ({"leg.knee_speeds": (0.0, 0.0)}, "leg.knee_speeds"),
        ({"state.hip_low": 0.75}, "state.hip_low = 0.75"),
        ({"state.hip_low": 1.0}, "state.hip_low = 1.0"),
        ({"state.force_edges": (0.5, 0.2)}, "state.force_edges"),
        ({"state.inclination_edges": (0.1, 0.1)}, "state.inclination_edges"),
        ({"leg.operating_height": 0.5}, "leg.operating_height = 0.5"),
        ({"leg.foot_radius": 0.25}, "leg.foot_radius = 0.25"),
        ({"trainer.stop_low": 0.6}, "trainer.stop_low"),
        ({"robot.legs": ("a", "b", "b", "d")}, r"robot\.legs = .*'b'.* has a name twice"),
        (
            {"robot.segments": ("front", "rear", "rear")},
            r"robot\.segments = .*'rear'.* has a name twice",
        ),
        ({"robot.legs": ("a", "b", "c")}, "robot.segment has 4 entries; 3, one for each of"),
        ({"robot.segment": ("front",) * 5}, "robot.segment has 5 entries; 4, one for each of"),
        ({"robot.mount": (0.5,)}, "robot.mount has 1 entries; 4, one for each of"),
        ({"robot.side": (1.0, -1.0)}, "robot.side has 2 entries; 4, one for each of"),
        ({"robot.offset": (0.0,) * 5}, "robot.offset has 5 entries; 4, one for each of"),
        (
            {"robot.segment": ("front", "front", "tail", "rear")},
            "robot.segment = 'tail' is none of robot.segments, front, rear",
        ),
        ({"robot.segments": ("front",)}, "robot.segment = 'rear' is none of robot.segments, front"),
        ({"robot.side": (1.0, -1.0, 0.0, -1.0)}, r"robot\.side = .* must be 1 or -1 for each leg"),
        ({"robot.side": (1.0, -1.0, 0.5, -1.0)}, r"robot\.side = .* must be 1 or -1 for each leg"),
        (
            {"robot.legs": ("a", "b", "c", "leg")},
            r"robot\.legs = .*: up to 64 would be right, and none called 'leg'",
        ),
    ],
)
def test_numbers_that_contradict_each_other_are_refused(
    changes: dict[str, Any], reason: str
) -> None:
    """What each range lets pass but no robot could be built of is refused with a name."""
    with pytest.raises(ParameterError, match=reason):
        replace(Params(), changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"gait.ticks": 16**50_000},
        {"gait.ticks": "9" * 100_000},
        {"leg.knee_speeds": [[0.0] * 9] * 100_000},
        {"state.force_edges": (0.5, 0.2) * 50_000},
        {"robot.legs": [f"leg_{n}" for n in range(100_000)]},
        {"robot.legs": ["a"] * 100_000},
        {"parts.reward": "a." * 100_000},
        {"robot.segment": ["x" * 100_000] * 4},
        {"g" * 100_000: 1},
    ],
    ids=["digits", "text", "lists", "falling", "legs", "twice", "path", "segment", "name"],
)
def test_what_is_refused_is_not_said_in_full(changes: dict[str, Any]) -> None:
    """One line says what is wrong, however long that is."""
    with pytest.raises(ParameterError) as error:
        replace(Params(), changes)
    assert len(str(error.value)) < 400
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Params(gait=Gait(period=math.nan)),
        lambda: Params(leg=Leg(thigh_length=-1.0)),
        lambda: Params(trainer=Trainer(stop_low=0.6)),
        lambda: Params(walk=LearningParams(gamma=1.5)),
    ],
)
def test_parameters_made_by_hand_are_checked_too(make: Callable[[], Params]) -> None:
    """There is no way around the checks: a Params is always a right one."""
    with pytest.raises(ParameterError):
        make()


def test_parameters_made_by_hand_have_their_own_type() -> None:
    """A whole number written as a float is made whole, as it is from a file."""
    params = Params(gait=Gait(ticks=32.0))  # type: ignore[arg-type]
    assert type(params.gait.ticks) is int


def test_tick_length_is_whole() -> None:
    """A tick is a whole number of nanoseconds, so stamps never drift."""
    gait = Gait()
    assert gait.tick_ns == 15_625_000
    assert gait.tick_ns * gait.ticks == 500_000_000
    assert gait.tick_s == 0.015625


@pytest.mark.parametrize("name", SPECS)
def test_replace_changes_one_number_only(name: str) -> None:
    """A change keeps all others, the original too, and changes the hash of all parameters."""
    before = Params()
    after = replace(before, {name: another(name)})
    assert before == Params()
    changed = {key for key, value in flat(after) if value != SPECS[key].default}
    assert changed == {name}
    assert params_sha256(after) != params_sha256(before)


@pytest.mark.parametrize("name", SPECS)
def test_cells_change_exactly_with_what_defines_them(name: str) -> None:
    """Tables can be exchanged unless a row or a column means something else."""
    changed = cells_sha256(replace(Params(), {name: another(name)})) != cells_sha256(Params())
    assert changed == (name in CELLS)


def test_cells_are_named_as_before_there_were_parts() -> None:
    """With the parts that come with the package, by the partition, load, speeds and stance alone.

    So tables that were learnt before parts had names can be used.
    """
    changes: list[dict[str, Any]] = [
        {},
        {"state.hip_bins": 5, "leg.load": 10.0, "gait.stance_share": 0.5},
    ]
    for params in (replace(Params(), change) for change in changes):
        every = as_dict(params)
        meaning = [
            every["state"],
            every["leg"]["load"],
            every["leg"]["knee_speeds"],
            every["gait"]["stance_share"],
        ]
        text = json.dumps(meaning, sort_keys=True)
        assert cells_sha256(params) == hashlib.sha256(text.encode()).hexdigest()


def test_the_cells_of_shipped_tables_are_the_default_s() -> None:
    """The very text that stands in the table which comes with the package."""
    about = load_about(shipped_table(Path("trained")))
    assert about["cells_sha256"] == cells_sha256(Params())


@pytest.mark.parametrize("part", ["gait", "discretizer", "reward", "value", "learner"])
def test_each_part_that_is_named_makes_other_cells(part: str) -> None:
    """Whichever part and whichever class: no two of them can be confused, nor with the default."""
    names = [{f"parts.{part}": path} for path in ("mine.A", "mine.B")]
    others = [{f"parts.{each}": "mine.A"} for each in ("gait", "reward") if each != part]
    every: list[dict[str, Any]] = [{}, *names, *others, {"state.hip_bins": 5, **names[0]}]
    hashes = [cells_sha256(replace(Params(), change)) for change in every]
    assert len(set(hashes)) == len(every)


def test_another_oscillator_makes_no_other_cells() -> None:
    """A table says what to do at a phase, whoever makes the phase."""
    params = replace(Params(), {"parts.cpg": "mine.Hopf", "parts.reward": "mine.Reward"})
    without = replace(Params(), {"parts.reward": "mine.Reward"})
    assert cells_sha256(params) == cells_sha256(without)


def test_most_legs() -> None:
    """64 legs are a robot, 65 are none."""

    def of(count: int) -> dict[str, Any]:
        return {
            "robot.legs": [f"leg_{n}" for n in range(count)],
            "robot.segment": ["front"] * count,
            "robot.mount": [0.0] * count,
            "robot.side": [1.0] * count,
            "robot.offset": [0.0] * count,
        }

    assert len(replace(Params(), of(64)).robot.legs) == 64
    with pytest.raises(ParameterError, match="up to 64 would be right"):
        replace(Params(), of(65))


def test_replace_takes_many_of_one_group() -> None:
    """Numbers that only fit together can be changed together."""
    params = replace(Params(), {"gait.ticks": 16, "gait.period": 1, "state.hip_bins": 3.0})
    assert params.gait == Gait(ticks=16, period=1.0)
    assert params.state == State(hip_bins=3)
    assert replace(params, {}) == params


def test_replace_changes_nothing_when_it_refuses() -> None:
    """One wrong name among right ones, and nothing is taken."""
    params = Params()
    with pytest.raises(ParameterError, match=r"no parameter 'gait\.nothing'"):
        replace(params, {"gait.period": 1.0, "gait.nothing": 2.0})
    assert params == Params()


def test_dictionary_round_trip() -> None:
    """Written as plain values and read again, nothing is lost."""
    params = replace(Params(), {"leg.knee_speeds": [-3, 0, 3.5], "gait.period": 0.48})
    nested = as_dict(params)
    names = {
        f"{group}.{name}": value for group, part in nested.items() for name, value in part.items()
    }
    assert replace(Params(), names) == params
    assert nested["leg"]["knee_speeds"] == [-3.0, 0.0, 3.5]


def test_hash_of_equal_numbers_is_equal() -> None:
    """``1`` and ``1.0`` are one number, wherever they were written: one hash."""
    by_file = replace(Params(), {"gait.period": 1})
    by_hand = Params(gait=Gait(period=1))
    assert by_hand == by_file
    assert params_sha256(by_hand) == params_sha256(by_file)


def test_the_two_stages_differ() -> None:
    """A leg tries everything on the trainer and nothing at random on the walker, by default."""
    params = Params()
    assert params.walk.epsilon_start < params.train.epsilon_start
    assert params.walk.rate != params.train.rate


def test_bounds_of_the_rate_are_in_order() -> None:
    """A floor over the ceiling is said, with both."""
    with pytest.raises(ParameterError, match=r"walk\.alpha_floor = 0\.5 .*alpha_ceiling = 0\.1"):
        replace(Params(), {"walk.alpha_floor": 0.5, "walk.alpha_ceiling": 0.1})
