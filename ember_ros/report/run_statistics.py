"""Record a run tick by tick: one row of statistics per cycle, and hashes of all signals.

The direct loop and the sim node pass the same values in the same order, so that runs of two
backends can be compared by their hashes. The record has no influence on the run.
"""

from __future__ import annotations

import csv
import hashlib
import json
import math
import statistics
import struct
import time
from array import array
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from ember_ros.errors import ParameterError
from ember_ros.params import Params
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition

CYCLES, MEASURED, TRACES = "cycles.csv", "measured.json", "traces.npy"
"""The files of a record: one row per cycle and module, the summary, the body's pose per tick."""
TRACE = ("x_m", "y_m", "roll_rad", "pitch_rad", "yaw_rad")
"""The columns of ``traces.npy``; yaw is continuous, it is not limited to +-pi."""
BODY = "body"
WINDOW = 200
"""Cycles at the start and at the end whose means are in the summary; at most half of a run each."""

_SENSE = struct.Struct("<q8d3?")
_COMMAND = struct.Struct("<q4d")
_NO_COMMAND = b"\0"
_TRANSITION = struct.Struct("<2q?qq?d")


class Row(NamedTuple):
    """One row of ``cycles.csv``: the statistics of one leg or of the body over one cycle."""

    cycle: int
    module: str
    """A leg's name, or ``body``."""
    peak_force_n: float
    """Largest vertical force on a foot, N; for the body the largest over the legs."""
    reward: float
    """Mean reward over the ticks of the cycle that have one, 0 if there are none. The last tick of
    a run has none, because its reward would be known one tick later."""
    contact_share: float | None
    """Share of stance ticks with the foot on the ground; None for a leg that reports no stance."""
    duty_factor: float
    """Share of all ticks with the foot on the ground."""
    slip_m: float
    """Distance that the foot slid on the ground, m; for the body the mean over the legs."""
    distance_m: float | None
    """Distance along the heading at the start of the cycle, m; this and the following columns are
    None for a leg."""
    turn_rad: float | None
    """Change of heading, rad, positive to the left."""
    yaw_rad: float | None
    """Heading at the end of the cycle, rad, whole turns included."""
    roll_sd_rad: float | None
    pitch_sd_rad: float | None
    tilt_max_rad: float | None
    """Largest absolute roll or pitch, rad."""
    height_min_m: float | None
    """Least height of the hips, m."""
    falls: int | None
    """Number of falls in this cycle."""


class _Sums:
    """Sums of one leg over a cycle."""

    __slots__ = ("contact", "credited", "down", "known", "peak", "slip", "stance", "terms")

    def __init__(self) -> None:
        self.peak = self.slip = 0.0
        self.contact = self.down = self.known = self.stance = 0
        self.credited = 0
        """Number of ticks with a reward."""
        self.terms: dict[str, float] = {}
        """Sum of each reward term over these ticks."""

    def share(self) -> float | None:
        """Return the share of stance ticks with the foot on the ground; None if it is not known."""
        if self.stance:
            return self.contact / self.stance
        return 0.0 if self.known else None

    def reward(self) -> dict[str, float]:
        """Return the mean of each reward term per tick."""
        return {name: total / self.credited for name, total in self.terms.items()}


