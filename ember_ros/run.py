"""Runs a ``RunConfig`` on one of three backends; all three write the same files.

=========  ===============================================
backend    what runs
=========  ===============================================
loop       the direct loop, without ROS
graph      all nodes in this process
processes  one process per node, as with seven ``ros2 run``
=========  ===============================================
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

from ember_ros import versions
from ember_ros.bag.run_metadata import RunMetadata
from ember_ros.bag.run_writer import RunWriter
from ember_ros.bag.storage import BagOptions, seal
from ember_ros.bag.storage import make_folder as make_bag_folder
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
from leg_node.assembly import BLIND
from leg_node.store import ENDINGS
from leg_node.table import Table
from leg_node.table_file import load_table, save_table

BACKENDS = ("loop", "graph", "processes")
CHECKPOINT_S = 5.0
"""Wall time between two checkpoints of the loop's table, s: the most that ``kill -9`` can lose."""
EARLIER, PART = ".earlier", ".earlier.part"
"""Folder that keeps an earlier run's files while a new one runs; and the folder while they are
moved there or back. See ``_move_aside``."""
TABLE, SUMMARY, PICTURE = "table.npz", "summary.json", "run.png"
OUTPUTS = (SUMMARY, CYCLES, MEASURED, TRACES, PICTURE, *(TABLE + e for e in ENDINGS), TABLE)
"""The files that a run writes into its folder, and that the next run there replaces."""

GoOn = Callable[[int, int], bool]
"""Called regularly with the cycles done and the falls; returns whether to continue."""


def learns_by_default(policy: str) -> bool:
    """Return whether the table changes in a run that does not say whether it learns.

    It does, unless the policy is one of those that choose without the table. A user's own policy
    may read the table, so it learns.
    """
    return policy not in BLIND


def run(
    config: RunConfig,
    backend: str,
    out: Path,
    go_on: GoOn,
    command: str,
    bag: BagOptions | None = None,
    namespace: str = "",
    replace: bool = True,
) -> tuple[RunRecord, dict[str, Any]]:
    """Run until all cycles are done or ``go_on`` returns False, and write the results.

    Each backend writes ``table.npz``, ``cycles.csv``, ``measured.json`` and ``traces.npy`` into
    ``out``; ``summary.json`` is written here. An earlier run there is replaced once the new one has
    finished a cycle; if the new one fails before, the earlier one is restored.

    Args:
        config: what to run.
        backend: one of ``BACKENDS``.
        out: a folder; created if it does not exist.
        go_on: receives the progress and can stop the run.
        command: the command line, for the summary.
        bag: the bag to record; None for none.
        namespace: of all nodes, and of the robot in the bag.
        replace: whether an earlier run in ``out`` may be replaced.

    Returns:
        The record and the summary.

    Raises:
        EmberError: a parameter, the table or the bag cannot be used, the graph fails, or another
            run is writing into ``out``.
    """
    provenance = versions.provenance()
    # Check all inputs before anything starts.
    start_sha256 = load_table(config.table, config.params)[0].sha256() if config.table else None
    if bag is not None and bag.folder.absolute() == out.absolute():
        raise ParameterError(f"{out} holds the run; another folder would be right for the bag")
    if bag is not None:
        # Only a check, before an earlier run is replaced: the backend makes the folder again.
        make_bag_folder(bag.folder)
        bag.folder.rmdir()
    _make_folder(out)
    with _locked(out):
        _restore_or_discard(out)
        if not replace:
            _refuse_existing_outputs(out)
        return _run_in_locked_folder(
            config, backend, out, go_on, command, bag, namespace, start_sha256, provenance
        )


def save_run(
    config: RunConfig,
    out: Path,
    record: RunRecord,
    table: Table,
    *,
    command: str,
    start_sha256: str | None,
    provenance: dict[str, str],
    replace: bool = False,
) -> dict[str, Any]:
    """Write a run of the direct loop from memory, with the same files as ``run``.

    Args:
        config: the configuration that was run.
        out: a folder; created if it does not exist.
        record: of the run.
        table: the table at the end.
        command: the call that ran it, for the summary.
        start_sha256: SHA-256 of the table at the start; None if it was empty.
        provenance: ``versions.provenance`` of the run.
        replace: whether an earlier run in ``out`` may be replaced.

    Returns:
        The summary.

    Raises:
        EmberError: the folder cannot be written, holds an earlier run, or another run is writing
            into it.
    """
    _make_folder(out)
    summary = _summary(
        config,
        "loop",
        record,
        command,
        start_sha256=start_sha256,
        end_sha256=table.sha256(),
        provenance=provenance,
    )
    with _locked(out):
        _restore_or_discard(out)
        if not replace:
            _refuse_existing_outputs(out)
        _move_aside(out, None)
        try:
            notes = {"cycle": config.start_cycle + summary["cycles"]}
            save_table(out / TABLE, table, config.params, config.seed, notes)
            _write_summary(out, summary)
            save_record(out, record)  # cycles.csv last: with it, the new run has its first cycle
        except OSError as error:
            _restore_or_discard(out)
            raise ParameterError(f"cannot write into {out}: {error.strerror}") from error
        except BaseException:
            _restore_or_discard(out)
            raise
        shutil.rmtree(out / EARLIER)
    return summary


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f"cannot create the folder {out}: {error.strerror}") from error


