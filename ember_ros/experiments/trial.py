"""One run of an experiment as a value: its configuration, the trial it starts from, its results.

The key of a trial is the SHA-256 of everything that determines it, including the code. So the files
in the folder with this name are the results that another run of the trial would give.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import itertools
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ember_ros.experiments.central import CentralLoop
from ember_ros.loop import Loop
from ember_ros.params import Params, params_sha256
from ember_ros.report.run_statistics import TRACE, Row, RunStatistics
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from ember_ros.versions import versions
from leg_node.assembly import make_discretizer
from leg_node.discretizer import states_of
from leg_node.table import Ints, Table
from leg_node.table_file import load_table, save_table

TILT_RAD, LOW_M = 0.3, 0.36
"""The safe range: a cycle with more tilt or lower hips is outside, with or without a fall."""
SETTLING_CYCLES = 100
"""Cycles at the start that ``outside_settled``, the share of cycles outside, does not include."""
WINDOW = 500
"""Cycles at the beginning and at the end whose standard deviations are compared."""
TRACED_CYCLES = 16
"""Cycles at the beginning and at the end whose roll and pitch are saved tick by tick."""
MIN_VISITS = 20
"""Minimum number of visits of a state by each of two legs, to compare their best actions there."""
CENTRAL = "central"
"""The policy of one learner for all legs."""
TABLE, MEASURES, CYCLES = "table.npz", "trial.json", "cycles.npz"
COLUMNS = tuple(name for name in Row._fields if name not in ("cycle", "module"))
DECIDES = (
    *("ember_ros.kinematics", "ember_ros.loop", "ember_ros.params"),
    *("ember_ros.parts", "ember_ros.phase", "ember_ros.run_config", "ember_ros.randomness"),
    *("ember_ros.signals", "ember_ros.worlds"),
    *(
        "ember_ros.experiments.central",
        "ember_ros.experiments.trial",
        "ember_ros.report.run_statistics",
    ),
    *("cpg_node.cpg", "leg_node.assembly", "leg_node.discretizer", "leg_node.gait"),
    *("leg_node.learner", "leg_node.module", "leg_node.policy", "leg_node.reward"),
    *("leg_node.shared", "leg_node.table", "leg_node.task", "leg_node.value"),
    *(
        "sim_node.bodies",
        "sim_node.bullet",
        "sim_node.sensors",
        "sim_node.trainer",
        "sim_node.walker",
    ),
)
"""The modules that determine the results of a trial."""


@functools.cache
def code_sha256(*more: str) -> str:
    """Return the SHA-256 of the syntax trees of the modules that determine results.

    Comments, docstrings and line breaks have no effect on it.

    Args:
        *more: modules to include besides ``DECIDES``.
    """
    digest = hashlib.sha256()
    for name in (*DECIDES, *more):
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            if isinstance(body, list):
                node.body = [each for each in body if not _only_words(each)]  # type: ignore[attr-defined]
        digest.update(ast.dump(tree).encode())
    return digest.hexdigest()


def _only_words(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


@dataclass(frozen=True)
class Trial:
    """The configuration of one run in the loop."""

    world: str
    """``trainer``, ``walker``, or the path of a class."""
    cycles: int
    seed: int
    params: Params = field(default_factory=Params)
    policy: str = "learned"
    """``learned``, ``scripted``, ``random``, ``central``, or the path of a class."""
    learning: bool = True
    start: Trial | None = None
    """The trial whose table the run starts from; None for an empty table."""

    @functools.cached_property
    def key(self) -> str:
        """The key of the trial; it is equal if and only if all that determines it is equal."""
        return self.key_with(versions())

    def key_with(self, installed: Mapping[str, str]) -> str:
        """Return the key that the trial has with these versions of installed packages."""
        content = [
            self.world,
            self.cycles,
            self.seed,
            params_sha256(self.params),
            self.policy,
            self.learning,
            self.start.key_with(installed) if self.start else None,
            code_sha256(*self._own_modules()),
            dict(installed),
        ]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:20]

    def _own_modules(self) -> list[str]:
        """Return the modules of the user's own parts: those not in ``DECIDES``.

        Modules that these import are not included.
        """
        paths = [*vars(self.params.parts).values(), self.world, self.policy]
        named = {path.rpartition(".")[0] for path in paths if "." in path}
        return sorted(named - set(DECIDES))


@dataclass(frozen=True)
class Outcome:
    """The results of a trial."""

    measures: dict[str, Any]
    """Scalar measures by name."""
    cycles: dict[str, NDArray[np.float64]]
    """Columns of ``cycles.csv`` of the body by name, ``(cycles,)`` each."""
    traces: NDArray[np.float64]
    """Roll and pitch at each tick of the first and of the last ``TRACED_CYCLES`` cycles, rad,
    ``(2, ticks, 2)``."""
    footfall: NDArray[np.float64]
    """Share of legs and cycles with the foot on the ground, for each tick of a leg's own cycle
    (stance first), ``(ticks,)``."""


def is_done(trial: Trial, folder: Path) -> bool:
    """Return whether the results of a trial are in ``folder``."""
    return (folder / trial.key / MEASURES).exists()


def outcome(trial: Trial, folder: Path) -> Outcome:
    """Read the results of a trial."""
    home = folder / trial.key
    with np.load(home / CYCLES, allow_pickle=False) as content:
        columns = {name: content[name] for name in content.files}
    measures = json.loads((home / MEASURES).read_text(encoding="utf-8"))
    return Outcome(measures, columns, columns.pop("traces"), columns.pop("footfall"))


class _TickStatistics:
    """An observer that counts the legs' states and the ticks with their feet on the ground."""

    def __init__(self, trial: Trial, legs: Sequence[str], start: Table | None) -> None:
        params = trial.params
        self.visits: Ints = np.zeros(states_of(make_discretizer(params)), dtype=np.int64)
        """Number of ticks that any leg was in each state, ``(states,)``."""
        self._ticks = params.gait.ticks
        named = dict(zip(params.robot.legs, params.robot.offset, strict=True))
        self._offsets = [named.get(leg, 0.0) for leg in legs]
        self._down: list[int] = [0] * self._ticks
        self._visited_at_start = None if start is None else visits_of_states(start) > 0

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        visits, down, ticks = self.visits, self._down, self._ticks
        for sense, offset, did in zip(senses, self._offsets, transitions, strict=True):
            assert did is not None  # the legs of the loop always return one
            visits[did.next_state] += 1
            if sense.force_mean > 0.0:  # measured over the tick that just ended
                down[int((beat.phase + offset) * ticks - 1) % ticks] += 1

    def footfall(self, cycles: int) -> NDArray[np.float64]:
        """Return the share of legs and cycles with the foot on the ground, ``(ticks,)``."""
        return np.array(self._down) / (len(self._offsets) * cycles)

    def unvisited_share(self) -> float | None:
        """Return the share of decisions in states without visits in the start table, if any."""
        if self._visited_at_start is None:
            return None
        return float(self.visits[~self._visited_at_start].sum() / max(1, self.visits.sum()))


