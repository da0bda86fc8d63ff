"""The same tick as nodes: all in this process, or one process a node.

Both give the table and the record of the run; both end what they started, whatever happens.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ember_ros.bag.storage import BagOptions
from ember_ros.children import STOP_S, child_command
from ember_ros.entry_points import NODES
from ember_ros.errors import EmberError, GraphError
from ember_ros.name_lock import (
    NAME_TAKEN,
    NameLock,
    NameTakenError,
    domain,
    lock_robot,
    wait_until_alone,
)
from ember_ros.params import as_dict, by_full_name
from ember_ros.params_file import dump_params
from ember_ros.run_config import RunConfig
from ember_ros.spinning import TURN_S, prepare_environment
from leg_node.table_file import load_table

if TYPE_CHECKING:
    from ember_ros.offline.replay import ReplayWorld
    from ember_ros.worlds import World
    from leg_node.table import Table

PATIENCE_S = 60.0
"""Wall time a graph started here waits for anybody: a busy machine must not change its bits."""


def node_options(
    config: RunConfig,
    out: Path | None = None,
    patience: float | None = None,
    bag: BagOptions | None = None,
) -> dict[str, dict[str, Any]]:
    """Return the options of every node of a plan, by the node's name; ``leg_<leg>`` for legs."""
    into = {} if bag is None else bag._asdict() | {"bag": str(bag.folder)}
    into.pop("folder", None)
    waits = {} if patience is None else {"patience": patience}
    table_waits = {} if patience is None else {"table_patience": patience / 2}
    nodes: dict[str, dict[str, Any]] = {
        "table_node": {
            "stage": config.stage,
            "table": str(config.table) if config.table else "",
            "save": str(out / "table.npz") if out else "",
            "seed": config.seed,
        },
        "cpg_node": {"world": config.world},
    }
    for leg in config.legs:
        nodes[f"leg_{leg}"] = {
            "leg": leg,
            "stage": config.stage,
            "seed": config.seed,
            "policy": config.policy,
            "learning": config.learning,
            "start_cycle": config.start_cycle,
            **table_waits,
        }
    nodes["sim_node"] = {
        "world": config.world,
        "cycles": config.cycles,
        "seed": config.seed,
        "out": str(out) if out else "",
        **waits,
        **into,
    }
    return nodes


def _ending(name: str) -> int:
    """Return a node's place in the order of ending, in which nothing learnt is lost."""
    return {"sim_node": 0, "table_node": 2}.get(name, 1)


class Graph:
    """All nodes of a plan in this process, on one executor."""

    def __init__(
        self,
        config: RunConfig,
        out: Path | None = None,
        *,
        namespace: str = "",
        patience: float | None = PATIENCE_S,
        bag: BagOptions | None = None,
        world: World | None = None,
        context: Any = None,
    ) -> None:
        """Make the nodes; nothing runs before ``run``.

        Args:
            config: what to run.
            out: folder for the record and the table; nowhere for None.
            namespace: of all nodes: another one is another robot.
            patience: wall seconds to wait for anybody; each node's own default for None.
            bag: where to record the run to; nowhere for None.
            world: to run in; the one that the plan names for None.
            context: an initialised rclpy context; one of its own for None.

        Raises:
            EmberError: a parameter or the table cannot be used.
            NameTakenError: another robot is running in this namespace.
        """
        prepare_environment()
        import rclpy
        from rclpy.experimental.events_executor import EventsExecutor
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions

        from cpg_node.node import CpgNode
        from leg_node.node import LegNode
        from leg_node.table_node import TableNode
        from sim_node.node import SimNode

        self.nodes: dict[str, Any] = {}
        self._own_context = context is None
        if context is None:
            context = rclpy.Context()
            rclpy.init(
                context=context,
                args=[
                    "--ros-args",
                    "--log-level",
                    "warn",
                ],  # a progress bar stands on this terminal
                signal_handler_options=SignalHandlerOptions.NO,
            )
        self._context = context
        self._executor = EventsExecutor(context=context)
        self._lock: NameLock | None = None
        makers = {"table_node": TableNode, "cpg_node": CpgNode, "sim_node": SimNode}
        try:
            self._lock = lock_robot(context.get_domain_id(), namespace)
            for name, options in node_options(config, out, patience, bag).items():
                make = makers.get(name, LegNode)
                given = by_full_name(as_dict(config.params)) | options
                node = make(
                    context=context,
                    namespace=namespace,
                    parameter_overrides=[Parameter(n, value=v) for n, v in given.items()],
                    **({"node_name": name} if make is LegNode else {}),
                    **({"world": world} if make is SimNode else {}),
                )
                self.nodes[name] = node
                self._executor.add_node(node)
        except BaseException:
            self.close()
            raise

    @property
    def sim(self) -> Any:
        """Return the sim node."""
        return self.nodes["sim_node"]

    def spin_once(self, timeout: float = TURN_S) -> None:
        """Let callbacks run; an exception in one of them is raised here."""
        self._executor.spin_once(timeout_sec=timeout)

    def run(self, go_on: Callable[[], bool] = lambda: True) -> None:
        """Run until the plan's cycles are done or ``go_on`` says no, then finish every node.

        Raises:
            NameTakenError: somebody else on the graph is what one of the nodes is; nothing has run.
            EmberError: a node could not end well; the others have.
        """
        if self._own_context:  # or the caller knows who is on the graph
            wait_until_alone(list(self.nodes.values()), go_on)
        while not self.sim.done and go_on():
            self.spin_once()
        self.finish()

    def finish(self) -> None:
        """Bring what every leg has learnt into the shared table, and end the record.

        Raises:
            EmberError: a node could not end well; the others have.
        """
        failed: list[EmberError] = []
        for name in sorted(self.nodes, key=_ending):
            try:
                self.nodes[name].finish(self.spin_once)
            except EmberError as error:
                failed.append(error)
        if failed:
            raise failed[0]

    def close(self) -> None:
        """Destroy all nodes."""
        for node in self.nodes.values():
            self._executor.remove_node(node)  # or it would keep their endpoints alive
            node.destroy_node()
        self.nodes.clear()
        if self._lock is not None:
            self._lock.release()
        self._executor.shutdown()
        if self._own_context:
            self._context.try_shutdown()


