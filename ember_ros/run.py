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

import contextlib
import fcntl
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.run_writer import RunWriter
from ember_ros.bag.storage import BagOptions, make_folder, seal
from ember_ros.bag.writer_process import WriterProcess
from ember_ros.errors import ParameterError, StoppedError, no_ros
from ember_ros.params import as_dict, params_sha256
from ember_ros.report.run_statistics import (
    BODY,
    CYCLES,
    MEASURED,
    TRACES,
    RunRecord,
    RunStatistics,
    load_record,
    save_record,
)
from ember_ros.run_config import RunConfig
from ember_ros.spinning import prepare_environment
from ember_ros.versions import provenance, versions
from leg_node.journal import ENDINGS
from leg_node.table import Table
from leg_node.table_file import load_table, save_table

BACKENDS = ("loop", "graph", "processes")
CHECKPOINT_S = 5.0
"""Wall time between two savings of what the loop has learnt: what ``kill -9`` can cost."""
EARLIER, PART = ".earlier", ".earlier.part"
"""Where an earlier run in the same folder lies until the new one has begun; and while it is on its
way there or back."""
TABLE, SUMMARY, PICTURE = "table.npz", "summary.json", "run.png"
LEFT = (SUMMARY, CYCLES, MEASURED, TRACES, PICTURE, *(TABLE + e for e in ENDINGS), TABLE)
"""What a run leaves in its folder, and the next one there replaces."""

GoOn = Callable[[int, int], bool]
"""Told now and then of cycles done and falls; says whether to go on."""


def run(
    config: RunConfig,
    way: str,
    out: Path,
    go_on: GoOn,
    command: str,
    bag: BagOptions | None = None,
    namespace: str = "",
    replace: bool = True,
) -> tuple[RunRecord, dict[str, Any]]:
    """Run a plan to its end, or until ``go_on`` says no, and write what came of it.

    Writes ``table.npz``, ``cycles.csv``, ``traces.npy`` and ``summary.json`` into ``out``. An
    earlier run there is replaced once this one has begun, and is as it was if it cannot begin.

    Args:
        config: what to run.
        way: one of ``BACKENDS``.
        out: a folder, made if need be.
        go_on: progress and stop.
        command: what was typed, for the summary.
        bag: where to record the run to; nowhere for None.
        namespace: of all nodes, and of the robot in the bag.
        replace: whether an earlier run in ``out`` may be replaced.

    Returns:
        The record and the summary.

    Raises:
        EmberError: a parameter, the table or the graph is not as it should be, or another run
            is writing into ``out``.
    """
    where = provenance()
    # Before anything starts: say what is wrong with it.
    start = load_table(config.table, config.params)[0].sha256() if config.table else None
    if bag is not None and bag.folder.absolute() == out.absolute():
        raise ParameterError(f"{out} is to hold the run; another folder would be right for the bag")
    if bag is not None:
        make_folder(bag.folder)  # say what is wrong with it before anything is replaced
        bag.folder.rmdir()
    _make(out)
    with _alone_in(out):
        if not replace:
            _refuse(out)
        return _run(config, way, out, go_on, command, bag, namespace, where, start)


def save_run(
    config: RunConfig,
    out: Path,
    record: RunRecord,
    table: Table,
    *,
    command: str,
    where: dict[str, str],
    start: str | None,
    replace: bool = False,
) -> dict[str, Any]:
    """Write a run of the direct loop that was kept in memory, as ``run`` would have left it.

    Args:
        config: what was run.
        out: a folder, made if need be.
        record: of the run.
        table: what was learnt.
        command: what was called, for the summary.
        where: ``versions.provenance`` of the run.
        start: SHA-256 of the table that it started from; None of an empty one.
        replace: whether an earlier run in ``out`` may be replaced.

    Returns:
        The summary.

    Raises:
        EmberError: the folder cannot be written, holds an earlier run, or another run is writing
            into it.
    """
    _make(out)
    summary = _summary(config, "loop", record, table.sha256(), command, where, start)
    with _alone_in(out):
        if not replace:
            _refuse(out)
        _set_aside(out, None)
        try:
            notes = {"cycle": config.start_cycle + summary["cycles"]}
            save_table(out / TABLE, table, config.params, config.seed, notes)
            _write_summary(out, summary)
            save_record(out, record)
        except OSError as error:
            _settle(out)
            raise ParameterError(f"cannot write into {out}: {error.strerror}") from error
        except BaseException:
            _settle(out)
            raise
        shutil.rmtree(out / EARLIER)
    return summary


