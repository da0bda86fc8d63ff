"""Measures the time of a tick in each mode of running, and its parts. No result is checked.

The same walk is run in all modes in turn, several times, so that a slow phase of the machine
affects all modes. Results are medians over the repeats, and ratios within one repeat. The two
learners of the package are compared in the same way, by the CPU time of all threads.
"""

from __future__ import annotations

import itertools
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ember_ros import cdr, wire
from ember_ros.bag.storage import BagOptions
from ember_ros.graph import Graph, processes
from ember_ros.loop import Loop
from ember_ros.params import Params, cells_sha256
from ember_ros.params_file import load_params
from ember_ros.report.run_statistics import RunStatistics
from ember_ros.run import TABLE
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, TDUpdate, Transition
from ember_ros.versions import provenance, versions
from ember_ros.worlds import WORLDS, make_world
from leg_node import calls
from leg_node.assembly import empty_table
from leg_node.shared import SharedTable, UpdateBatch
from leg_node.table_file import save_table

Report = Callable[[str], None]

LEARNERS: dict[str, tuple[str, ...]] = {"ember": (), "plain": ("plain",)}
"""Parameter files by learner."""


class _Recording:
    """Observer that keeps the signals of a run, to use them again."""

    def __init__(self) -> None:
        self.ticks: list[
            tuple[Beat, tuple[LegSense, ...], tuple[LegCommand, ...], tuple[Transition, ...]]
        ] = []

    def tick(
        self,
        beat: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[LegCommand | None],
        body: BodyState,
        transitions: Sequence[Transition | None],
    ) -> None:
        """Append one tick."""
        present_commands = tuple(c for c in commands if c is not None)
        present_transitions = tuple(t for t in transitions if t is not None)
        self.ticks.append((beat, tuple(senses), present_commands, present_transitions))


def bench(
    params: Params, *, cycles: int, repeats: int, train_cycles: int, epochs: int, report: Report
) -> dict[str, Any]:
    """Run all measurements.

    Args:
        params: parameters of the robot.
        cycles: length of each measured walk, cycles.
        repeats: how often each mode is measured.
        train_cycles: length of the timed training, whose table the walks start from.
        epochs: epochs in which four legs push to and pull from the shared table, to measure its
            memory.
        report: function to call with the name of the present measurement.

    Returns:
        The results as plain numbers by name, as in ``bench.json``.
    """
    with tempfile.TemporaryDirectory(prefix="ember_ros_bench_") as name:
        folder = Path(name)
        report(f"training {train_cycles} cycles by the loop")
        training_s = _train(params, train_cycles, folder / TABLE)
        config = RunConfig("walker", cycles, params=params, table=folder / TABLE)
        recording, falls = _record(config)
        bags = itertools.count()
        modes: dict[str, Callable[[], float]] = {
            "physics": lambda: _physics(config, recording),
            "loop": lambda: _loop(config, record=False),
            "loop, recorded": lambda: _loop(config, record=True),
            "graph": lambda: _graph(config, None),
            "graph, with a bag": lambda: _graph(config, folder / f"bag{next(bags)}"),
            "processes": lambda: _processes(config, folder / "processes"),
            "conversion": lambda: _conversion(config, recording),
        }
        times: dict[str, list[float]] = {mode: [] for mode in modes}
        for repeat in range(repeats):
            for mode, measure in modes.items():
                report(f"repeat {repeat + 1} of {repeats}: {mode}")
                times[mode].append(measure())
        report("learning: ember against plain")
        learning = _learning(train_cycles, cycles, repeats, folder)
    report(f"the table over {epochs} epochs")
    ticks = cycles * params.gait.ticks
    tick_us = {mode: 1e6 * statistics.median(t) / ticks for mode, t in times.items()}
    ticks_per_s = 1.0 / params.gait.tick_s

    def ratio(numerator: str, denominator: str) -> float:
        """Return the median over repeats of a ratio of ticks per second."""
        return statistics.median(
            b / a for a, b in zip(times[numerator], times[denominator], strict=True)
        )

    return {
        "cycles": cycles,
        "repeats": repeats,
        "falls": falls,
        "ticks_per_s": {mode: 1e6 / us for mode, us in tick_us.items() if mode != "conversion"},
        "loop_of_physics": ratio("loop", "physics"),
        "graph_of_loop": ratio("graph", "loop, recorded"),
        "bag_costs": 1.0 - ratio("graph, with a bag", "graph"),
        "processes_times_real_time": 1e6 / tick_us["processes"] / ticks_per_s,
        "us_per_tick": {
            "physics": tick_us["physics"],
            "sensing and learning": tick_us["loop"] - tick_us["physics"],
            "a line a cycle": tick_us["loop, recorded"] - tick_us["loop"],
            "message conversion": tick_us["conversion"],
            "executor and transport": tick_us["graph"]
            - tick_us["loop, recorded"]
            - tick_us["conversion"],
        },
        "learning": learning,
        "training_cycles": train_cycles,
        "training_s": training_s,
        "table": _table_memory(params, epochs),
        "versions": versions(),
        "provenance": provenance(),
    }


