"""Tests of experiments: trials, the runner, the arms, statistics, commands and documents."""

from __future__ import annotations

import functools
import importlib
import json
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from ember_ros.experiments import isotropy, relearning, runner, stats
from ember_ros.experiments.central import CentralLoop
from ember_ros.experiments.reporting import column
from ember_ros.experiments.reproduction import DOCUMENT, RESULTS, STUDIES, document
from ember_ros.experiments.studies import learners, senses
from ember_ros.experiments.studies.fig5 import STOPS, VARIATIONS, settling_step
from ember_ros.experiments.studies.sharing import NO_SYNC, cycle_reached
from ember_ros.experiments.study import (
    BODIES,
    LEARNERS,
    OUTDATED,
    WALK_SEED_OFFSET,
    Size,
    learner_params,
    outdated_reason,
    page_of,
    training_trial,
    walking_trials,
)
from ember_ros.experiments.trial import (
    CENTRAL,
    DECIDES,
    TABLE,
    Trial,
    code_sha256,
    is_done,
    outcome,
    run_trial,
)
from ember_ros.loop import Loop
from ember_ros.params import Params, replace
from ember_ros.run_config import RunConfig
from ember_ros.signals import LegCommand, LegSense
from ember_ros.worlds import make_world
from leg_node.discretizer import PaperDiscretizer
from leg_node.table_file import load_table
from support.command import EMBER, ROOT, child, ember, started
from support.legs import beat
from support.waiting import DEADLINE_S, until

pytest.importorskip("pybullet", reason="trials need a world")
pytest.importorskip("scipy", reason="statistics need it")

SIZE = Size(seeds=2, train=3, walk=20)


# -- trials -----------------------------------------------------------------------------------


def test_a_trial_equals_a_run_of_the_loop(tmp_path: Path) -> None:
    """A training and a walk from its table give the same tables as two loops, bit for bit."""
    (walk,) = walking_trials("ember", "narrow", 3, [4], [training_trial("ember", SIZE, 4)])
    assert walk.start is not None
    for trial in (walk.start, walk):
        assert run_trial(trial, tmp_path)
    configs = [
        RunConfig("trainer", 3, seed=4, params=learner_params("ember")),
        RunConfig(
            "walker",
            3,
            seed=4 + WALK_SEED_OFFSET,
            params=learner_params("ember", "narrow"),
            table=tmp_path / walk.start.key / TABLE,
        ),
    ]
    for config, trial in zip(configs, (walk.start, walk), strict=True):
        loop = Loop(config)
        for _ in range(3 * 32):
            loop.tick()
        sha = loop.finish().sha256()
        loop.close()
        assert outcome(trial, tmp_path).measures["table_sha256"] == sha
        saved, _ = load_table(tmp_path / trial.key / TABLE, config.params)
        assert saved.sha256() == sha


def test_a_trial_is_reproducible(tmp_path: Path) -> None:
    """All measures except the CPU time are equal, and all cycles, traces and footfalls."""
    (trial,) = walking_trials("plain", "short", 4, [1])
    found = []
    for folder in ("one", "two"):
        run_trial(trial, tmp_path / folder)
        found.append(outcome(trial, tmp_path / folder))
    one, two = ({**each.measures, "cpu_s": 0} for each in found)
    assert one == two
    assert found[0].cycles.keys() == found[1].cycles.keys()
    for name, values in found[0].cycles.items():
        assert np.array_equal(values, found[1].cycles[name])
    assert np.array_equal(found[0].traces, found[1].traces)


def test_the_key_contains_everything_that_determines_a_trial() -> None:
    """Trials that differ in one field have different keys; equal trials have equal keys."""
    base = Trial("walker", 5, 1)
    others = [
        Trial("trainer", 5, 1),
        Trial("walker", 6, 1),
        Trial("walker", 5, 2),
        Trial("walker", 5, 1, replace(Params(), {"walk.gamma": 0.5})),
        Trial("walker", 5, 1, policy="random"),
        Trial("walker", 5, 1, learning=False),
        Trial("walker", 5, 1, start=Trial("trainer", 5, 1)),
        Trial("walker", 5, 1, start=Trial("trainer", 5, 2)),
    ]
    assert len({trial.key for trial in [base, *others]}) == len(others) + 1
    assert Trial("walker", 5, 1).key == base.key


