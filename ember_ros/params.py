"""Every physical and learning number, each once, with its unit, its range and its meaning.

Groups are frozen dataclasses. ROS parameter declarations, their descriptors and ranges,
``ember params`` and the reader of parameter files all derive from the fields here; there is no
second list. Names are ``group.field``, as in a ROS parameter file::

    /**:
      ros__parameters:
        walker:
          hip_half_width: 0.35
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from ember_ros.errors import ParameterError, shown

Value: TypeAlias = "float | int | bool | str | tuple[float, ...] | tuple[str, ...]"

TRAINER_LEG = "leg"
"""The one leg of the trainer."""
MAX_LEGS = 64
MAX_CELLS = 4_000_000
"""Of a table: a hundred times those of the paper. A file can ask for more than any memory holds."""


def num(default: Any, unit: str, doc: str, low: float = -math.inf, high: float = math.inf) -> Any:
    """Make a dataclass field with a unit, a meaning and an inclusive range."""
    return field(default=default, metadata={"unit": unit, "doc": doc, "low": low, "high": high})


def text(default: str | tuple[str, ...], form: str, doc: str) -> Any:
    """Make a dataclass field of text, or of a list of it, each of which must be of a form."""
    return field(
        default=default,
        metadata={"unit": "text", "doc": doc, "low": -math.inf, "high": math.inf, "form": form},
    )


NAME, PATH = "name", "dotted path"
_FORMS = {
    NAME: (re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*"), "a name in lower case, as of a topic"),
    PATH: (re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)+"), "a dotted path, package.module.Class"),
}


@dataclass(frozen=True)
class Gait:
    """The central pattern generator and the hip ramp that follows it (paper, sections II, IV)."""

    period: float = num(0.5, "s", "one cycle of the CPG", 0.1, 10.0)
    ticks: int = num(32, "1", "actions a cycle; a power of two, so that phases are exact", 4, 1024)
    stance_share: float = num(0.75, "1", "share of the cycle in stance (3:1)", 0.1, 0.95)
    hip_front: float = num(0.70, "rad", "hip angle at the start of stance", -1.5, 1.5)
    hip_rear: float = num(-0.45, "rad", "hip angle at the end of stance", -1.5, 1.5)

    @property
    def tick_ns(self) -> int:
        """Length of one tick, ns."""
        return round(self.period * 1e9) // self.ticks

    @property
    def tick_s(self) -> float:
        """Length of one tick, s."""
        return self.tick_ns / 1e9


@dataclass(frozen=True)
class Leg:
    """One two-joint leg: its links, its motors, its hair (paper, section II)."""

    thigh_length: float = num(0.25, "m", "hip axis to knee axis", 0.01, 5.0)
    shank_length: float = num(0.25, "m", "knee axis to the sole", 0.01, 5.0)
    foot_radius: float = num(0.02, "m", "the foot is a sphere at the shank's end", 0.001, 0.5)
    thigh_mass: float = num(0.20, "kg", "mass of the thigh", 0.001, 100.0)
    shank_mass: float = num(0.08, "kg", "mass of the shank without the foot", 0.001, 100.0)
    foot_mass: float = num(0.02, "kg", "mass of the foot", 0.001, 100.0)
    knee_max: float = num(1.5, "rad", "largest bend of the knee; the least is 0", 0.1, 3.0)
    hip_torque: float = num(12.0, "N m", "largest torque of the hip motor", 0.0, 1000.0)
    knee_torque: float = num(16.0, "N m", "largest torque of the knee motor", 0.0, 1000.0)
    hip_speed_max: float = num(10.0, "rad/s", "largest speed the hip asks for", 0.1, 100.0)
    knee_speeds: tuple[float, ...] = num(
        (-28.0, -7.2, -4.8, -2.8, -1.2, 0.0, 3.0, 8.0, 28.0),
        "rad/s",
        "the knee speeds to choose from; straightening is negative; zero must be among them",
        -200.0,
        200.0,
    )
    hair_length: float = num(0.04, "m", "the hair touches below this clearance", 0.0, 1.0)
    operating_height: float = num(0.45, "m", "hip over ground to be kept: 90 %", 0.01, 10.0)
    load: float = num(24.525, "N", "weight a leg is meant to carry; forces are seen in it", 0.01)


@dataclass(frozen=True)
class Physics:
    """The simulator and the ground."""

    substeps: int = num(4, "1", "physics steps a tick", 1, 1000)
    iterations: int = num(20, "1", "iterations of the contact solver", 1, 1000)
    gravity: float = num(9.81, "m/s^2", "downward", 0.0, 100.0)
    friction: float = num(1.0, "1", "friction between foot and ground", 0.0, 10.0)
    contact_stiffness: float = num(3000.0, "N/m", "of foot on ground", 1.0)
    contact_damping: float = num(100.0, "N s/m", "of foot on ground", 0.0)


@dataclass(frozen=True)
class Trainer:
    """The cantilever trainer (paper, section III)."""

    bar_length: float = num(3.0, "m", "vertical axle to the leg's attachment", 0.1, 100.0)
    inner_mass: float = num(0.3, "kg", "inner half of the bar", 0.001, 100.0)
    tip_mass: float = num(2.5, "kg", "what the leg carries, at the bar's tip", 0.001, 1000.0)
    axle_friction: float = num(0.6, "N m", "dry friction of the axle", 0.0, 1000.0)
    axle_damping: float = num(2.5, "N m s/rad", "viscous friction of the axle", 0.0, 1000.0)
    stop_height: float = num(0.43, "m", "the stop holds the attachment at or over this", 0.0, 10.0)
    modulation: float = num(0.0, "m", "standard deviation of the stop's height; 0: fixed", 0.0, 1.0)
    stop_low: float = num(0.37, "m", "least height of a modulated stop", 0.0, 10.0)
    stop_high: float = num(0.50, "m", "largest height of a modulated stop", 0.0, 10.0)
    tip_radius: float = num(0.08, "m", "of the load at the tip, a sphere", 0.001, 10.0)
    hinge_max: float = num(
        1.0, "rad", "largest angle of the hinge, up; without stop also down", 0.1, 1.5
    )
    stop_slew: float = num(0.003, "m/tick", "fastest change of the stop's height", 0.0, 1.0)


@dataclass(frozen=True)
class Walker:
    """The body with four legs (paper, section IV)."""

    mass: float = num(5.0, "kg", "body: twice what one leg carries on the trainer", 0.01, 1000.0)
    length: float = num(1.2, "m", "of the cylinder; legs at its extremes", 0.1, 10.0)
    radius: float = num(0.20, "m", "of the cylinder", 0.01, 2.0)
    hip_half_width: float = num(0.22, "m", "hip axis to the middle plane", 0.0, 5.0)
    hip_forward: float = num(0.07, "m", "hips forward of the body's ends", -1.0, 1.0)
    twist_amplitude: float = num(0.05, "rad", "front half against rear half", 0.0, 1.0)
    twist_phase: float = num(0.875, "cycle", "phase of the largest twist", 0.0, 1.0)
    twist_torque: float = num(60.0, "N m", "largest torque of the twist motor", 0.0, 1000.0)
    fall_angle: float = num(0.6, "rad", "roll or pitch beyond this is a fall", 0.01, 3.2)
    fall_height: float = num(0.36, "m", "hips under this for a cycle are a fall", 0.0, 10.0)


@dataclass(frozen=True)
class Robot:
    """The walker's segments and legs; lists about legs have one entry a leg, in the same order."""

    segments: tuple[str, ...] = text(
        ("front", "rear"), NAME, "parts of the body from front to rear, joined by twist motors"
    )
    legs: tuple[str, ...] = text(
        ("front_left", "front_right", "rear_left", "rear_right"),
        NAME,
        "names of the legs; their order is the order of everything that is done leg by leg",
    )
    segment: tuple[str, ...] = text(
        ("front", "front", "rear", "rear"), NAME, "that each leg hangs on"
    )
    mount: tuple[float, ...] = num(
        (0.5, 0.5, -0.5, -0.5), "body", "ahead of the body's middle, in lengths of it", -1.0, 1.0
    )
    side: tuple[float, ...] = num(
        (1.0, -1.0, 1.0, -1.0), "1", "1: the left one, -1: the right one", -1.0, 1.0
    )
    offset: tuple[float, ...] = num(
        (0.0, 0.5, 0.5, 0.0), "cycle", "phase offset of each leg", 0.0, 1.0
    )


