"""Asks a running robot what determines its run: its nodes their parameters, its table its content.

Every node of ours declares what it was told as parameters, and the table can be pulled; so who
records needs to be told nothing, and the bag says what the nodes say, not what somebody meant.
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
from ember_ros.params import SPECS, Params, replace
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
_NAMELESS = "_NODE_NAME_UNKNOWN_"  # what a graph says of an endpoint before it knows the node


class _Question:
    """One call of a ``rcl_interfaces/srv/GetParameters``, answered once."""

    def __init__(self, node: Node, service: str, request: GetParameters.Request) -> None:
        self._client = topics.Service(service, topics.PULL.kind).call(node)
        self._request = request
        self._future: Future | None = None

    def answer(self) -> Any:
        """Ask if it was not asked yet; return the answer, or None while there is none."""
        if self._future is None:
            if self._client.service_is_ready():
                self._future = self._client.call_async(self._request)
            return None
        return self._future.result() if self._future.done() else None


class MetadataClient:
    """What the nodes of one namespace answer; ``ask`` until nobody is waited for."""

    def __init__(self, node: Node, namespace: str) -> None:
        """Ask in the name of ``node``."""
        self._node, self._namespace = node, namespace
        self._questions: dict[str, _Question] = {}
        self._told: dict[str, dict[str, Any]] = {}
        self._table: Any = None

    def ask(self) -> list[str]:
        """Ask whom there is to ask; return who has not answered yet."""
        self._ask_publisher(topics.CLOCK.name, OF_SIM)
        self._ask_publisher(topics.PHASE.name, OF_CPG)
        legs = [topics.command(leg).name for leg in self.legs]
        for command in legs:
            self._ask_publisher(command, OF_LEG)
        if self._table is None:
            if TABLE not in self._questions:
                request = calls.write_pull(None, -1)  # of before epoch 0: nothing is merged for it
                service = absolute(self._namespace, TABLE)
                self._questions[TABLE] = _Question(self._node, service, request)
            self._table = self._questions[TABLE].answer()
        waiting = [
            name for name in (topics.CLOCK.name, topics.PHASE.name, *legs) if name not in self._told
        ]
        return waiting if self._table is not None else [*waiting, TABLE]

    def _ask_publisher(self, topic: str, names: Sequence[str]) -> None:
        """Ask the node that publishes a topic for its parameters of these names."""
        if topic in self._told:
            return
        if topic not in self._questions:
            name = absolute(self._namespace, topic)
            for publisher in self._node.get_publishers_info_by_topic(name):
                if publisher.node_name != _NAMELESS:
                    node = absolute(publisher.node_namespace, publisher.node_name)
                    request = GetParameters.Request(names=list(names))
                    question = _Question(self._node, f"{node}/get_parameters", request)
                    self._questions[topic] = question
                    break
            else:
                return
        answer = self._questions[topic].answer()
        if answer is not None:
            values = map(parameter_value_to_python, answer.values)
            self._told[topic] = {n: v for n, v in zip(names, values, strict=False) if v is not None}

    @property
    def world(self) -> str | None:
        """Return which world the sim node simulates; None where there is none, or not yet known."""
        world = self._told.get(topics.CLOCK.name, {}).get("world")
        try:
            return spec_of(world).path and world if isinstance(world, str) else None
        except EmberError:  # of a class that cannot be imported here
            return None

    @property
    def legs(self) -> tuple[str, ...]:
        """Return the names of the robot's legs, in order; none while the world is not known."""
        world = self.world
        return () if world is None else legs_of(world, self._params({}, []))

    def run_metadata(
        self, world: str, first_tick: int
    ) -> tuple[RunMetadata, Table | None, list[str]]:
        """Return what determined the run, as far as it was answered.

        Args:
            world: of the run.
            first_tick: that is recorded.

        Returns:
            The card, the table at the start, and what is wrong with either, in words.
        """
        wrong: list[str] = []
        legs, numbers = self._legs(world, wrong)
        params = self._params(numbers, wrong)
        table = self._start_table(params, wrong) if first_tick == 0 else None
        if first_tick:
            wrong.append(f"recorded from tick {first_tick} on, not from the beginning")
        sha = None if table is None else table.sha256()
        return RunMetadata(world, legs, params, sha, first_tick, versions()), table, wrong

    def params(self, world: str) -> Params:
        """Return the numbers that the nodes of a world were told, as far as they answered."""
        return self._params(self._legs(world, [])[1], [])

    def _params(self, numbers: dict[str, Any], wrong: list[str]) -> Params:
        """Return the numbers of legs, sim node and CPG together; the defaults if they are wrong."""
        sim = self._told.get(topics.CLOCK.name, {})
        cpg = self._told.get(topics.PHASE.name, {})
        try:
            own = {n: v for n, v in {**sim, **cpg}.items() if n in SPECS}
            return replace(Params(), {**numbers, **own})
        except EmberError as error:
            wrong.append(f"parameters: {error}")
            return Params()

    def _legs(self, world: str, wrong: list[str]) -> tuple[dict[str, LegMetadata], dict[str, Any]]:
        """Return what each leg was told, and the numbers on which all agree."""
        legs: dict[str, LegMetadata] = {}
        numbers: dict[str, Any] | None = None
        for leg in legs_of(world, self._params({}, [])):
            told = self._told.get(topics.command(leg).name, {})
            if not told.keys() >= set(OF_LEG):
                wrong.append(f"{leg} does not say what it was told: no leg node of ours")
                continue
            own = {name: told[name] for name in OF_LEG if name in SPECS and name not in OF_CPG}
            if numbers is not None and own != numbers:
                wrong.append(f"{leg} has other parameters than the legs before it")
                continue
            numbers = own
            legs[leg] = LegMetadata(*(told[name] for name in LegMetadata._fields))
        return legs, numbers or {}

    def _start_table(self, params: Params, wrong: list[str]) -> Table | None:
        if self._table is None:
            wrong.append("nobody serves a table")
            return None
        table = empty_table(params)
        try:
            changes = calls.read_changes(self._table)
            if len(changes.values) != len(table):
                raise EmberError(f"{len(changes.values)} cells instead of {len(table)}")
        except EmberError as error:
            wrong.append(f"the table: {error}")
            return None
        table.values[changes.cells] = changes.values
        table.visits[changes.cells] = changes.visits
        return table