def test_decides_lists_all_modules_of_a_trial(tmp_path: Path) -> None:
    """A module of this package that a trial imports is in ``DECIDES``, so the key depends on it."""
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from ember_ros.experiments.trial import DECIDES, Trial, run_trial\n"
        "start = Trial('trainer', 1, 0)\n"
        "for trial in (start, Trial('walker', 1, 0, start=start)):\n"
        "    assert run_trial(trial, Path(sys.argv[1]))\n"
        "print('\\n'.join(sys.modules))\n"
    )
    command = [sys.executable, "-c", code, "trials"]
    run = child(command, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    imported = {
        name for name in run.stdout.split() if name.split(".")[0] in ("ember_ros", *PACKAGES)
    }
    allowed = {"leg_node", "sim_node", "cpg_node", "ember_ros.experiments", "ember_ros.report"}
    # These do not determine results: versions, errors, a protocol, file formats and file locations.
    # A table is identified by its SHA-256.
    allowed |= {"ember_ros", "ember_ros.versions", "ember_ros.observer", "ember_ros.shipped"}
    allowed |= {"leg_node.table_file", "ember_ros.bounded_io", "ember_ros.errors"}
    assert imported - allowed == set(DECIDES)


PACKAGES = ("leg_node", "sim_node", "cpg_node")


@pytest.mark.slow
def test_the_key_contains_the_code_of_own_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Changed code in a user's own part gives another key; a changed comment does not."""
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / "named_in_a_trial.py"
    params = replace(Params(), {"parts.reward": "named_in_a_trial.Mine"})

    def key(code: str, trial: Trial) -> str:
        file.write_text(code)
        importlib.invalidate_caches()
        code_sha256.cache_clear()
        return trial.key_with({})

    for trial in (
        Trial("walker", 1, 0, params),
        Trial("walker", 1, 0, policy="named_in_a_trial.Mine"),
        Trial("named_in_a_trial.Mine", 1, 0),
    ):
        first = key("class Mine:\n    a = 1\n", trial)
        assert key("# a remark\nclass Mine:\n    a = 1\n", trial) == first
        assert key("class Mine:\n    a = 2\n", trial) != first
    plain = Trial("walker", 1, 0)
    assert key("", plain) == key("class Mine: pass\n", plain)


def test_a_stopped_trial_saves_nothing(tmp_path: Path) -> None:
    """A trial that was stopped leaves no files, and can be run again."""
    trial = Trial("trainer", 5, 0)
    left = iter([True, True, False])
    assert not run_trial(trial, tmp_path, lambda: next(left))
    assert list(tmp_path.iterdir()) == []
    assert run_trial(trial, tmp_path)
    assert is_done(trial, tmp_path)


def test_measures_follow_from_the_cycles(tmp_path: Path) -> None:
    """Falls, shares and distances are computed a second time, from the saved cycles."""
    trial = Trial("walker", 30, 3, policy="random", learning=False)
    run_trial(trial, tmp_path)
    found = outcome(trial, tmp_path)
    measures, cycles = found.measures, found.cycles
    assert measures["falls"] == cycles["falls"].sum() > 0
    assert measures["first_fall"] == np.flatnonzero(cycles["falls"])[0]
    bad = (cycles["tilt_max_rad"] > 0.3) | (cycles["height_min_m"] < 0.36)
    assert measures["outside"] == bad.mean()
    assert measures["outside_settled"] is None
    # NumPy sums in another order.
    assert measures["distance_m"] == pytest.approx(cycles["distance_m"].mean())
    assert measures["unvisited_share"] is None
    assert found.traces.shape == (2, 16 * 32, 2)


def test_the_cost_of_transport_is_plausible(tmp_path: Path) -> None:
    """The cost of transport of the scripted knee has the magnitude of that of walking robots."""
    trial = Trial("walker", 20, 0, policy="scripted", learning=False)
    run_trial(trial, tmp_path)
    cost = outcome(trial, tmp_path).measures["cost_of_transport"]
    assert 0.1 < cost < 10.0


# -- the runner -------------------------------------------------------------------------------


def test_dependency_order() -> None:
    """A training comes before the walks that start from it, and every trial comes once."""
    start = Trial("trainer", 1, 0)
    walked = [Trial("walker", 1, seed, start=start) for seed in (1, 2)]
    assert runner.in_dependency_order([*walked, walked[0]]) == [start, *walked]


@pytest.mark.slow
def test_the_runner_continues_a_stopped_run(tmp_path: Path) -> None:
    """A stopped run returns False; a second run completes it without repeating any trial."""
    trials = [Trial("walker", 1, seed, start=Trial("trainer", 1, seed)) for seed in range(2)]
    progress: list[tuple[int, int]] = []

    def stop_soon(spent: int, of: int) -> bool:
        progress.append((spent, of))
        return spent == 0

    assert not runner.run_all(trials, tmp_path, stop_soon)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.glob("*/trial.json")}
    assert 1 <= len(before) < 4
    assert runner.run_all(trials, tmp_path, lambda spent, of: True)
    after = {file: file.stat().st_mtime_ns for file in tmp_path.glob("*/trial.json")}
    assert len(after) == 4
    assert {file: after[file] for file in before} == before
    assert progress[-1][1] == sum(map(runner.cost, runner.in_dependency_order(trials)))


