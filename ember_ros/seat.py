"""Who is the sim, the CPG, the table or a leg of a robot, is so alone: its seat. Pure.

Discovery is asynchronous: two that start at once see each other late, so looking at the graph
cannot decide between them. On one machine the kernel decides: a seat is the name of a socket, which
one process can have, and which is free the moment that process is gone, however it ended. Such
names are known just as far as nodes of one machine hear each other: all users, one network
namespace.

Who is not one of our nodes, or on another machine, is looked for on the graph as well.
"""

from __future__ import annotations

import errno
import hashlib
import os
import socket
import time
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ember_ros.errors import GraphError

if TYPE_CHECKING:
    from ember_ros.topics import Service, Topic

TAKEN = 3
"""Exit code of a node whose seat somebody else has."""
LOOK_S = 0.5
"""Wall time in which who is on the graph is discovered."""
LEASE_S = 25.0
"""Wall time after which a process that was killed is off the graph: Fast DDS's lease of 20 s."""
TURN_S = 0.02
NAME_BYTES = 107  # of a socket's name
SOCKETS = Path("/proc/net/unix")


class TakenError(GraphError):
    """Somebody else is on the graph as what a node or a run was started to be."""


def domain() -> int:
    """Return the domain id of processes that are started with this environment."""
    given = os.environ.get("ROS_DOMAIN_ID", "")
    return int(given) if given.isdecimal() else 0  # what is no number, rclpy refuses


def _bind(name: str) -> int:
    """Return a new socket of this name, known until it is closed."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(b"\0" + name.encode())
        return bound.detach()


def _close(sockets: Sequence[int]) -> None:
    for each in sockets:
        os.close(each)


class Seat:
    """One place on the graph, held until it is left or this process is gone."""

    def __init__(self, domain_id: int, place: str, who: str) -> None:
        """Take a seat.

        Args:
            domain_id: of the graph.
            place: full name of what only one may publish or serve.
            who: full name of the node that takes it.

        Raises:
            TakenError: somebody else on this machine has it.
        """
        key = hashlib.sha256(f"{domain_id} {place}".encode()).hexdigest()[:24]
        name = f"ember_ros.{key}"
        try:
            held = [_bind(name)]
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise TakenError(_taken(_who_has(name), place)) from None
        # A name says nothing but itself: a second one says whose the first is.
        said = f"{name}.{os.getpid()}."
        held.append(_bind(said + who[-(NAME_BYTES - len(said) - 1) :]))
        self.leave = weakref.finalize(self, _close, held)
        """Let others have it."""


def _who_has(name: str) -> str:
    """Return the node that has a seat, and its process, as far as that is known."""
    deadline = time.monotonic() + LOOK_S
    while time.monotonic() < deadline:  # it takes the seat first and says who it is then
        for line in SOCKETS.read_text(encoding="utf-8", errors="replace").splitlines():
            _, found, said = line.rpartition(f" @{name}.")
            if found:
                process, _, who = said.partition(".")
                return f"{who} (process {process})"
        time.sleep(TURN_S)
    return "another node"


def _taken(who: str, place: str) -> str:
    """Return the sentence that says who has a place, and how to live beside each other."""
    return (
        f"{place} is taken by {who}; to run beside it, give this one a namespace (ember: "
        "--namespace robot_2; a node: --ros-args -r __ns:=/robot_2) or another ROS_DOMAIN_ID"
    )


def run_seat(domain_id: int, namespace: str) -> Seat:
    """Take the seat of a whole robot, so that of two runs that start at once one goes on.

    Raises:
        TakenError: another run on this machine has it.
    """
    root = "/" + f"{namespace.strip('/')}/".lstrip("/")
    return Seat(domain_id, f"{root} as a whole", f"{root}sim_node")


class Seated:
    """What makes an rclpy node one that is alone in its place. Comes before ``Node`` as a base."""

    _place: Topic | Service
    _seat: Seat | None = None

    def take_seat(self: Any, place: Topic | Service) -> None:
        """Take the seat of who publishes a topic or serves a service; left with ``destroy_node``.

        Raises:
            TakenError: somebody else on this machine has it.
        """
        self._place = place
        domain_id, who = self.context.get_domain_id(), self.get_fully_qualified_name()
        try:
            self._seat = Seat(domain_id, self.resolved(place), who)
        except TakenError:
            super().destroy_node()  # type: ignore[misc]
            raise

    def resolved(self: Any, place: Topic | Service) -> str:
        """Return the full name of a topic or service of this node."""
        if _is_topic(place):
            return str(self.resolve_topic_name(place.name))
        return str(self.resolve_service_name(place.name))

    def holders(self: Any, place: Topic | Service) -> list[str]:
        """Return the full names of all nodes on the graph that publish a topic or serve a service.

        A node that was killed stands there until its lease ends. Where nobody from beyond this
        machine can be, two of one name are thus one: that no two live is what seats are for.
        """
        name = self.resolved(place)
        if _is_topic(place):
            infos = self.get_publishers_info_by_topic(name)
            names = [_full(info.node_namespace, info.node_name) for info in infos]
        else:
            names = [
                _full(namespace, node)
                for node, namespace in self.get_node_names_and_namespaces()
                if name in self._served_by(node, namespace)
            ]
        return sorted(set(names) if only_this_machine() else names)

    def _served_by(self: Any, node: str, namespace: str) -> list[str]:
        try:
            served = self.get_service_names_and_types_by_node(node, namespace)
        except Exception:  # it is gone by now; rclpy's own error is not public
            return []
        return [name for name, _ in served]

    def others(self: Any) -> list[str]:
        """Return the full names of those who have this node's seat besides it."""
        names: list[str] = self.holders(self._place)
        own = self.get_fully_qualified_name()
        if own in names:
            names.remove(own)
        return names

    def destroy_node(self: Any) -> None:
        """Destroy the node and leave its seat."""
        super().destroy_node()  # type: ignore[misc]
        if self._seat is not None:
            self._seat.leave()


def _is_topic(place: Topic | Service) -> bool:
    return hasattr(place, "publish")


def _full(namespace: str, name: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def only_this_machine() -> bool:
    """Return whether nodes of this process hear this machine only."""
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    return reach == "LOCALHOST" and not os.environ.get("ROS_STATIC_PEERS")


def make_sure(nodes: Sequence[Any], go_on: Callable[[], bool] = lambda: True) -> None:
    """Wait until it is known that nobody else has these nodes' seats, or ``go_on`` says no.

    Nodes must not be spun before: until then they disturb nobody. Who is still on the graph after
    the lease of a process that was killed, lives.

    Raises:
        TakenError: somebody else has one of them.
    """
    seated = [node for node in nodes if isinstance(node, Seated)]
    began, said = time.monotonic(), False
    while go_on():
        found = {node.resolved(node._place): node.others() for node in seated}
        crowded = [(place, others) for place, others in found.items() if others]
        waited = time.monotonic() - began
        if waited >= LOOK_S and not crowded:
            return
        if waited >= LOOK_S and not said:
            said = True
            place, others = crowded[0]
            seated[0].get_logger().warning(  # type: ignore[attr-defined]
                f"{place} is taken by {' and '.join(others)}; waiting {LEASE_S:.0f} s, for who was "
                "killed stays on the graph for a while"
            )
        if waited >= LEASE_S:
            place, others = crowded[0]
            raise TakenError(_taken(" and ".join(others), place))
        time.sleep(TURN_S)
