"""Bags of older versions: read for ever, and replayed as far as they can be."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from ember_ros import cdr, topics, wire
from ember_ros.bag import inspection
from ember_ros.bag.run_metadata import NEUTRAL, RunMetadata, read_run_metadata
from ember_ros.errors import BagError
from ember_ros.params import Params, digest, params_sha256
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat
from leg_node.assembly import empty_table
from support import bags
from support.configs import small_config
from support.needs import needs_bags

SHIPPED_BAG = Path(__file__).parent / "fixtures" / "walk"


@needs_bags
def test_the_bag_that_is_kept_is_read(tmp_path: Path) -> None:
    """Of before ``<leg>/transition``: counts, lines, and what its legs sensed and did."""
    from ember_ros.bag.reader import Bag

    with Bag(SHIPPED_BAG) as bag:
        found, rows = inspection.info(bag)
    assert (found["ticks"], found["falls"], found["damaged"]) == (96, 0, [])
    assert found["reward"] is None  # nobody said what was paid
    assert len(rows) == 3 * 5
    with Bag(SHIPPED_BAG) as bag:
        files = inspection.write_csv(bag, tmp_path)
        assert bag.reward_terms == ()
    lines = files[1].read_text().splitlines()
    assert len(lines) == 1 + 96 * 4
    assert lines[0].split(",") == list(inspection.TICK_COLUMNS)


@needs_bags
def test_the_phases_of_the_bag_that_is_kept_are_read_as_beats() -> None:
    """Of before they had a stamp: a phase named its tick."""
    from ember_ros.bag.reader import Bag

    with Bag(SHIPPED_BAG) as bag:
        assert bag.connections["/cpg/phase"].msgtype == topics.BARE_PHASE.kind
        assert [tick.beat for tick in bag.ticks()] == [Beat(n, n / 32) for n in range(96)]


@needs_bags
def test_the_phase_offsets_of_the_bag_that_is_kept_are_those_of_the_robot() -> None:
    """They were numbers of the gait, one a leg; nothing of the card is gone."""
    from ember_ros.bag.reader import Bag

    with Bag(SHIPPED_BAG) as bag:
        assert bag.run_metadata is not None
        assert bag.run_metadata.params.robot == Params().robot
        assert not [name for name in bag.run_metadata.gone if name.startswith("gait.")]


@needs_bags
def test_a_bag_of_two_kinds_of_phase_is_read_by_the_stamped_one(tmp_path: Path) -> None:
    """Whatever else is said on that topic: what this version says is what is read."""
    from ember_ros.bag.reader import Bag

    made = bags.record(tmp_path / "bag", small_config(1))
    raws = bags.raws_of(made.bag)
    bare = [
        raw._replace(kind=topics.BARE_PHASE.kind, data=cdr.ENCAPSULATION + bytes(8))
        for raw in raws
        if raw.topic == "/cpg/phase"
    ]
    for name, order in {"before": [*bare, *raws], "behind": [*raws, *bare]}.items():
        both = bags.write(tmp_path / name, order)
        with Bag(both) as bag:
            assert [tick.beat for tick in bag.ticks()] == [Beat(n, n / 32) for n in range(32)]


@needs_bags
def test_transitions_that_do_not_tell_what_came_next_are_left_out(tmp_path: Path) -> None:
    """Of before they did: all else is read, learnt from and replayed; no reward is made up."""
    from ember_ros.bag.reader import Bag
    from ember_ros.offline.relearn import relearn
    from ember_ros.offline.replay import replay

    made = bags.record(tmp_path / "new", small_config(2))
    tick_ns = made.config.params.gait.tick_ns
    older = []
    for raw in bags.raws_of(made.bag):
        leg, _, what = raw.topic.strip("/").rpartition("/")
        if what == "transition":
            transition = wire.TransitionWire(leg, tick_ns).read(raw.data)
            names = [*wire.OLDER_TRANSITION, *(name for name, _ in transition.terms)]
            numbers = [
                transition.stance,
                transition.state,
                transition.action,
                *(value for _, value in transition.terms),
            ]
            laid = wire.JointWire(f"{leg}_thigh", names, "position")
            raw = raw._replace(data=laid.pack(raw.ns, numbers))
        older.append(raw)
    old = bags.write(tmp_path / "old", older, made.table)
    with Bag(old) as bag, Bag(made.bag) as new:
        ticks = list(bag.ticks())
        assert [tick[:5] for tick in ticks] == [tick[:5] for tick in new.ticks()]
        assert {tick.transitions for tick in ticks} == {(None,) * 4}
        assert bag.reward_terms == ()
        assert inspection.info(bag)[0]["reward"] is None
        done = replay(bag)
    assert done.parts == {"senses": True, "commands": True, "rewards": None, "table": True}
    assert done.equal
    assert relearn([old]).table.sha256() == made.table


@needs_bags
def test_the_bag_that_is_kept_is_learnt_from() -> None:
    """A tick's update needs the senses after it, so each leg has one less than its ticks."""
    from ember_ros.offline.relearn import relearn

    learnt = relearn([SHIPPED_BAG])
    assert (learnt.ticks, learnt.updates, learnt.skipped) == (96, 4 * 95, 0)


