"""Attacks a running robot and measures how it recovers: ``ember chaos``.

Seven processes walk and learn. One fault after the other is injected, drawn from a seed: processes
are killed and started again, or stopped for a while; strangers publish on the robot's topics; its
services get requests that make no sense. After each fault the time until the robot is well again is
measured: all legs command the present tick, and the ticks go on.

What was learned is checked from outside: after every fault the table is saved, and the visits of no
cell may be fewer than before. At the end there may not be more updates in it than ticks in which
the legs can have learned.
"""

from __future__ import annotations

import itertools
import json
import random
import signal
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ember_ros import cdr, topics, wire
from ember_ros.errors import EmberError, SignalError
from ember_ros.graph import Processes
from ember_ros.params import cells_sha256
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, LegCommand, LegSense, TDUpdate
from ember_ros.versions import provenance
from leg_node.shared import UpdateBatch
from leg_node.table import Table
from leg_node.table_file import load_table

HEALTHY_TICKS = 16
"""Ticks with commands of all legs after which the robot is well again."""
FROZEN_S = 60.0
"""Wall time after a fault after which a robot that is not well again counts as frozen, s."""
PAUSE_S = (0.3, 1.5)
"""Wall time between two faults, s, from and to."""
DOWN_S = (0.0, 1.5)
"""Wall time that a killed process stays down, s, from and to."""
STOPPED_S = (0.2, 4.0)
"""Wall time that a stopped process stands still, s, from and to."""
FLOOD = 2000
"""Messages of a flood."""
ENDLESS = 10**7
"""Cycles of the walk: more than it can do."""

GoOn = Callable[[float, str], bool]
"""Called with the share of the time that has passed and the progress in words; returns whether to
continue."""


class Fault(NamedTuple):
    """One injected fault, and what it cost."""

    kind: str
    recovery_s: float | None
    """Wall time until the robot was well again; None if it was not within ``FROZEN_S``."""
    missed: int
    """Commands of single legs that were missing in the ticks of that time."""


