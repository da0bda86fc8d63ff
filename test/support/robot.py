"""The nodes of a robot in this process, started one by one. Needs rclpy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from typing import Any

from rclpy.parameter import Parameter

from cpg_node.node import CpgNode
from ember_ros.graph import Graph, node_options
from ember_ros.params import as_dict
from ember_ros.run_config import RunConfig
from ember_ros.worlds import World
from leg_node.node import LegNode
from leg_node.table_node import TableNode
from sim_node.node import SimNode
from support.legs import LEGS
from support.ros import Ros
from support.runs import Bits, by_graph
from support.waiting import in_time

PATIENCE_S = 30.0
"""Wall time, s, that nodes wait for each other, so that a slow machine does not change the bits."""
LEG_NODES = tuple(f"leg_{leg}" for leg in LEGS)
KINDS: dict[str, Any] = {"table_node": TableNode, "cpg_node": CpgNode, "sim_node": SimNode}


def overrides(parameters: Mapping[str, Any]) -> list[Parameter]:
    """Return parameters as ``rclpy.parameter.Parameter`` objects."""
    return [Parameter(name, value=value) for name, value in parameters.items()]


def matched(*nodes: Any) -> bool:
    """Return whether all publishers and subscriptions among these nodes are matched."""
    subscribed = Counter(each.topic_name for node in nodes for each in node.subscriptions)
    return all(
        each.get_subscription_count() >= subscribed[each.topic_name]
        for node in nodes
        for each in node.publishers
    )


def level(message: Any, name: str) -> tuple[bytes, str]:
    """Return the level and the text of one status in a diagnostics message."""
    (status,) = (s for s in message.status if s.name == name)
    return status.level, status.message


def run_to_end(graph: Graph) -> Graph:
    """Run a graph to its end, with a deadline; return it."""
    graph.run(in_time())
    assert graph.sim.done
    return graph


class Robot:
    """The nodes of a configuration, each of which can start late, be killed and be restarted."""

    def __init__(
        self,
        ros: Ros,
        config: RunConfig,
        namespace: str = "",
        *,
        without: Collection[str] = (),
        patience: float | None = None,
        world: Callable[[RunConfig], World] | None = None,
        **options: dict[str, Any],
    ) -> None:
        """Start the nodes.

        Args:
            ros: spins the nodes.
            config: the configuration of the run.
            namespace: namespace of the robot.
            without: names of nodes that are not started now.
            patience: wall time, s, that nodes wait for others; None for their default.
            world: makes the world; None for the one of the configuration.
            options: changed node options, by name of the node.
        """
        self._ros, self._config, self.namespace, self._world = ros, config, namespace, world
        self._options = node_options(config, patience=patience)
        self.nodes: dict[str, Any] = {}
        for name in self._options:
            if name not in without:
                self.start(name, **options.get(name, {}))

    def _make(self, name: str, changes: Mapping[str, Any]) -> Any:
        parameters = {
            f"{group}.{field}": value
            for group, fields in as_dict(self._config.params).items()
            for field, value in fields.items()
        }
        extra: dict[str, Any] = {"node_name": name} if name.startswith("leg_") else {}
        if name == "sim_node" and self._world is not None:
            extra = {"world": self._world(self._config)}
        return KINDS.get(name, LegNode)(
            context=self._ros.context,
            namespace=self.namespace,
            parameter_overrides=overrides({**parameters, **self._options[name], **changes}),
            **extra,
        )

    @property
    def sim(self) -> Any:
        """Return the sim node."""
        return self.nodes["sim_node"]

    @property
    def tick(self) -> int:
        """Return the present tick of the world."""
        return int(self.sim.tick)

    @property
    def table(self) -> str:
        """Return the SHA-256 of the shared table."""
        return str(self.nodes["table_node"].shared.table.sha256())

    def start(self, name: str, **changes: Any) -> Any:
        """Start a node with changed options, and return it."""
        node = self.nodes[name] = self._ros.add(self._make(name, changes))
        return node

    def begin(self, *listeners: Any, **changes: Any) -> None:
        """Start the sim node, which was left out, when all nodes are matched with it."""
        sim = self._make("sim_node", changes)
        try:
            self._ros.spin_until(
                lambda: matched(sim, *self.nodes.values(), *listeners), "all are matched"
            )
        finally:
            self.nodes["sim_node"] = self._ros.add(sim)

    def kill(self, name: str) -> Any:
        """Destroy a node without finishing it, and return it."""
        node = self.nodes.pop(name)
        self._ros.remove(node)
        return node

    def spin_to_tick(self, tick: int) -> None:
        """Spin until the world is at a tick, or done."""
        self._ros.spin_until(lambda: self.tick >= tick or self.sim.done, f"tick {tick}")

    def finish(self) -> None:
        """Finish all nodes, the sim node first and the table node last."""
        order = {"sim_node": 0, "table_node": 2}
        for name in sorted(self.nodes, key=lambda name: order.get(name, 1)):
            self.nodes[name].finish(self._ros.spin_once)

    def run(self) -> Bits:
        """Run to the end and return the bits."""
        self._ros.spin_until(lambda: self.sim.done, "the last tick")
        self.finish()
        return by_graph(self)