@dataclass(frozen=True)
class Parts:
    """Which class does what, by its dotted path; ``README.md`` tells how to swap one."""

    cpg: str = text("cpg_node.cpg.FixedPeriod", PATH, "ticks -> phase")
    gait: str = text("leg_node.gait.HipRamp", PATH, "beat and senses -> stance, goal of the hip")
    discretizer: str = text("leg_node.discretizer.PaperDiscretizer", PATH, "senses -> state")
    reward: str = text("leg_node.reward.PaperReward", PATH, "senses -> reward by term")
    value: str = text("leg_node.value.paper_or_smoothed", PATH, "table -> values of a state")
    learner: str = text("leg_node.learner.QLearning", PATH, "transitions -> updates of the table")


@dataclass(frozen=True)
class State:
    """The partition of what a leg senses (paper, section VI-B): 17 x 8 x 8 x 2 x 2 states."""

    hip_low: float = num(-0.50, "rad", "lower end of the hip's range", -3.2, 3.2)
    hip_high: float = num(0.75, "rad", "upper end of the hip's range", -3.2, 3.2)
    hip_bins: int = num(17, "1", "equal partitions of the hip's range", 1, 1000)
    force_edges: tuple[float, ...] = num(
        (0.02, 0.25, 0.5, 0.8, 1.1, 1.6, 2.4), "load", "edges between force bins", 0.0
    )
    inclination_edges: tuple[float, ...] = num(
        (-0.90, -0.75, -0.65, -0.55, -0.45, -0.25, 0.05),
        "rad",
        "edges between bins of the shank's inclination",
        -3.2,
        3.2,
    )


