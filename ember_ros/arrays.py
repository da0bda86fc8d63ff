"""The signals of all ticks of a run as named NumPy arrays. Pure.

Row ``t`` of each array belongs to tick ``t``: the senses at its start, the action chosen then, and
the reward for it, which is computed one tick later. The columns of arrays of shape
``(ticks, legs)`` are the legs in the order of ``run.legs``. All arrays are read-only.
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
    """A dataclass whose fields are arrays of one shape."""

    def __repr__(self) -> str:
        """Return names, types and shapes of the arrays, without their values."""
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        columns = ((field.name, getattr(self, field.name)) for field in fields)
        lines = [f"  {name}: {column.dtype} {column.shape}" for name, column in columns]
        return "\n".join([f"{type(self).__name__} of", *lines])


@dataclass(frozen=True, eq=False, repr=False)
class Senses(Columns):
    """The readings of each leg's sensors at the start of a tick, each ``(ticks, legs)``.

    Force, slip and contact are those of the tick that just ended, as in ``signals.LegSense``.
    """

    hip: Floats
    """Hip angle relative to the body, rad."""
    knee: Floats
    """Knee angle relative to the thigh, rad, 0 when the leg is straight."""
    hip_speed: Floats
    """Angular speed of the hip joint, rad/s."""
    knee_speed: Floats
    """Angular speed of the knee joint, rad/s."""
    force_mean: Floats
    """Vertical force between ground and foot, mean over the tick, N."""
    force_peak: Floats
    """Vertical force between ground and foot, maximum over the tick, N."""
    inclination: Floats
    """Angle of the shank from the vertical in the leg's plane, rad, positive if the foot is in
    front of the knee."""
    slip: Floats
    """Distance that the foot slid on the ground during the tick, m, 0 or more."""
    hair: Bools
    """Whether the hair (touch sensor) in front of the foot touches the ground."""
    contact: Bools
    """Whether the foot touched the ground at the end of the tick."""
    first_tick: Bools
    """Whether the robot was put back on its feet after a fall, just before this tick."""


@dataclass(frozen=True, eq=False, repr=False)
class Commands(Columns):
    """The motor commands of each leg for a tick, each ``(ticks, legs)``."""

    hip_speed: Floats
    """Target speed of the hip motor, rad/s."""
    knee_speed: Floats
    """Target speed of the knee motor, rad/s."""
    hip_torque: Floats
    """Maximum torque of the hip motor, N m."""
    knee_torque: Floats
    """Maximum torque of the knee motor, N m."""


@dataclass(frozen=True, eq=False, repr=False)
class Pose(Columns):
    """The pose of the body in the world frame at the start of a tick, each ``(ticks,)``."""

    x: Floats
    """Position, m; on the trainer, the distance walked along the circle."""
    y: Floats
    """Position, m; 0 on the trainer."""
    roll: Floats
    """Roll angle, rad."""
    pitch: Floats
    """Pitch angle, rad, positive if the front is down."""
    yaw: Floats
    """Yaw angle, rad, unwrapped: it may exceed pi."""


@dataclass(frozen=True, eq=False, repr=False)
class Body(Pose):
    """The ground truth of the body at the start of a tick, each ``(ticks,)``."""

    height: Floats
    """Height of the hips above the ground, m."""
    falls: Ints
    """Number of falls since the start of the run."""


@dataclass(frozen=True, eq=False, repr=False)
class Ticks:
    """All signals of all ticks of a run."""

    senses: Senses
    """Sensor readings of each leg."""
    commands: Commands
    """Motor commands of each leg."""
    rewards: dict[str, Floats]
    """Weighted reward terms of the tick by name, ``(ticks, legs)`` each; 0 for a term that did not
    apply, and where ``credited`` is False."""
    reward: Floats
    """The sum of the terms, ``(ticks, legs)``."""
    credited: Bools
    """Whether the tick was rewarded and learnt from, ``(ticks, legs)``. False for the last tick of
    a run, because no senses follow it, and for a tick in which the robot fell."""
    states: Ints
    """Index of the discretized state, 0 or more, ``(ticks, legs)``."""
    actions: Ints
    """Index of the knee speed in ``leg.knee_speeds``, ``(ticks, legs)``."""
    stances: Bools
    """Whether the gait is in stance, ``(ticks, legs)``."""
    td_errors: Floats
    """Temporal-difference error of the update for the tick: target minus old value,
    ``(ticks, legs)``; 0 where nothing was learnt."""
    phases: Floats
    """Phase of the central pattern generator, cycles since the start, ``(ticks,)``."""
    body: Body
    """Ground truth of the body."""


class _Layout(NamedTuple):
    """Memory layout of one tick of one leg, for ``struct`` and for NumPy."""

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
    """Observer that keeps all ticks of a direct loop: about 170 bytes per leg and tick."""

    def __init__(self, params: Params, legs: Sequence[str]) -> None:
        """Start without ticks.

        Args:
            params: define the knee speeds, in whose order actions are numbered.
            legs: names of the legs, in order.
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
        """Append one tick; every leg must have a command and a transition."""
        if not self._phases:
            first = transitions[0]
            assert first is not None
            self._names = tuple(name for name, _ in first.terms)
            self._layout = _layout(len(self._names))
        pack = self._layout.packed.pack
        for sense, command, transition in zip(senses, commands, transitions, strict=True):
            assert command is not None
            assert transition is not None
            self._data += pack(
                *sense[1:],
                *command[1:],
                transition.next_state,
                transition.next_stance,
                transition.action >= 0,
                transition.td_error,
                *[value for _, value in transition.terms],
            )
        self._phases.append(beat.phase)
        self._heights.append(body.height)
        self._falls.append(body.falls)

    def ticks(self, record: RunRecord) -> Ticks:
        """Return all ticks as arrays.

        Args:
            record: the record of the same run; it has the pose of the body.
        """
        legs, count = self._legs, len(self._phases)
        records = np.frombuffer(self._data, self._layout.dtype).reshape(count, legs)
        floats, flags, command = records["floats"], records["flags"], records["command"]
        terms = {name: _shifted(records["terms"][:, :, n]) for n, name in enumerate(self._names)}
        reward = np.zeros((count, legs))
        for values in terms.values():  # in the order in which a transition adds them
            reward += values
        command_columns = [_frozen(command[:, :, n]) for n in range(4)]
        x, y, roll, pitch, yaw = _pose(record)
        return Ticks(
            senses=Senses(
                *(_frozen(floats[:, :, n]) for n in range(8)),
                *(_frozen(flags[:, :, n]) for n in range(3)),
            ),
            commands=Commands(*command_columns),
            rewards=terms,
            reward=_frozen(reward),
            credited=_shifted(records["credited"]),
            states=_frozen(records["state"]),
            # From the speed, because a transition has its action only if the tick was credited.
            actions=_frozen(np.searchsorted(self._speeds, command_columns[1])),
            stances=_frozen(records["stance"]),
            td_errors=_shifted(records["td_error"]),
            phases=_frozen(np.array(self._phases)),
            body=Body(
                x, y, roll, pitch, yaw,
                height=_frozen(np.array(self._heights)),
                falls=_frozen(np.array(self._falls, dtype=np.int64)),
            ),
        )  # fmt: skip


def pose_of(record: RunRecord) -> Pose:
    """Return the columns of a record's traces by name."""
    return Pose(*_pose(record))


def _pose(record: RunRecord) -> list[Floats]:
    return [_frozen(record.traces[:, n]) for n in range(len(TRACE))]


def _frozen(column: NDArray[Any]) -> NDArray[Any]:
    """Return a contiguous, read-only copy."""
    copy = np.array(column, order="C")
    copy.flags.writeable = False
    return copy


def _shifted(column: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only copy shifted to the tick before, with 0 in the last row.

    A transition is published one tick after the tick that it describes.
    """
    shifted = np.zeros(column.shape, column.dtype)
    shifted[:-1] = column[1:]
    shifted.flags.writeable = False
    return shifted
