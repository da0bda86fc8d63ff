"""Experiments: trials are what they say and run once; numbers in pages come from result files."""

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

from ember_ros.experiments import isotropy, lab, relearn, stats
from ember_ros.experiments.central import CentralLoop
from ember_ros.experiments.reproduction import DOCUMENT, RESULTS, STUDIES, document
from ember_ros.experiments.studies import learners, senses
from ember_ros.experiments.studies.fig5 import BACK, HEIGHTS, settles
from ember_ros.experiments.studies.sharing import NEVER, reached
from ember_ros.experiments.study import (
    BODIES,
    LEARNERS,
    OLDER,
    OTHER_SEED,
    Size,
    belongs,
    numbers,
    page_of,
    trained,
    walks,
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
from ember_ros.experiments.words import column
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

pytest.importorskip("pybullet", reason="a trial needs a world")
pytest.importorskip("scipy", reason="statistics need it")

SIZE = Size(seeds=2, train=3, walk=20)


# -- trials -----------------------------------------------------------------------------------


def test_a_trial_is_what_the_loop_does(tmp_path: Path) -> None:
    """A trained start and a walk from it: the same tables as by hand, bit for bit."""
    (walk,) = walks("ember", "narrow", 3, [4], [trained("ember", SIZE, 4)])
    assert walk.start is not None
    for trial in (walk.start, walk):
        assert run_trial(trial, tmp_path)
    configs = [
        RunConfig("trainer", 3, seed=4, params=numbers("ember")),
        RunConfig(
            "walker",
            3,
            seed=4 + OTHER_SEED,
            params=numbers("ember", "narrow"),
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
        kept, _ = load_table(tmp_path / trial.key / TABLE, config.params)
        assert kept.sha256() == sha


def test_a_trial_twice_is_the_same_trial(tmp_path: Path) -> None:
    """All measures but the time it took are equal, and so is every curve."""
    (trial,) = walks("plain", "short", 4, [1])
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


def test_whatever_determines_a_trial_is_in_its_name() -> None:
    """Each of these is another trial; equal ones are one."""
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


def test_the_code_that_decides_is_all_that_runs(tmp_path: Path) -> None:
    """No module of the house takes part in a trial unnoticed: its code would not be in the name."""
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
    house = {name for name in run.stdout.split() if name.split(".")[0] in ("ember_ros", *ROOMS)}
    idle = {"leg_node", "sim_node", "cpg_node", "ember_ros.experiments", "ember_ros.report"}
    # What is said of a trial, errors, a protocol, a file's format and its place: a table is held by
    # its SHA-256.
    idle |= {"ember_ros", "ember_ros.versions", "ember_ros.observer", "ember_ros.shipped"}
    idle |= {"leg_node.table_file", "ember_ros.bounded_io", "ember_ros.errors"}
    assert house - idle == set(DECIDES)


ROOMS = ("leg_node", "sim_node", "cpg_node")


@pytest.mark.slow
def test_the_code_of_a_part_that_is_named_is_in_the_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another line in a file of one's own, and what was run before is of another trial."""
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


def test_a_stopped_trial_leaves_nothing(tmp_path: Path) -> None:
    """Stopped in the middle, it is as if it had not begun; then it can be run whole."""
    trial = Trial("trainer", 5, 0)
    left = iter([True, True, False])
    assert not run_trial(trial, tmp_path, lambda: next(left))
    assert list(tmp_path.iterdir()) == []
    assert run_trial(trial, tmp_path)
    assert is_done(trial, tmp_path)


def test_measures_are_those_of_the_record(tmp_path: Path) -> None:
    """Falls, shares and ways, written here a second time from the cycles that were kept."""
    trial = Trial("walker", 30, 3, policy="random", learning=False)
    run_trial(trial, tmp_path)
    found = outcome(trial, tmp_path)
    measures, cycles = found.measures, found.cycles
    assert measures["falls"] == cycles["falls"].sum() > 0
    assert measures["first_fall"] == np.flatnonzero(cycles["falls"])[0]
    bad = (cycles["tilt_max_rad"] > 0.3) | (cycles["height_min_m"] < 0.36)
    assert measures["outside"] == bad.mean()
    assert measures["outside_settled"] is None
    # NumPy adds in another order.
    assert measures["distance_m"] == pytest.approx(cycles["distance_m"].mean())
    assert measures["unvisited_share"] is None
    assert found.traces.shape == (2, 16 * 32, 2)


def test_a_scripted_walk_costs_what_a_walk_costs(tmp_path: Path) -> None:
    """The motors do work, so that the cost of transport is a number of a walking machine's size."""
    trial = Trial("walker", 20, 0, policy="scripted", learning=False)
    run_trial(trial, tmp_path)
    cost = outcome(trial, tmp_path).measures["cost_of_transport"]
    assert 0.1 < cost < 10.0


# -- the lab ----------------------------------------------------------------------------------


def test_starts_come_first_and_nothing_twice() -> None:
    """Walks of one training share it, and it stands before them."""
    start = Trial("trainer", 1, 0)
    walked = [Trial("walker", 1, seed, start=start) for seed in (1, 2)]
    assert lab.in_order([*walked, walked[0]]) == [start, *walked]


@pytest.mark.slow
def test_the_lab_goes_on_where_it_was(tmp_path: Path) -> None:
    """Stopped, it says so; started again it runs what is missing, and nothing once more."""
    trials = [Trial("walker", 1, seed, start=Trial("trainer", 1, seed)) for seed in range(2)]
    told: list[tuple[int, int]] = []

    def stop_soon(spent: int, of: int) -> bool:
        told.append((spent, of))
        return spent == 0

    assert not lab.run_all(trials, tmp_path, stop_soon)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.glob("*/trial.json")}
    assert 1 <= len(before) < 4
    assert lab.run_all(trials, tmp_path, lambda spent, of: True)
    after = {file: file.stat().st_mtime_ns for file in tmp_path.glob("*/trial.json")}
    assert len(after) == 4
    assert {file: after[file] for file in before} == before
    assert told[-1][1] == sum(map(lab.cost, lab.in_order(trials)))


def alive(group: int) -> list[str]:
    """Return the processes of a group that have not ended."""
    found = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, of = file.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue  # it ended while it was looked for
        if int(of) == group and state != "Z":
            found.append(file.parent.name)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "words", "says"),
    [
        (signal.SIGINT, ("fig5", "--seeds", "2"), "finished runs are in out/trials"),
        (signal.SIGHUP, ("fig5", "--seeds", "2"), "finished runs are in out/trials"),
        (signal.SIGINT, ("relearn", "--cycles", "1000000"), "after 0 of 5 seeds"),
    ],
)
def test_ctrl_c_stops_an_experiment_and_its_workers(
    tmp_path: Path, number: int, words: tuple[str, ...], says: str
) -> None:
    """The terminal, or its end, signals them all: 130, a line that says so, nobody left."""
    command = [*EMBER, "experiment", *words]
    with started(
        command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as lead:
        threads = Path(f"/proc/{lead.pid}/task")
        until(
            lambda: lead.poll() is not None or len(list(threads.glob("*"))) >= 3,
            "its pool has begun",
        )
        os.killpg(lead.pid, number)
        output, _ = lead.communicate(timeout=2 * DEADLINE_S)
    assert lead.returncode == 130, output
    assert "Stopped" in output
    assert says in output
    until(lambda: not alive(lead.pid), "nobody is left")


# -- what the arms are made of -----------------------------------------------------------------


def test_the_learners_differ_in_the_named_parts_alone() -> None:
    """All parts of ember on plain are ember, and the other way round: the list is whole."""
    parts = tuple(learners.PARTS)
    assert numbers("plain", **learners.changes("ember", parts)) == numbers("ember")
    assert numbers("ember", **learners.changes("plain", parts)) == numbers("plain")
    for part in parts:
        assert learners.changes("ember", (part,)) != learners.changes("plain", (part,))


def test_a_sense_that_is_left_out_says_nothing() -> None:
    """The state does not depend on it, and does on the others."""
    base = LegSense(0, 0.1, 0.5, 0.0, 0.0, 10.0, 10.0, -0.5, 0.0, True, True, False)
    other = {
        "without force": base._replace(force_mean=50.0),
        "without inclination": base._replace(inclination=0.3),
    }
    for name, changes in senses.WITHOUT.items():
        partition = PaperDiscretizer(numbers("ember", **changes))
        same = {
            lost
            for lost, sense in other.items()
            if partition.index(sense, True) == partition.index(base, True)
        }
        assert same == {name} - {"all senses", "without hair"}
    # The hair is no matter of the partition: it is so long that it touches wherever the leg is.
    world = make_world("walker", numbers("ember", **senses.WITHOUT["without hair"]), 0)
    for tick in range(40):
        world.step(beat(tick), [None] * 4)
        assert all(sense.hair for sense in world.observe())
    world.close()


def test_private_legs_part_ways(tmp_path: Path) -> None:
    """With ``sync_every`` beyond the run, four legs learn four tables; shared ones learn one."""
    found = []
    ways: list[dict[str, Any]] = [{}, {"walk__sync_every": NEVER}]
    for changes in ways:
        loop = Loop(RunConfig("walker", 30, params=numbers("plain", **changes)))
        for _ in range(30 * 32):
            loop.tick()
        found.append({leg.copy.table.visits.sum() for leg in loop.legs})
        if changes:
            assert len({leg.copy.table.sha256() for leg in loop.legs}) == 4
        loop.close()
    assert max(found[1]) < 30 * 32  # a private leg knows its own ticks alone
    assert min(found[0]) > 3 * 29 * 31


def test_the_central_learner_learns_by_the_same_rule(tmp_path: Path) -> None:
    """One update a tick into the joint table; legs do what it says and learn nothing themselves."""
    config = RunConfig("walker", 2, seed=1, params=numbers("plain"))
    loop = CentralLoop(config)
    assert (loop.joint.states, loop.joint.actions) == (32 * 16, 9**4)
    heard: list[tuple[LegCommand | None, ...]] = []

    class Hear:
        def tick(self, phase: Any, senses: Any, commands: Any, *others: Any) -> None:
            heard.append(tuple(commands))

    for _ in range(64):
        loop.tick(Hear())
    falls = loop.world.body().falls
    assert loop.joint.visits.sum() == 63 - falls
    speeds = config.params.leg.knee_speeds
    for tick, commands in enumerate(heard[:20]):  # before any fall: every joint action was learnt
        joint = sum(
            speeds.index(command.knee_speed) * len(speeds) ** n
            for n, command in enumerate(commands)
            if command
        )
        states = loop.joint.visits.reshape(32, 16, -1)[tick % 32]
        assert states[:, joint].sum() >= 1
    assert np.abs(loop.joint.values).max() <= 0.1 * 5  # a constant rate, from 0 on
    assert loop.finish().visits.sum() == 0
    loop.close()
    trial = Trial("walker", 2, 1, numbers("plain"), CENTRAL)
    run_trial(trial, tmp_path)
    assert outcome(trial, tmp_path).measures["falls"] == falls


def test_every_table_of_walkers_has_its_company() -> None:
    """Wherever trained legs walk, the scripted knee, a random one and the empty table do, too."""
    for name, study in STUDIES.items():
        by_place: dict[str, set[str]] = {}
        for arm in study.arms(SIZE):
            for trial in arm.trials:
                place = str((trial.params.walker, trial.params.physics))
                kind = "trained" if trial.start else trial.policy
                if trial.world == "walker":
                    by_place.setdefault(place, set()).add(kind)
        for place, kinds in by_place.items():
            assert {"scripted", "random", "learned"} <= kinds, (name, place, kinds)


def test_every_figure_is_asked_for_in_every_body() -> None:
    """Trained against empty, shared against private, fixed against modulated: four bodies each."""
    assert BODIES == ("reference", "easy", "short", "narrow")
    for name in ("direct", "sharing", "regime"):
        arms = STUDIES[name].arms(SIZE)
        assert {arm.labels["body"] for arm in arms} == set(BODIES)
        assert set(LEARNERS) <= {arm.labels["learner"] for arm in arms}


@pytest.mark.slow
def test_held_out_seeds_are_no_others() -> None:
    """They begin at 100 and meet no seed that is used elsewhere."""
    arms = STUDIES["walker"].arms(Size(10, 1, 10))
    (held,) = (arm for arm in arms if arm.labels.get("seeds") == "held out")
    starts = [trial.start.seed for trial in held.trials if trial.start]
    assert starts == list(range(100, 110))
    assert [trial.seed for trial in held.trials] == list(range(1100, 1110))
    used = {
        trial.seed
        for study in STUDIES.values()
        for arm in study.arms(Size(10, 1, 10))
        for trial in lab.in_order(arm.trials)
        if arm.labels.get("seeds") != "held out"
    }
    assert not used & {*starts, *range(1100, 1110)}


# -- statistics --------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_interval_holds_its_mean() -> None:
    """Student's t; without spread, the mean itself."""
    found = stats.interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert found.low < found.mean == 3.0 < found.high
    reach = 2.776 * math.sqrt(2.5 / 5)  # Student's t at 4 degrees of freedom, from a table
    assert (found.low, found.high) == pytest.approx((3.0 - reach, 3.0 + reach), abs=1e-3)
    assert stats.interval([2.0, 2.0]) == (2.0, 2.0, 2.0, 2)
    assert stats.interval([1.0, 2.0, 3.0, 4.0, 5.0]) == found


@pytest.mark.parametrize(
    ("values", "claimed", "word"),
    [
        ([1.0, 1.2, 0.9, 1.1], 1, "holds"),
        ([1.0, 1.2, 0.9, 1.1], -1, "fails"),
        ([-1.0, -1.2, -0.9], -1, "holds"),
        ([1.0, -1.2, 0.9, -1.1], 1, "unclear"),
        ([0.0, 0.0, 0.0], 1, "unclear"),
        ([5.0], 1, "unclear"),
    ],
)
def test_verdicts(values: list[float], claimed: int, word: str) -> None:
    """A claim holds or fails where the interval is on one side of 0; one seed proves nothing."""
    assert stats.verdict(stats.interval(values), claimed=claimed) == word


def test_differences_are_seed_by_seed() -> None:
    """What all seeds share falls out of it."""
    found = stats.difference([11.0, 101.0, 1001.0], [10.0, 100.0, 1000.0])
    assert found == (1.0, 1.0, 1.0, 3)


def test_survival_is_kaplan_meier() -> None:
    """Two of four fell, one was censored between them: worked out by hand."""
    curve = stats.survival([9, None, 29, None], [40, 20, 40, 40])
    share = dict(zip(curve.steps, curve.share, strict=True))
    assert share[0.0] == 1.0
    assert share[10.0] == 0.75  # 3 of 4
    assert share[30.0] == pytest.approx(0.75 * 1 / 2)  # 1 of the 2 that are left
    assert all(low <= s <= high for s, low, high in zip(*curve[1:], strict=True))
    assert stats.survival([None, None], [7, 7]).share == [1.0, 1.0]


def test_settling_and_reaching() -> None:
    """A ramp settles at 90 % of its way; a step is reached when its mean has come up."""
    ramp = np.concatenate([np.zeros(1000), np.linspace(0, 1, 1000), np.ones(1000)])
    # A ramp of 1000 points, and a mean over 200: to a few steps.
    assert settles(ramp) == pytest.approx(1000 + 900 + 100, abs=5)
    assert settles(np.ones(1000)) == 200
    values = np.concatenate([np.zeros(100), np.ones(100)])
    assert reached(values, 0.5) == 101  # the first cycle of a mean that is half up, in its middle
    assert reached(values, 2.0) is None


def test_a_measure_that_is_missing_is_not_left_out() -> None:
    """A mean over fewer runs than there are would be a wrong one."""
    with pytest.raises(ValueError, match="outside_settled"):
        column([{"outside_settled": 0.1}, {"outside_settled": None}], "outside_settled")


# -- the commands and the document -------------------------------------------------------------


SMOKE = ("--seeds", 1, "--cycles", 2, "--walk-cycles", 10)


@pytest.mark.slow
def test_all_experiments_in_small(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every experiment runs, and writes what it says; again, nothing is run and nothing changes."""
    words = ("experiment", "all", *SMOKE, "--out", tmp_path, "--trials", tmp_path / "trials")
    assert ember(*words) == 0
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
    # Its pictures were drawn twice, to the same bytes.
    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)
    ran = {file: file.stat().st_mtime_ns for file in (tmp_path / "trials").glob("*/*")}
    assert ember(*words) == 0
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "trials").glob("*/*")} == ran
    assert {file: file.read_bytes() for file in results.iterdir()} == before
    assert "REPRODUCTION.md" in "".join(capfd.readouterr())


@pytest.mark.slow
def test_results_of_other_code_are_told_apart(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A result that this version would not come to is drawn, and said to be another's."""
    words = ("experiment", "fig5", *SMOKE, "--out", tmp_path, "--trials", tmp_path / "trials")
    assert ember(*words) == 0
    file = tmp_path / RESULTS / "fig5.json"
    found = json.loads(file.read_text())
    assert belongs(STUDIES["fig5"], found) is None
    changes: list[tuple[Callable[[Any], Any], dict[str, str]]] = [
        (lambda found: found["about"], {"code_sha256": "0" * 64}),
        (lambda found: found["arms"][1]["runs"][0], {"trial": "0" * 20}),
        (lambda found: found["about"]["versions"], {"numpy": "1.0"}),
    ]
    for where, change in changes:
        other = json.loads(file.read_text())
        where(other).update(change)
        assert belongs(STUDIES["fig5"], other) is not None
    other = json.loads(file.read_text())
    other["about"]["code_sha256"] = "0" * 64
    file.write_text(json.dumps(other))
    capfd.readouterr()
    assert ember("experiment", "fig5", "--redraw", "--out", tmp_path) == 0
    assert "fig5: this version would give other results" in capfd.readouterr().out


@pytest.mark.slow
def test_several_seeds_in_small(tmp_path: Path) -> None:
    """With more than one seed there are quartiles, and one experiment alone writes no document."""
    words = ("experiment", "fig5", "--seeds", 2, "--cycles", 4, "--out", tmp_path)
    assert ember(*words, "--trials", tmp_path / "trials") == 0
    found = json.loads((tmp_path / RESULTS / "fig5.json").read_text())
    ways = len(LEARNERS) * len(HEIGHTS) + len(BACK)
    assert [len(arm["runs"]) for arm in found["arms"]] == [2] * ways
    curve = found["curves"]["ember/fixed/peak_force_n"]
    (arm,) = (a for a in found["arms"] if a["labels"] == {"learner": "ember", "height": "fixed"})
    means = [run["peak_force_n"] for run in arm["runs"]]  # over all 4 steps, of both seeds
    # Curves are rounded.
    assert np.mean(curve["median"]) == pytest.approx(np.mean(means), rel=1e-4)
    assert not (tmp_path / DOCUMENT).exists()


def found_in_docs(name: str) -> Any:
    """Return a result that is kept."""
    return json.loads((ROOT / "docs" / RESULTS / f"{name}.json").read_text())


def test_the_document_says_what_the_result_files_say() -> None:
    """docs/REPRODUCTION.md is made from docs/results, to the letter: no figure typed by hand.

    Where results are of code that decided otherwise, it says so before anything else.
    """
    assert (ROOT / "docs" / DOCUMENT).read_text() == document(ROOT / "docs" / RESULTS)


PAGES: dict[str, Callable[[Any], str]] = {
    name: functools.partial(page_of, study) for name, study in STUDIES.items()
}
PAGES |= {"relearn": relearn.page, "isotropy": isotropy.page}


@pytest.mark.parametrize("name", list(PAGES))
def test_a_page_says_what_its_result_says(name: str) -> None:
    """And that it is older than this version, where it is."""
    page = (ROOT / "docs" / RESULTS / f"{name}.md").read_text()
    assert page == PAGES[name](found_in_docs(name))


def test_the_readme_says_where_results_are_older_than_this_version() -> None:
    """It shows figures of theirs."""
    pages = [ROOT / "docs" / DOCUMENT, *(ROOT / "docs" / RESULTS / f"{n}.md" for n in PAGES)]
    older = [page.name for page in pages if OLDER in page.read_text()]
    assert (OLDER in (ROOT / "README.md").read_text()) is bool(older), older


@pytest.mark.parametrize("name", list(STUDIES))
def test_the_result_files_are_whole(name: str) -> None:
    """Ten seeds where ten are promised, all numbers finite, and small enough to keep."""
    for ending in ("json", "csv", "png"):
        assert (ROOT / "docs" / RESULTS / f"{name}.{ending}").stat().st_size < 3_000_000
    found = json.loads((ROOT / "docs" / RESULTS / f"{name}.json").read_text())
    assert (found["about"]["seeds"], found["about"]["walk"]) == (10, 7000)
    for arm in found["arms"]:
        for run in arm["runs"]:
            assert all(math.isfinite(value) for value in run.values() if isinstance(value, float))


def test_the_readme_says_what_the_document_says() -> None:
    """Its figures are the document's own lines."""
    readme = (ROOT / "README.md").read_text()
    said = readme.partition("<!-- in short -->")[2].partition("<!-- end -->")[0].strip()
    assert said.startswith("- ")
    assert said in (ROOT / "docs" / DOCUMENT).read_text()