def alive(group: int) -> list[str]:
    """Return the processes of a group that have not ended."""
    running = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, of = file.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue  # it ended during the search
        if int(of) == group and state != "Z":
            running.append(file.parent.name)
    return running


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "arguments", "message"),
    [
        (signal.SIGINT, ("fig5", "--seeds", "2"), "finished runs are in out/trials"),
        (signal.SIGHUP, ("fig5", "--seeds", "2"), "finished runs are in out/trials"),
        (signal.SIGINT, ("relearn", "--cycles", "1000000"), "after 0 of 5 seeds"),
    ],
)
def test_ctrl_c_stops_an_experiment_and_its_workers(
    tmp_path: Path, number: int, arguments: tuple[str, ...], message: str
) -> None:
    """After SIGINT or SIGHUP to all processes: exit code 130, a message, no process left."""
    command = [*EMBER, "experiment", *arguments]
    with started(
        command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as lead:
        threads = Path(f"/proc/{lead.pid}/task")
        until(
            lambda: lead.poll() is not None or len(list(threads.glob("*"))) >= 3,
            "its workers have started",
        )
        os.killpg(lead.pid, number)
        output, _ = lead.communicate(timeout=2 * DEADLINE_S)
    assert lead.returncode == 130, output
    assert "Stopped" in output
    assert message in output
    until(lambda: not alive(lead.pid), "all processes have ended")


# -- arms --------------------------------------------------------------------------------------


def test_the_learners_differ_only_in_the_named_parts() -> None:
    """`plain` with all parts of `ember` is `ember`, and vice versa: the list is complete."""
    parts = tuple(learners.PARTS)
    assert learner_params("plain", **learners.changes("ember", parts)) == learner_params("ember")
    assert learner_params("ember", **learners.changes("plain", parts)) == learner_params("plain")
    for part in parts:
        assert learners.changes("ember", (part,)) != learners.changes("plain", (part,))


def test_a_sense_that_is_left_out_has_no_effect() -> None:
    """The state does not depend on this sense, but it does depend on the others."""
    base = LegSense(0, 0.1, 0.5, 0.0, 0.0, 10.0, 10.0, -0.5, 0.0, True, True, False)
    other = {
        "without force": base._replace(force_mean=50.0),
        "without inclination": base._replace(inclination=0.3),
    }
    for name, changes in senses.WITHOUT.items():
        partition = PaperDiscretizer(learner_params("ember", **changes))
        same = {
            lost
            for lost, sense in other.items()
            if partition.index(sense, True) == partition.index(base, True)
        }
        assert same == {name} - {"all senses", "without hair"}
    # The hair is not left out by the partition: it is so long that it always touches the ground.
    world = make_world("walker", learner_params("ember", **senses.WITHOUT["without hair"]), 0)
    for tick in range(40):
        world.step(beat(tick), [None] * 4)
        assert all(sense.hair for sense in world.observe())
    world.close()


def test_private_tables_differ(tmp_path: Path) -> None:
    """With ``sync_every`` longer than the run, four legs learn four tables; otherwise one table."""
    visits = []
    variants: list[dict[str, Any]] = [{}, {"walk__sync_every": NO_SYNC}]
    for changes in variants:
        loop = Loop(RunConfig("walker", 30, params=learner_params("plain", **changes)))
        for _ in range(30 * 32):
            loop.tick()
        visits.append({leg.copy.table.visits.sum() for leg in loop.legs})
        if changes:
            assert len({leg.copy.table.sha256() for leg in loop.legs}) == 4
        loop.close()
    assert max(visits[1]) < 30 * 32  # a private table contains only the ticks of its own leg
    assert min(visits[0]) > 3 * 29 * 31


def test_the_central_learner_updates_the_joint_table(tmp_path: Path) -> None:
    """One update per tick; the legs do the joint action and do not learn by themselves."""
    config = RunConfig("walker", 2, seed=1, params=learner_params("plain"))
    loop = CentralLoop(config)
    assert (loop.joint.states, loop.joint.actions) == (32 * 16, 9**4)
    commands_per_tick: list[tuple[LegCommand | None, ...]] = []

    class CommandObserver:
        def tick(self, phase: Any, senses: Any, commands: Any, *others: Any) -> None:
            commands_per_tick.append(tuple(commands))

    for _ in range(64):
        loop.tick(CommandObserver())
    falls = loop.world.body().falls
    assert loop.joint.visits.sum() == 63 - falls
    speeds = config.params.leg.knee_speeds
    for tick, commands in enumerate(
        commands_per_tick[:20]
    ):  # before the first fall: the table was updated for each joint action
        joint = sum(
            speeds.index(command.knee_speed) * len(speeds) ** n
            for n, command in enumerate(commands)
            if command
        )
        states = loop.joint.visits.reshape(32, 16, -1)[tick % 32]
        assert states[:, joint].sum() >= 1
    assert np.abs(loop.joint.values).max() <= 0.1 * 5  # a constant learning rate, starting from 0
    assert loop.finish().visits.sum() == 0
    loop.close()
    trial = Trial("walker", 2, 1, learner_params("plain"), CENTRAL)
    run_trial(trial, tmp_path)
    assert outcome(trial, tmp_path).measures["falls"] == falls


def test_every_body_has_its_baselines() -> None:
    """For each body with trained legs there are a scripted knee, a random knee and empty tables."""
    for name, study in STUDIES.items():
        kinds_by_body: dict[str, set[str]] = {}
        for arm in study.arms(SIZE):
            for trial in arm.trials:
                body = str((trial.params.walker, trial.params.physics))
                kind = "trained" if trial.start else trial.policy
                if trial.world == "walker":
                    kinds_by_body.setdefault(body, set()).add(kind)
        for body, kinds in kinds_by_body.items():
            assert {"scripted", "random", "learned"} <= kinds, (name, body, kinds)


def test_the_comparisons_use_all_bodies() -> None:
    """Trained or empty, shared or private, fixed or modulated: each is compared in four bodies."""
    assert BODIES == ("reference", "easy", "short", "narrow")
    for name in ("direct", "sharing", "regime"):
        arms = STUDIES[name].arms(SIZE)
        assert {arm.labels["body"] for arm in arms} == set(BODIES)
        assert set(LEARNERS) <= {arm.labels["learner"] for arm in arms}


@pytest.mark.slow
def test_held_out_seeds_are_not_used_elsewhere() -> None:
    """They start at 100, and no other arm uses them."""
    arms = STUDIES["walker"].arms(Size(10, 1, 10))
    (held,) = (arm for arm in arms if arm.labels.get("seeds") == "held out")
    starts = [trial.start.seed for trial in held.trials if trial.start]
    assert starts == list(range(100, 110))
    assert [trial.seed for trial in held.trials] == list(range(1100, 1110))
    used = {
        trial.seed
        for study in STUDIES.values()
        for arm in study.arms(Size(10, 1, 10))
        for trial in runner.in_dependency_order(arm.trials)
        if arm.labels.get("seeds") != "held out"
    }
    assert not used & {*starts, *range(1100, 1110)}


# -- statistics --------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_interval_contains_its_mean() -> None:
    """It is Student's t interval; for equal values it is their mean."""
    interval = stats.interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert interval.low < interval.mean == 3.0 < interval.high
    reach = 2.776 * math.sqrt(2.5 / 5)  # Student's t at 4 degrees of freedom, from a table
    assert (interval.low, interval.high) == pytest.approx((3.0 - reach, 3.0 + reach), abs=1e-3)
    assert stats.interval([2.0, 2.0]) == (2.0, 2.0, 2.0, 2)
    assert stats.interval([1.0, 2.0, 3.0, 4.0, 5.0]) == interval


@pytest.mark.parametrize(
    ("values", "claimed", "expected"),
    [
        ([1.0, 1.2, 0.9, 1.1], 1, "holds"),
        ([1.0, 1.2, 0.9, 1.1], -1, "fails"),
        ([-1.0, -1.2, -0.9], -1, "holds"),
        ([1.0, -1.2, 0.9, -1.1], 1, "unclear"),
        ([0.0, 0.0, 0.0], 1, "unclear"),
        ([5.0], 1, "unclear"),
    ],
)
def test_verdicts(values: list[float], claimed: int, expected: str) -> None:
    """A claim holds or fails if the interval is on one side of 0; with one seed it is unclear."""
    assert stats.verdict(stats.interval(values), claimed=claimed) == expected


def test_differences_are_paired_by_seed() -> None:
    """Differences between seeds have no effect."""
    difference = stats.difference([11.0, 101.0, 1001.0], [10.0, 100.0, 1000.0])
    assert difference == (1.0, 1.0, 1.0, 3)


def test_survival_is_kaplan_meier() -> None:
    """Two of four fell, one was censored between them; expected values were computed by hand."""
    curve = stats.survival([9, None, 29, None], [40, 20, 40, 40])
    share = dict(zip(curve.steps, curve.share, strict=True))
    assert share[0.0] == 1.0
    assert share[10.0] == 0.75  # 3 of 4
    assert share[30.0] == pytest.approx(0.75 * 1 / 2)  # 1 of the 2 that are left
    assert all(low <= s <= high for s, low, high in zip(*curve[1:], strict=True))
    assert stats.survival([None, None], [7, 7]).share == [1.0, 1.0]


def test_settling_step_and_cycle_reached() -> None:
    """A ramp settles at 90 % of its height; a level is reached when the moving mean reaches it."""
    ramp = np.concatenate([np.zeros(1000), np.linspace(0, 1, 1000), np.ones(1000)])
    # A ramp of 1000 points and a mean over 200: exact to a few steps.
    assert settling_step(ramp) == pytest.approx(1000 + 900 + 100, abs=5)
    assert settling_step(np.ones(1000)) == 200
    values = np.concatenate([np.zeros(100), np.ones(100)])
    assert (
        cycle_reached(values, 0.5) == 101
    )  # the middle of the first window whose mean reaches 0.5
    assert cycle_reached(values, 2.0) is None


def test_a_missing_measure_is_an_error() -> None:
    """A mean over the other runs would be wrong."""
    with pytest.raises(ValueError, match="outside_settled"):
        column([{"outside_settled": 0.1}, {"outside_settled": None}], "outside_settled")


# -- the commands and the document -------------------------------------------------------------


SMOKE = ("--seeds", 1, "--cycles", 2, "--walk-cycles", 10)


@pytest.mark.slow
def test_all_experiments_with_a_small_size(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every experiment writes its files; a second run repeats no trial and changes no file."""
    arguments = ("experiment", "all", *SMOKE, "--out", tmp_path, "--trials", tmp_path / "trials")
    assert ember(*arguments) == 0
    results = tmp_path / RESULTS
    for name in STUDIES:
        for ending in ("json", "csv", "md", "png"):
            assert (results / f"{name}.{ending}").stat().st_size > 0
        found = json.loads((results / f"{name}.json").read_text())
        lines = (results / f"{name}.csv").read_text().splitlines()
        assert len(lines) == 1 + sum(len(arm["runs"]) for arm in found["arms"])
    page = (tmp_path / DOCUMENT).read_text()
    assert not re.search(r"\bnan\b", page)
    for study in STUDIES.values():
        assert f"## {study.title}\n" in page
    assert page == document(results)
    before = {file: file.read_bytes() for file in results.iterdir()}
    for file in (*results.glob("*.md"), *results.glob("*.png"), tmp_path / DOCUMENT):
        file.unlink()
    assert ember("experiment", "all", "--redraw", "--out", tmp_path) == 0
    assert "this version would give other results" not in "".join(capfd.readouterr())
    assert {file: file.read_bytes() for file in results.iterdir()} == before
    assert (tmp_path / DOCUMENT).read_text() == page
    # Figures are not drawn a third time: they were the same bytes twice.
    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)
    ran = {file: file.stat().st_mtime_ns for file in (tmp_path / "trials").glob("*/*")}
    assert ember(*arguments) == 0
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "trials").glob("*/*")} == ran
    assert {file: file.read_bytes() for file in results.iterdir()} == before
    assert "REPRODUCTION.md" in "".join(capfd.readouterr())


@pytest.mark.slow
def test_outdated_results_are_reported(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Results that this version would not compute are redrawn, with a message."""
    arguments = ("experiment", "fig5", *SMOKE, "--out", tmp_path, "--trials", tmp_path / "trials")
    assert ember(*arguments) == 0
    file = tmp_path / RESULTS / "fig5.json"
    results = json.loads(file.read_text())
    assert outdated_reason(STUDIES["fig5"], results) is None
    changes: list[tuple[Callable[[Any], Any], dict[str, str]]] = [
        (lambda results: results["about"], {"code_sha256": "0" * 64}),
        (lambda results: results["arms"][1]["runs"][0], {"trial": "0" * 20}),
        (lambda results: results["about"]["versions"], {"numpy": "1.0"}),
    ]
    for where, change in changes:
        other = json.loads(file.read_text())
        where(other).update(change)
        assert outdated_reason(STUDIES["fig5"], other) is not None
    other = json.loads(file.read_text())
    other["about"]["code_sha256"] = "0" * 64
    file.write_text(json.dumps(other))
    capfd.readouterr()
    assert ember("experiment", "fig5", "--redraw", "--out", tmp_path) == 0
    assert "fig5: this version would give other results" in capfd.readouterr().out


@pytest.mark.slow
def test_several_seeds_with_a_small_size(tmp_path: Path) -> None:
    """With two seeds there are quartiles; a single experiment does not write the document."""
    arguments = ("experiment", "fig5", "--seeds", 2, "--cycles", 4, "--out", tmp_path)
    assert ember(*arguments, "--trials", tmp_path / "trials") == 0
    found = json.loads((tmp_path / RESULTS / "fig5.json").read_text())
    ways = len(LEARNERS) * len(STOPS) + len(VARIATIONS)
    assert [len(arm["runs"]) for arm in found["arms"]] == [2] * ways
    curve = found["curves"]["ember/fixed/peak_force_n"]
    (arm,) = (a for a in found["arms"] if a["labels"] == {"learner": "ember", "height": "fixed"})
    means = [run["peak_force_n"] for run in arm["runs"]]  # over all 4 steps, of both seeds
    # Curves are rounded.
    assert np.mean(curve["median"]) == pytest.approx(np.mean(means), rel=1e-4)
    assert not (tmp_path / DOCUMENT).exists()


def documented_results(name: str) -> Any:
    """Return the results of an experiment in docs."""
    return json.loads((ROOT / "docs" / RESULTS / f"{name}.json").read_text())


def test_the_document_agrees_with_the_result_files() -> None:
    """docs/REPRODUCTION.md is exactly what is computed from docs/results.

    This includes the note at its beginning if results are outdated.
    """
    assert (ROOT / "docs" / DOCUMENT).read_text() == document(ROOT / "docs" / RESULTS)


PAGES: dict[str, Callable[[Any], str]] = {
    name: functools.partial(page_of, study) for name, study in STUDIES.items()
}
PAGES |= {"relearn": relearning.page, "isotropy": isotropy.page}


@pytest.mark.parametrize("name", list(PAGES))
def test_pages_agree_with_the_result_files(name: str) -> None:
    """Each page in docs/results is exactly what is computed from its JSON file."""
    page = (ROOT / "docs" / RESULTS / f"{name}.md").read_text()
    assert page == PAGES[name](documented_results(name))


def test_the_readme_notes_outdated_results() -> None:
    """It cites results, so it has the note if any page has it."""
    pages = [ROOT / "docs" / DOCUMENT, *(ROOT / "docs" / RESULTS / f"{n}.md" for n in PAGES)]
    older = [page.name for page in pages if OUTDATED in page.read_text()]
    assert (OUTDATED in (ROOT / "README.md").read_text()) is bool(older), older


@pytest.mark.parametrize("name", list(STUDIES))
def test_the_result_files_are_complete(name: str) -> None:
    """They have ten seeds and only finite numbers, and are small enough for the repository."""
    for ending in ("json", "csv", "png"):
        assert (ROOT / "docs" / RESULTS / f"{name}.{ending}").stat().st_size < 3_000_000
    found = json.loads((ROOT / "docs" / RESULTS / f"{name}.json").read_text())
    assert (found["about"]["seeds"], found["about"]["walk"]) == (10, 7000)
    for arm in found["arms"]:
        for run in arm["runs"]:
            assert all(math.isfinite(value) for value in run.values() if isinstance(value, float))


def test_the_readme_agrees_with_the_document() -> None:
    """Its summary is part of the document."""
    readme = (ROOT / "README.md").read_text()
    summary = readme.partition("<!-- in short -->")[2].partition("<!-- end -->")[0].strip()
    assert summary.startswith("- ")
    assert summary in (ROOT / "docs" / DOCUMENT).read_text()
