"""The central pattern generator as a node: ``ros2 run ember_ros cpg_node``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from cpg_node.cpg import Beats
from ember_ros import cdr, parts, topics, wire
from ember_ros.errors import SignalError
from ember_ros.inbox import Inbox
from ember_ros.name_lock import SingleNode
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.spinning import node_main
from ember_ros.worlds import legs_of


class CpgNode(SingleNode, Node):  # type: ignore[misc]
    """Hears the clock, publishes the beat.

    Subscribes: ``clock`` (rosgraph_msgs/Clock); for an oscillator that wants feedback also
    ``<leg>/joint_states`` and ``<leg>/contact`` (sensor_msgs/JointState) of all legs.
    Publishes: ``cpg/phase`` (sensor_msgs/JointState): stamp, and cycles since the start.
    Parameters: ``gait.*``, ``robot.*``, ``parts.*``; ``world``.
    """

    GROUPS = ("gait", "robot", "parts")
    OPTIONS = ("world",)

    def __init__(self, **kwargs: Any) -> None:
        """Make the node; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range, or there is no such oscillator.
            NameTakenError: there is another CPG in this namespace.
        """
        super().__init__("cpg_node", automatically_declare_parameters_from_overrides=True, **kwargs)
        self.done = False
        params = declare_params(self, self.GROUPS)
        options = declare_options(self, self.OPTIONS)
        self.lock_name(topics.PHASE)
        self._tick_ns = params.gait.tick_ns
        self._beats = Beats(parts.make(params, "cpg", params))
        self._wire = wire.BeatWire(self._tick_ns)
        self._last = -1
        self._publisher = topics.PHASE.publish(self)
        self._senses: dict[str, wire.SenseWire] = {}
        if self._beats.hears_legs:
            legs = legs_of(options["world"], params)
            self._senses = {leg: wire.SenseWire(leg, self._tick_ns) for leg in legs}
        sources = [f"{leg} {part}" for leg in self._senses for part in ("joints", "contact")]
        self._inbox = Inbox("clock", *sources)
        topics.CLOCK.subscribe(self, self._hear_clock)
        for leg, senses in self._senses.items():
            joints, contact = f"{leg} joints", f"{leg} contact"
            topics.joint_states(leg).subscribe(self, self._listener(joints, senses.read_joints))
            topics.contact(leg).subscribe(self, self._listener(contact, senses.read_contact))

    def _listener(
        self, source: str, read: Callable[[bytes], tuple[int, Any]]
    ) -> Callable[[bytes], None]:
        return lambda data: self._hear(source, data, read)

    def _hear_clock(self, data: bytes) -> None:
        self._hear("clock", data, self._read_clock)

    def _read_clock(self, data: bytes) -> tuple[int, None]:
        # A clock between two ticks tells of the one that has begun.
        return cdr.read_clock(data, topics.CLOCK.name) // self._tick_ns, None

    def _hear(self, source: str, data: bytes, read: Callable[[bytes], tuple[int, Any]]) -> None:
        try:
            tick, value = read(data)
        except SignalError as why:
            self.get_logger().warning(f"refused: {why}", throttle_duration_sec=5.0)
            return
        if self._inbox.put(source, tick, value) or self._inbox.time_restarted():
            self._publish(tick)

    def _publish(self, tick: int) -> None:
        """Publish the beat of a tick if all that it hangs on is there."""
        heard = self._inbox.pop(tick)
        if heard is None:
            return
        _, *parts_heard = heard
        feedback = [
            senses.sense(tick, joints, contact)
            for senses, joints, contact in zip(
                self._senses.values(), parts_heard[::2], parts_heard[1::2], strict=True
            )
        ]
        self._publisher.publish(self._wire.pack(self._beats.at(tick, feedback)))

    def finish(self, spin: Callable[[], None]) -> None:
        """Nothing to bring home."""


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal."""
    sys.exit(node_main(CpgNode, args))


if __name__ == "__main__":
    main()
