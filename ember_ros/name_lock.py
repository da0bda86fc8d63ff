"""A lock on a name: one sim, one CPG, one table and one node per leg in a namespace. Pure.

Discovery is asynchronous: two nodes that start at the same time discover each other late, so the
graph alone cannot decide which of them may stay. On one machine the kernel decides: the lock is an
abstract Unix socket. One process can bind its name, and the kernel frees it when that process ends,
however it ends. Abstract socket names are shared by all users of one network namespace, which is
also how far nodes of one machine discover each other.

Nodes of other packages, and nodes on other machines, are looked up on the graph in addition.
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

NAME_TAKEN = 3
"""Exit code of a node whose name another node holds."""
DISCOVERY_S = 0.5
"""Wall time in which all nodes on the graph are discovered, s."""
LEASE_S = 25.0
"""Wall time after which a killed process is off the graph, s (Fast DDS: 20 s)."""
POLL_S = 0.02  # wall time between two checks
NAME_BYTES = 107  # maximum length of a socket's name
SOCKETS = Path("/proc/net/unix")


class NameTakenError(GraphError):
    """Another node or run on the graph already holds the name."""


def domain() -> int:
    """Return the domain id of processes that are started with this environment."""
    value = os.environ.get("ROS_DOMAIN_ID", "")
    return int(value) if value.isdecimal() else 0  # rclpy refuses anything but a number


def _bind(name: str) -> int:
    """Return a new socket bound to this name until it is closed."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(b"\0" + name.encode())
        return bound.detach()


def _close(sockets: Sequence[int]) -> None:
    for each in sockets:
        os.close(each)


class NameLock:
    """The lock on one name, held until ``release`` or until this process ends."""

    def __init__(self, domain_id: int, locked_name: str, holder: str) -> None:
        """Acquire the lock.

        Args:
            domain_id: ROS_DOMAIN_ID of the graph.
            locked_name: full name of the topic or service that only one node may offer.
            holder: full name of the node that acquires the lock.

        Raises:
            NameTakenError: another process on this machine holds the lock.
        """
        key = hashlib.sha256(f"{domain_id} {locked_name}".encode()).hexdigest()[:24]
        name = f"ember_ros.{key}"
        try:
            sockets = [_bind(name)]
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise NameTakenError(_taken_message(_find_holder(name), locked_name)) from None
        # The first socket carries no data; the name of a second one tells who holds the lock.
        prefix = f"{name}.{os.getpid()}."
        sockets.append(_bind(prefix + holder[-(NAME_BYTES - len(prefix) - 1) :]))
        self.release = weakref.finalize(self, _close, sockets)
        """Release the lock."""


def _find_holder(name: str) -> str:
    """Return the node that holds a lock and its process id, or ``another node`` if unknown."""
    deadline = time.monotonic() + DISCOVERY_S
    while time.monotonic() < deadline:  # the holder binds the second socket after the first
        for line in SOCKETS.read_text(encoding="utf-8", errors="replace").splitlines():
            _, separator, owner = line.rpartition(f" @{name}.")
            if separator:
                process, _, node = owner.partition(".")
                return f"{node} (process {process})"
        time.sleep(POLL_S)
    return "another node"


def _taken_message(holder: str, locked_name: str) -> str:
    """Return the error message: who holds a name, and how to run a second robot beside it."""
    return (
        f"{locked_name} is taken by {holder}; to run a second robot beside it, use a namespace "
        "(ember: --namespace robot_2; a node: --ros-args -r __ns:=/robot_2) or another "
        "ROS_DOMAIN_ID"
    )


def lock_robot(domain_id: int, namespace: str) -> NameLock:
    """Lock a whole robot: of two runs that start at the same time, exactly one continues.

    Raises:
        NameTakenError: another run on this machine holds the lock.
    """
    root = "/" + f"{namespace.strip('/')}/".lstrip("/")
    return NameLock(domain_id, f"{root} as a whole", f"{root}sim_node")


