"""Runs a ``RunConfig`` as ROS nodes: all in this process, or one process per node.

Both write the table and the record of the run. Both stop everything they started, whatever happens.
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
from ember_ros.spinning import SPIN_S, prepare_environment
from leg_node.table_file import load_table

if TYPE_CHECKING:
    from ember_ros.offline.replay import ReplayWorld
    from ember_ros.worlds import World
    from leg_node.table import Table

PATIENCE_S = 60.0
"""Wall time that nodes started here wait for each other, s: a slow machine must not change bits."""


def node_options(
    config: RunConfig,
    out: Path | None = None,
    patience: float | None = None,
    bag: BagOptions | None = None,
) -> dict[str, dict[str, Any]]:
    """Return the options of every node of a run, by the node's name; ``leg_<leg>`` for legs.

    Args:
        config: what to run.
        out: folder for the record and the table; None for none.
        patience: wall time that nodes wait for each other, s; each node's default for None.
        bag: the bag to record; None for none.
    """
    bag_options = {} if bag is None else bag._asdict() | {"bag": str(bag.folder)}
    bag_options.pop("folder", None)
    sim_patience = {} if patience is None else {"patience": patience}
    leg_patience = {} if patience is None else {"table_patience": patience / 2}
    nodes: dict[str, dict[str, Any]] = {
        "table_node": {
            "stage": config.stage,
            "table": str(config.table) if config.table else "",
            "save": str(out / "table.npz") if out else "",
            "fresh": True,  # a run replaces what is in its folder, or was refused before
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
            **leg_patience,
        }
    nodes["sim_node"] = {
        "world": config.world,
        "cycles": config.cycles,
        "seed": config.seed,
        "out": str(out) if out else "",
        **sim_patience,
        **bag_options,
    }
    return nodes


def _shutdown_order(name: str) -> int:
    """Return when a node ends: the sim first, then the legs, then the table that they push to."""
    return {"sim_node": 0, "table_node": 2}.get(name, 1)


class Graph:
    """All nodes of a run in this process, on one executor."""

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
        """Create the nodes; nothing runs before ``run``.

        Args:
            config: what to run.
            out: folder for the record and the table; None for none.
            namespace: of all nodes; another namespace is another robot.
            patience: wall time that nodes wait for each other, s; each node's default for None.
            bag: the bag to record; None for none.
            world: the world to run in; the one that ``config`` names for None.
            context: an initialised rclpy context; a new one for None.

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
                ],  # a progress bar uses this terminal
                signal_handler_options=SignalHandlerOptions.NO,
            )
        self._context = context
        self._executor = EventsExecutor(context=context)
        self._lock: NameLock | None = None
        classes = {"table_node": TableNode, "cpg_node": CpgNode, "sim_node": SimNode}
        try:
            self._lock = lock_robot(context.get_domain_id(), namespace)
            for name, options in node_options(config, out, patience, bag).items():
                node_class = classes.get(name, LegNode)
                overrides = by_full_name(as_dict(config.params)) | options
                node = node_class(
                    context=context,
                    namespace=namespace,
                    parameter_overrides=[Parameter(n, value=v) for n, v in overrides.items()],
                    **({"node_name": name} if node_class is LegNode else {}),
                    **({"world": world} if node_class is SimNode else {}),
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

    def spin_once(self, timeout: float = SPIN_S) -> None:
        """Run the next callback, if any; an exception in it is raised here."""
        self._executor.spin_once(timeout_sec=timeout)

    def run(self, go_on: Callable[[], bool] = lambda: True) -> None:
        """Run until all cycles are done or ``go_on`` returns False, then finish every node.

        Raises:
            NameTakenError: another node on the graph offers the same topic or service as one of
                these nodes; nothing has run.
            EmberError: a node could not finish; the others have finished.
        """
        if self._own_context:  # a caller with its own context knows what is on the graph
            wait_until_alone(list(self.nodes.values()), go_on)
        while not self.sim.done and go_on():
            self.spin_once()
        self.finish()

    def finish(self) -> None:
        """Push every leg's last updates into the shared table, and finish the record.

        Raises:
            EmberError: a node could not finish; the others have finished.
        """
        failed: list[EmberError] = []
        for name in sorted(self.nodes, key=_shutdown_order):
            try:
                self.nodes[name].finish(self.spin_once)
            except EmberError as error:
                failed.append(error)
        if failed:
            raise failed[0]

    def close(self) -> None:
        """Destroy all nodes."""
        for node in self.nodes.values():
            self._executor.remove_node(node)  # otherwise it keeps the node's endpoints alive
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
    """Run in a recorded world with real leg nodes, a table node and a CPG node.

    It is a ``Runner`` for ``ember_ros.offline.replay``.

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
    """Each node of a run in its own process, as with seven ``ros2 run``."""

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
            out: folder for the record and the table; ``log`` in it has the parameters and a log
                per node.
            namespace: of all nodes.
            patience: wall time that nodes wait for each other, s; each node's default for None.
            bag: the bag to record; None for none.

        Raises:
            NameTakenError: another robot is running in this namespace.
            GraphError: ``out`` cannot be written.
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
                f"cannot write {error.filename}, for the nodes' parameters and logs: "
                f"{error.strerror}"
            ) from error
        self._options = node_options(config, out, patience, bag)
        self._params, self._namespace = params, namespace
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        try:
            for name in self._options:
                self.log(name).unlink(missing_ok=True)
                self.start(name)
        except BaseException:
            self.stop()
            raise

    def log(self, name: str) -> Path:
        """Return the file with what a node prints."""
        return self._logs / f"{name}.txt"

    def start(self, name: str) -> None:
        """Start a node's process, or start it again after it has ended."""
        ended = self.processes.get(name)
        if ended is not None and ended.stdin is not None:
            ended.stdin.close()
        command = [*child_command(NODES.get(name, NODES["leg_node"])), "--ros-args"]
        command += ["--params-file", str(self._params), "-r", f"__node:={name}"]
        if self._namespace:
            command += ["-r", f"__ns:=/{self._namespace.strip('/')}"]
        for option, value in self._options[name].items():
            if value != "":
                command += ["-p", f"{option}:={json.dumps(value)}"]
        with self.log(name).open("ab") as log:
            # A new session, so that Ctrl-C reaches this process only, which then stops the nodes
            # in the right order.
            self.processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=os.environ | {"PYTHONUNBUFFERED": "1"},
            )

    def wait(self, go_on: Callable[[], bool] = lambda: True) -> None:
        """Wait until the sim node has run its cycles or ``go_on`` returns False.

        Raises:
            NameTakenError: a node with the same name is running already.
            GraphError: a node ended too early.
        """
        while self.processes["sim_node"].poll() is None and go_on():
            for name, process in self.processes.items():
                if process.poll() is not None and name != "sim_node":
                    self._died(name, process)
            time.sleep(SPIN_S / 2)  # one cannot wait for several processes at once
        code = self.processes["sim_node"].poll()
        if code:
            self._died("sim_node", self.processes["sim_node"])

    def _died(self, name: str, process: subprocess.Popen[bytes]) -> None:
        log = self.log(name)
        last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-3:]
        if process.returncode == NAME_TAKEN:
            raise NameTakenError(last[-1].removeprefix("error: "))
        raise GraphError(
            f"{name} ended with code {process.returncode} before its time; its log {log} ends "
            f"with: {' / '.join(last) or 'nothing'}"
        )

    def stop(self) -> None:
        """Stop the sim first, then the legs, then the table, so that no update is lost."""
        for _, group in itertools.groupby(
            sorted(self.processes, key=_shutdown_order), key=_shutdown_order
        ):
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
    """Start ``Processes`` with these options, and stop them at the end of the block."""
    running = Processes(config, out, **options)
    try:
        yield running
    finally:
        running.stop()
