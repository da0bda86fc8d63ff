"""An rclpy context in its own domain with a test node; checks that nothing keeps running."""

from __future__ import annotations

import fcntl
import gc
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from support.waiting import DEADLINE_S

RETRY_S = 2.0
"""Wall time, s, after which a service that did not answer is called again."""
LEAVE_S = 30.0
"""Wall time, s, after which the nodes of another process must have left the graph. If its leave
message was lost, they leave when the lease of 20 s ends."""
DOMAINS = range(1, 101)
DRAIN_CALLBACKS = 100
"""Callbacks after which an executor has no work left for a node that was removed from it."""


@contextmanager
def reserved_domain() -> Iterator[int]:
    """Reserve a domain id that no other test on this machine uses."""
    folder = Path(f"/tmp/ember_ros_test_domains.{os.getuid()}")
    folder.mkdir(exist_ok=True)
    first = os.getpid() * 7 + reserved_domain.__dict__.setdefault("count", 0)
    reserved_domain.__dict__["count"] += (
        1  # not the previous one: its leave messages may still arrive
    )
    for n in range(len(DOMAINS)):
        domain = DOMAINS[(first + n) % len(DOMAINS)]
        with (folder / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    raise RuntimeError("all domain ids are taken by other tests")


def _children() -> set[str]:
    """Return the ids of the living processes that this process started."""
    found: set[str] = set()
    for task in Path("/proc/self/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # a thread that has just ended
            found.update((task / "children").read_text().split())
    return found


class Ros:
    """A context in its own domain, a test node, and an executor."""

    def __init__(self, domain: int) -> None:
        """Initialise the context."""
        import rclpy
        from rclpy.experimental.events_executor import EventsExecutor
        from rclpy.logging import LoggingSeverity, set_logger_level
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions

        # The level belongs to the process: a graph that `ember` ran before sets it to warnings.
        set_logger_level("", LoggingSeverity.INFO)

        self.domain = domain
        self.context = rclpy.Context()
        rclpy.init(
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self._executor = EventsExecutor(context=self.context)
        self._nodes: list[Any] = []
        self.killed: set[str] = set()
        """Names of the nodes of killed processes, which sent no leave message."""
        self.node: Any = self.add(Node("test_observer", context=self.context))

    def add(self, node: Any) -> Any:
        """Spin ``node`` from now on, and destroy it at the end; return it."""
        self._executor.add_node(node)
        self._nodes.append(node)
        return node

    def remove(self, *nodes: Any) -> None:
        """Destroy ``nodes`` now, after the executor has released them."""
        names = {node.get_fully_qualified_name() for node in nodes}
        for node in nodes:
            self._nodes.remove(node)
            self._executor.remove_node(node)
        for _ in range(DRAIN_CALLBACKS):  # queued callbacks need the nodes to exist
            self.spin_once(0.0)
        for node in nodes:
            node.destroy_node()
        if nodes != (self.node,):
            self.spin_until(lambda: not names & self.alive(), f"{names} destroyed")

    def alive(self) -> set[str]:
        """Return the names of all nodes on the graph that have a publisher.

        The name of a dead node can stay forever: the graph update of a process may arrive after its
        leave message, and rmw_dds_common then adds a participant that never leaves.
        """
        from rclpy.node import NodeNameNonExistentError

        found = set()
        for name, namespace in self.node.get_node_names_and_namespaces():
            with suppress(NodeNameNonExistentError):  # gone meanwhile
                if self.node.get_publisher_names_and_types_by_node(name, namespace):
                    found.add(f"{namespace.rstrip('/')}/{name}")
        return found

    def spin_once(self, timeout: float = 0.02) -> None:
        """Run one callback, or wait for one until the timeout."""
        self._executor.spin_once(timeout_sec=timeout)

    def spin_until(
        self, condition: Callable[[], Any], what: str, also: Callable[[float], None] | None = None
    ) -> None:
        """Spin until a condition holds; ``also`` is another executor's ``spin_once``."""
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"did not come true: {what}"
            if also is None:
                self.spin_once()
            else:
                also(0.002)
                self.spin_once(0.0)

    def publisher(self, topic: Any, *, matched: bool = True) -> Any:
        """Return a publisher of one of ``topics``, matched with a subscription."""
        publisher = topic.publish(self.node)
        if matched:
            self.spin_until(publisher.get_subscription_count, f"{topic.name} is subscribed to")
        return publisher

    def messages(self, topic: Any, *, matched: bool = True, raw: bool = False) -> list[Any]:
        """Subscribe to one of ``topics`` and return the list that its messages will be put in."""
        from ember_ros.topics import class_of, latest

        received: list[Any] = []
        subscription = self.node.create_subscription(
            class_of(topic.kind), topic.name, received.append, latest(100_000), raw=raw
        )
        if matched:
            self.spin_until(subscription.handle.get_publisher_count, f"{topic.name} is published")
        return received

    def client(self, service: Any) -> Any:
        """Return a client of one of ``topics``' services that is ready."""
        client = service.call(self.node)
        self.spin_until(client.service_is_ready, f"{service.name} is served")
        return client

    def call(self, client: Any, request: Any, also: Callable[[float], None] | None = None) -> Any:
        """Call a service and return its response; retry, since a killed server looks ready, too."""
        calls = [client.call_async(request)]
        called = time.monotonic()

        def answered() -> bool:
            nonlocal called
            if time.monotonic() > called + RETRY_S:
                calls.append(client.call_async(request))
                called = time.monotonic()
            return any(call.done() for call in calls)

        self.spin_until(answered, f"{client.srv_name} answers", also)
        return next(call for call in calls if call.done()).result()

    def close(self) -> None:
        """Destroy all nodes, and check that none is left in the context."""
        self.remove(*self._nodes[:0:-1])
        gc.collect()  # nodes whose constructor raised
        known = {"/test_observer"} | self.killed
        deadline = time.monotonic() + LEAVE_S
        while self.alive() - known and time.monotonic() < deadline:
            self.spin_once()
        left = self.alive() - known
        self.remove(self.node)
        self._executor.shutdown()
        self.context.try_shutdown()
        assert not left, f"nodes left running: {left}"


@contextmanager
def ros_in(domain: int) -> Iterator[Ros]:
    """Open a context in a domain; check at the end that no thread or process keeps running."""
    threads, children = set(threading.enumerate()), _children()
    ros = Ros(domain)
    try:
        yield ros
    finally:
        ros.close()
        left = set(threading.enumerate()) - threads
        assert not left, f"threads left running: {left}"
        assert _children() <= children, "processes left running"