class _Observer:
    """A node beside the robot: it measures health, and publishes as a stranger."""

    def __init__(self, config: RunConfig) -> None:
        import rclpy
        from rclpy.experimental.events_executor import EventsExecutor
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions

        self._context = rclpy.Context()
        rclpy.init(
            args=["--ros-args", "--log-level", "error"],
            context=self._context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node: Any = Node("chaos", context=self._context)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.tick_ns = config.params.gait.tick_ns
        self.legs = config.legs
        self.tick, self.ticks, self.commands = -1, 0, 0
        self._own: set[bytes] = set()  # what this node publishes as a stranger
        self._commanded: dict[str, int] = {}
        self._complete = 0  # ticks since the last reset with commands of all legs
        self._last_complete = -1
        topics.CLOCK.subscribe(self.node, self._on_clock, depth=1000)
        for leg in self.legs:
            topics.command(leg).subscribe(self.node, self._on_command(leg), depth=1000)
        self._publishers: dict[str, Any] = {}
        self.push, self.pull = topics.PUSH.call(self.node), topics.PULL.call(self.node)
        self._save = topics.SAVE.call(self.node)

    def _on_clock(self, data: bytes) -> None:
        if bytes(data) in self._own:
            return
        try:
            tick = cdr.read_clock(data, topics.CLOCK.name) // self.tick_ns
        except SignalError:
            return
        self.ticks += tick - self.tick if tick >= self.tick else tick + 1
        self.tick = tick

    def _on_command(self, leg: str) -> Callable[[bytes], None]:
        reader = wire.CommandWire(leg, self.tick_ns)

        def callback(data: bytes) -> None:
            if bytes(data) in self._own:
                return
            try:
                tick = reader.read(data).tick
            except SignalError:
                return
            if self._commanded.get(leg) == tick:
                return  # repeated
            self._commanded[leg] = tick
            self.commands += 1
            if (
                all(self._commanded.get(each) == tick for each in self.legs)
                and tick != self._last_complete
            ):
                self._last_complete = tick
                self._complete += 1

        return callback

    def publish(self, topic: topics.Topic, data: bytes) -> None:
        """Publish as a stranger on a topic of the robot."""
        if topic.name not in self._publishers:
            self._publishers[topic.name] = topic.publish(self.node)
            self.until(self._publishers[topic.name].get_subscription_count, 5.0)
        self._own.add(data)
        self._publishers[topic.name].publish(data)

    def stop_publishing(self) -> None:
        """Destroy all publishers: beside one of these no node of the robot would start again."""
        while self._publishers:
            self.node.destroy_publisher(self._publishers.popitem()[1])

    def spin(self, seconds: float) -> None:
        """Run the node's callbacks for some wall time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def until(self, condition: Callable[[], Any], timeout_s: float) -> float | None:
        """Spin until a condition holds; return the wall time, or None after the timeout."""
        start = time.monotonic()
        while not condition():
            if time.monotonic() - start > timeout_s:
                return None
            self._executor.spin_once(timeout_sec=0.02)
        return time.monotonic() - start

    def until_healthy(self, timeout_s: float = FROZEN_S) -> float | None:
        """Spin until all legs command tick after tick; return the wall time that it took."""
        self._complete = 0
        return self.until(lambda: self._complete >= HEALTHY_TICKS, timeout_s)

    def call(self, client: Any, request: Any, timeout_s: float = 10.0) -> Any:
        """Call a service; return its response, or None after the timeout."""
        future = client.call_async(request)
        if self.until(future.done, timeout_s) is None:
            client.remove_pending_request(future)
            return None
        return future.result()

    def save(self) -> bool:
        """Save the table with everything that it has acknowledged; return whether it was saved."""
        from std_srvs.srv import Trigger

        response = self.call(self._save, Trigger.Request())
        return response is not None and response.success

    def close(self) -> None:
        """Destroy the node and its context."""
        self._executor.remove_node(self.node)
        self.node.destroy_node()
        self._executor.shutdown()
        self._context.try_shutdown()


class Chaos:
    """One campaign of faults."""

    def __init__(self, config: RunConfig, out: Path, seed: int) -> None:
        """Start the robot.

        Args:
            config: what it runs; its cycles are not used.
            out: folder for the logs and the table.
            seed: of the faults.

        Raises:
            EmberError: the robot cannot be started.
        """
        self.config = RunConfig(
            config.world, ENDLESS, seed=config.seed, params=config.params, table=config.table
        )
        self._random = random.Random(seed)
        self.faults: list[Fault] = []
        self.ended: list[str] = []
        """Processes that ended by themselves, with their exit codes."""
        self.lost_cells = 0
        """Cells whose visits became fewer."""
        self._least: Any = None
        self._robot = Processes(self.config, out, patience=1.0)
        self._observer = _Observer(self.config)
        self.startup_s = self._observer.until_healthy(120.0)
        if self.startup_s is None:
            self.close()
            raise EmberError(f"the robot does not walk; its logs are in {out / 'log'}")

    # -- faults ------------------------------------------------------------------------------

    def _kinds(self) -> dict[str, Callable[[], None]]:
        """Return what injects a fault of each kind; it returns when the cause of it is over."""
        legs = [name for name in self._robot.processes if name.startswith("leg_")]
        kinds: dict[str, Callable[[], None]] = {}
        for name in ("sim_node", "cpg_node", "table_node"):
            kinds[f"kill {name}"] = lambda name=name: self._kill(name)  # type: ignore[misc]
            kinds[f"stop {name}"] = lambda name=name: self._stop(name)  # type: ignore[misc]
        kinds["kill leg_node"] = lambda: self._kill(self._random.choice(legs))
        kinds["stop leg_node"] = lambda: self._stop(self._random.choice(legs))
        kinds["kill two nodes"] = self._kill_two
        kinds["clock of a stranger"] = self._strange_clock
        kinds["messages of the future"] = self._future
        kinds["flood of old messages"] = self._flood
        kinds["rubbish on topics"] = self._rubbish
        kinds["rubbish to the table"] = self._bad_requests
        return kinds

    def _kill(self, *names: str) -> None:
        for name in names:
            self._robot.processes[name].kill()
        for name in names:
            self._robot.processes[name].wait()
        self._observer.spin(self._random.uniform(*DOWN_S))
        for name in names:
            self._robot.start(name)

    def _kill_two(self) -> None:
        self._kill(*self._random.sample(list(self._robot.processes), 2))

    def _stop(self, name: str) -> None:
        process = self._robot.processes[name]
        process.send_signal(signal.SIGSTOP)
        self._observer.spin(self._random.uniform(*STOPPED_S))
        process.send_signal(signal.SIGCONT)

    def _strange_clock(self) -> None:
        for _ in range(20):
            ahead = self._random.choice([1, 1, 2, 100, 10**8])
            ns = (self._observer.tick + ahead) * self._observer.tick_ns
            self._observer.publish(topics.CLOCK, cdr.pack_clock(ns))
            self._observer.spin(0.01)

    def _sense(self, tick: int) -> LegSense:
        hip, knee, speed = (self._random.uniform(-1.0, 1.0) for _ in range(3))
        return LegSense(
            tick, hip, knee, speed, speed, 9.0, 9.0, 0.1, 0.01, False, True, False
        )  # fmt: skip

    def _future(self) -> None:
        leg = self._random.choice(self._observer.legs)
        senses = wire.SenseWire(leg, self._observer.tick_ns)
        commands = wire.CommandWire(leg, self._observer.tick_ns)
        beats = wire.BeatWire(self._observer.tick_ns)
        for ahead in range(20):
            tick = self._observer.tick + 10 + 1000 * ahead
            joints, contact = senses.pack(self._sense(tick))
            self._observer.publish(topics.joint_states(leg), joints)
            self._observer.publish(topics.contact(leg), contact)
            self._observer.publish(topics.PHASE, beats.pack(Beat(tick, tick / 32)))
            self._observer.publish(
                topics.command(leg), commands.pack(LegCommand(tick, 1.0, 1.0, 1.0, 1.0))
            )
            self._observer.spin(0.01)

    def _flood(self) -> None:
        tick = max(0, self._observer.tick - 1000)
        topic, data = self._random.choice(
            [
                (topics.CLOCK, cdr.pack_clock(tick * self._observer.tick_ns)),
                (topics.PHASE, wire.BeatWire(self._observer.tick_ns).pack(Beat(tick, 0.0))),
            ]
        )
        for n in range(FLOOD):
            self._observer.publish(topic, data)
            if n % 50 == 0:
                self._observer.spin(0.0)

    def _rubbish(self) -> None:
        leg = self._random.choice(self._observer.legs)
        joints, contact = wire.SenseWire(leg, self._observer.tick_ns).pack(
            self._sense(self._observer.tick)._replace(knee=float("nan"))
        )
        own = (topics.joint_states, topics.contact, topics.command, topics.transition)
        some = [topics.PHASE, *(make(leg) for make in own)]
        for _ in range(200):
            rubbish = self._random.randbytes(self._random.choice([8, 100]))
            data = self._random.choice([joints, contact[:-9], cdr.ENCAPSULATION + rubbish])
            self._observer.publish(self._random.choice(some), data)
            # Fast DDS sends no more bytes than a message of a fixed size has.
            self._observer.publish(topics.CLOCK, cdr.ENCAPSULATION + rubbish[:8])
            self._observer.spin(0.001)

    def _bad_requests(self) -> None:
        from rcl_interfaces.srv import GetParameters

        from leg_node import calls

        cells = cells_sha256(self.config.params)
        update = TDUpdate(0, 0, 0.0)
        bad = UpdateBatch(0, "chaos", 0, cells, (update,))
        for request in (
            calls.write_push(bad._replace(cells_sha256="0" * 64)),
            calls.write_push(bad._replace(leg=99)),
            calls.write_push(bad._replace(epoch=-1)),
            calls.write_push(bad._replace(updates=(update._replace(cell=10**9),))),
            calls.write_push(bad._replace(updates=(update._replace(target=float("inf")),))),
            calls.write_push(bad._replace(updates=(update,) * 10_000)),
        ):
            response = self._observer.call(self._observer.push, request)
            if response is not None and response.result.successful:
                raise EmberError("the table took a push that makes no sense")
        for names in (["values"] * 3000, ["x" * 100_000], [f"since={2**70}"]):
            self._observer.call(self._observer.pull, GetParameters.Request(names=names))

    # -- the campaign ------------------------------------------------------------------------

    def run(self, seconds: float, go_on: GoOn = lambda share, text: True) -> None:
        """Inject faults for some wall time, each kind in turn, in an order drawn anew each time."""
        kinds = self._kinds()
        begin = time.monotonic()
        for name in itertools.chain.from_iterable(self._orders(list(kinds))):
            passed = time.monotonic() - begin
            frozen = sum(fault.recovery_s is None for fault in self.faults)
            text = f"{len(self.faults)} faults, {frozen} freezes; now: {name}"
            if passed > seconds or not go_on(passed / seconds, text):
                return
            self._observer.spin(self._random.uniform(*PAUSE_S))
            ticks, commands = self._observer.ticks, self._observer.commands
            kinds[name]()
            self._observer.stop_publishing()
            recovery = self._observer.until_healthy()
            missed = len(self._observer.legs) * (self._observer.ticks - ticks) - (
                self._observer.commands - commands
            )
            self.faults.append(Fault(name, recovery, max(0, missed)))
            self._check_processes()
            if recovery is None:
                self._kill(*self._robot.processes)
                self._observer.until_healthy()
            self._check_table()

    def _orders(self, names: list[str]) -> Iterator[list[str]]:
        while True:
            self._random.shuffle(names)
            yield names

    def _check_processes(self) -> None:
        """Record processes that ended by themselves, and start them again."""
        for name, process in self._robot.processes.items():
            code = process.poll()
            if code is not None:
                self.ended.append(f"{name}: {code}")
                self._robot.start(name)

    def _check_table(self) -> None:
        """Count the cells whose visits became fewer since the last check."""
        if not self._observer.save():
            return
        visits = self._table().visits
        if self._least is not None:
            self.lost_cells += int((visits < self._least).sum())
        self._least = visits

    def _table(self) -> Table:
        return load_table(self._robot.out / "table.npz", self.config.params)[0]

    def close(self) -> None:
        """Stop the robot and the observer."""
        self._observer.close()
        self._robot.stop()

    def results(self) -> dict[str, Any]:
        """Stop the robot and return the measures of the campaign."""
        self._observer.spin(0.5)
        self.close()
        table = self._table()
        start = 0
        if self.config.table is not None:
            start = int(load_table(self.config.table, self.config.params)[0].visits.sum())
        fewer = 0 if self._least is None else int((table.visits < self._least).sum())
        by_kind: dict[str, dict[str, Any]] = {}
        for kind in sorted({fault.kind for fault in self.faults}):
            faults = [fault for fault in self.faults if fault.kind == kind]
            times = [fault.recovery_s for fault in faults if fault.recovery_s is not None]
            by_kind[kind] = {
                "faults": len(faults),
                "freezes": len(faults) - len(times),
                "median_s": round(statistics.median(times), 2) if times else None,
                "worst_s": round(max(times), 2) if times else None,
                "missed_commands": sum(fault.missed for fault in faults),
            }
        return {
            "faults": len(self.faults),
            "freezes": sum(fault.recovery_s is None for fault in self.faults),
            "ended_by_themselves": self.ended,
            "startup_s": None if self.startup_s is None else round(self.startup_s, 2),
            "kinds": by_kind,
            "cells_with_fewer_visits": self.lost_cells + fewer,
            "learned": int(table.visits.sum()) - start,
            "learned_at_most": self._observer.ticks * len(self._observer.legs),
            "ticks": self._observer.ticks,
        }


def chaos(
    config: RunConfig, out: Path, *, minutes: float, seed: int, go_on: GoOn, command: str
) -> dict[str, Any]:
    """Attack a robot for some minutes; return what it cost.

    Args:
        config: what the robot runs.
        out: folder for its logs and its table.
        minutes: wall time of the campaign.
        seed: of the faults.
        go_on: is called before every fault.
        command: that makes these results.

    Raises:
        EmberError: the robot cannot be started.
    """
    campaign = Chaos(config, out, seed)
    try:
        campaign.run(60.0 * minutes, go_on)
    except BaseException:
        campaign.close()
        raise
    results = campaign.results()
    return {"about": {"command": command, "seed": seed, **provenance()}, **results}


def page(results: dict[str, Any]) -> str:
    """Return the page of a campaign, in Markdown."""
    lines = [
        "# Chaos",
        "",
        f"{results['faults']} faults were injected into a robot of seven processes that walked and "
        f"learned: made by `{results['about']['command']}`. A robot is well again when "
        f"{HEALTHY_TICKS} ticks have had commands of all legs; one that is not within "
        f"{FROZEN_S:.0f} s is frozen. The recovery of a killed process is measured from its new "
        "start, and contains the time that a Python process with rclpy needs to start; all seven "
        f"together needed {results['startup_s']} s.",
        "",
        f"- Freezes: {results['freezes']}",
        f"- Processes that ended by themselves: {len(results['ended_by_themselves'])}"
        + "".join(f"; {each}" for each in results["ended_by_themselves"]),
        f"- Cells of the table whose visits became fewer: {results['cells_with_fewer_visits']}",
        f"- Updates in the table: {results['learned']}; in {results['ticks']} ticks, the legs can "
        f"have made at most {results['learned_at_most']}",
        "",
        "| fault | number | frozen | recovery, median, s | worst, s | commands missed |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for kind, each in results["kinds"].items():
        lines.append(
            f"| {kind} | {each['faults']} | {each['freezes']} | {each['median_s']} | "
            f"{each['worst_s']} | {each['missed_commands']} |"
        )
    return "\n".join(lines) + "\n"


def write(results: dict[str, Any], folder: Path) -> list[str]:
    """Write ``chaos.json`` and ``chaos.md``; return their names."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(results, indent=1) + "\n"
    (folder / "chaos.json").write_text(text, encoding="utf-8")
    (folder / "chaos.md").write_text(page(results), encoding="utf-8")
    return ["chaos.json", "chaos.md"]
