"""Requests what determines the run of a running robot: the nodes' parameters, and the table.

Every node of ours declares its configuration as parameters, and the table can be pulled. So a
recorder needs no configuration of the run, and the bag holds the one that the nodes really have.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future

from ember_ros import topics
from ember_ros.bag.run_metadata import LegMetadata, RunMetadata
from ember_ros.bag.run_writer import absolute
from ember_ros.errors import EmberError
from ember_ros.params import SPECS, Params, cells_sha256, replace
from ember_ros.versions import versions
from ember_ros.worlds import legs_of, spec_of
from leg_node import calls
from leg_node.assembly import empty_table
from leg_node.table import Table

TABLE = topics.PULL.name


def _names(*groups: str) -> list[str]:
    return [name for name in SPECS if name.split(".")[0] in groups]


LEG_GROUPS = ("gait", "leg", "robot", "parts", "state", "reward", "script", "train", "walk")
OF_LEG = (*LegMetadata._fields, *_names(*LEG_GROUPS))
OF_SIM = ("world", *_names("physics", "trainer", "walker", "robot"))
OF_CPG = ("parts.cpg",)
_NAMELESS = "_NODE_NAME_UNKNOWN_"  # rmw's name of a node that is not discovered yet


class _Request:
    """One call of a ``rcl_interfaces/srv/GetParameters`` service."""

    def __init__(self, node: Node, service: str, request: GetParameters.Request) -> None:
        self._client = topics.Service(service, topics.PULL.kind).call(node)
        self._request = request
        self._future: Future | None = None

    def poll(self) -> Any:
        """Send the request once the service is there; return the response, None before it."""
        if self._future is None:
            if self._client.service_is_ready():
                self._future = self._client.call_async(self._request)
            return None
        return self._future.result() if self._future.done() else None


class MetadataClient:
    """The parameters and the table of one namespace; ``poll`` until nothing is missing."""

    def __init__(self, node: Node, namespace: str) -> None:
        """Call the services of a namespace through ``node``."""
        self._node, self._namespace = node, namespace
        self._requests: dict[str, _Request] = {}
        self._parameters: dict[str, dict[str, Any]] = {}  # by the topic that their node publishes
        self._table: Any = None

    def poll(self) -> list[str]:
        """Request what can be requested now.

        Returns:
            The topics whose publishers have not responded yet, and ``table/pull`` if it has not.
        """
        self._request_parameters(topics.CLOCK.name, OF_SIM)
        self._request_parameters(topics.PHASE.name, OF_CPG)
        legs = [topics.command(leg).name for leg in self.legs]
        for command in legs:
            self._request_parameters(command, OF_LEG)
        if self._table is None:
            if TABLE not in self._requests:
                # Of before epoch 0: the table node merges nothing for it.
                request = calls.write_pull(None, -1)
                service = absolute(self._namespace, TABLE)
                self._requests[TABLE] = _Request(self._node, service, request)
            self._table = self._requests[TABLE].poll()
        publishers = (topics.CLOCK.name, topics.PHASE.name, *legs)
        missing = [topic for topic in publishers if topic not in self._parameters]
        return missing if self._table is not None else [*missing, TABLE]

    def _request_parameters(self, topic: str, names: Sequence[str]) -> None:
        """Request the parameters of these names from the node that publishes a topic."""
        if topic in self._parameters:
            return
        if topic not in self._requests:
            name = absolute(self._namespace, topic)
            for publisher in self._node.get_publishers_info_by_topic(name):
                if publisher.node_name != _NAMELESS:
                    node = absolute(publisher.node_namespace, publisher.node_name)
                    request = GetParameters.Request(names=list(names))
                    service = f"{node}/get_parameters"
                    self._requests[topic] = _Request(self._node, service, request)
                    break
            else:
                return
        response = self._requests[topic].poll()
        if response is not None:
            values = map(parameter_value_to_python, response.values)
            self._parameters[topic] = {
                name: value for name, value in zip(names, values, strict=False) if value is not None
            }

    @property
    def world(self) -> str | None:
        """Return the sim node's world; None if there is no sim node, or it has not responded."""
        world = self._parameters.get(topics.CLOCK.name, {}).get("world")
        try:
            return spec_of(world).path and world if isinstance(world, str) else None
        except EmberError:  # of a class that cannot be imported here
            return None

    @property
    def legs(self) -> tuple[str, ...]:
        """Return the names of the robot's legs, in order; none before the world is known."""
        world = self.world
        return () if world is None else legs_of(world, self._params({}, []))

    def run_metadata(
        self, world: str, first_tick: int
    ) -> tuple[RunMetadata, Table | None, list[str]]:
        """Return what determined the run, as far as the nodes responded.

        Args:
            world: of the run.
            first_tick: the first one that is recorded.

        Returns:
            The run metadata, the table at the start, and in words why the run cannot be replayed.
        """
        problems: list[str] = []
        legs, numbers = self._legs(world, problems)
        params = self._params(numbers, problems)
        table = self._start_table(params, problems) if first_tick == 0 else None
        if first_tick:
            problems.append(f"recorded from tick {first_tick} on, not from the beginning")
        sha = None if table is None else table.sha256()
        return RunMetadata(world, legs, params, sha, first_tick, versions()), table, problems

    def params(self, world: str) -> Params:
        """Return the parameters of a world's nodes, as far as these responded."""
        return self._params(self._legs(world, [])[1], [])

    def _params(self, numbers: dict[str, Any], problems: list[str]) -> Params:
        """Return the parameters of legs, sim node and CPG; the defaults if they are invalid."""
        sim = self._parameters.get(topics.CLOCK.name, {})
        cpg = self._parameters.get(topics.PHASE.name, {})
        try:
            own = {n: v for n, v in {**sim, **cpg}.items() if n in SPECS}
            return replace(Params(), {**numbers, **own})
        except EmberError as error:
            problems.append(f"parameters: {error}")
            return Params()

    def _legs(
        self, world: str, problems: list[str]
    ) -> tuple[dict[str, LegMetadata], dict[str, Any]]:
        """Return each leg's metadata, and the parameters that all legs have."""
        legs: dict[str, LegMetadata] = {}
        numbers: dict[str, Any] | None = None
        for leg in legs_of(world, self._params({}, [])):
            parameters = self._parameters.get(topics.command(leg).name, {})
            if not parameters.keys() >= set(OF_LEG):
                problems.append(f"{leg} has no parameters of a leg node of this package")
                continue
            own = {
                name: parameters[name] for name in OF_LEG if name in SPECS and name not in OF_CPG
            }
            if numbers is not None and own != numbers:
                problems.append(f"{leg} has other parameters than the legs before it")
                continue
            numbers = own
            legs[leg] = LegMetadata(*(parameters[name] for name in LegMetadata._fields))
        return legs, numbers or {}

    def _start_table(self, params: Params, problems: list[str]) -> Table | None:
        if self._table is None:
            problems.append("no node serves table/pull")
            return None
        table = empty_table(params)
        try:
            changes = calls.read_changes(self._table, table, cells_sha256(params))
            if len(changes.values) != len(table):
                raise EmberError(f"{len(changes.values)} cells instead of {len(table)}")
        except EmberError as error:
            problems.append(f"the table: {error}")
            return None
        table.values[changes.cells] = changes.values
        table.visits[changes.cells] = changes.visits
        return table