class RunStatistics:
    """Record statistics and hashes of a run: call ``tick`` for every tick, then ``finish``."""

    def __init__(self, params: Params, legs: Sequence[str], folder: Path | None = None) -> None:
        """Start a record.

        Args:
            params: the parameters of the run.
            legs: the names of the legs, in order.
            folder: ``cycles.csv`` is written there row by row, and ``measured.json`` and
                ``traces.npy`` by ``finish``; without it no files are written.

        Raises:
            ParameterError: the folder cannot be written.
        """
        self.rows: list[Row] = []
        self.traces = array("d")
        """The pose of the body at each tick, columns as in ``TRACE``, as a flat array."""
        self._legs = tuple(legs)
        self.terms: list[dict[str, float]] = []
        """For each cycle, the mean of each reward term per tick and leg."""
        self._senses_hash, self._commands_hash = hashlib.sha256(), hashlib.sha256()
        self._transitions_hash = hashlib.sha256()
        self._senses, self._commands = (
            bytearray(),
            bytearray(),
        )  # packed signals of this cycle, to be hashed
        self._transitions = bytearray()
        self._sums = [_Sums() for _ in legs]
        self._beat: Beat | None = None
        self._poses: list[BodyState] = []  # at the start of each tick of this cycle
        self._body = BodyState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
        self._turns = 0  # whole turns of the body so far
        self._stances: list[bool | None] = []
        """Whether each leg is in stance in the latest tick; None if the leg did not report it."""
        self._first_fall: int | None = None
        self._absences = dict.fromkeys(legs, 0)
        self._folder = folder
        self._began: float | None = None  # wall time, used in the summary only
        self._wall = 0.0
        self._file: TextIO | None = None
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                self._file = (folder / CYCLES).open("w", newline="", encoding="utf-8")
            except OSError as error:
                raise ParameterError(
                    f"cannot write the record of the run into {folder}: {error.strerror}"
                ) from error
            self._csv = csv.writer(self._file)
            self._csv.writerow(Row._fields)

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Record one complete tick: senses and commands, and the transitions of the tick before."""
        if self._began is None:
            self._began = time.perf_counter()
        self._end_tick(senses, body, transitions, int(beat.phase))
        for sense, command in zip(senses, commands, strict=True):
            self._senses += _SENSE.pack(*sense)
            self._commands += _COMMAND.pack(*command) if command else _NO_COMMAND
        for transition in transitions:
            self._transitions += _packed(transition)
        if None in commands:
            for leg, command in zip(self._legs, commands, strict=True):
                self._absences[leg] += command is None
        self._poses.append(body)
        self.traces.extend((body.x, body.y, body.roll, body.pitch, self._yaw()))
        self._beat = beat
        self._stances = [
            transition.next_stance if transition is not None else None for transition in transitions
        ]

    def finish(self, senses: Sequence[LegSense], body: BodyState) -> None:
        """Record the senses after the last tick, end the last cycle, and close the file."""
        if self._beat is not None:
            self._wall = time.perf_counter() - (self._began or 0.0)
            self._end_tick(senses, body, [None] * len(self._legs), None)
            if self._poses:
                self._end_cycle()
            self._beat = None
        if self._file is not None and self._folder is not None:
            self._file.close()
            self._file = None
            _save_measured(self._folder, self.record())

    def _end_tick(
        self,
        senses: Sequence[LegSense],
        body: BodyState,
        transitions: Sequence[Transition | None],
        cycle: int | None,
    ) -> None:
        """Add the tick that just ended, as measured by the senses, to the sums of its cycle.

        Args:
            senses: the senses at its end.
            body: the state of the body at its end.
            transitions: its transitions.
            cycle: the cycle of the tick that starts now; if it is another one, the cycle ends.
        """
        before, self._body = self._body, body
        if self._beat is None:
            return
        self._turns += round((before.yaw - body.yaw) / math.tau)  # yaw jumps where it passes pi
        for sums, transition in zip(self._sums, transitions, strict=True):
            if transition is not None and transition.credited:
                sums.credited += 1
                for name, value in transition.terms:
                    sums.terms[name] = sums.terms.get(name, 0.0) + value
        for sense, sums, stance in zip(senses, self._sums, self._stances, strict=True):
            if stance is not None:
                sums.known += 1
                sums.stance += stance
            if sense.first_tick:
                continue
            sums.slip += sense.slip
            if sense.force_peak > sums.peak:
                sums.peak = sense.force_peak
            if sense.force_mean > 0.0:
                sums.down += 1
                sums.contact += stance is True
        if body.falls != before.falls and self._first_fall is None:
            self._first_fall = int(self._beat.phase)
        if cycle is not None and cycle != int(self._beat.phase):
            self._end_cycle()

    def _end_cycle(self) -> None:
        """Write the rows of the cycle that just ended, update the hashes, and reset the sums."""
        assert self._beat is not None
        cycle, poses = int(self._beat.phase), self._poses
        start, end, ticks, n_legs = poses[0], self._body, len(poses), len(self._legs)
        rows = []
        rewards = [sums.reward() for sums in self._sums]
        names = dict.fromkeys(name for each in rewards for name in each)
        self.terms.append({n: sum(each.get(n, 0.0) for each in rewards) / n_legs for n in names})
        for leg, sums, terms in zip(self._legs, self._sums, rewards, strict=True):
            share = sums.share()
            reward = sum(terms.values())
            duty = sums.down / ticks
            rows.append(Row(cycle, leg, sums.peak, reward, share, duty, sums.slip, *[None] * 8))
        rolls, pitches = [p.roll for p in poses], [p.pitch for p in poses]
        rows.append(
            Row(
                cycle,
                BODY,
                max(row.peak_force_n for row in rows),
                sum(row.reward for row in rows) / n_legs,
                _mean(row.contact_share for row in rows),
                sum(row.duty_factor for row in rows) / n_legs,
                sum(row.slip_m for row in rows) / n_legs,
                (end.x - start.x) * math.cos(start.yaw) + (end.y - start.y) * math.sin(start.yaw),
                math.remainder(end.yaw - start.yaw, math.tau),
                self._yaw(),
                statistics.pstdev(rolls),
                statistics.pstdev(pitches),
                max(map(abs, rolls + pitches)),
                min(p.height for p in poses),
                end.falls - start.falls,
            )
        )
        self.rows += rows
        if self._file is not None:
            self._csv.writerows(rows)
            self._file.flush()
        self._senses_hash.update(self._senses)
        self._commands_hash.update(self._commands)
        self._transitions_hash.update(self._transitions)
        self._senses.clear()
        self._commands.clear()
        self._transitions.clear()
        self._poses = []
        self._sums = [_Sums() for _ in self._legs]

    def _yaw(self) -> float:
        """Return the heading of the body, rad, whole turns included."""
        return self._body.yaw + self._turns * math.tau

    def body_rows(self) -> list[Row]:
        """Return the rows of the body, one per cycle."""
        return self.rows[len(self._legs) :: len(self._legs) + 1]

    def record(self) -> RunRecord:
        """Return the record up to now."""
        traces = np.frombuffer(self.traces).reshape(-1, len(TRACE)).copy()
        return RunRecord(list(self.rows), traces, self.summary())

    def summary(self) -> dict[str, Any]:
        """Return the measures of the run for ``summary.json``, by name."""
        rows = self.body_rows()
        window = min(WINDOW, max(1, len(rows) // 2))  # the two windows must not overlap
        traces = np.frombuffer(self.traces).reshape(-1, len(TRACE))
        return {
            "cycles": len(rows),
            "falls": self._body.falls,
            "first_fall": self._first_fall,
            "distance_per_cycle_m": _mean(row.distance_m for row in rows),
            "heading_change_rad": self._yaw() - float(traces[0, 4]) if len(traces) else None,
            "roll_sd_rad": float(traces[:, 2].std()) if len(traces) else None,
            "pitch_sd_rad": float(traces[:, 3].std()) if len(traces) else None,
            "first": _window(rows[:window], self.terms[:window]),
            "last": _window(rows[-window:], self.terms[-window:]),
            "absent_ticks": dict(self._absences),
            "commands_sha256": self._commands_hash.hexdigest(),
            "senses_sha256": self._senses_hash.hexdigest(),
            "transitions_sha256": self._transitions_hash.hexdigest(),
            "wall_s": round(self._wall, 3),
            "ticks_per_s": round(len(traces) / self._wall, 1) if self._wall else None,
        }


class RunRecord(NamedTuple):
    """A finished record, as in the files of its folder."""

    rows: list[Row]
    traces: np.ndarray[Any, np.dtype[np.float64]]
    """The body's pose at each tick, ``(ticks, len(TRACE))``."""
    measured: dict[str, Any]

    def body_rows(self) -> list[Row]:
        """Return the rows of the body, one per cycle."""
        return [row for row in self.rows if row.module == BODY]


