"""What determined a run, in one message (topic ``run/card``): enough to run it again. Pure."""

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
"""Of the JSON text: a hundred times the usual number."""
FORMAT = 1
"""Of the JSON text; a version reads its own format and all earlier ones."""
NEUTRAL: Mapping[str, Value] = {
    "reward.lead": 0,
    "train.alpha_ceiling": 1.0,
    "walk.alpha_ceiling": 1.0,
}
"""For parameters that older versions do not have: the value that gives the older behaviour.

It is used only to read the metadata of older versions. A parameter that is not here has its default
there: a new one whose default changes the behaviour must be added here.
"""


class LegMetadata(NamedTuple):
    """The configuration of one leg."""

    stage: str
    seed: int
    policy: str
    learning: bool
    shared: bool
    start_cycle: int = 0


@dataclasses.dataclass(frozen=True)
class RunMetadata:
    """Everything that determined a run except the senses and the values of the start table."""

    world: str
    legs: Mapping[str, LegMetadata]
    """Of each leg, by name and in order; legs that are not of this package are missing."""
    params: Params
    start_table_sha256: str | None
    """Of the table at the start; None if it is unknown."""
    first_tick: int
    """The first tick in the bag: from another than 0 the run cannot be replayed."""
    versions: Mapping[str, str]
    filled: Mapping[str, Value] = dataclasses.field(default_factory=dict)
    """Parameters that the run's version did not have, with the values that replace them."""
    gone: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Parameters or values of the run that this version does not have."""
    stored_sha256: str | None = dataclasses.field(default=None, compare=False)
    """Of the parameters as they were stored; None if they were not read from a bag."""

    @classmethod
    def of_config(cls, config: RunConfig, table: Table, versions: Mapping[str, str]) -> RunMetadata:
        """Return the metadata of a config that starts from ``table``."""
        leg = LegMetadata(
            config.stage, config.seed, config.policy, config.learning, True, config.start_cycle
        )
        legs = dict.fromkeys(config.legs, leg)
        return cls(config.world, legs, config.params, table.sha256(), 0, dict(versions))

    def config(self, cycles: int, table: Path | None) -> RunConfig:
        """Return the config that this run had.

        Args:
            cycles: to run.
            table: the file of the start table.

        Raises:
            BagError: the run cannot be replayed; the message says why.
        """
        prefix = "this run cannot be replayed: "
        if self.first_tick:
            raise BagError(
                f"{prefix}it was recorded from tick {self.first_tick} on, and what the legs had "
                "learnt before is not in the bag; start the recorder before the world"
            )
        if self.start_table_sha256 is None:
            raise BagError(f"{prefix}the table at its start was not requested in time")
        if self.gone:
            raise BagError(
                f"{prefix}this version does not know what {', '.join(self._gone())} did; `ember "
                "bag info`, `csv`, `play` and `relearn` work with it"
            )
        missing = [leg for leg in legs_of(self.world, self.params) if leg not in self.legs]
        if missing:
            raise BagError(
                f"{prefix}it has no metadata of {', '.join(missing)}: not leg nodes of ember_ros"
            )
        kinds = set(self.legs.values())
        if len(kinds) > 1 or not all(leg.shared for leg in kinds):
            raise BagError(
                f"{prefix}its legs had different configurations or shared no table: "
                f"{ {name: leg._asdict() for name, leg in self.legs.items()} }"
            )
        (leg,) = kinds
        if leg.stage != stage_of(self.world):
            raise BagError(
                f"{prefix}its legs had the learning parameters of stage {leg.stage!r}, which is "
                f"not that of the {self.world}; `ember relearn` works with it"
            )
        return RunConfig(
            self.world,
            cycles,
            seed=leg.seed,
            params=self.params,
            policy=leg.policy,
            learning=leg.learning,
            table=table,
            start_cycle=leg.start_cycle,
        )

    def _gone(self) -> list[str]:
        return [f"{name} = {value!r}" for name, value in self.gone.items()]

    def without_table(self) -> RunMetadata:
        """Return the metadata with an unknown start table."""
        return dataclasses.replace(self, start_table_sha256=None)

    def to_json(self) -> str:
        """Return the metadata as JSON."""
        content = {
            "format": FORMAT,
            "world": self.world,
            "legs": {name: leg._asdict() for name, leg in self.legs.items()},
            "params": as_dict(self.params),
            "params_sha256": params_sha256(self.params),
            "start_table_sha256": self.start_table_sha256,
            "first_tick": self.first_tick,
            "versions": dict(self.versions),
        }
        return json.dumps(content)


def read_run_metadata(text: str, where: str) -> RunMetadata:
    """Return the metadata in a JSON text.

    Raises:
        BagError: it is not valid, or has a later format than this version reads.
    """
    try:
        content = read_json(text, MAX_CHARACTERS)
        version = content["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise BagError(f"{where} is no card of a run: {error!r}") from error
    if version != FORMAT:
        raise BagError(
            f"{where} is of format {shown(version)}, and this version reads {FORMAT}; a newer "
            "ember_ros reads it"
        )
    try:
        stored = digest(content["params"])
        params, filled, gone = _params(_with_current_names(content["params"]))
        run_metadata = RunMetadata(
            world=_world(content["world"]),
            legs={name: _leg(leg) for name, leg in content["legs"].items()},
            params=params,
            start_table_sha256=_text(content["start_table_sha256"]),
            first_tick=_of(int, content["first_tick"]),
            versions={name: _of(str, text) for name, text in content["versions"].items()},
            filled=filled,
            gone=gone,
            stored_sha256=stored,
        )
    except (
        KeyError, TypeError, ValueError, OverflowError, AttributeError, ParameterError
    ) as error:  # fmt: skip
        raise BagError(f"{where} is no complete card of a run: {error!r}") from error
    if content.get("params_sha256") != stored:
        raise BagError(f"{where} is damaged: its parameters do not have the SHA-256 it names")
    return run_metadata


def _params(stored: Mapping[str, Any]) -> tuple[Params, dict[str, Value], dict[str, Any]]:
    """Return stored parameters, those that had to be added, and those that no longer exist.

    Raises:
        ParameterError: a value of gait or leg is invalid, without which no message can be read.
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


def _with_current_names(stored: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return stored parameters with their current names.

    Before the robot was described by lists, the gait had one phase offset per leg.
    """
    gait = dict(stored["gait"])
    legs = SPECS["robot.legs"].default
    assert isinstance(legs, tuple)
    offsets = [gait.pop(f"offset_{leg}", None) for leg in legs]
    gait.pop("offset_leg", None)  # of the trainer's leg, where it has no effect
    if None in offsets:
        return stored
    return {**stored, "gait": gait, "robot": {"offset": offsets}}


def _world(value: Any) -> str:
    """Return the name of a world; a user's own is imported only at a replay."""
    if "." not in _of(str, value):
        spec_of(value)
    return str(value)


def _leg(stored: Mapping[str, Any]) -> LegMetadata:
    return LegMetadata(
        _one_of(stored["stage"], ("train", "walk")),
        _of(int, stored["seed"]),
        _of(str, stored["policy"]),
        _of(bool, stored["learning"]),
        _of(bool, stored["shared"]),
        _of(int, stored.get("start_cycle", 0)),  # 0 in older versions, which had no such key
    )


def _of(kind: type[T], value: Any) -> T:
    """Return a value of exactly this type; no value is converted."""
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
