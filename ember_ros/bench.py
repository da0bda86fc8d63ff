"""What a tick costs, and where: measured, never asserted.

All ways of running one and the same walk are measured in turn, over and over, so that a machine
that slows down slows all of them; what is quoted are medians, and ratios within one turn. The two
learners that come with the package are measured so too, by the CPU time of all threads together.
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

Say = Callable[[str], None]

LEARNERS: dict[str, tuple[str, ...]] = {"ember": (), "plain": ("plain",)}
"""The parameter files of each learner."""


class _Tape:
    """Keeps a run's signals, to be used again."""

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
        """Keep one tick."""
        asked = tuple(c for c in commands if c is not None)
        paid = tuple(t for t in transitions if t is not None)
        self.ticks.append((beat, tuple(senses), asked, paid))


def bench(
    params: Params, *, cycles: int, repeats: int, train_cycles: int, epochs: int, say: Say
) -> dict[str, Any]:
    """Measure everything and return it as plain numbers.

    Args:
        params: of the robot.
        cycles: of each measured walk.
        repeats: turns.
        train_cycles: of the training that is timed, and that the walks start from.
        epochs: pushed by four legs and pulled, to see what the table's memory does.
        say: told what is being measured.
    """
    with tempfile.TemporaryDirectory(prefix="ember_ros_bench_") as name:
        folder = Path(name)
        say(f"training {train_cycles} cycles by the loop")
        training_s = _train(params, train_cycles, folder / TABLE)
        config = RunConfig("walker", cycles, params=params, table=folder / TABLE)
        tape, falls = _tape(config)
        bags = itertools.count()
        ways: dict[str, Callable[[], float]] = {
            "physics": lambda: _physics(config, tape),
            "loop": lambda: _loop(config, record=False),
            "loop, recorded": lambda: _loop(config, record=True),
            "graph": lambda: _graph(config, None),
            "graph, with a bag": lambda: _graph(config, folder / f"bag{next(bags)}"),
            "processes": lambda: _processes(config, folder / "processes"),
            "conversion": lambda: _conversion(config, tape),
        }
        times: dict[str, list[float]] = {way: [] for way in ways}
        for turn in range(repeats):
            for way, measure in ways.items():
                say(f"turn {turn + 1} of {repeats}: {way}")
                times[way].append(measure())
        say("learning: ember against plain")
        learning = _learning(train_cycles, cycles, repeats, folder)
    say(f"the table over {epochs} epochs")
    ticks = cycles * params.gait.ticks
    cost = {way: 1e6 * statistics.median(t) / ticks for way, t in times.items()}
    real_time = 1.0 / params.gait.tick_s

    def ratio(of: str, to: str) -> float:
        return statistics.median(b / a for a, b in zip(times[of], times[to], strict=True))

    return {
        "cycles": cycles,
        "repeats": repeats,
        "falls": falls,
        "ticks_per_s": {way: 1e6 / us for way, us in cost.items() if way != "conversion"},
        "loop_of_physics": ratio("loop", "physics"),
        "graph_of_loop": ratio("graph", "loop, recorded"),
        "bag_costs": 1.0 - ratio("graph, with a bag", "graph"),
        "processes_times_real_time": 1e6 / cost["processes"] / real_time,
        "us_per_tick": {
            "physics": cost["physics"],
            "sensing and learning": cost["loop"] - cost["physics"],
            "a line a cycle": cost["loop, recorded"] - cost["loop"],
            "message conversion": cost["conversion"],
            "executor and transport": cost["graph"] - cost["loop, recorded"] - cost["conversion"],
        },
        "learning": learning,
        "training_cycles": train_cycles,
        "training_s": training_s,
        "table": _table_memory(params, epochs),
        "versions": versions(),
        "provenance": provenance(),
    }


def _train(params: Params, cycles: int, file: Path) -> float:
    config = RunConfig("trainer", cycles, params=params)
    loop, recorder = Loop(config), RunStatistics(params, config.legs)
    began = time.perf_counter()
    for _ in range(config.cycles * params.gait.ticks):
        loop.tick(recorder)
    took = time.perf_counter() - began
    save_table(file, loop.finish(), params, config.seed)
    loop.close()
    return took


