"""Processes that are started here: they import our modules alone, and are not left behind."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ember_ros.children import child_command, module_command
from ember_ros.params import Params
from ember_ros.run import SUMMARY, TABLE
from leg_node.table_file import load_table
from support.command import EMBER, child, started
from support.waiting import DEADLINE_S, until

FOREVER = "1000000"
HARD_OF_HEARING = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("deaf", flush=True)
signal.sigtimedwait([signal.SIGUSR1], 1.5)
signal.signal(signal.SIGINT, lambda *_: sys.exit(7))
while True:
    signal.pause()
"""


def named(folder: Path) -> list[int]:
    """Return the processes in whose command a folder stands."""
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if str(folder).encode() in file.read_bytes():
                found.append(int(file.parent.name))
        except OSError:
            continue  # it ended while it was looked for
    return found


# -- what they import --------------------------------------------------------------------------


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """Return a folder whose modules have the names of ours, of others and of Python's own."""
    names = ("yaml", "json", "runpy", "socket", "pickle", "random", "rosbags", "mcap")
    for name in (*names, "leg_node", "sim_node", "ember_ros"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('{name} of the user')\n")
    return tmp_path


def test_a_process_imports_nothing_of_the_working_directory(hostile: Path) -> None:
    """Neither for Python's own modules nor for ours; arguments reach it."""
    command = [*module_command("ember_ros.bag.writer_process"), '["bag", 0.0, 0.0]']
    (hostile / "bag").mkdir()
    done = child(command, cwd=hostile, env={**os.environ})
    assert (done.returncode, done.stdout, done.stderr) == (0, "ready\n", "")
    assert (hostile / "bag" / "metadata.yaml").is_file()


@pytest.mark.skipif(sys.version_info < (3, 11), reason="multiprocessing starts its own Python")
def test_workers_import_nothing_of_the_working_directory(hostile: Path) -> None:
    """Experiments' workers, and what looks after their semaphores."""
    folder = hostile / "program"
    folder.mkdir()
    (folder / "run.py").write_text(
        "from ember_ros.experiments import runner\n"
        "if __name__ == '__main__':\n"
        "    with runner.workers() as (pool, _):\n"
        "        print(pool.submit(runner.cost, runner.Trial('walker', 2, 0)).result())\n"
    )
    done = child([sys.executable, "program/run.py"], cwd=hostile, env={**os.environ})
    assert (done.returncode, done.stdout, done.stderr) == (0, "6\n", "")


# -- how they end ------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_child_ends_when_its_input_does(tmp_path: Path) -> None:
    """A signal that is sent while nobody listens yet is sent again."""
    (tmp_path / "hard_of_hearing.py").write_text(HARD_OF_HEARING)
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    with started(
        child_command("hard_of_hearing"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    ) as deaf:
        assert deaf.stdout is not None
        assert select.select([deaf.stdout], [], [], DEADLINE_S)[0], "it does not start"
        assert deaf.stdout.readline() == b"deaf\n"
        assert deaf.stdin is not None
        deaf.stdin.close()
        assert deaf.wait(DEADLINE_S) == 7


@pytest.fixture
def out(tmp_path: Path) -> Iterator[Path]:
    """Return the folder of a run, of which nothing is left in the end."""
    yield tmp_path / "run"
    for process in named(tmp_path):
        os.kill(process, signal.SIGKILL)


def saved(out: Path) -> bool:
    """Return whether a table is there that was learnt."""
    return bool(load_table(out / TABLE, Params())[0].visits.sum() > 100)


def walking(out: Path) -> bool:
    """Return whether some cycles were written down."""
    record = out / "cycles.csv"
    return record.exists() and record.stat().st_size > 400


@pytest.mark.ros
@pytest.mark.slow
def test_nodes_end_with_the_process_that_started_them(out: Path) -> None:
    """``kill -9`` of ``ember`` leaves nobody behind, and what was learnt in the table's file."""
    command = [*EMBER, "walk", "--cycles", FOREVER, "--on", "processes", "--out", str(out)]
    with started(command, stdout=subprocess.DEVNULL) as ember:
        until(lambda: walking(out) or ember.poll() is not None, "it walks")
        assert len(named(out)) > 4
        ember.kill()
    until(lambda: not named(out), "all have ended")
    assert saved(out)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["loop", "graph", "processes"])
def test_a_closed_terminal_ends_a_run_as_ctrl_c_does(out: Path, way: str) -> None:
    """The kernel sends SIGHUP, and nothing can be written any more: saved, 130, nobody left."""
    ours, terminal = pty.openpty()
    command = [*EMBER, "walk", "--cycles", FOREVER, "--on", way, "--out", str(out)]
    # A session of its own, whose terminal this is: setsid, and the first terminal that is opened.
    opened = f"exec setsid -c {' '.join(command)}"
    with started(["sh", "-c", opened], stdin=terminal, stdout=terminal, stderr=terminal) as ember:
        os.close(terminal)
        os.set_blocking(ours, False)

        def watched() -> bool:
            with contextlib.suppress(BlockingIOError):
                os.read(ours, 1 << 16)
            return walking(out) or ember.poll() is not None

        until(watched, "it walks")
        os.close(ours)
        assert ember.wait(DEADLINE_S) == 130
    assert saved(out)
    assert (out / SUMMARY).is_file()
    until(lambda: not named(out), "all have ended")


@pytest.mark.slow
def test_a_run_below_nohup_goes_on(out: Path) -> None:
    """A SIGHUP that was ignored from the start is none."""
    command = ["nohup", *EMBER, "walk", "--cycles", "40", "--on", "loop", "--out", str(out)]
    with started(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as ember:
        until(lambda: walking(out) or ember.poll() is not None, "it walks")
        ember.send_signal(signal.SIGHUP)
        assert ember.wait(DEADLINE_S) == 0
    assert '"complete": true' in (out / SUMMARY).read_text()


def test_a_process_that_hangs_when_it_ends_exits_with_its_code() -> None:
    """Nothing is left to save then; who started it is not kept waiting."""
    code = (
        "import threading; from ember_ros import spinning; spinning.SHUTDOWN_S = 0.1; "
        "spinning._exit_if_stuck(4); threading.Event().wait()"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=DEADLINE_S).returncode == 4
