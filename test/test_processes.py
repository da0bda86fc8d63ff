"""One process a node: the bits of the loop, and what happens when one of them is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.srv import GetParameters

from ember_ros import topics
from ember_ros.children import module_command
from ember_ros.entry_points import NODES
from ember_ros.errors import GraphError
from ember_ros.graph import Graph, Processes, node_options, processes
from ember_ros.name_lock import NAME_TAKEN, NameTakenError
from ember_ros.params import Params, as_dict, replace
from ember_ros.params_file import dump_params, load_params
from ember_ros.report.run_statistics import load_record
from ember_ros.run_config import RunConfig
from leg_node.table_file import load_table
from support.legs import LEGS
from support.robot import LEG_NODES, PATIENCE_S, level
from support.ros import Ros
from support.runs import Bits
from support.waiting import in_time

pytestmark = pytest.mark.slow

CYCLES = 20
TICKS = 32
FOREVER = 10**6
STOP_S = 20.0
"""Wall time in which a process that was asked to stop must have stopped."""


def wire_tick(message: Any) -> int:
    """Return the tick in the stamp of a message."""
    stamp = message.header.stamp
    return int((stamp.sec * 10**9 + stamp.nanosec) // Params().gait.tick_ns)


def walk(sync_every: int = 32, **options: Any) -> RunConfig:
    """Return a plan of a walker that learns."""
    params = replace(Params(), {"walk.sync_every": sync_every})
    return RunConfig("walker", CYCLES, params=params, **options)


# -- the same bits -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "config",
    [
        walk(sync_every=48, seed=4),
        walk(sync_every=1, seed=3),
        RunConfig("trainer", 2 * CYCLES, seed=5),
        RunConfig("walker", 4, seed=6, params=load_params("hexapod")),
    ],
    ids=["walker, the end within an epoch", "walker, one table for all", "trainer", "hexapod"],
)
def test_processes_end_with_the_bits_of_the_loop(
    ros: Ros, tmp_path: Path, by_loop: Callable[[RunConfig], Bits], config: RunConfig
) -> None:
    """Table, senses and commands are equal, bit for bit; nobody refuses anything or is late."""
    diagnostics = ros.messages(topics.DIAGNOSTICS, matched=False)

    go_on = in_time()

    def look_on() -> bool:
        ros.spin_once(0.0)
        return go_on()

    with processes(config, tmp_path, patience=PATIENCE_S) as running:
        running.wait(look_on)
    codes = {name: process.returncode for name, process in running.processes.items()}
    assert codes == dict.fromkeys(codes, 0)
    measured = load_record(tmp_path).measured
    table, about = load_table(tmp_path / "table.npz", config.params)
    expected = by_loop(config)
    assert table.sha256() == expected.table
    assert measured["senses_sha256"] == expected.senses
    assert measured["commands_sha256"] == expected.commands
    assert measured["falls"] == expected.falls
    assert not any(measured["absent_ticks"].values())
    assert about["seed"] == config.seed
    for log in (tmp_path / "log").iterdir():
        said = log.read_text()
        for word in ("refused", "Traceback", "error", "absent", "alone"):
            assert word not in said, f"{log.name}: {said}"
    assert not list(tmp_path.glob("table.npz.*"))
    assert all("absent" not in (s.message for s in m.status) for m in diagnostics)


def test_a_process_that_cannot_start_is_named_with_what_it_said(ros: Ros, tmp_path: Path) -> None:
    """A node that ends before its time is a GraphError with its name, code and last words."""
    running = Processes(walk(table=tmp_path / "none.npz"), tmp_path / "out")
    try:
        with pytest.raises(GraphError, match=r"table_node ended with code 2 .* there is no table"):
            running.wait(in_time())
    finally:
        running.stop()
    assert all(process.returncode is not None for process in running.processes.values())


# -- killed and restarted ----------------------------------------------------------------------


class Fleet:
    """The processes of a robot, each of which can be killed and started again."""

    def __init__(self, ros: Ros, config: RunConfig, out: Path, **options: dict[str, Any]) -> None:
        """Start all, with some options changed."""
        self._ros, self._out = ros, out
        self._params = out / "params.yaml"
        self._params.write_text(dump_params(config.params), encoding="utf-8")
        self.options = {
            name: {**given, **options.get(name, {})}
            for name, given in node_options(config, out).items()
        }
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.ended: list[tuple[str, int]] = []
        self.ticks: list[Any] = []
        self.diagnostics: list[Any] = []
        for name in self.options:
            self.start(name)
        self.clock = ros.messages(topics.CLOCK, matched=False)
        self.diagnostics = ros.messages(topics.DIAGNOSTICS, matched=False)

    def start(self, name: str) -> None:
        """Start a process as ``ros2 run`` would."""
        command = [sys.executable, "-m", NODES.get(name, NODES["leg_node"]), "--ros-args"]
        command += ["--params-file", str(self._params), "-r", f"__node:={name}"]
        for option, value in self.options[name].items():
            if value != "":
                command += ["-p", f"{option}:={json.dumps(value)}"]
        with self.log(name).open("ab") as log:
            self.processes[name] = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )

    def kill(self, name: str) -> None:
        """Kill a process with a signal that it cannot catch, or say goodbye to others."""
        self.processes[name].kill()
        assert self.processes[name].wait(STOP_S) == -signal.SIGKILL
        self._ros.killed.add(f"/{name}")

    def log(self, name: str) -> Path:
        """Return the file of what a node says."""
        return self._out / f"{name}.txt"

    def tick(self) -> int:
        """Return the last tick that was told."""
        if not self.clock:
            return -1
        stamp = self.clock[-1].clock
        return int((stamp.sec * 10**9 + stamp.nanosec) // Params().gait.tick_ns)

    def level(self, name: str) -> tuple[bytes, str]:
        """Return the level and the text of a part in the last diagnostics."""
        if not self.diagnostics:
            return b"", ""
        return level(self.diagnostics[-1], name)

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until a condition holds; nobody but who was killed may have ended."""
        self._ros.spin_until(condition, what)
        for name, process in self.processes.items():
            code = process.poll()
            assert code in (None, -signal.SIGKILL) or name == "sim_node", (
                f"{name} ended with {code}: {self.log(name).read_text()}"
            )

    def until_it_walks_on(self, ticks: int = 2 * TICKS) -> None:
        """Spin until some more ticks went by."""
        now = self.tick()
        self.until(lambda: self.tick() >= now + ticks, f"{ticks} more ticks")

    def until_all_are_present(self) -> None:
        """Spin until the whole robot walks."""
        self.until(
            lambda: (
                all(self.level(leg)[1] == "present" for leg in LEGS)
                and self.level("sim_node")[1] == "walking"
            ),
            "all legs are present",
        )
        self.until_it_walks_on()

    def stop(self) -> None:
        """Ask all to stop, the table last, and hold that they do so in good order."""
        groups = (["sim_node"], [n for n in self.processes if n.startswith("leg_")],
                  ["cpg_node", "table_node"])  # fmt: skip
        for group in groups:
            alive = [name for name in group if self.processes[name].poll() is None]
            for name in alive:
                self.processes[name].send_signal(signal.SIGINT)
            for name in alive:
                self.ended.append((name, self._end(name)))

    def _end(self, name: str) -> int:
        """Return how a process ended; if it did not, let it say in its log where it hangs."""
        process = self.processes[name]
        try:
            return process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)  # rclpy has faulthandler print where it is
            process.wait(STOP_S)
            raise AssertionError(f"{name} does not stop: {self.log(name).read_text()}") from None

    def kill_all(self) -> None:
        """Leave nothing behind, whatever went wrong."""
        for process in self.processes.values():
            if process.poll() is None:
                process.kill()
            process.wait(STOP_S)