def by_graph(
    config: RunConfig,
    world: ReplayWorld,
    folder: Path,
    go_on: Callable[[int], bool],
    *,
    namespace: str = "",
) -> tuple[int, Table]:
    """Run a plan in a recorded world by real leg nodes, a table node and a CPG node.

    It is a ``Runner`` of ``ember_ros.offline.replay``, in any namespace.

    Raises:
        EmberError: as ``Graph``.
    """
    graph = Graph(config, folder, world=world, namespace=namespace)
    graph.sim.observers.append(world)
    try:
        graph.run(lambda: go_on(graph.sim.tick))
        done = graph.sim.tick
    finally:
        graph.close()
    return done, load_table(folder / "table.npz", config.params)[0]


# -- one process a node ----------------------------------------------------------------------


class Processes:
    """Each node of a plan in a process of its own, as seven ``ros2 run`` would start them."""

    def __init__(
        self,
        config: RunConfig,
        out: Path,
        *,
        namespace: str = "",
        patience: float | None = PATIENCE_S,
        bag: BagOptions | None = None,
    ) -> None:
        """Start the processes.

        Args:
            config: what to run.
            out: folder for the record and the table; parameters and a log a node in ``log``.
            namespace: of all nodes.
            patience: wall seconds to wait for anybody; each node's own default for None.
            bag: where to record the run to; nowhere for None.

        Raises:
            NameTakenError: another run is going on in this namespace.
        """
        prepare_environment()
        self._lock = lock_robot(domain(), namespace)
        self.out = out
        self._logs = out / "log"
        params = self._logs / "params.yaml"
        try:
            self._logs.mkdir(parents=True, exist_ok=True)
            params.write_text(dump_params(config.params), encoding="utf-8")
        except OSError as error:
            self._lock.release()
            raise GraphError(
                f"cannot write {error.filename}, for what the nodes are told and say: "
                f"{error.strerror}"
            ) from error
        nodes = node_options(config, out, patience, bag)
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        try:
            for name, options in nodes.items():
                self._start(name, options, params, namespace)
        except BaseException:
            self.stop()
            raise

    def _start(self, name: str, options: dict[str, Any], params: Path, namespace: str) -> None:
        command = [*child_command(NODES.get(name, NODES["leg_node"])), "--ros-args"]
        command += ["--params-file", str(params), "-r", f"__node:={name}"]
        if namespace:
            command += ["-r", f"__ns:=/{namespace.strip('/')}"]
        for option, value in options.items():
            if value != "":
                command += ["-p", f"{option}:={json.dumps(value)}"]
        with (self._logs / f"{name}.txt").open("wb") as log:
            # A session of its own: Ctrl-C is for us, and we tell them in the right order.
            self.processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=os.environ | {"PYTHONUNBUFFERED": "1"},
            )

    def wait(self, go_on: Callable[[], bool] = lambda: True) -> None:
        """Wait until the sim node has run its cycles or ``go_on`` says no.

        Raises:
            GraphError: a node ended before its time.
        """
        while self.processes["sim_node"].poll() is None and go_on():
            for name, process in self.processes.items():
                if process.poll() is not None and name != "sim_node":
                    self._died(name, process)
            time.sleep(TURN_S / 2)  # processes cannot be waited for on several at once
        code = self.processes["sim_node"].poll()
        if code:
            self._died("sim_node", self.processes["sim_node"])

    def _died(self, name: str, process: subprocess.Popen[bytes]) -> None:
        log = self._logs / f"{name}.txt"
        last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-3:]
        if process.returncode == NAME_TAKEN:
            raise NameTakenError(last[-1].removeprefix("error: "))
        raise GraphError(
            f"{name} ended with code {process.returncode} before its time; its log {log} ends "
            f"with: {' / '.join(last) or 'nothing'}"
        )

    def stop(self) -> None:
        """Stop all in an order in which nothing learnt is lost: sim, legs, and the table last."""
        for _, group in itertools.groupby(sorted(self.processes, key=_ending), key=_ending):
            names = list(group)
            for name in names:
                if self.processes[name].poll() is None:
                    self.processes[name].send_signal(signal.SIGINT)
            for name in names:
                self._reap(name)
        self._lock.release()

    def _reap(self, name: str) -> None:
        process = self.processes[name]
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        assert process.stdin is not None
        process.stdin.close()


@contextmanager
def processes(config: RunConfig, out: Path, **options: Any) -> Iterator[Processes]:
    """Run a plan as ``Processes`` with these options for as long as the block lasts."""
    running = Processes(config, out, **options)
    try:
        yield running
    finally:
        running.stop()