def visits_of_states(table: Table) -> Ints:
    """Return the number of updates of each state's actions, ``(states,)``."""
    total: Ints = table.visits.reshape(table.states, table.actions).sum(axis=1)
    return total


def run_trial(trial: Trial, folder: Path, go_on: Callable[[], bool] = lambda: True) -> bool:
    """Run a trial and save its results; the trial it starts from must have been run.

    Args:
        trial: the trial to run.
        folder: folder of all trials.
        go_on: is called before every cycle; the trial stops if it returns False.

    Returns:
        Whether the trial was completed; if not, nothing is saved.
    """
    began = time.process_time()
    config = RunConfig(
        trial.world,
        trial.cycles,
        seed=trial.seed,
        params=trial.params,
        policy="learned" if trial.policy == CENTRAL else trial.policy,
        learning=trial.learning,
        table=folder / trial.start.key / TABLE if trial.start else None,
    )
    loop = CentralLoop(config) if trial.policy == CENTRAL else Loop(config)
    try:
        start = load_table(config.table, config.params)[0] if config.table else None
        recorder = RunStatistics(config.params, config.legs)
        statistics = _TickStatistics(trial, config.legs, start)
        for _ in range(trial.cycles):
            if not go_on():
                return False
            for _ in range(config.params.gait.ticks):
                loop.tick(recorder, statistics)
        recorder.finish(loop.world.observe(), loop.world.body())
        differ = _disagreement([leg.copy.table for leg in loop.legs])
        table = loop.finish()
        summary = recorder.summary()
        measures = {
            **_measures(config.params, recorder, loop.world.work),
            "legs_differ": differ,
            "unvisited_share": statistics.unvisited_share(),
            "states_visited": int((statistics.visits > 0).sum()),
            "commands_sha256": summary["commands_sha256"],
            "senses_sha256": summary["senses_sha256"],
            "table_sha256": table.sha256(),
            "cpu_s": round(time.process_time() - began, 2),
        }
        _save(trial, folder, measures, recorder, statistics, table)
    finally:
        loop.close()
    return True


