"""The command line: what a person types, and what is left behind."""

from __future__ import annotations

import csv
import fcntl
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml

from ember_ros import terminal
from ember_ros.cli.ember import COMMANDS
from ember_ros.name_lock import lock_robot
from ember_ros.params import Params
from ember_ros.params_file import dump_params, load_params
from ember_ros.report.run_statistics import Row, load_record
from ember_ros.run import EARLIER, SUMMARY, TABLE
from ember_ros.spinning import Stop
from leg_node.table_file import load_table
from support.command import EMBER, child, closed_pipe, ember, environment, started
from support.needs import needs_bullet
from support.waiting import DEADLINE_S, until

pytest.importorskip("pybullet", reason="every command here builds a world")

Run = Callable[..., str]

SUMMARY_KEYS = {
    "command", "seed", "cycles", "falls", "first_fall", "distance_per_cycle_m", "roll_sd_rad",
    "pitch_sd_rad", "table_sha256", "commands_sha256", "senses_sha256", "wall_s", "ticks_per_s",
    "versions", "provenance", "planned_cycles",
}  # fmt: skip


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Return a runner of commands in a folder of its own; it returns all that was printed."""
    monkeypatch.chdir(tmp_path)

    def go(*words: Any, code: int = 0) -> str:
        capfd.readouterr()
        got = ember(*words)
        output = "".join(capfd.readouterr())
        assert got == code, output
        return output

    return go


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a table after some training."""
    out = tmp_path_factory.mktemp("trained") / "run"
    assert ember("train", "--cycles", 30, "--out", out) == 0
    return out / TABLE


@pytest.mark.parametrize("verb", ["", "train", "walk", "demo", "bench", "experiment", "params"])
def test_help_tells_what_each_option_does(run: Run, verb: str) -> None:
    """Every command says what it is for, and shows its options with their defaults."""
    text = run(*verb.split(), "--help")
    words = " ".join(text.split())
    assert len(text.splitlines()) > 8
    if verb in ("train", "walk", "demo", "bench", "experiment"):
        assert "--out" in text
        assert "default: out/" in words


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_says_of_a_command_what_its_own_help_says_first(run: Run, name: str) -> None:
    """The list imports no command: what it says stands in a table, and each command says it too."""
    listed = " ".join(run("--help").split())
    assert f" {name} {COMMANDS[name].help}" in listed
    own = run(name, "--help").split("\n\n")[1]
    assert " ".join(own.split()) == COMMANDS[name].help


