"""What determined a run, in one message: enough to run it again. Pure."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ember_ros.bounded_io import read_json
from ember_ros.errors import BagError, ParameterError, shown
from ember_ros.params import (
    SPECS,
    Params,
    Value,
    as_dict,
    check,
    digest,
    params_sha256,
    replace,
)
from ember_ros.run_config import RunConfig
from ember_ros.worlds import legs_of, spec_of, stage_of
from leg_node.table import Table

T = TypeVar("T")
MAX_CHARACTERS = 1 << 20
"""Of a card: a hundred times what one has."""
FORMAT = 1
"""Of the card; a reader knows its own and all before."""
NEUTRAL: Mapping[str, Value] = {
    "reward.lead": 0,
    "train.alpha_ceiling": 1.0,
    "walk.alpha_ceiling": 1.0,
}
"""Of parameters that came later: the value that gives what was done before they were there.

Read for the cards of older versions only. Of a parameter that is not here that is its default, so
who adds one with another default adds it here too.
"""


class LegMetadata(NamedTuple):
    """What one leg was told."""

    stage: str
    seed: int
    policy: str
    learning: bool
    shared: bool
    start_cycle: int = 0


@dataclasses.dataclass(frozen=True)
class RunMetadata:
    """Everything that determined a run but the senses themselves and the table at its start."""

    world: str
    legs: Mapping[str, LegMetadata]
    """What each leg was told, by its name and in order; a leg of others' making is not here."""
    params: Params
    start_table_sha256: str | None
    """Of the table at the start; None where nobody knew it."""
    first_tick: int
    """The first tick in the bag: another than 0 has no beginning to be replayed from."""
    versions: Mapping[str, str]
    filled: Mapping[str, Value] = dataclasses.field(default_factory=dict)
    """Parameters that the run's version did not have yet, and the values that stand for that."""
    gone: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What the run had and this version has not: parameters that are gone, or values of them."""
    stored_sha256: str | None = dataclasses.field(default=None, compare=False)
    """Of the parameters as they were stored; None of a card that was never stored."""

    @classmethod
    def of_config(cls, config: RunConfig, table: Table, versions: Mapping[str, str]) -> RunMetadata:
        """Return the card of a plan that starts from ``table``."""
        told = LegMetadata(
            config.stage, config.seed, config.policy, config.learning, True, config.start_cycle
        )
        legs = dict.fromkeys(config.legs, told)
        return cls(config.world, legs, config.params, table.sha256(), 0, dict(versions))

    def config(self, cycles: int, table: Path | None) -> RunConfig:
        """Return the plan that this run had.

        Args:
            cycles: of it.
            table: where the table at its start lies now.

        Raises:
            BagError: the run had no plan that can be followed again; the message says why.
        """
        cannot = "this run cannot be replayed: "
        if self.first_tick:
            raise BagError(
                f"{cannot}it was recorded from tick {self.first_tick} on, and what the legs knew "
                "by then is in no message; start the recorder before the world"
            )
        if self.start_table_sha256 is None:
            raise BagError(f"{cannot}the table at its start was not asked for in time")
        if self.gone:
            raise BagError(
                f"{cannot}this version does not know what {', '.join(self._gone())} did; `ember "
                "bag info`, `csv`, `play` and `relearn` work with it"
            )
        missing = [leg for leg in legs_of(self.world, self.params) if leg not in self.legs]
        if missing:
            raise BagError(f"{cannot}nothing is known of {', '.join(missing)}: not legs of ours")
        told = set(self.legs.values())
        if len(told) > 1 or not all(each.shared for each in told):
            raise BagError(
                f"{cannot}its legs were told different things or shared no table: "
                f"{ {leg: each._asdict() for leg, each in self.legs.items()} }"
            )
        (each,) = told
        if each.stage != stage_of(self.world):
            raise BagError(
                f"{cannot}its legs had the learning numbers of stage {each.stage!r}, which is not "
                f"that of the {self.world}; `ember relearn` works with it"
            )
        return RunConfig(
            self.world,
            cycles,
            seed=each.seed,
            params=self.params,
            policy=each.policy,
            learning=each.learning,
            table=table,
            start_cycle=each.start_cycle,
        )

    def _gone(self) -> list[str]:
        return [f"{name} = {value!r}" for name, value in self.gone.items()]

    def without_table(self) -> RunMetadata:
        """Return the card of a run of which nobody knows what table it started from."""
        return dataclasses.replace(self, start_table_sha256=None)

    def to_json(self) -> str:
        """Return the card as JSON."""
        content = {
            "format": FORMAT,
            "world": self.world,
            "legs": {leg: told._asdict() for leg, told in self.legs.items()},
            "params": as_dict(self.params),
            "params_sha256": params_sha256(self.params),
            "start_table_sha256": self.start_table_sha256,
            "first_tick": self.first_tick,
            "versions": dict(self.versions),
        }
        return json.dumps(content)


def read_run_metadata(text: str, where: str) -> RunMetadata:
    """Return the card in a JSON text.

    Raises:
        BagError: it is none, or of a later format than this version knows.
    """
    try:
        content = read_json(text, MAX_CHARACTERS)
        found = content["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise BagError(f"{where} is no card of a run: {error!r}") from error
    if found != FORMAT:
        raise BagError(
            f"{where} is of format {shown(found)}, and this version knows {FORMAT}; a newer "
            "ember_ros reads it"
        )
    try:
        stored = digest(content["params"])
        params, filled, gone = _params(_as_now(content["params"]))
        run_metadata = RunMetadata(
            world=_world(content["world"]),
            legs={leg: _leg(told) for leg, told in content["legs"].items()},
            params=params,
            start_table_sha256=_text(content["start_table_sha256"]),
            first_tick=_of(int, content["first_tick"]),
            versions={name: _of(str, each) for name, each in content["versions"].items()},
            filled=filled,
            gone=gone,
            stored_sha256=stored,
        )
    except (
        KeyError, TypeError, ValueError, OverflowError, AttributeError, ParameterError
    ) as error:  # fmt: skip
        raise BagError(f"{where} is no whole card of a run: {error!r}") from error
    if content.get("params_sha256") != stored:
        raise BagError(f"{where} is damaged: its parameters do not have the SHA-256 it names")
    return run_metadata


def _params(stored: Mapping[str, Any]) -> tuple[Params, dict[str, Value], dict[str, Any]]:
    """Return the parameters of a card, what had to be filled in, and what is gone.

    Raises:
        ParameterError: the gait or the leg cannot be held, without which no message is understood.
    """
    known: dict[str, Value] = {}
    gone: dict[str, Any] = {}
    for group, numbers in stored.items():
        for field, value in numbers.items():
            name = f"{group}.{field}"
            try:
                known[name] = check(name, value)
            except ParameterError:
                if name in SPECS and group in ("gait", "leg"):
                    raise
                gone[name] = value
    filled = {
        name: NEUTRAL.get(name, spec.default) for name, spec in SPECS.items() if name not in known
    }
    return replace(Params(), {**known, **filled}), filled, gone


def _as_now(stored: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return parameters as they are called now.

    The phase offsets were numbers of the gait, one a leg, before the robot was described by lists.
    """
    gait = dict(stored["gait"])
    legs = SPECS["robot.legs"].default
    assert isinstance(legs, tuple)
    offsets = [gait.pop(f"offset_{leg}", None) for leg in legs]
    gait.pop("offset_leg", None)  # of the trainer's leg, where it means nothing
    if None in offsets:
        return stored
    return {**stored, "gait": gait, "robot": {"offset": offsets}}


def _world(value: Any) -> str:
    """Return a world; whether one of somebody's own can be imported here is seen at a replay."""
    if "." not in _of(str, value):
        spec_of(value)
    return str(value)


def _leg(told: Mapping[str, Any]) -> LegMetadata:
    return LegMetadata(
        _one_of(told["stage"], ("train", "walk")),
        _of(int, told["seed"]),
        _of(str, told["policy"]),
        _of(bool, told["learning"]),
        _of(bool, told["shared"]),
        _of(int, told.get("start_cycle", 0)),  # before it could be told, it was 0
    )


def _of(kind: type[T], value: Any) -> T:
    """Return a value that is of a kind, and not something that could be made into it."""
    if type(value) is not kind:
        raise TypeError(f"{shown(value)} is no {kind.__name__}")
    return value


def _text(value: Any) -> str | None:
    if not isinstance(value, str | None):
        raise TypeError(f"{shown(value)} is no text")
    return value


def _one_of(value: Any, choices: Sequence[str]) -> str:
    if value not in choices:
        raise ValueError(f"{shown(value)} is not {' or '.join(choices)}")
    return str(value)
