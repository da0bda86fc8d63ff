"""What happened in a run, tick by tick, as arrays by name. Pure.

Row ``t`` of every array is about tick ``t``: what is sensed at its start, what is chosen then, and
what that was worth, which is known one tick later. The columns of ``(ticks, legs)`` are the legs
in the order of ``run.legs``. All arrays are read-only.
"""

from __future__ import annotations

import dataclasses
import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ember_ros.params import Params
from ember_ros.report.run_statistics import TRACE, RunRecord
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from leg_node.table import Floats, Ints

Bools = NDArray[np.bool_]


class Columns:
    """Arrays of one shape, by name."""

    def __repr__(self) -> str:
        """Return names, types and shapes; the numbers are too many."""
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        told = ((f.name, getattr(self, f.name)) for f in fields)
        lines = [f"  {name}: {column.dtype} {column.shape}" for name, column in told]
        return "\n".join([f"{type(self).__name__} of", *lines])


@dataclass(frozen=True, eq=False, repr=False)
class Senses(Columns):
    """What is mounted on each leg and reads there at the start of a tick, each ``(ticks, legs)``.

    Force, slip and contact speak of the tick that just ended, as in ``signals.LegSense``.
    """

    hip: Floats
    """Hip angle relative to the body, rad."""
    knee: Floats
    """Knee angle relative to the thigh, rad, 0 when the leg is straight."""
    hip_speed: Floats
    """rad/s"""
    knee_speed: Floats
    """rad/s"""
    force_mean: Floats
    """Vertical force between ground and foot, mean over the tick, N."""
    force_peak: Floats
    """The same, largest value within the tick, N."""
    inclination: Floats
    """Angle of the shank from the vertical in the leg's plane, rad, foot ahead positive."""
    slip: Floats
    """Distance the foot slid on the ground in the tick, m, never < 0."""
    hair: Bools
    """The hair in front of the foot touches the ground."""
    contact: Bools
    """The foot touched the ground at the end of the tick."""
    first_tick: Bools
    """The leg was picked up and put down just now, after a fall."""


@dataclass(frozen=True, eq=False, repr=False)
class Commands(Columns):
    """What each leg asks of its motors during a tick, each ``(ticks, legs)``."""

    hip_speed: Floats
    """rad/s"""
    knee_speed: Floats
    """rad/s"""
    hip_torque: Floats
    """Largest torque the motor may use to reach its speed, N m."""
    knee_torque: Floats
    """N m"""


@dataclass(frozen=True, eq=False, repr=False)
class Pose(Columns):
    """Where the body is at the start of a tick, each ``(ticks,)``."""

    x: Floats
    """m; on the trainer the distance walked along the circle."""
    y: Floats
    """m; on the trainer 0."""
    roll: Floats
    """rad"""
    pitch: Floats
    """rad, nose down positive."""
    yaw: Floats
    """rad; it goes on past half a turn and does not jump back."""


@dataclass(frozen=True, eq=False, repr=False)
class Body(Pose):
    """The world's truth about the body at the start of a tick, each ``(ticks,)``."""

    height: Floats
    """Height of the hips over the ground, m."""
    falls: Ints
    """Falls so far."""


@dataclass(frozen=True, eq=False, repr=False)
class Ticks:
    """Everything that happened in a run by the tick."""

    senses: Senses
    """What each leg sensed."""
    commands: Commands
    """What each leg asked of its motors."""
    rewards: dict[str, Floats]
    """Reward for the tick by term, weighted, ``(ticks, legs)`` each; 0 for a term that did not
    apply, and where nothing was credited."""
    reward: Floats
    """The sum of the terms, ``(ticks, legs)``."""
    credited: Bools
    """Whether the tick was rewarded and learnt from, ``(ticks, legs)``: not a run's last tick,
    whose end no leg senses, nor one in which the robot fell."""
    states: Ints
    """State as the discretizer says, 0 or more, ``(ticks, legs)``."""
    actions: Ints
    """Position of the knee speed in ``leg.knee_speeds``, ``(ticks, legs)``."""
    stances: Bools
    """Whether the tick is of stance, as the gait says, ``(ticks, legs)``."""
    td_errors: Floats
    """What the learner's update was worth that followed the tick: its target less the value that
    was believed before, ``(ticks, legs)``; 0 where nothing was learnt."""
    phases: Floats
    """Of the central pattern generator, cycles since the start, ``(ticks,)``."""
    body: Body
    """Where the body was."""