def test_ctrl_c_before_a_command_listens_is_one_of_a_command(run: Run) -> None:
    """While what it needs is imported as well: the code of Ctrl-C, and no traceback."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "ember_ros.cli.params", Interrupts("params"))
        assert run("params", code=130).strip() == ""


class Interrupts(ModuleType):
    """A module that Ctrl-C finds at its beginning."""

    def __getattr__(self, name: str) -> Any:
        if name.endswith("_command"):
            raise KeyboardInterrupt
        raise AttributeError(name)


@pytest.mark.parametrize(
    "way", ["loop", "graph", pytest.param("processes", marks=pytest.mark.slow)]
)
def test_every_way_leaves_the_same_files(run: Run, table: Path, way: str) -> None:
    """Table, lines a cycle, summary and picture, whichever way it ran."""
    run("walk", "--cycles", 3, "--seed", 2, "--on", way, "--table", table, "--out", "o")
    summary = json.loads(Path("o", SUMMARY).read_text())
    assert summary.keys() >= SUMMARY_KEYS
    assert (summary["cycles"], summary["seed"], summary["on"]) == (3, 2, way)
    assert summary["complete"]
    learnt, about = load_table(Path("o", TABLE), Params())
    assert learnt.sha256() == summary["table_sha256"] == about["table_sha256"]
    assert about["seed"] == 2
    with Path("o/cycles.csv").open() as file:
        lines = list(csv.reader(file))
    assert tuple(lines[0]) == Row._fields
    assert len(lines) == 1 + 3 * 5
    assert load_record(Path("o")).traces.shape == (3 * 32, 5)
    assert Path("o/run.png").read_bytes().startswith(b"\x89PNG")
    assert not list(Path("o").glob("table.npz.*"))


def test_the_table_that_was_learnt_is_where_walking_starts(run: Run, table: Path) -> None:
    """A frozen walk ends with the very table it began with; a learning one does not."""
    before = load_table(table, Params())[0].sha256()
    run("walk", "--cycles", 2, "--freeze", "--table", table, "--out", "a", "--on", "loop")
    run("walk", "--cycles", 2, "--table", table, "--out", "b", "--on", "loop")
    after = [json.loads(Path(o, SUMMARY).read_text())["table_sha256"] for o in "ab"]
    assert after[0] == before
    assert after[1] != before


@pytest.mark.parametrize("policy", ["scripted", "random"])
def test_baselines_learn_only_when_asked(run: Run, policy: str) -> None:
    """Without --learn the table of a baseline stays empty; with it, it fills."""
    for out, words in (("a", ()), ("b", ("--learn",))):
        run("walk", "--cycles", 2, "--on", "loop", "--policy", policy, "--out", out, *words)
    empty, filled = (load_table(Path(o, TABLE), Params())[0].visits.sum() for o in "ab")
    assert empty == 0
    assert filled > 4 * 60


@needs_bullet
def test_a_policy_of_one_s_own_is_named_by_its_path(run: Run) -> None:
    """And learns, as one that reads the table does; a wrong name lists the right ones."""
    run("walk", "--cycles", 1, "--on", "loop", "--policy", "leg_node.policy.EpsilonGreedy")
    summary = json.loads(Path("out/walk", SUMMARY).read_text())
    assert summary["policy"] == "leg_node.policy.EpsilonGreedy"
    assert summary["learning"] is True
    assert "'learned', 'scripted', 'random'" in run("walk", "--policy", "best", code=2)


def test_an_earlier_run_is_not_replaced_unasked(run: Run) -> None:
    """What was learnt is not lost to a second run in the same folder."""
    run("train", "--cycles", 1)
    before = Path("out/train", TABLE).read_bytes()
    assert "earlier run" in run("train", "--cycles", 2, code=2)
    assert Path("out/train", TABLE).read_bytes() == before
    run("train", "--cycles", 2, "--force")
    assert Path("out/train", TABLE).read_bytes() != before


def test_an_earlier_run_that_a_killed_one_set_aside_is_there_again(run: Run) -> None:
    """It is not replaced unasked, and lies where it lay; ``--resume`` finds it too."""
    run("train", "--cycles", 1)
    out, aside = Path("out/train"), Path("out/train", EARLIER)
    for words, code in ((("--cycles", 2), 2), (("--resume", out, "--out", "b"), 0)):
        aside.mkdir()
        for name in (SUMMARY, TABLE):
            (out / name).replace(aside / name)
        (out / "cycles.csv").write_text("cycle,module\n")
        said = run("train", "--cycles", 2, *words, code=code)
        assert ("earlier run (summary.json, table.npz)" in said) is bool(code)
        assert {each.name for each in out.iterdir()} >= {SUMMARY, TABLE}
        assert not aside.exists()


@pytest.mark.parametrize("name", ["cycles.csv", "run.png", "traces.npy"])
def test_whatever_a_run_writes_is_not_replaced_unasked(run: Run, name: str) -> None:
    """``ember bag csv --out v`` leaves a cycles.csv too."""
    Path("v").mkdir()
    Path("v", name).write_text("mine")
    assert f"({name})" in run("train", "--cycles", 1, "--out", "v", code=2)
    assert Path("v", name).read_text() == "mine"


def test_where_another_run_writes_the_second_is_told_so(run: Run) -> None:
    """And not to force its way."""
    run("train", "--cycles", 1)
    held = os.open("out/train", os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    assert "another run is writing into out/train" in run("train", "--cycles", 1, code=2)
    os.close(held)


def test_ctrl_c_before_the_first_cycle_replaces_nothing(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says that the earlier run is as it was, with the code of Ctrl-C."""
    run("train", "--cycles", 1)
    before = Path("out/train", SUMMARY).read_text()
    monkeypatch.setattr(Stop, "__init__", Stop.request)
    assert "is as it was" in run("train", "--cycles", 2, "--force", code=130)
    assert Path("out/train", SUMMARY).read_text() == before