def refuse_to_replace(out: Path) -> None:
    """Check that a run would replace nothing in a folder; the folder need not exist.

    Raises:
        ParameterError: it holds files of an earlier run, or another run is writing into it.
    """
    if not out.is_dir():
        return
    with _locked(out):
        _restore_or_discard(out)
        _refuse_existing_outputs(out)


def _refuse_existing_outputs(out: Path) -> None:
    existing = [name for name in OUTPUTS if (out / name).exists()]
    if existing:
        raise ParameterError(
            f"{out} holds an earlier run ({', '.join(existing)}); give another --out, or --force "
            "to replace it"
        )


def recover(out: Path) -> None:
    """Restore the earlier run if a later one was killed before its first cycle ended.

    Does nothing if another run is writing into the folder; ignores errors of the file system.
    """
    with contextlib.suppress(ParameterError, OSError), _locked(out):
        _restore_or_discard(out)


@contextlib.contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Lock a folder against other runs; the kernel frees the lock when this process ends.

    An earlier process may have been killed here: first call ``_restore_or_discard``.

    Raises:
        ParameterError: another run holds the lock.
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
        yield
    finally:
        os.close(folder)


def _has_first_cycle(out: Path) -> bool:
    """Return whether ``cycles.csv`` holds the header and at least one row."""
    return (out / CYCLES).exists() and (out / CYCLES).read_bytes().count(b"\n") > 1


# What the hidden folders mean, and what `_restore_or_discard` makes of them after a kill:
#   neither                      the files in `out` belong to one run; they stay
#   .earlier.part                the earlier run is being moved there or back; it is moved back
#   .earlier, no finished cycle  the new run's files are removed, then the earlier run is moved back
#   .earlier, a finished cycle   the new run stays; .earlier is removed, as at the end of a run
def _move_aside(out: Path, start_table: Path | None) -> None:
    """Move the files of an earlier run into ``EARLIER``, all or none of them.

    ``EARLIER`` is made even if there was no earlier run; it is then empty.

    If the new run starts from a table, the table in ``out`` is copied instead of moved.

    Raises:
        ParameterError: ``out`` cannot be written, or a folder has the name of one of the files.
    """
    part = out / PART
    try:
        part.mkdir()
        for name in OUTPUTS:
            file = out / name
            if file.is_dir():
                raise ParameterError(
                    f"{file} is a folder, but a run writes a file of that name; another --out "
                    "would be right"
                )
            if file.exists():
                if name == TABLE and start_table is not None:
                    shutil.copy2(file, part / name)  # it may be the table to start from
                else:
                    file.replace(part / name)
        part.rename(out / EARLIER)
    except OSError as error:
        _restore_or_discard(out)
        raise ParameterError(f"cannot write into {out}: {error.strerror}") from error
    except ParameterError:
        _restore_or_discard(out)
        raise


def _restore_or_discard(out: Path) -> None:
    """Restore the earlier run if the new one has no finished cycle; otherwise discard the earlier.

    The process may be killed at any point and the function called again: nothing is removed from
    ``out`` once the first file has been restored.
    """
    aside, part = out / EARLIER, out / PART
    if aside.exists():
        if _has_first_cycle(out):
            shutil.rmtree(aside)
            return
        for name in OUTPUTS:
            (out / name).unlink(missing_ok=True)
        aside.rename(part)
    if part.exists():
        for file in part.iterdir():
            file.replace(out / file.name)
        part.rmdir()


def _run_in_locked_folder(
    config: RunConfig,
    backend: str,
    out: Path,
    go_on: GoOn,
    command: str,
    bag: BagOptions | None,
    namespace: str,
    start_sha256: str | None,
    provenance: dict[str, str],
) -> tuple[RunRecord, dict[str, Any]]:
    if backend != "loop":
        prepare_environment()
    runners = {"loop": _loop, "graph": _graph, "processes": _processes}
    _move_aside(out, config.table)
    had_earlier_run = any((out / EARLIER).iterdir())
    try:
        runners[backend](config, out, go_on, bag, namespace)
    except BaseException:
        _restore_or_discard(out)
        raise
    if had_earlier_run and config.cycles and not _has_first_cycle(out):
        _restore_or_discard(out)
        raise StoppedError(
            f"stopped before the first cycle ended; the earlier run in {out} is as it was before"
        )
    shutil.rmtree(out / EARLIER)
    record = load_record(out)
    summary = _summary(
        config,
        backend,
        record,
        command,
        start_sha256=start_sha256,
        end_sha256=load_table(out / TABLE, config.params)[0].sha256(),
        provenance=provenance,
    )
    if bag is not None:
        facts = {"planned_cycles": str(config.cycles)}
        # When a graph is stopped, some legs may have acted at the last tick and others not: the
        # table at the end of a replay is then unknown.
        if summary["complete"] or backend == "loop":
            facts["table_sha256"] = summary["table_sha256"]
        seal(bag.folder, **facts)
    _write_summary(out, summary)
    return record, summary