def _make(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f"cannot make the folder {out}: {error.strerror}") from error


def refuse_to_replace(out: Path) -> None:
    """Hold that a run would replace nothing in a folder, of which there may be none yet.

    Raises:
        ParameterError: it holds what a run leaves, or another run is writing into it.
    """
    if not out.is_dir():
        return
    with _alone_in(out):
        _refuse(out)


def _refuse(out: Path) -> None:
    kept = [name for name in LEFT if (out / name).exists()]
    if kept:
        raise ParameterError(
            f"{out} holds an earlier run ({', '.join(kept)}); give another --out, or --force to "
            "replace it"
        )


def recover(out: Path) -> None:
    """Bring back what a run had set aside that was killed before its first cycle ended."""
    with contextlib.suppress(ParameterError, OSError), _alone_in(out):
        pass


@contextlib.contextmanager
def _alone_in(out: Path) -> Iterator[None]:
    """Hold a folder against other runs; the lock dies with its process.

    Raises:
        ParameterError: another run holds it.
    """
    folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ParameterError(
                f"another run is writing into {out}; give this one another --out"
            ) from None
        except OSError:  # a file system without locks
            pass
        _settle(out)
        yield
    finally:
        os.close(folder)


def _begun(out: Path) -> bool:
    """Return whether a run has ended its first cycle."""
    return (out / CYCLES).exists() and (out / CYCLES).read_bytes().count(b"\n") > 1


def _set_aside(out: Path, start: Path | None) -> None:
    """Set an earlier run's files aside, all or none; the table that is started from stays as well.

    Raises:
        ParameterError: the folder cannot be written, or holds a folder where a file will be.
    """
    part = out / PART
    try:
        part.mkdir()
        for name in LEFT:
            file = out / name
            if file.is_dir():
                raise ParameterError(
                    f"{file} is a folder, and a run writes a file of that name; another --out "
                    "would be right"
                )
            if file.exists():
                if name == TABLE and start is not None:
                    shutil.copy2(file, part / name)  # it may be the one to start from
                else:
                    file.replace(part / name)
        part.rename(out / EARLIER)
    except OSError as error:
        _settle(out)
        raise ParameterError(f"cannot write into {out}: {error.strerror}") from error
    except ParameterError:
        _settle(out)
        raise


def _settle(out: Path) -> None:
    """Bring what was set aside back if the run after it did not begin, or remove it if it did.

    It may be killed at any point and begun again: nothing is removed in ``out`` any more once the
    first file has come back.
    """
    aside, part = out / EARLIER, out / PART
    if aside.exists():
        if _begun(out):
            shutil.rmtree(aside)
            return
        for name in LEFT:
            (out / name).unlink(missing_ok=True)
        aside.rename(part)
    if part.exists():
        for file in part.iterdir():
            file.replace(out / file.name)
        part.rmdir()


def _run(
    config: RunConfig,
    way: str,
    out: Path,
    go_on: GoOn,
    command: str,
    bag: BagOptions | None,
    namespace: str,
    where: dict[str, str],
    start: str | None,
) -> tuple[RunRecord, dict[str, Any]]:
    if way != "loop":
        prepare_environment()
    ways = {"loop": _loop, "graph": _graph, "processes": _processes}
    _set_aside(out, config.table)
    earlier = any((out / EARLIER).iterdir())
    try:
        ways[way](config, out, go_on, bag, namespace)
    except BaseException:
        _settle(out)
        raise
    if earlier and config.cycles and not _begun(out):
        _settle(out)
        raise StoppedError(
            f"stopped before the first cycle ended; the earlier run in {out} is as it was"
        )
    shutil.rmtree(out / EARLIER)
    record = load_record(out)
    learnt = load_table(out / TABLE, config.params)[0].sha256()
    summary = _summary(config, way, record, learnt, command, where, start)
    if bag is not None:
        facts = {"planned_cycles": str(config.cycles)}
        # A graph that is stopped leaves open which legs had the last tick: then nobody can say
        # which table a replay must end with.
        if summary["complete"] or way == "loop":
            facts["table_sha256"] = summary["table_sha256"]
        seal(bag.folder, **facts)
    _write_summary(out, summary)
    return record, summary