def save_record(folder: Path, record: RunRecord) -> None:
    """Write a finished record into a folder, ``cycles.csv`` last.

    Raises:
        OSError: the folder cannot be written.
    """
    _save_measured(folder, record)
    with (folder / CYCLES).open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(Row._fields)
        lines.writerows(record.rows)


def _save_measured(folder: Path, record: RunRecord) -> None:
    text = json.dumps(record.measured, indent=2) + "\n"
    (folder / MEASURED).write_text(text, encoding="utf-8")
    np.save(folder / TRACES, record.traces)


def load_record(folder: Path) -> RunRecord:
    """Read the record of a finished run."""
    with (folder / CYCLES).open(newline="", encoding="utf-8") as file:
        rows = [
            Row(int(line[0]), line[1], *(float(x) if x else None for x in line[2:]))  # type: ignore[arg-type]
            for line in list(csv.reader(file))[1:]
        ]
    measured = json.loads((folder / MEASURED).read_text(encoding="utf-8"))
    return RunRecord(rows, np.load(folder / TRACES, allow_pickle=False), measured)


def _packed(transition: Transition | None) -> bytes:
    """Return the bytes of a transition for the hash."""
    if transition is None:
        return b"\0"
    values = [value for _, value in transition.terms]
    own = (*transition[:4], transition.next_state, transition.next_stance, transition.td_error)
    return _TRANSITION.pack(*own) + struct.pack(f"<{len(values)}d", *values)


def _mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _window(rows: Sequence[Row], terms: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Return means over some rows of the body, and of each reward term."""
    names = dict.fromkeys(name for each in terms for name in each)
    return {
        "cycles": len(rows),
        "distance_per_cycle_m": _mean(row.distance_m for row in rows),
        "contact_share": _mean(row.contact_share for row in rows),
        "peak_force_n": _mean(row.peak_force_n for row in rows),
        "reward": _mean(row.reward for row in rows),
        "reward_by_term": {name: _mean(each.get(name, 0.0) for each in terms) for name in names},
        "falls": sum(row.falls or 0 for row in rows),
    }