def _save(
    trial: Trial,
    folder: Path,
    measures: dict[str, Any],
    recorder: RunStatistics,
    statistics: _TickStatistics,
    table: Table,
) -> None:
    """Write all files of a trial, or none."""
    folder.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=".draft_", dir=folder))
    try:
        rows, shown = recorder.body_rows(), TRACED_CYCLES * trial.params.gait.ticks
        traces = np.frombuffer(recorder.traces).reshape(-1, len(TRACE))[:, 2:4]
        columns = {
            name: np.array([getattr(row, name) for row in rows], dtype=float) for name in COLUMNS
        }
        few = min(shown, len(traces))
        columns["traces"] = np.stack([traces[:few], traces[len(traces) - few :]])
        columns["footfall"] = statistics.footfall(trial.cycles)
        np.savez_compressed(draft / CYCLES, allow_pickle=False, **columns)
        if trial.policy != CENTRAL:
            save_table(draft / TABLE, table, trial.params, trial.seed)
        (draft / MEASURES).write_text(json.dumps(measures, indent=1) + "\n", encoding="utf-8")
        shutil.rmtree(folder / trial.key, ignore_errors=True)
        os.rename(draft, folder / trial.key)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _measures(params: Params, recorder: RunStatistics, work: float) -> dict[str, Any]:
    """Return the scalar measures of a run."""
    rows = recorder.body_rows()
    traces = np.frombuffer(recorder.traces).reshape(-1, len(TRACE))
    window = min(WINDOW, len(rows)) * params.gait.ticks
    summary = recorder.summary()
    out = [(r.tilt_max_rad or 0.0) > TILT_RAD or (r.height_min_m or 0.0) < LOW_M for r in rows]
    way = sum(r.distance_m or 0.0 for r in rows)
    early, late = rows[:WINDOW], rows[-min(WINDOW, len(rows)) :]
    leg, walker = params.leg, params.walker
    legs = len(recorder.rows) // len(rows) - 1
    mass = walker.mass + legs * (leg.thigh_mass + leg.shank_mass + leg.foot_mass)
    return {
        "cycles": len(rows),
        "falls": summary["falls"],
        "first_fall": summary["first_fall"],
        "outside": _share(out),
        "outside_settled": _share(out[SETTLING_CYCLES:]),
        "distance_m": way / len(rows),
        "distance_last_m": sum(r.distance_m or 0.0 for r in late) / len(late),
        "reward": sum(r.reward for r in rows) / len(rows),
        "reward_last": sum(r.reward for r in late) / len(late),
        "peak_force_n": sum(r.peak_force_n for r in late) / len(late),
        "contact_share": sum(r.contact_share or 0.0 for r in late) / len(late),
        "duty_factor": sum(r.duty_factor for r in late) / len(late),
        "slip_m": sum(r.slip_m for r in late) / len(late),
        "turn_rad": sum(abs(r.turn_rad or 0.0) for r in late) / len(late),
        "heading_change_rad": summary["heading_change_rad"],
        "drift_rad": _drift(rows),
        "drift_first_rad": _drift(early),
        "drift_last_rad": _drift(late),
        "roll_sd_rad": float(traces[:, 2].std()),
        "pitch_sd_rad": float(traces[:, 3].std()),
        "roll_sd_first_rad": float(traces[:window, 2].std()),
        "roll_sd_last_rad": float(traces[-window:, 2].std()),
        "pitch_sd_first_rad": float(traces[:window, 3].std()),
        "pitch_sd_last_rad": float(traces[-window:, 3].std()),
        "cost_of_transport": work / (mass * params.physics.gravity * way) if way > 0.0 else None,
    }


def _drift(rows: Sequence[Row]) -> float:
    """Return the absolute value of the mean change of heading per cycle, rad."""
    return abs(sum(r.turn_rad or 0.0 for r in rows)) / len(rows)


def _share(bits: Sequence[bool]) -> float | None:
    return sum(bits) / len(bits) if bits else None


def _disagreement(tables: Sequence[Table]) -> float | None:
    """Return the mean share of often visited states in which two legs have other best actions."""
    shares = []
    for one, other in itertools.combinations(tables, 2):
        known = (visits_of_states(one) >= MIN_VISITS) & (visits_of_states(other) >= MIN_VISITS)
        if known.any():
            shape = (one.states, one.actions)
            best = [table.values.reshape(shape)[known].argmax(axis=1) for table in (one, other)]
            shares.append(float((best[0] != best[1]).mean()))
    return sum(shares) / len(shares) if shares else None