def _summary(
    config: RunConfig,
    way: str,
    record: RunRecord,
    learnt: str,
    command: str,
    where: dict[str, str],
    start: str | None,
) -> dict[str, Any]:
    """Return what ``summary.json`` says; ``learnt`` and ``start`` are SHA-256 of tables."""
    return {
        "command": command,
        "on": way,
        "world": config.world,
        "policy": config.policy,
        "learning": config.learning,
        "seed": config.seed,
        "start_cycle": config.start_cycle,
        "planned_cycles": config.cycles,
        "start_table": str(config.table) if config.table else None,
        "start_table_sha256": start,
        **record.measured,
        "complete": len(record.traces) == config.cycles * config.params.gait.ticks,
        "table_sha256": learnt,
        "parts": as_dict(config.params)["parts"],
        "params_sha256": params_sha256(config.params),
        "versions": versions(),
        "provenance": where,
    }


def _write_summary(out: Path, summary: dict[str, Any]) -> None:
    (out / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _loop(
    config: RunConfig, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str
) -> None:
    from ember_ros.loop import Loop
    from ember_ros.observer import Observer

    loop = Loop(config)
    recorder = RunStatistics(config.params, config.legs, out)
    observers: list[Observer] = [recorder]
    writer, recording = None, None
    if bag is not None:
        writer = WriterProcess(bag)
        run_metadata = RunMetadata.of_config(config, loop.shared.table, versions())
        recording = RunWriter(writer, run_metadata, loop.shared.table, namespace=namespace)
        observers.append(recording)
    saved = time.monotonic()
    try:
        for cycle in range(config.cycles):
            if config.learning and time.monotonic() - saved >= CHECKPOINT_S:
                # All that was pushed, merged or not; it changes nothing in the run.
                notes = {"cycle": config.start_cycle + cycle}
                save_table(out / TABLE, loop.shared.preview(), config.params, config.seed, notes)
                saved = time.monotonic()
            if not go_on(cycle, loop.world.body().falls):
                break
            for _ in range(config.params.gait.ticks):
                loop.tick(*observers)
        if writer is not None and recording is not None:
            recording.finish()
            writer.close()
    finally:
        notes = {"cycle": config.start_cycle + loop.now // config.params.gait.ticks}
        save_table(out / TABLE, loop.finish(), config.params, config.seed, notes)
        recorder.finish(loop.world.observe(), loop.world.body())
        if writer is not None:
            writer.abandon()  # nothing, if it was closed
        loop.close()


def _graph(
    config: RunConfig, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str
) -> None:
    try:
        from ember_ros.graph import Graph

        graph = Graph(config, out, bag=bag, namespace=namespace)
    except ModuleNotFoundError as error:
        raise no_ros(error) from error
    try:
        tally = _Progress(out / CYCLES)
        graph.run(lambda: go_on(*tally.read()))
    finally:
        graph.close()


def _processes(
    config: RunConfig, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str
) -> None:
    need_ros()  # say it here, not in seven logs
    from ember_ros.graph import processes

    tally = _Progress(out / CYCLES)
    with processes(config, out, bag=bag, namespace=namespace) as running:
        running.wait(lambda: go_on(*tally.read()))


def need_ros() -> None:
    """Import ROS, for the sake of the error.

    Raises:
        ParameterError: it is not here.
    """
    try:
        import rclpy  # noqa: F401
    except ModuleNotFoundError as error:
        raise no_ros(error) from error


class _Progress:
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
