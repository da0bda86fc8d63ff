"""The nodes of a robot in this process, one by one. Needs rclpy."""

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
"""Wall time that nodes wait where bits are compared: a busy machine must not change them."""
LEG_NODES = tuple(f"leg_{leg}" for leg in LEGS)
KINDS: dict[str, Any] = {"table_node": TableNode, "cpg_node": CpgNode, "sim_node": SimNode}


def overrides(parameters: Mapping[str, Any]) -> list[Parameter]:
    """Return parameters as rclpy takes them."""
    return [Parameter(name, value=value) for name, value in parameters.items()]


def matched(*nodes: Any) -> bool:
    """Return whether every subscription of these nodes has every publisher of theirs."""
    heard = Counter(each.topic_name for node in nodes for each in node.subscriptions)
    return all(
        each.get_subscription_count() >= heard[each.topic_name]
        for node in nodes
        for each in node.publishers
    )


def level(message: Any, name: str) -> tuple[bytes, str]:
    """Return the level and the text of one status in a diagnostics message."""
    (status,) = (s for s in message.status if s.name == name)
    return status.level, status.message


def spun(graph: Graph) -> Graph:
    """Run a graph to its end, which must come in time; return it."""
    graph.run(in_time())
    assert graph.sim.done
    return graph


class Robot:
    """The nodes of a plan, each of which can come late, die and come back."""

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
        """Start all nodes but those left out, with some options changed.

        Args:
            ros: where they are spun.
            config: what they run.
            namespace: of the robot.
            without: names of nodes that are not started now.
            patience: wall time, s, that nodes wait for others; by default their own.
            world: makes another world than the plan's.
            options: changes of a node's options, by the node's name.
        """
        self._ros, self._plan, self.namespace, self._world = ros, config, namespace, world
        self._options = node_options(config, patience=patience)
        self.nodes: dict[str, Any] = {}
        for name in self._options:
            if name not in without:
                self.start(name, **options.get(name, {}))

    def _make(self, name: str, changes: Mapping[str, Any]) -> Any:
        numbers = {
            f"{group}.{field}": value
            for group, fields in as_dict(self._plan.params).items()
            for field, value in fields.items()
        }
        extra: dict[str, Any] = {"node_name": name} if name.startswith("leg_") else {}
        if name == "sim_node" and self._world is not None:
            extra = {"world": self._world(self._plan)}
        return KINDS.get(name, LegNode)(
            context=self._ros.context,
            namespace=self.namespace,
            parameter_overrides=overrides({**numbers, **self._options[name], **changes}),
            **extra,
        )

    @property
    def sim(self) -> Any:
        """Return the sim node."""
        return self.nodes["sim_node"]

    @property
    def tick(self) -> int:
        """Return the world's present tick."""
        return int(self.sim.tick)

    @property
    def table(self) -> str:
        """Return the SHA-256 of the shared table."""
        return str(self.nodes["table_node"].shared.table.sha256())

    def start(self, name: str, **changes: Any) -> Any:
        """Start a node with some options changed, and return it."""
        node = self.nodes[name] = self._ros.add(self._make(name, changes))
        return node

    def begin(self, *listeners: Any, **changes: Any) -> None:
        """Start the world, which was left out, once everybody is matched with it."""
        sim = self._make("sim_node", changes)
        try:
            self._ros.spin_until(
                lambda: matched(sim, *self.nodes.values(), *listeners), "all are matched"
            )
        finally:
            self.nodes["sim_node"] = self._ros.add(sim)

    def kill(self, name: str) -> Any:
        """Destroy a node where it stands, and return it."""
        node = self.nodes.pop(name)
        self._ros.remove(node)
        return node

    def walk_to(self, tick: int) -> None:
        """Spin until the world is at a tick, or done."""
        self._ros.spin_until(lambda: self.tick >= tick or self.sim.done, f"tick {tick}")

    def finish(self) -> None:
        """End all nodes, the world first and the table last."""
        last = {"sim_node": 0, "table_node": 2}
        for name in sorted(self.nodes, key=lambda name: last.get(name, 1)):
            self.nodes[name].finish(self._ros.spin_once)

    def run(self) -> Bits:
        """Run to the end and return the bits."""
        self._ros.spin_until(lambda: self.sim.done, "the last tick")
        self.finish()
        return by_graph(self)