def _summary(
    config: RunConfig,
    backend: str,
    record: RunRecord,
    command: str,
    *,
    start_sha256: str | None,
    end_sha256: str,
    provenance: dict[str, str],
) -> dict[str, Any]:
    """Return the content of ``summary.json``; both SHA-256 are of tables."""
    return {
        "command": command,
        "on": backend,
        "world": config.world,
        "policy": config.policy,
        "learning": config.learning,
        "seed": config.seed,
        "start_cycle": config.start_cycle,
        "planned_cycles": config.cycles,
        "start_table": str(config.table) if config.table else None,
        "start_table_sha256": start_sha256,
        **record.measured,
        "complete": len(record.traces) == config.cycles * config.params.gait.ticks,
        "table_sha256": end_sha256,
        "parts": as_dict(config.params)["parts"],
        "params_sha256": params_sha256(config.params),
        "versions": versions.versions(),
        "provenance": provenance,
    }


def _write_summary(out: Path, summary: dict[str, Any]) -> None:
    (out / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _loop(
    config: RunConfig, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str
) -> None:
    from ember_ros.loop import Loop
    from ember_ros.observer import Observer

    loop = Loop(config)
    # Writes cycles.csv row by row, and measured.json and traces.npy at the end; `load_record` reads
    # them back.
    statistics = RunStatistics(config.params, config.legs, out)
    observers: list[Observer] = [statistics]
    writer, run_writer = None, None
    if bag is not None:
        writer = WriterProcess(bag)
        run_metadata = RunMetadata.of_config(config, loop.shared.table, versions.versions())
        run_writer = RunWriter(writer, run_metadata, loop.shared.table, namespace=namespace)
        observers.append(run_writer)
    saved = time.monotonic()
    try:
        for cycle in range(config.cycles):
            if config.learning and time.monotonic() - saved >= CHECKPOINT_S:
                # With all pushes, merged or not; the preview changes nothing in the run.
                notes = {"cycle": config.start_cycle + cycle}
                save_table(out / TABLE, loop.shared.preview(), config.params, config.seed, notes)
                saved = time.monotonic()
            if not go_on(cycle, loop.world.body().falls):
                break
            for _ in range(config.params.gait.ticks):
                loop.tick(*observers)
        if writer is not None and run_writer is not None:
            run_writer.finish()
            writer.close()
    finally:
        notes = {"cycle": config.start_cycle + loop.now // config.params.gait.ticks}
        save_table(out / TABLE, loop.finish(), config.params, config.seed, notes)
        statistics.finish(loop.world.observe(), loop.world.body())
        if writer is not None:
            writer.abandon()  # does nothing if the writer is closed
        loop.close()


def _graph(
    config: RunConfig, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str
) -> None:
    # The table_node writes the table into `out`, and the sim_node the record.
    try:
        from ember_ros.graph import Graph

        graph = Graph(config, out, bag=bag, namespace=namespace)
    except ModuleNotFoundError as error:
        raise no_ros(error) from error
    try:
        progress = _Progress(out / CYCLES)
        graph.run(lambda: go_on(*progress.read()))
    finally:
        graph.close()


def _processes(
    config: RunConfig, out: Path, go_on: GoOn, bag: BagOptions | None, namespace: str
) -> None:
    # The table_node writes the table into `out`, and the sim_node the record.
    need_ros()  # one error here instead of one in each of seven logs
    from ember_ros.graph import processes

    progress = _Progress(out / CYCLES)
    with processes(config, out, bag=bag, namespace=namespace) as running:
        running.wait(lambda: go_on(*progress.read()))


def need_ros() -> None:
    """Check that rclpy can be imported.

    Raises:
        ParameterError: it cannot.
    """
    try:
        import rclpy  # noqa: F401
    except ModuleNotFoundError as error:
        raise no_ros(error) from error


class _Progress:
    """Counts the cycles and falls in a ``cycles.csv`` while a run writes it."""

    PERIOD_S = 0.1  # wall time between two reads

    def __init__(self, file: Path) -> None:
        """Start at the beginning of ``file``, which need not exist yet."""
        self._file, self._offset, self._next_read = file, 0, 0.0
        self._cycles = self._falls = 0

    def read(self) -> tuple[int, int]:
        """Return cycles and falls so far."""
        now = time.monotonic()
        if now >= self._next_read and self._file.exists():
            self._next_read = now + self.PERIOD_S
            with self._file.open("rb") as file:
                file.seek(self._offset)
                new = file.read()
            complete = new[: new.rfind(b"\n") + 1]
            self._offset += len(complete)
            for line in complete.decode().splitlines():
                cells = line.split(",")
                if cells[1] == BODY:
                    self._cycles += 1
                    self._falls += int(cells[-1])
        return self._cycles, self._falls