class _Layout(NamedTuple):
    """Of one leg's tick, as bytes and as a record of numpy."""

    packed: struct.Struct
    dtype: np.dtype[np.void]


def _layout(terms: int) -> _Layout:
    return _Layout(
        struct.Struct(f"<8d3?4dq??d{terms}d"),
        np.dtype(
            [
                ("floats", "<f8", (8,)),
                ("flags", "?", (3,)),
                ("command", "<f8", (4,)),
                ("state", "<i8"),
                ("stance", "?"),
                ("credited", "?"),
                ("td_error", "<f8"),
                ("terms", "<f8", (terms,)),
            ]
        ),
    )


class Collector:
    """Keeps every tick of a direct loop in memory: about 170 bytes a leg."""

    def __init__(self, params: Params, legs: Sequence[str]) -> None:
        """Begin with no tick.

        Args:
            params: for the knee speeds that actions are positions of.
            legs: their names, in order.
        """
        self._speeds, self._legs = np.array(params.leg.knee_speeds), len(legs)
        self._data = bytearray()
        self._phases, self._heights = array("d"), array("d")
        self._falls = array("q")
        self._names: tuple[str, ...] = ()
        self._layout = _layout(0)

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Take one tick of a loop, in which every leg commands and tells its transition."""
        if not self._phases:
            first = transitions[0]
            assert first is not None
            self._names = tuple(name for name, _ in first.terms)
            self._layout = _layout(len(self._names))
        pack = self._layout.packed.pack
        for sense, command, did in zip(senses, commands, transitions, strict=True):
            assert command is not None
            assert did is not None
            self._data += pack(
                *sense[1:],
                *command[1:],
                did.next_state,
                did.next_stance,
                did.action >= 0,
                did.td_error,
                *[value for _, value in did.terms],
            )
        self._phases.append(beat.phase)
        self._heights.append(body.height)
        self._falls.append(body.falls)

    def ticks(self, record: RunRecord) -> Ticks:
        """Return everything as arrays.

        Args:
            record: of the same run, for the pose of the body.
        """
        legs, count = self._legs, len(self._phases)
        every = np.frombuffer(self._data, self._layout.dtype).reshape(count, legs)
        floats, flags, command = every["floats"], every["flags"], every["command"]
        terms = {name: _later(every["terms"][:, :, n]) for n, name in enumerate(self._names)}
        reward = np.zeros((count, legs))
        for values in terms.values():  # in the order in which a transition adds them
            reward += values
        speeds = [_kept(command[:, :, n]) for n in range(4)]
        x, y, roll, pitch, yaw = _pose(record)
        return Ticks(
            senses=Senses(
                *(_kept(floats[:, :, n]) for n in range(8)),
                *(_kept(flags[:, :, n]) for n in range(3)),
            ),
            commands=Commands(*speeds),
            rewards=terms,
            reward=_kept(reward),
            credited=_later(every["credited"]),
            states=_kept(every["state"]),
            # By its speed: a transition tells the action only where there is a reward for it.
            actions=_kept(np.searchsorted(self._speeds, speeds[1])),
            stances=_kept(every["stance"]),
            td_errors=_later(every["td_error"]),
            phases=_kept(np.array(self._phases)),
            body=Body(
                x, y, roll, pitch, yaw,
                height=_kept(np.array(self._heights)),
                falls=_kept(np.array(self._falls, dtype=np.int64)),
            ),
        )  # fmt: skip


def pose_of(record: RunRecord) -> Pose:
    """Return the traces of a record by name."""
    return Pose(*_pose(record))


def _pose(record: RunRecord) -> list[Floats]:
    return [_kept(record.traces[:, n]) for n in range(len(TRACE))]


def _kept(column: NDArray[Any]) -> NDArray[Any]:
    """Return a copy in one piece that nobody can change."""
    copy = np.array(column, order="C")
    copy.flags.writeable = False
    return copy


def _later(column: NDArray[Any]) -> NDArray[Any]:
    """Return what is told one tick later, by the tick that it is about; 0 in the last one."""
    moved = np.zeros(column.shape, column.dtype)
    moved[:-1] = column[1:]
    moved.flags.writeable = False
    return moved