class SingleNode:
    """A mixin for rclpy nodes of which a namespace may have one; a base class before ``Node``."""

    _endpoint: Topic | Service
    _lock: NameLock | None = None

    def lock_name(self: Any, endpoint: Topic | Service) -> None:
        """Become the only node that publishes a topic or serves a service.

        ``destroy_node`` releases the lock.

        Raises:
            NameTakenError: another node on this machine holds the lock.
        """
        self._endpoint = endpoint
        domain_id, own_name = self.context.get_domain_id(), self.get_fully_qualified_name()
        try:
            self._lock = NameLock(domain_id, self.full_name_of(endpoint), own_name)
        except NameTakenError:
            super().destroy_node()  # type: ignore[misc]
            raise

    def full_name_of(self: Any, endpoint: Topic | Service) -> str:
        """Return the full name of a topic or service of this node."""
        if _is_topic(endpoint):
            return str(self.resolve_topic_name(endpoint.name))
        return str(self.resolve_service_name(endpoint.name))

    def providers(self: Any, endpoint: Topic | Service) -> list[str]:
        """Return the full names of all nodes on the graph that publish a topic or serve a service.

        A killed node stays on the graph until its lease ends. If discovery is limited to this
        machine, equal names count once: one of them must be a killed node, because the lock allows
        only one live node.
        """
        name = self.full_name_of(endpoint)
        if _is_topic(endpoint):
            infos = self.get_publishers_info_by_topic(name)
            names = [_full(info.node_namespace, info.node_name) for info in infos]
        else:
            names = [
                _full(namespace, node)
                for node, namespace in self.get_node_names_and_namespaces()
                if name in self._served_by(node, namespace)
            ]
        return sorted(set(names) if is_localhost_only() else names)

    def _served_by(self: Any, node: str, namespace: str) -> list[str]:
        try:
            served = self.get_service_names_and_types_by_node(node, namespace)
        except Exception:  # the node has left the graph; rclpy's own error class is not public
            return []
        return [name for name, _ in served]

    def duplicates(self: Any) -> list[str]:
        """Return the full names of other nodes that offer this node's topic or service."""
        names: list[str] = self.providers(self._endpoint)
        own = self.get_fully_qualified_name()
        if own in names:
            names.remove(own)
        return names

    def destroy_node(self: Any) -> None:
        """Destroy the node and release its lock."""
        super().destroy_node()  # type: ignore[misc]
        if self._lock is not None:
            self._lock.release()


def _is_topic(endpoint: Topic | Service) -> bool:
    return hasattr(endpoint, "publish")


def _full(namespace: str, name: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def is_localhost_only() -> bool:
    """Return whether nodes of this process discover nodes of this machine only."""
    discovery_range = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    return discovery_range == "LOCALHOST" and not os.environ.get("ROS_STATIC_PEERS")


def wait_until_alone(nodes: Sequence[Any], go_on: Callable[[], bool] = lambda: True) -> None:
    """Wait until no other node offers what these nodes offer, or until ``go_on`` returns False.

    Call it before the nodes are spun: until then they influence no other node. A node that is
    still on the graph after the lease of a killed process is alive.

    Raises:
        NameTakenError: another node offers the same topic or service.
    """
    single = [node for node in nodes if isinstance(node, SingleNode)]
    start, warned = time.monotonic(), False
    while go_on():
        others = {node.full_name_of(node._endpoint): node.duplicates() for node in single}
        taken = [(name, holders) for name, holders in others.items() if holders]
        elapsed = time.monotonic() - start
        if elapsed >= DISCOVERY_S and not taken:
            return
        if elapsed >= DISCOVERY_S and not warned:
            warned = True
            name, holders = taken[0]
            single[0].get_logger().warning(  # type: ignore[attr-defined]
                f"{name} is taken by {' and '.join(holders)}; waiting up to {LEASE_S:.0f} s, "
                "because a killed node stays on the graph for a while"
            )
        if elapsed >= LEASE_S:
            name, holders = taken[0]
            raise NameTakenError(_taken_message(" and ".join(holders), name))
        time.sleep(POLL_S)
