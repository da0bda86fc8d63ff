"""Bags of older versions: read for ever, and replayed as far as they can be."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ember_ros.bag import look
from ember_ros.bag.card import NEUTRAL, Card, read_card
from ember_ros.errors import BagError
from ember_ros.params import Params, digest, params_sha256
from ember_ros.plan import Plan
from leg_node.assembly import empty_table
from support.needs import needs_bags

KEPT = Path(__file__).parent / "fixtures" / "walk"


@needs_bags
def test_the_bag_that_is_kept_is_read(tmp_path: Path) -> None:
    """Of before ``<leg>/transition``: counts, lines, and what its legs sensed and did."""
    from ember_ros.bag.reading import Bag

    with Bag(KEPT) as bag:
        found, rows = look.info(bag)
    assert (found["ticks"], found["falls"], found["damaged"]) == (96, 0, [])
    assert found["reward"] is None  # nobody said what was paid
    assert len(rows) == 3 * 5
    with Bag(KEPT) as bag:
        files = look.write_csv(bag, tmp_path)
        assert bag.reward_terms == ()
    lines = files[1].read_text().splitlines()
    assert len(lines) == 1 + 96 * 4
    assert lines[0].split(",") == list(look.TICK_COLUMNS)


@needs_bags
def test_the_bag_that_is_kept_is_learnt_from() -> None:
    """A tick's update needs the senses after it, so each leg has one less than its ticks."""
    from ember_ros.bag.relearn import relearn

    learnt = relearn([KEPT])
    assert (learnt.ticks, learnt.updates, learnt.skipped) == (96, 4 * 95, 0)


@needs_bags
def test_the_bag_that_is_kept_is_replayed_as_far_as_can_be() -> None:
    """Every command comes out again; the table was read with matrix products then, and differs."""
    from ember_ros.bag.reading import Bag
    from ember_ros.bag.replay import replay

    with Bag(KEPT) as bag:
        done = replay(bag)
    assert (done.ticks, done.compared, done.difference, done.missing) == (96, 384, None, None)
    assert done.paid_otherwise is None
    assert done.recorded_sha256 is not None
    assert done.equal == (done.table.sha256() == done.recorded_sha256)


def stored(change: dict[str, dict[str, Any]], left_out: tuple[str, ...] = ()) -> str:
    """Return a card with other parameters, hashed as they are, as another version stored it."""
    content = json.loads(Card.of_plan(Plan("walker", 1), empty_table(Params()), {}).to_json())
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
    card = read_card(stored({}, (name,)), "card")
    assert card.filled.keys() == {name}
    group, field = name.split(".")
    held = getattr(getattr(card.params, group), field)
    assert held == NEUTRAL.get(name, getattr(getattr(Params(), group), field))
    assert card.stored_sha256 != params_sha256(Params())
    assert card.plan(1, None).params == card.params


@pytest.mark.parametrize(
    "change",
    [{"walk": {"smooth_hair": 0.2}}, {"balance": {"gain": 1.0}}, {"physics": {"substeps": 0}}],
)
def test_a_parameter_that_is_gone_refuses_the_replay_alone(change: dict[str, Any]) -> None:
    """The card is read; only what would have to be exact says what it does not know."""
    card = read_card(stored(change), "card")
    (group,) = change
    (field,) = change[group]
    assert card.gone == {f"{group}.{field}": change[group][field]}
    with pytest.raises(BagError, match=rf"cannot be replayed: .*{group}\.{field} = "):
        card.plan(1, None)


def test_parameters_that_were_changed_are_damage() -> None:
    """The SHA-256 is that of the parameters as they were stored."""
    text = stored({})
    with pytest.raises(BagError, match="damaged"):
        read_card(text.replace('"radius": 0.2', '"radius": 0.3'), "card")
