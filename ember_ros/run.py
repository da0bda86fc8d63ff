"""Run a plan in one of three ways, and leave the same files behind.

========  ==============================================
way       what runs
========  ==============================================
loop      no ROS: the direct loop
graph     all nodes in this process
processes one process a node, as seven ``ros2 run`` would
========  ==============================================
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ember_ros.bag.card import Card
from ember_ros.bag.recording import Recording
from ember_ros.bag.scribe import Scribe
from ember_ros.bag.storage import BagOptions, make_folder, seal
from ember_ros.errors import EmberError, ParameterError
from ember_ros.params import params_sha256
from ember_ros.plan import Plan
from ember_ros.report.recorder import (
    BODY,
    CYCLES,
    MEASURED,
    TRACES,
    Record,
    Recorder,
    load_record,
)
from ember_ros.versions import provenance, versions
from leg_node.journal import ENDINGS
from leg_node.table_file import load_table, save_table

WAYS = ("loop", "graph", "processes")
TABLE, SUMMARY, PICTURE = "table.npz", "summary.json", "run.png"

GoOn = Callable[[int, int], bool]
"""Told now and then of cycles done and falls; says whether to go on."""


def run(
    plan: Plan,
    way: str,
    out: Path,
    go_on: GoOn,
    command: str,
    bag: BagOptions | None = None,
    namespace: str = "",
) -> tuple[Record, dict[str, Any]]:
    """Run a plan to its end, or until ``go_on`` says no, and write what came of it.

    Writes ``table.npz``, ``cycles.csv``, ``traces.npy`` and ``summary.json`` into ``out``.

    Args:
        plan: what to run.
        way: one of ``WAYS``.
        out: a folder, made if need be.
        go_on: progress and stop.
        command: what was typed, for the summary.
        bag: where to record the run to; nowhere for None.
        namespace: of all nodes, and of the robot in the bag.

    Returns:
        The record and the summary.

    Raises:
        EmberError: a parameter, the table or the graph is not as it should be.
    """
    where = provenance()
    if plan.table:
        load_table(plan.table, plan.params)  # say what is wrong with it before anything starts
    if bag is not None:
        make_folder(bag.folder)  # say what is wrong with it before anything is replaced
        bag.folder.rmdir()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f"cannot make the folder {out}: {error.strerror}") from error
    old = [SUMMARY, CYCLES, MEASURED, TRACES, PICTURE, *(TABLE + ending for ending in ENDINGS)]
    if plan.table is None:
        old.append(TABLE)  # or the table node would go on from it
    for name in old:
        (out / name).unlink(missing_ok=True)
    {"loop": _loop, "graph": _graph, "processes": _processes}[way](plan, out, go_on, bag, namespace)
    record = load_record(out)
    ticks = plan.cycles * plan.params.gait.ticks
    summary = {
        "command": command,
        "on": way,
        "world": plan.world,
        "policy": plan.policy,
        "learning": plan.learning,
        "seed": plan.seed,
        "planned_cycles": plan.cycles,
        "start_table": str(plan.table) if plan.table else None,
        **record.measured,
        "complete": len(record.traces) == ticks,
        "table_sha256": load_table(out / TABLE, plan.params)[0].sha256(),
        "params_sha256": params_sha256(plan.params),
        "versions": versions(),
        "provenance": where,
    }
    if bag is not None:
        facts = {"planned_cycles": str(plan.cycles)}
        # A graph that is stopped leaves open which legs had the last tick: then nobody can say
        # which table a replay must end with.
        if summary["complete"] or way == "loop":
            facts["table_sha256"] = summary["table_sha256"]
        seal(bag.folder, **facts)
    (out / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return record, summary


def _loop(plan: Plan, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str) -> None:
    from ember_ros.loop import Loop
    from ember_ros.observer import Observer

    loop = Loop(plan)
    recorder = Recorder(plan.params, plan.legs, out)
    observers: list[Observer] = [recorder]
    writer, recording = None, None
    if bag is not None:
        writer = Scribe(bag)
        card = Card.of_plan(plan, loop.shared.table, versions())
        recording = Recording(writer, card, loop.shared.table, namespace=namespace)
        observers.append(recording)
    try:
        for cycle in range(plan.cycles):
            if not go_on(cycle, loop.world.body().falls):
                break
            for _ in range(plan.params.gait.ticks):
                loop.tick(*observers)
        if writer is not None and recording is not None:
            recording.finish()
            writer.close()
    finally:
        save_table(out / TABLE, loop.finish(), plan.params, plan.seed)
        recorder.finish(loop.world.observe(), loop.world.body())
        if writer is not None:
            writer.abandon()  # nothing, if it was closed
        loop.close()


def _graph(plan: Plan, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str) -> None:
    try:
        from ember_ros.graph import Graph

        graph = Graph(plan, out, bag=bag, namespace=namespace)
    except ModuleNotFoundError as error:
        raise no_ros(error) from error
    try:
        tally = _Tally(out / CYCLES)
        graph.run(lambda: go_on(*tally.read()))
    finally:
        graph.close()


def _processes(plan: Plan, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str) -> None:
    try:
        import rclpy  # noqa: F401  say it here, not in seven logs

        from ember_ros.graph import processes
    except ModuleNotFoundError as error:
        raise no_ros(error) from error
    tally = _Tally(out / CYCLES)
    with processes(plan, out, bag=bag, namespace=namespace) as running:
        running.wait(lambda: go_on(*tally.read()))


def no_ros(error: ModuleNotFoundError) -> EmberError:
    """Return the error for a missing ROS; one of our own that is missing is raised as it is."""
    if error.name and error.name.split(".")[0] in ("ember_ros", "leg_node", "sim_node", "cpg_node"):
        raise error
    return ParameterError(
        f"ROS 2 is not here ({error}): `pip install 'ember_ros[ros]'`, or source an installed "
        "Jazzy; `--on loop` needs none"
    )


class _Tally:
    """Counts cycles and falls in a record that is growing."""

    EVERY_S = 0.1

    def __init__(self, file: Path) -> None:
        """Begin at the start of ``file``, which need not be there yet."""
        self._file, self._at, self._next = file, 0, 0.0
        self._cycles = self._falls = 0

    def read(self) -> tuple[int, int]:
        """Return cycles and falls so far."""
        now = time.monotonic()
        if now >= self._next and self._file.exists():
            self._next = now + self.EVERY_S
            with self._file.open("rb") as file:
                file.seek(self._at)
                fresh = file.read()
            whole = fresh[: fresh.rfind(b"\n") + 1]
            self._at += len(whole)
            for line in whole.decode().splitlines():
                cells = line.split(",")
                if cells[1] == BODY:
                    self._cycles += 1
                    self._falls += int(cells[-1])
        return self._cycles, self._falls