@dataclass(frozen=True)
class Reward:
    """Weights and scales of the named reward terms (paper, section VI-A)."""

    slip: float = num(1.0, "1", "weight of the slip term")
    slip_scale: float = num(0.006, "m", "slip in a tick that earns nothing", 1e-6, 1.0)
    height: float = num(1.0, "1", "weight of the height term")
    height_scale: float = num(0.025, "m", "height error that earns nothing", 1e-6, 1.0)
    term_low: float = num(-0.5, "1", "slip and height terms never fall below this")
    lost_contact: float = num(-0.5, "1", "no contact during stance")
    lead: int = num(2, "tick", "so long before stance is rewarded as stance is", 0, 1023)
    swing_free: float = num(0.3, "1", "no contact during swing")
    swing_strike: float = num(-1.0, "1", "contact during swing")
    force: float = num(-0.5, "1/load", "per load of peak force over the limit")
    force_limit: float = num(1.6, "load", "peak force that is free", 0.0)
    force_most: float = num(4.0, "load", "peak force over the limit counts up to this", 0.0)


@dataclass(frozen=True)
class Script:
    """The knee written by hand, ``--policy scripted``: what a body can be walked with at all."""

    swing_bend: float = num(1.4, "rad", "of the knee in swing: nearly all it has", 0.0, 3.0)
    reach_ticks: int = num(3, "tick", "before stance, in which the knee is put down", 0, 1023)


class Rate(NamedTuple):
    """The learning rate of a cell at its Nth visit: ``1 / N``, within two bounds."""

    floor: float
    ceiling: float