@pytest.mark.parametrize("verb", ["train", "walk", "demo", "bench", "experiment"])
def test_no_name_is_no_folder(run: Run, verb: str) -> None:
    """``--out "$UNSET"`` would fill the folder one is in."""
    words = [verb, "fig5"] if verb == "experiment" else [verb]
    assert "'' is not a folder" in run(*words, "--out", "", code=2)
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize(("name", "way"), [("log", "processes"), ("cycles.csv", "loop")])
def test_a_file_where_a_folder_is_needed_is_said_in_one_line(run: Run, name: str, way: str) -> None:
    """And the other way round."""
    out = Path("out")
    out.mkdir()
    if name == "log":
        (out / name).write_text("mine")
    else:
        (out / name).mkdir()
    said = run("walk", "--cycles", 1, "--on", way, "--out", out, "--force", code=2)
    (line,) = [line for line in said.splitlines() if line.strip()]
    assert line.startswith("error: ")
    assert str(out / name) in line


def test_progress_is_a_line_now_and_then_without_a_terminal(
    run: Run, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """On standard error, so that output can be piped on; and no line too often."""
    monkeypatch.setattr(terminal, "LINE_PERIOD_S", 0.0)
    capfd.readouterr()
    assert ember("train", "--cycles", 3) == 0
    output, aside = capfd.readouterr()
    lines = [f"training (loop): {n}/3 cycles, 0 falls" for n in (0, 1, 2, 3)]
    assert aside.splitlines() == lines
    assert "training (loop)" not in output
    monkeypatch.setattr(terminal, "LINE_PERIOD_S", 1000.0)
    assert ember("train", "--cycles", 3, "--force") == 0
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_a_path_that_standard_output_has_no_letters_for_is_spelt_out(tmp_path: Path) -> None:
    """A run that is whole does not end with a traceback for its name."""
    out = tmp_path / "\u00fcber \udce9"  # not even UTF-8
    done = subprocess.run(
        [*EMBER, "train", "--cycles", "1", "--out", out],
        capture_output=True,
        env=environment(PYTHONIOENCODING="ascii"),
        check=False,
        timeout=DEADLINE_S,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\xfcber \\udce9" in done.stdout
    assert (out / TABLE).exists()


@pytest.mark.slow
def test_who_hears_only_the_first_line_ends_nothing(tmp_path: Path) -> None:
    """``ember params | head -1``: no traceback."""
    for words in (("params", "--describe"), ("train", "--cycles", "1", "--out", tmp_path / "run")):
        with closed_pipe() as pipe:
            done = child([*EMBER, *words], stdout=pipe)
        assert "Traceback" not in done.stderr
    assert (tmp_path / "run" / SUMMARY).exists()


def _truncated(file: Path, whole: bytes) -> None:
    file.write_bytes(whole[: len(whole) // 2])


def _foreign(file: Path, whole: bytes) -> None:
    np.savez(file, weights=np.ones(3))


def _missing(file: Path, whole: bytes) -> None:
    file.unlink()


@pytest.mark.parametrize(
    ("spoil", "says"),
    [(_truncated, "not a whole"), (_foreign, "not a whole"), (_missing, "there is no table")],
)
@pytest.mark.parametrize("way", ["loop", "graph", "processes"])
def test_a_bad_table_is_said_before_anything_starts(
    run: Run, table: Path, spoil: Callable[[Path, bytes], None], says: str, way: str
) -> None:
    """One line that names the file; no half-made folder, no node left behind."""
    bad = Path("bad.npz")
    bad.write_bytes(table.read_bytes())
    spoil(bad, table.read_bytes())
    output = run("walk", "--cycles", 2, "--on", way, "--table", bad, "--out", "o", code=2)
    assert len(output.strip().splitlines()) == 1
    assert output.startswith("error: ")
    assert "bad.npz" in output
    assert says in output
    assert not Path("o").exists()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("/**: {ros__parameters: {walker: {lenght: 2.0}}}", "did you mean walker.length"),
        ("/**: {ros__parameters: {walker: {length: 99.0}}}", "out of range: 0.1 to 10.0"),
        ("/**: {ros__parameters: {walker: {length: long}}}", "must be a number"),
        ("/**: {ros__parameters: {walker.length: 99.0}}", "out of range"),
        ("/**: {ros__parameters: [1]}", "would be right"),
        ("/**: {ros__parameters: {walk: {gamma: .nan}}}", "out of range"),
        ("walker: {length: 2.0}", "would be right"),
        ("/**: {ros__parameters: {", "not YAML"),
        ("", "would be right"),
    ],
)
def test_a_bad_parameter_file_is_said_in_one_line(run: Run, content: str, says: str) -> None:
    """File, name, value and what would be right."""
    Path("p.yaml").write_text(content)
    output = run("walk", "--params", "p.yaml", code=2)
    assert output.startswith("error: ")
    assert "p.yaml" in output
    assert says in output


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--cycles", -1), "cycles = -1 must be 0 or more"),
        (("--bag", "b", "--split-s", "nan"), "'nan' is not a finite number"),
        (("--bag", "b", "--split-mb", "inf"), "'inf' is not a finite number"),
        (("--seed", -1), "seed = -1: 0 to 9223372036854775807 would be right"),
        (("--params", "none.yaml"), "none.yaml"),
        (("--out", "/proc/ember"), "/proc/ember"),
        (("--on", "moon"), "moon"),
        (("--policy", "none"), "none"),
    ],
)
def test_a_bad_option_is_said(run: Run, words: tuple[Any, ...], says: str) -> None:
    """Exit code 2, the option's value, no traceback."""
    output = run("train", "--cycles", 1, *words, code=2)
    assert says in output
    assert "Traceback" not in output