@needs_bags
def test_the_bag_that_is_kept_is_replayed_as_far_as_can_be() -> None:
    """Every command comes out again; the table was read with matrix products then, and differs."""
    from ember_ros.bag.reader import Bag
    from ember_ros.offline.replay import replay

    with Bag(SHIPPED_BAG) as bag:
        done = replay(bag)
    assert (done.ticks, done.compared, done.difference, done.missing) == (96, 384, None, None)
    assert done.transition_difference is None
    assert done.recorded_sha256 is not None
    assert done.equal == (done.table.sha256() == done.recorded_sha256)


def stored(change: dict[str, dict[str, Any]], left_out: tuple[str, ...] = ()) -> str:
    """Return a card with other parameters, hashed as they are, as another version stored it."""
    content = json.loads(
        RunMetadata.of_config(RunConfig("walker", 1), empty_table(Params()), {}).to_json()
    )
    for group, numbers in change.items():
        content["params"].setdefault(group, {}).update(numbers)
    for name in left_out:
        group, field = name.split(".")
        del content["params"][group][field]
    content["params_sha256"] = digest(content["params"])
    return json.dumps(content)


@pytest.mark.parametrize("name", [*NEUTRAL, "walker.radius", "train.gamma"])
def test_a_parameter_that_came_later_is_filled_in(name: str) -> None:
    """With the value that gives what was done before it; the hash is of what was stored."""
    run_metadata = read_run_metadata(stored({}, (name,)), "card")
    assert run_metadata.filled.keys() == {name}
    group, field = name.split(".")
    held = getattr(getattr(run_metadata.params, group), field)
    assert held == NEUTRAL.get(name, getattr(getattr(Params(), group), field))
    assert run_metadata.stored_sha256 != params_sha256(Params())
    assert run_metadata.config(1, None).params == run_metadata.params


@pytest.mark.parametrize(
    "change",
    [{"walk": {"smooth_hair": 0.2}}, {"balance": {"gain": 1.0}}, {"physics": {"substeps": 0}}],
)
def test_a_parameter_that_is_gone_refuses_the_replay_alone(change: dict[str, Any]) -> None:
    """The card is read; only what would have to be exact says what it does not know."""
    run_metadata = read_run_metadata(stored(change), "card")
    (group,) = change
    (field,) = change[group]
    assert run_metadata.gone == {f"{group}.{field}": change[group][field]}
    with pytest.raises(BagError, match=rf"cannot be replayed: .*{group}\.{field} = "):
        run_metadata.config(1, None)


def of_before(offsets: dict[str, float]) -> str:
    """Return a card of before the robot was described by lists, with these offsets of legs."""
    content = json.loads(
        RunMetadata.of_config(RunConfig("walker", 1), empty_table(Params()), {}).to_json()
    )
    for group in ("robot", "parts", "script"):
        del content["params"][group]
    content["params"]["gait"] |= {f"offset_{leg}": value for leg, value in offsets.items()}
    content["params_sha256"] = digest(content["params"])
    return json.dumps(content)


def test_offsets_of_the_gait_are_offsets_of_the_robot() -> None:
    """Each leg's own, in the order of legs; the trainer's, which means nothing, is no loss."""
    offsets = {"rear_right": 0.75, "front_left": 0.125, "rear_left": 0.5, "front_right": 0.25}
    run_metadata = read_run_metadata(of_before({**offsets, "leg": 0.5}), "card")
    robot = Params().robot
    expected = dataclasses.replace(robot, offset=(0.125, 0.25, 0.5, 0.75))
    assert (run_metadata.params.robot, run_metadata.gone) == (expected, {})
    assert "robot.offset" not in run_metadata.filled
    assert {"robot.legs", "parts.cpg", "script.swing_bend"} <= run_metadata.filled.keys()
    assert run_metadata.config(1, None).params == dataclasses.replace(Params(), robot=expected)


def test_offsets_of_some_legs_alone_are_not_guessed() -> None:
    """What cannot be understood refuses the replay, and is named."""
    run_metadata = read_run_metadata(of_before({"front_left": 0.5, "rear_left": 0.0}), "card")
    assert run_metadata.gone == {"gait.offset_front_left": 0.5, "gait.offset_rear_left": 0.0}
    with pytest.raises(BagError, match=r"gait\.offset_front_left = 0\.5"):
        run_metadata.config(1, None)


def test_offsets_out_of_their_range_are_told() -> None:
    """Such a number can mean nothing here: the replay is refused, and it is named."""
    run_metadata = read_run_metadata(of_before(dict.fromkeys(Params().robot.legs, 7.0)), "card")
    with pytest.raises(BagError, match=r"robot\.offset = \[7\.0, 7\.0, 7\.0, 7\.0\]"):
        run_metadata.config(1, None)


def test_parameters_that_were_changed_are_damage() -> None:
    """The SHA-256 is that of the parameters as they were stored."""
    text = stored({})
    with pytest.raises(BagError, match="damaged"):
        read_run_metadata(text.replace('"radius": 0.2', '"radius": 0.3'), "card")