@dataclass(frozen=True)
class LearningParams:
    """One-step Q-learning, epsilon-greedy (paper, section VI-C). One set a stage.

    The paper's own learner is in ``config/plain.yaml``: a constant rate, and the table read as it
    is.
    """

    gamma: float = num(0.8, "1", "discount a tick", 0.0, 1.0)
    alpha_floor: float = num(
        0.02, "1", "learning rate is 1/visits, but not less than this", 0.0, 1.0
    )
    alpha_ceiling: float = num(1.0, "1", "nor more than this; the floor: a constant", 0.0, 1.0)
    epsilon_start: float = num(1.0, "1", "share of random actions at first", 0.0, 1.0)
    epsilon_end: float = num(0.002, "1", "share of random actions in the end", 0.0, 1.0)
    epsilon_cycles: int = num(3000, "cycle", "from the first to the last", 1, 10**9)
    smooth: float = num(0.3, "1", "say of a neighbour one bin away; 0: none, the paper's", 0.0, 0.9)
    smooth_every: int = num(4, "cycle", "between two smoothed readings of the table", 1, 10**6)
    visits_own: int = num(100, "1", "most visits of a cell that count for itself", 1, 10**9)
    visits_near: int = num(5, "1", "most visits of a cell that count for its neighbours", 0, 10**9)
    prior: float = num(5.0, "visit", "weight of the whole state for each action; 0: none", 0.0, 1e6)
    pessimism: float = num(
        1.0, "1", "an untried action is this much worse than its state", 0.0, 1e6
    )
    sync_every: int = num(32, "tick", "ticks between syncs with the shared table", 1, 10**6)

    @property
    def rate(self) -> Rate:
        """Return the bounds of the learning rate."""
        return Rate(self.alpha_floor, self.alpha_ceiling)


def _walking() -> LearningParams:
    return LearningParams(alpha_floor=0.03, epsilon_start=0.0, epsilon_end=0.0)


@dataclass(frozen=True)
class Params:
    """All groups together."""

    gait: Gait = field(default_factory=Gait)
    leg: Leg = field(default_factory=Leg)
    physics: Physics = field(default_factory=Physics)
    trainer: Trainer = field(default_factory=Trainer)
    walker: Walker = field(default_factory=Walker)
    robot: Robot = field(default_factory=Robot)
    parts: Parts = field(default_factory=Parts)
    state: State = field(default_factory=State)
    reward: Reward = field(default_factory=Reward)
    script: Script = field(default_factory=Script)
    train: LearningParams = field(default_factory=LearningParams)
    walk: LearningParams = field(default_factory=_walking)

    def __post_init__(self) -> None:
        for group in dataclasses.fields(self):
            part = getattr(self, group.name)
            own = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
            checked = {name: check(f"{group.name}.{name}", value) for name, value in own.items()}
            # In each number's own type, so that equal numbers have one hash.
            object.__setattr__(self, group.name, type(part)(**checked))
        _check_together(self)


class Spec(NamedTuple):
    """What is known of one parameter."""

    default: Value
    unit: str
    doc: str
    low: float
    high: float
    form: str = ""
    """Of text: a key of the forms above."""


def flat(params: Params) -> Iterator[tuple[str, Value]]:
    """Yield ``("group.field", value)`` of all parameters, in the order of their definition."""
    for group in dataclasses.fields(params):
        part = getattr(params, group.name)
        for each in dataclasses.fields(part):
            yield f"{group.name}.{each.name}", getattr(part, each.name)


def _specs() -> dict[str, Spec]:
    table: dict[str, Spec] = {}
    for group in dataclasses.fields(Params):
        assert callable(group.default_factory)
        part = group.default_factory()
        for each in dataclasses.fields(part):
            meta = each.metadata
            table[f"{group.name}.{each.name}"] = Spec(
                getattr(part, each.name),
                meta["unit"],
                meta["doc"],
                meta["low"],
                meta["high"],
                meta.get("form", ""),
            )
    return table


SPECS: Mapping[str, Spec] = _specs()
"""Every parameter by its full name."""


def spec_of(name: str) -> Spec:
    """Return what is known of a parameter.

    Raises:
        ParameterError: there is none of that name.
    """
    try:
        return SPECS[name]
    except KeyError:
        import difflib

        near = difflib.get_close_matches(name, SPECS, n=3)
        hint = f"did you mean {', '.join(near)}?" if near else "`ember params` lists them all"
        raise ParameterError(f"there is no parameter {shown(name)}; {hint}") from None