@pytest.mark.ros
def test_no_cycles_are_a_run_as_well(run: Run) -> None:
    """Nothing is done, everything is written, on the graph too."""
    for way in ("loop", "graph"):
        run("walk", "--cycles", 0, "--on", way, "--out", way)
        assert json.loads(Path(way, SUMMARY).read_text())["cycles"] == 0


def test_printed_parameters_are_a_file_that_says_the_same(run: Run) -> None:
    """`ember params` round-trips through the reader, every number of it."""
    text = run("params")
    assert text == dump_params(Params())
    Path("p.yaml").write_text(text)
    assert load_params(Path("p.yaml")) == Params()
    assert set(yaml.safe_load(text)) == {"/**"}
    described = " ".join(run("params", "--describe").split())
    assert "hip axis to the middle plane" in described
    assert "leg.load = 24.525 [N], 0.01 or more, and finite" in described
    assert "reward.slip = 1.0 [1], any number, and finite" in described
    assert not re.search(r"\binf\b", described)


def test_set_goes_with_the_files_not_with_the_defaults(run: Run) -> None:
    """A number that only fits what a file says is taken; alone, it is refused, in one line."""
    Path("p.yaml").write_text("/**: {ros__parameters: {trainer: {stop_high: 0.7}}}")
    words = ("train", "--cycles", 1, "--set", "trainer.stop_low=0.6")
    run(*words, "--params", "p.yaml", "--out", "out/both")
    output = run(*words, "--out", "out/alone", code=2)
    assert output.startswith("error: trainer.stop_low = 0.6")
    assert output.count("\n") == 1


@pytest.mark.slow
@pytest.mark.ros
def test_demo_trains_walks_and_draws(run: Run) -> None:
    """Both runs and a picture of both; a second demo replaces the first where it may."""
    for force in ([], ["--force"]):
        run("demo", "--cycles", 20, "--walk-cycles", 3, *force)
        walk = json.loads(Path("out/demo/walk", SUMMARY).read_text())
        train = json.loads(Path("out/demo/train", SUMMARY).read_text())
        assert walk["start_table"] == str(Path("out/demo/train", TABLE))
        assert (train["on"], walk["on"]) == ("loop", "graph")
        assert walk["learning"]
        assert walk["table_sha256"] != train["table_sha256"]
    assert Path("out/demo/demo.png").stat().st_size > 20_000