def _train(params: Params, cycles: int, file: Path) -> float:
    """Train, save the table, and return the wall time of the training, s."""
    config = RunConfig("trainer", cycles, params=params)
    loop, recorder = Loop(config), RunStatistics(params, config.legs)
    start = time.perf_counter()
    for _ in range(config.cycles * params.gait.ticks):
        loop.tick(recorder)
    duration = time.perf_counter() - start
    save_table(file, loop.finish(), params, config.seed)
    loop.close()
    return duration


def _learning(
    train_cycles: int, cycles: int, repeats: int, folder: Path
) -> dict[str, dict[str, float]]:
    """Return the CPU time per tick of the loop, us, by world and learner, and their ratio.

    The legs of the walker start from the table of a training with the same learner.
    """
    configs: dict[tuple[str, str], RunConfig] = {}
    for learner, files in LEARNERS.items():
        params, table = load_params(*files), folder / f"{learner}.npz"
        _train(params, train_cycles, table)
        configs["trainer", learner] = RunConfig("trainer", cycles, params=params)
        configs["walker", learner] = RunConfig("walker", cycles, params=params, table=table)
    times: dict[tuple[str, str], list[float]] = {each: [] for each in configs}
    for _ in range(repeats):
        for each, config in configs.items():
            times[each].append(_loop(config, record=False, clock=time.process_time))
    results: dict[str, dict[str, float]] = {}
    for world in WORLDS:
        ember, plain = (times[world, learner] for learner in LEARNERS)
        ticks = cycles * configs[world, "ember"].params.gait.ticks
        results[world] = {
            "ember_us": 1e6 * statistics.median(ember) / ticks,
            "plain_us": 1e6 * statistics.median(plain) / ticks,
            "ember_of_plain": statistics.median(a / b for a, b in zip(ember, plain, strict=True)),
        }
    return results


def _record(config: RunConfig) -> tuple[_Recording, int]:
    recording, loop = _Recording(), Loop(config)
    for _ in range(config.cycles * config.params.gait.ticks):
        loop.tick(recording)
    falls = loop.world.body().falls
    loop.close()
    return recording, falls


def _physics(config: RunConfig, recording: _Recording) -> float:
    """Return the wall time of the recorded commands without sensing, s."""
    world: Any = make_world(config.world, config.params, config.seed)
    start = time.perf_counter()
    for beat, _, commands, _ in recording.ticks:
        world.coast(beat, commands)
    duration = time.perf_counter() - start
    world.close()
    return duration


def _loop(
    config: RunConfig, *, record: bool, clock: Callable[[], float] = time.perf_counter
) -> float:
    loop = Loop(config)
    recorders = [RunStatistics(config.params, config.legs)] if record else []
    start = clock()
    for _ in range(config.cycles * config.params.gait.ticks):
        loop.tick(*recorders)
    duration = clock() - start
    loop.close()
    return duration


def _graph(config: RunConfig, bag: Path | None) -> float:
    graph = Graph(config, bag=BagOptions(bag) if bag else None)
    # Up to the first tick, because discovery and matching are not part of the time of a tick.
    while not graph.sim.recorder.traces:
        graph.spin_once()
    start = time.perf_counter()
    while not graph.sim.done:
        graph.spin_once()
    duration = time.perf_counter() - start
    graph.close()
    return duration


def _processes(config: RunConfig, out: Path) -> float:
    """Return the wall time of a run in seven processes, s.

    Extrapolated from the time between the first and the last finished cycle, so that the start of
    the processes is not included.
    """
    with processes(config, out) as running:
        marks: list[tuple[float, int]] = []

        def watch() -> bool:
            file = out / "cycles.csv"
            lines = file.read_bytes().count(b"\n") if file.exists() else 0
            done = max(0, lines - 1) // (len(config.legs) + 1)
            if done and (not marks or marks[-1][1] != done):
                marks.append((time.perf_counter(), done))
            return True

        running.wait(watch)
    (out / "cycles.csv").unlink()
    (start, first), (ended, last) = marks[0], marks[-1]
    return (ended - start) * config.cycles / (last - first)