def check(name: str, value: Any) -> Value:
    """Return ``value`` in the parameter's own type.

    Raises:
        ParameterError: unknown name, wrong type, not finite, or out of range.
    """
    spec = spec_of(name)

    def number(item: Any, whole: bool) -> float | int:
        if isinstance(item, bool) or not isinstance(item, (int, float)):
            raise ParameterError(f"{name} must be a number [{spec.unit}], not {shown(item)}")
        try:
            finite = math.isfinite(item)
        except OverflowError:  # a whole number beyond all floats
            finite = False
        if not finite or not spec.low <= item <= spec.high:
            raise ParameterError(
                f"{name} = {shown(item)} is out of range: {spec.low} to {spec.high} "
                f"[{spec.unit}], and finite"
            )
        if whole and item != int(item):
            raise ParameterError(f"{name} must be a whole number [{spec.unit}], not {shown(item)}")
        return int(item) if whole else float(item)

    def word(item: Any) -> str:
        form, right = _FORMS[spec.form]
        if not isinstance(item, str) or not form.fullmatch(item):
            raise ParameterError(f"{name} must be {right}, not {shown(item)}")
        return item

    if isinstance(spec.default, tuple):
        if isinstance(value, (str, bytes)) or not isinstance(value, Iterable):
            kind = "names" if spec.form else f"numbers [{spec.unit}]"
            raise ParameterError(f"{name} must be a list of {kind}, not {shown(value)}")
        listed = tuple(value)
        if not listed:
            raise ParameterError(f"{name} must not be empty")
        if spec.form:
            return tuple(map(word, listed))
        return tuple(float(number(item, False)) for item in listed)
    if spec.form:
        return word(value)
    return number(value, isinstance(spec.default, int))


def _check_robot(robot: Robot) -> None:
    legs = len(robot.legs)
    for name in ("segments", "legs"):
        names = getattr(robot, name)
        if len(set(names)) != len(names):
            raise ParameterError(f"robot.{name} = {shown(names)} has a name twice")
    for name in ("segment", "mount", "side", "offset"):
        if len(getattr(robot, name)) != legs:
            raise ParameterError(
                f"robot.{name} has {len(getattr(robot, name))} entries; {legs}, one for each of "
                "robot.legs, would be right"
            )
    if others := [name for name in robot.segment if name not in robot.segments]:
        raise ParameterError(
            f"robot.segment = {shown(others[0])} is none of robot.segments, "
            f"{', '.join(robot.segments)}"
        )
    if any(abs(side) != 1.0 for side in robot.side):
        raise ParameterError(f"robot.side = {shown(robot.side)} must be 1 or -1 for each leg")
    if legs > MAX_LEGS or TRAINER_LEG in robot.legs:
        raise ParameterError(
            f"robot.legs = {shown(robot.legs)}: up to {MAX_LEGS} would be right, and none called "
            f"{TRAINER_LEG!r}, which is the trainer's"
        )