def _learning(
    train_cycles: int, cycles: int, repeats: int, folder: Path
) -> dict[str, dict[str, float]]:
    """Return the CPU time of a tick of the loop, us, by world and learner, and their ratio.

    Legs of a walker start from what a leg with the same learner was trained to.
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
    found: dict[str, dict[str, float]] = {}
    for world in WORLDS:
        ember, plain = (times[world, learner] for learner in LEARNERS)
        ticks = cycles * configs[world, "ember"].params.gait.ticks
        found[world] = {
            "ember_us": 1e6 * statistics.median(ember) / ticks,
            "plain_us": 1e6 * statistics.median(plain) / ticks,
            "ember_of_plain": statistics.median(a / b for a, b in zip(ember, plain, strict=True)),
        }
    return found


def _tape(config: RunConfig) -> tuple[_Tape, int]:
    tape, loop = _Tape(), Loop(config)
    for _ in range(config.cycles * config.params.gait.ticks):
        loop.tick(tape)
    falls = loop.world.body().falls
    loop.close()
    return tape, falls


def _physics(config: RunConfig, tape: _Tape) -> float:
    """Drive the motors as the loop did, and sense nothing."""
    world: Any = make_world(config.world, config.params, config.seed)
    began = time.perf_counter()
    for beat, _, commands, _ in tape.ticks:
        world.coast(beat, commands)
    took = time.perf_counter() - began
    world.close()
    return took


def _loop(
    config: RunConfig, *, record: bool, clock: Callable[[], float] = time.perf_counter
) -> float:
    loop = Loop(config)
    recorders = [RunStatistics(config.params, config.legs)] if record else []
    began = clock()
    for _ in range(config.cycles * config.params.gait.ticks):
        loop.tick(*recorders)
    took = clock() - began
    loop.close()
    return took


def _graph(config: RunConfig, bag: Path | None) -> float:
    graph = Graph(config, bag=BagOptions(bag) if bag else None)
    while not graph.sim.recorder.traces:  # up to the first tick: matching is not a tick's cost
        graph.spin_once()
    began = time.perf_counter()
    while not graph.sim.done:
        graph.spin_once()
    took = time.perf_counter() - began
    graph.close()
    return took


def _processes(config: RunConfig, out: Path) -> float:
    """Measure from the first whole cycle to the last: the start of seven Pythons is no tick."""
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
    (began, first), (ended, last) = marks[0], marks[-1]
    return (ended - began) * config.cycles / (last - first)


def _conversion(config: RunConfig, tape: _Tape) -> float:
    """Write and read every message of every tick, and send none."""
    gait = config.params.gait
    senses = [wire.SenseWire(leg, gait.tick_ns) for leg in config.legs]
    commands = [wire.CommandWire(leg, gait.tick_ns) for leg in config.legs]
    transitions = [wire.TransitionWire(leg, gait.tick_ns) for leg in config.legs]
    began = time.perf_counter()
    beats = wire.BeatWire(gait.tick_ns)
    for beat, felt, asked, paid in tape.ticks:
        ns = cdr.read_clock(cdr.pack_clock(felt[0].tick * gait.tick_ns), "clock")
        told = beats.pack(beat)
        beats.read(told)
        for sense_wire, command_wire, transition_wire, sense, command, did in zip(
            senses, commands, transitions, felt, asked, paid, strict=True
        ):
            joints, contact = sense_wire.pack(sense)
            tick, first = sense_wire.read_joints(joints)
            sense_wire.sense(tick, first, sense_wire.read_contact(contact)[1])
            beats.read(told)
            command_wire.read(command_wire.pack(command))
            transition_wire.read(transition_wire.pack(did))
    assert ns == (len(tape.ticks) - 1) * gait.tick_ns
    return time.perf_counter() - began


def _table_memory(params: Params, epochs: int) -> dict[str, int]:
    """Push and pull for many epochs as four legs do, and see what the table's memory does."""
    import tracemalloc

    cells = cells_sha256(params)
    shared = SharedTable(empty_table(params), legs=4, cells=cells, rate=params.walk.rate)
    ticks, size = params.gait.ticks, len(shared.table)
    early = max(1, epochs // 10)
    seen: dict[str, int] = {}
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
                seen[f"bytes_after_{epoch + 1}_epochs"] = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    return seen


def lines(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what was measured as pairs of a name and a figure with its unit."""
    rows = [(way, f"{rate:.0f} ticks/s") for way, rate in found["ticks_per_s"].items()]
    rows += [
        ("loop, of physics alone", f"{found['loop_of_physics']:.0%}"),
        ("graph in one process, of the loop", f"{found['graph_of_loop']:.0%}"),
        ("a bag takes of the graph's ticks/s", f"{found['bag_costs']:.1%}"),
        ("seven processes", f"{found['processes_times_real_time']:.1f} times real time"),
    ]
    rows += [(f"a tick: {part}", f"{cost:.0f} us") for part, cost in found["us_per_tick"].items()]
    rows += [
        (
            f"learning on the {world}: ember, of plain",
            f"{cost['ember_of_plain']:.0%} ({cost['ember_us']:.0f} against "
            f"{cost['plain_us']:.0f} us of CPU a tick)",
        )
        for world, cost in found["learning"].items()
    ]
    rows.append((f"{found['training_cycles']} training cycles", f"{found['training_s']:.1f} s"))
    rows += [
        (f"shared table, {when.replace('_', ' ')}", f"{size / 1e6:.2f} MB")
        for when, size in found["table"].items()
    ]
    return rows


def page(found: dict[str, Any], command: str) -> str:
    """Return what was measured as a Markdown page."""
    head = [
        "# What a tick costs",
        "",
        f"Made by `{command}`: one walk of {found['cycles']} cycles with a trained table, still "
        f"learning ({found['falls']} falls), run in all ways in turn, {found['repeats']} turns; "
        "medians, and ratios within one turn. Loop and graph are compared as `ember` runs them, "
        "with their record. Versions: "
        + ", ".join(f"{name} {number}" for name, number in found["versions"].items())
        + f". On {found['provenance']['cpu']}, {found['provenance']['date']}.",
        "",
        "| what | figure |",
        "|---|---|",
    ]
    return "\n".join([*head, *(f"| {name} | {figure} |" for name, figure in lines(found))]) + "\n"


def write(found: dict[str, Any], out: Path, command: str) -> list[str]:
    """Write the page and the numbers into a folder, and return the names of the files."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "bench.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    (out / "bench.md").write_text(page(found, command), encoding="utf-8")
    return ["bench.md", "bench.json"]