@pytest.mark.slow
@pytest.mark.parametrize("way", ["graph", "processes"])
def test_a_run_lives_beside_another_in_a_namespace_of_its_own(
    run: Run, free_domain: int, way: str
) -> None:
    """In the same one it is refused, says how to live beside it, and ends with 2."""
    walk = ("walk", "--cycles", 2, "--on", way)
    lock = lock_robot(free_domain, "")
    output = run(*walk, "--out", "a", code=2)
    assert f"error: / as a whole is taken by /sim_node (process {os.getpid()})" in output
    assert not Path("a", SUMMARY).exists()
    run(*walk, "--out", "a", "--namespace", "/lab/robot_2")
    lock.release()
    run(*walk, "--out", "b")
    a, b = (json.loads(Path(each, SUMMARY).read_text())["senses_sha256"] for each in "ab")
    assert a == b


@pytest.mark.slow
def test_a_namespace_is_of_the_demo_and_of_a_replay_too(run: Run, free_domain: int) -> None:
    """Beside a robot at the root; a bag's only robot is replayed in whichever is asked for."""
    lock = lock_robot(free_domain, "")
    robot = ("--namespace", "robot_2")
    run("demo", "--cycles", 5, "--walk-cycles", 2, code=2)
    run("demo", "--cycles", 5, "--walk-cycles", 2, "--force", *robot)
    run("walk", "--cycles", 2, "--on", "loop", "--bag", "bag", "--out", "o")
    run("replay", "bag", "--on", "graph", code=2)
    assert "Equal, bit for bit" in run("replay", "bag", "--on", "graph", *robot)
    lock.release()
    assert "'2' is not a namespace" in run("walk", "--namespace", "2", code=2)
    assert "no robot in robot_2" in run("replay", "bag", *robot, code=2)


@pytest.mark.slow
@pytest.mark.ros
def test_a_bag_of_the_loop_has_the_namespace_too(run: Run) -> None:
    """However a run was run, its bag has the same bytes."""
    for way in ("loop", "graph"):
        given = ("--bag", f"bag_{way}", "--namespace", "robot_2", "--out", way)
        run("walk", "--cycles", 2, "--on", way, *given)
    bags = [next(Path(f"bag_{way}").glob("*.mcap")).read_bytes() for way in ("loop", "graph")]
    assert bags[0] == bags[1]
    run("replay", "bag_loop", "--namespace", "robot_2")


@pytest.mark.slow
@pytest.mark.parametrize("way", ["loop", "graph", "processes"])
def test_ctrl_c_saves_what_was_learnt(tmp_path: Path, way: str) -> None:
    """SIGINT in the middle: exit code 130, a whole table that holds what was learnt."""
    command = [*EMBER, "walk", "--cycles", "1000000", "--on", way, "--out", "o"]
    record = tmp_path / "o" / "cycles.csv"
    with started(command, cwd=tmp_path, stdout=subprocess.PIPE) as walk:
        until(
            lambda: walk.poll() is not None or (record.exists() and record.stat().st_size > 400),
            "it walks",
        )
        walk.send_signal(signal.SIGINT)
        output = walk.communicate(timeout=DEADLINE_S)[0].decode()
    assert walk.returncode == 130, output
    assert "the table is in o/table.npz" in output
    summary = json.loads((tmp_path / "o" / SUMMARY).read_text())
    assert not summary["complete"]
    assert summary["cycles"] >= 1
    assert load_table(tmp_path / "o" / TABLE, Params())[0].visits.sum() > 100


@pytest.mark.slow
@pytest.mark.ros
def test_bench_measures_every_way(run: Run) -> None:
    """A small one: every figure is there and positive; none is judged."""
    run("bench", "--cycles", 4, "--repeats", 1, "--train-cycles", 5, "--epochs", 20)
    found = json.loads(Path("out/bench/bench.json").read_text())
    ways = {"physics", "loop", "loop, recorded", "graph", "graph, with a bag", "processes"}
    assert set(found["ticks_per_s"]) == ways
    assert min(found["ticks_per_s"].values()) > 0
    assert found["us_per_tick"]["message conversion"] > 0
    page = Path("out/bench/bench.md").read_text()
    assert "| seven processes |" in page
    for world in ("trainer", "walker"):
        assert min(found["learning"][world].values()) > 0
        assert f"| learning on the {world}: ember / plain |" in page