def _conversion(config: RunConfig, recording: _Recording) -> float:
    """Return the wall time of writing and reading the messages of all ticks without sending, s."""
    gait = config.params.gait
    senses = [wire.SenseWire(leg, gait.tick_ns) for leg in config.legs]
    commands = [wire.CommandWire(leg, gait.tick_ns) for leg in config.legs]
    transitions = [wire.TransitionWire(leg, gait.tick_ns) for leg in config.legs]
    start = time.perf_counter()
    beats = wire.BeatWire(gait.tick_ns)
    for beat, tick_senses, tick_commands, tick_transitions in recording.ticks:
        ns = cdr.read_clock(cdr.pack_clock(tick_senses[0].tick * gait.tick_ns), "clock")
        beat_bytes = beats.pack(beat)
        beats.read(beat_bytes)
        for sense_wire, command_wire, transition_wire, sense, command, transition in zip(
            senses,
            commands,
            transitions,
            tick_senses,
            tick_commands,
            tick_transitions,
            strict=True,
        ):
            joints, contact = sense_wire.pack(sense)
            tick, first = sense_wire.read_joints(joints)
            sense_wire.sense(tick, first, sense_wire.read_contact(contact)[1])
            beats.read(beat_bytes)
            command_wire.read(command_wire.pack(command))
            transition_wire.read(transition_wire.pack(transition))
    assert ns == (len(recording.ticks) - 1) * gait.tick_ns
    return time.perf_counter() - start


def _table_memory(params: Params, epochs: int) -> dict[str, int]:
    """Return the bytes allocated by a shared table after pushes and pulls of four legs."""
    import tracemalloc

    cells = cells_sha256(params)
    shared = SharedTable(empty_table(params), legs=4, cells=cells, rate=params.walk.rate)
    ticks, size = params.gait.ticks, len(shared.table)
    early = max(1, epochs // 10)
    memory: dict[str, int] = {}
    tracemalloc.start()
    try:
        for epoch in range(epochs):
            for leg in range(4):
                start = 7919 * (4 * epoch + leg)
                updates = tuple(
                    TDUpdate(epoch * ticks + n, (start + 31 * n) % size, 1.0) for n in range(8)
                )
                push = UpdateBatch(leg, f"run{epoch // 1000}", epoch, cells, updates)
                shared.push(calls.read_push(calls.write_push(push)))
            for _ in range(4):
                shared.pull(shared.version, epoch)
            if epoch + 1 in (early, epochs):
                memory[f"bytes_after_{epoch + 1}_epochs"] = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    return memory


def lines(results: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the results as pairs of a name and a value with its unit."""
    rows = [(mode, f"{rate:.0f} ticks/s") for mode, rate in results["ticks_per_s"].items()]
    rows += [
        ("loop / physics alone", f"{results['loop_of_physics']:.0%}"),
        ("graph in one process / loop", f"{results['graph_of_loop']:.0%}"),
        ("ticks/s of the graph lost by recording a bag", f"{results['bag_costs']:.1%}"),
        ("seven processes", f"{results['processes_times_real_time']:.1f} times real time"),
    ]
    rows += [
        (f"time per tick, {part}", f"{us:.0f} us") for part, us in results["us_per_tick"].items()
    ]
    rows += [
        (
            f"learning on the {world}: ember / plain",
            f"{cost['ember_of_plain']:.0%} ({cost['ember_us']:.0f} against "
            f"{cost['plain_us']:.0f} us of CPU per tick)",
        )
        for world, cost in results["learning"].items()
    ]
    rows.append((f"{results['training_cycles']} training cycles", f"{results['training_s']:.1f} s"))
    rows += [
        (f"shared table, {when.replace('_', ' ')}", f"{size / 1e6:.2f} MB")
        for when, size in results["table"].items()
    ]
    return rows


def page(results: dict[str, Any], command: str) -> str:
    """Return the results as a Markdown page."""
    head = [
        "# Time of a tick",
        "",
        f"Made by `{command}`: one walk of {results['cycles']} cycles with a trained table, still "
        f"learning ({results['falls']} falls), run in each mode in turn, {results['repeats']} "
        "times; medians, and ratios within one repeat. Loop and graph are compared as `ember` runs "
        "them, with the statistics of each cycle. Versions: "
        + ", ".join(f"{name} {number}" for name, number in results["versions"].items())
        + f". On {results['provenance']['cpu']}, {results['provenance']['date']}.",
        "",
        "| measurement | value |",
        "|---|---|",
    ]
    return "\n".join([*head, *(f"| {name} | {value} |" for name, value in lines(results))]) + "\n"


def write(results: dict[str, Any], out: Path, command: str) -> list[str]:
    """Write the results as Markdown and JSON into a folder; return the file names."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "bench.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    (out / "bench.md").write_text(page(results, command), encoding="utf-8")
    return ["bench.md", "bench.json"]