@pytest.fixture(scope="module")
def fleet(ros_of_module: Ros, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """Let a robot walk for all tests below; each leaves it walking; in the end all stop well."""
    out = tmp_path_factory.mktemp("fleet")
    fleet = Fleet(
        ros_of_module, walk(seed=2), out, sim_node={"cycles": FOREVER, "patience": 1.0, "out": ""}
    )
    try:
        fleet.until_all_are_present()
        yield fleet
        fleet.stop()
        assert fleet.ended == [(name, 0) for name, _ in fleet.ended]
        for name in fleet.processes:
            assert "Traceback" not in fleet.log(name).read_text()
    finally:
        fleet.kill_all()


def test_a_leg_that_is_killed_is_absent_and_rejoins_when_it_is_started_again(fleet: Fleet) -> None:
    """The sim says who is absent and the others walk on; the new process is waited for again."""
    fleet.kill("leg_front_right")
    fleet.until(
        lambda: fleet.level("front_right") == (DiagnosticStatus.ERROR, "absent"), "it is absent"
    )
    assert fleet.level("sim_node")[0] == DiagnosticStatus.WARN
    fleet.until_it_walks_on()
    assert fleet.level("front_right") == (DiagnosticStatus.ERROR, "absent")
    assert {fleet.level(leg)[1] for leg in LEGS if leg != "front_right"} == {"present"}
    fleet.start("leg_front_right")
    fleet.until_all_are_present()


def test_a_cpg_that_is_killed_stops_the_world_and_is_taken_on_by_a_new_one(fleet: Fleet) -> None:
    """The world stands still and says so, for as long as it takes, and goes on at the same tick."""
    fleet.kill("cpg_node")
    fleet.until(
        lambda: fleet.level("sim_node") == (DiagnosticStatus.WARN, "no phase"), "there is no phase"
    )
    stopped, said = fleet.tick(), len(fleet.diagnostics)
    fleet.until(lambda: len(fleet.diagnostics) > said + 3, "diagnostics go on")
    assert fleet.tick() == stopped
    fleet.start("cpg_node")
    fleet.until(lambda: fleet.tick() > stopped, "the world goes on")
    assert fleet.tick() < stopped + 100 * TICKS
    fleet.until_all_are_present()


def test_legs_go_on_while_the_table_is_gone_and_come_back_to_it(
    fleet: Fleet, ros_of_module: Ros
) -> None:
    """Killed and started again, it has what it acknowledged, and gets what legs kept for it."""
    pull = ros_of_module.client(topics.PULL)

    def visits() -> int:
        answer = ros_of_module.call(pull, GetParameters.Request(names=["visits"]))
        return sum(answer.values[0].integer_array_value)

    before = visits()
    fleet.kill("table_node")
    went_on = fleet.tick()
    fleet.until_it_walks_on()
    fleet.start("table_node")
    fleet.until(
        lambda: "recovered after a crash" in fleet.log("table_node").read_text(),
        "the table takes up its store",
    )
    ros_of_module.node.destroy_client(pull)
    pull = ros_of_module.client(topics.PULL)
    fleet.until(
        lambda: all("the table is back" in fleet.log(f"leg_{leg}").read_text() for leg in LEGS),
        "every leg sees that the table is back",
    )
    fleet.until_it_walks_on()
    assert visits() >= before + 4 * (fleet.tick() - went_on - 4 * TICKS)
    ros_of_module.node.destroy_client(pull)
    fleet.until_all_are_present()


def test_a_sim_that_is_killed_and_started_again_begins_time_anew(fleet: Fleet) -> None:
    """Legs and CPG follow it to its first tick and walk on, with what they have learnt."""
    fleet.until(lambda: fleet.tick() > 4 * TICKS, "some cycles")
    fleet.kill("sim_node")
    fleet.start("sim_node")
    fleet.until(
        lambda: all("time restarted" in fleet.log(f"leg_{leg}").read_text() for leg in LEGS),
        "every leg notices",
    )
    heard = len(fleet.clock)
    fleet.until(lambda: len(fleet.clock) > heard + 2 * TICKS, "the new world walks")
    fleet.until_all_are_present()


def test_a_second_process_of_a_name_does_not_join(fleet: Fleet, tmp_path: Path) -> None:
    """Each kind of node, started by hand beside the robot: one line, 3, and the robot walks on."""
    fleet.until_all_are_present()
    given = {
        "sim_node": [],
        "cpg_node": [],
        "table_node": ["-p", f"save:={tmp_path / 'table.npz'}"],
        "leg_node": ["-p", "leg:=rear_left", "-r", "__node:=another_leg"],
    }
    seconds = {
        name: subprocess.Popen(
            [*module_command(NODES.get(name, NODES["leg_node"])), "--ros-args", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for name, arguments in given.items()
    }
    try:
        fleet.until(lambda: all(p.poll() is not None for p in seconds.values()), "all have ended")
    finally:
        for process in seconds.values():
            process.kill()
    for name, process in seconds.items():
        said, _ = process.communicate(timeout=STOP_S)
        first = "leg_rear_left" if name == "leg_node" else name
        elder = fleet.processes[first].pid
        assert process.returncode == NAME_TAKEN, said
        assert said.startswith("error: ")
        assert f" is taken by /{first} (process {elder}); " in said
        assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())
    fleet.until_all_are_present()


def test_a_second_run_is_refused_before_it_starts_anything(ros: Ros, tmp_path: Path) -> None:
    """It says who is there, and makes no folder; in another namespace it would be another robot."""
    with processes(walk(), tmp_path / "first", patience=PATIENCE_S) as first:
        with pytest.raises(NameTakenError, match=rf"/sim_node \(process {os.getpid()}\)"):
            Processes(walk(), tmp_path / "second")
        assert not (tmp_path / "second").exists()
        with pytest.raises(NameTakenError, match="/sim_node"):
            Graph(walk(), context=ros.context)
        with closing(Graph(walk(), context=ros.context, namespace="robot_2")):
            first.wait(in_time())
    assert load_record(tmp_path / "first").measured["cycles"] == CYCLES


def test_no_pair_is_lost_or_doubled_when_the_table_is_killed(ros: Ros, tmp_path: Path) -> None:
    """What was acknowledged lasts, the rest is said again: each tick is learnt exactly once."""
    cycles = 160  # so many that the world still walks when a table has started twice
    fleet = Fleet(
        ros,
        walk(seed=6),
        tmp_path,
        sim_node={"cycles": cycles, "patience": PATIENCE_S},
        table_node={"seed": 6},
    )
    try:
        fleet.until(lambda: fleet.tick() > TICKS, "the robot walks")
        for life in (1, 2):
            fleet.kill("table_node")
            fleet.start("table_node")
            fleet.until(
                lambda life=life: (
                    fleet.log("table_node").read_text().count("recovered after") == life
                ),  # type: ignore[misc]
                f"life {life + 1} of the table",
            )
            fleet.until_it_walks_on()
        fleet.until(lambda: fleet.processes["sim_node"].poll() is not None, "the last tick")
        fleet.stop()
        assert all(code == 0 for _, code in fleet.ended)
    finally:
        fleet.kill_all()
    measured = load_record(tmp_path).measured
    assert not any(measured["absent_ticks"].values())
    table, _ = load_table(tmp_path / "table.npz", walk().params)
    assert table.visits.sum() == 4 * (cycles * TICKS - 1 - measured["falls"])


@pytest.mark.parametrize("tick", [40, 90])
def test_nothing_learnt_is_lost_when_all_are_stopped_at_once(
    ros: Ros, tmp_path: Path, tick: int
) -> None:
    """Ctrl-C of ``ros2 launch``: the table serves until the legs have handed in, and all end soon.

    Soon is before launch sends a stronger signal.
    """
    config = walk(seed=6, policy="scripted")  # that never falls: a fall teaches nothing
    sim = {"cycles": FOREVER, "out": "", "patience": PATIENCE_S}  # who comes late has learnt less
    fleet = Fleet(ros, config, tmp_path, sim_node=sim)
    paid = {leg: ros.messages(topics.transition(leg), matched=False) for leg in LEGS}
    try:
        fleet.until(lambda: fleet.tick() > tick and all(paid.values()), "the robot walks")
        for process in fleet.processes.values():
            process.send_signal(signal.SIGINT)
        asked = time.monotonic()
        while any(process.poll() is None for process in fleet.processes.values()):
            ros.spin_once()
            assert time.monotonic() < asked + STOP_S
        codes = {name: process.returncode for name, process in fleet.processes.items()}
        assert codes == dict.fromkeys(codes, 0)
    finally:
        fleet.kill_all()
    for name in LEG_NODES:
        assert "lost" not in fleet.log(name).read_text()
    table, _ = load_table(tmp_path / "table.npz", walk().params)
    said = sum(wire_tick(heard[-1]) for heard in paid.values())
    # Of every tick but the first; what is learnt at the end of an epoch is said once it is pushed.
    assert 4 * tick <= said <= table.visits.sum() <= said + len(LEGS)


def test_the_parameter_file_of_a_run_holds_every_number() -> None:
    """What the processes are started with is the whole of the plan's parameters."""
    params = walk(sync_every=7).params
    content = yaml.safe_load(dump_params(params))
    assert content == {"/**": {"ros__parameters": as_dict(params)}}