def _check_together(p: Params) -> None:
    _check_robot(p.robot)
    gait = p.gait
    if gait.ticks & (gait.ticks - 1):
        raise ParameterError(
            f"gait.ticks = {gait.ticks} must be a power of two: phases k / ticks are exact then"
        )
    if abs(gait.period * 1e9 / gait.ticks - gait.tick_ns) > 1e-3:
        raise ParameterError(
            f"gait.period = {gait.period} s does not divide into {gait.ticks} ticks of whole "
            "nanoseconds; stamps would drift (0.5 s or 0.48 s would be right)"
        )
    if gait.hip_front <= gait.hip_rear:
        raise ParameterError(
            f"gait.hip_front = {gait.hip_front} must be greater than hip_rear = {gait.hip_rear}"
        )
    stance = gait.stance_share * gait.ticks
    if stance != int(stance) or not 0 < stance < gait.ticks:
        raise ParameterError(
            f"gait.stance_share = {gait.stance_share} must be a whole number of the "
            f"{gait.ticks} ticks, leaving some for swing"
        )
    if 0.0 not in p.leg.knee_speeds or list(p.leg.knee_speeds) != sorted(set(p.leg.knee_speeds)):
        raise ParameterError(
            f"leg.knee_speeds = {shown(p.leg.knee_speeds)} must rise strictly and have 0.0 among "
            "them"
        )
    if p.state.hip_low >= p.state.hip_high:
        raise ParameterError(
            f"state.hip_low = {p.state.hip_low} must be less than hip_high = {p.state.hip_high}"
        )
    for name in ("force_edges", "inclination_edges"):
        edges = getattr(p.state, name)
        if list(edges) != sorted(set(edges)):
            raise ParameterError(f"state.{name} = {shown(edges)} must rise strictly")
    if p.leg.operating_height >= p.leg.thigh_length + p.leg.shank_length:
        raise ParameterError(
            f"leg.operating_height = {p.leg.operating_height} m is out of the leg's reach of "
            f"{p.leg.thigh_length + p.leg.shank_length} m"
        )
    if p.leg.foot_radius >= p.leg.shank_length:
        raise ParameterError(
            f"leg.foot_radius = {p.leg.foot_radius} m must be less than leg.shank_length"
        )
    for stage, learning_params in (("train", p.train), ("walk", p.walk)):
        if learning_params.alpha_floor > learning_params.alpha_ceiling:
            raise ParameterError(
                f"{stage}.alpha_floor = {learning_params.alpha_floor} must not be greater than "
                f"{stage}.alpha_ceiling = {learning_params.alpha_ceiling}"
            )
    trainer = p.trainer
    if trainer.stop_low > trainer.stop_high:
        raise ParameterError(
            f"trainer.stop_low = {trainer.stop_low} m must not be greater than stop_high = "
            f"{trainer.stop_high} m"
        )
    if trainer.modulation > 0.0 and not (
        trainer.stop_low <= trainer.stop_height <= trainer.stop_high
    ):
        raise ParameterError(
            f"trainer.stop_height = {trainer.stop_height} m must lie in stop_low to stop_high, "
            f"{trainer.stop_low} to {trainer.stop_high} m, when it is modulated"
        )


def replace(params: Params, changes: Mapping[str, Any]) -> Params:
    """Return ``params`` with some full names changed.

    Raises:
        ParameterError: an unknown name, or a value of the wrong type or out of range.
    """
    groups: dict[str, dict[str, Value]] = {}
    for name, value in changes.items():
        checked = check(name, value)
        group, each = name.split(".")
        groups.setdefault(group, {})[each] = checked
    return dataclasses.replace(
        params,
        **{
            group: dataclasses.replace(getattr(params, group), **fields)
            for group, fields in groups.items()
        },
    )


def as_dict(params: Params) -> dict[str, dict[str, Any]]:
    """Return nested dictionaries of plain numbers and lists, ready for JSON or YAML."""
    out: dict[str, dict[str, Any]] = {}
    for name, value in flat(params):
        group, each = name.split(".")
        out.setdefault(group, {})[each] = list(value) if isinstance(value, tuple) else value
    return out


def by_full_name(nested: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return what ``as_dict`` nests by full names, ``group.field``."""
    return {f"{group}.{n}": v for group, fields in nested.items() for n, v in fields.items()}


def digest(content: Any) -> str:
    """Return the SHA-256 of plain values: of their JSON with sorted names."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def params_sha256(params: Params) -> str:
    """Return the SHA-256 of all parameters: equal exactly when every number is equal."""
    return digest(as_dict(params))


def cells_sha256(params: Params) -> str:
    """Return the SHA-256 of what gives a table's rows and columns their meaning.

    The partition of the state, the load that forces are measured in, the knee speeds, the stance
    share, and the parts of a leg that are another than the default: tables can be exchanged between
    runs that agree in these.
    """
    every = as_dict(params)
    leg = every["leg"]
    meaning = [every["state"], leg["load"], leg["knee_speeds"], every["gait"]["stance_share"]]
    named = {part: path for part, path in every["parts"].items() if _named(part, path)}
    return digest([*meaning, named] if named else meaning)


def _named(part: str, path: str) -> bool:
    """Return whether a part of a leg is another than the default, which gives no name."""
    return part != "cpg" and path != SPECS[f"parts.{part}"].default
