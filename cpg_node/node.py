"""The central pattern generator as a node: ``ros2 run ember_ros cpg_node``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from cpg_node.cpg import Beats
from ember_ros import cdr, parts, topics, wire
from ember_ros.errors import SignalError
from ember_ros.inbox import Inbox, Receipt
from ember_ros.name_lock import SingleNode
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.spinning import node_main
from ember_ros.throttle import Throttle
from ember_ros.worlds import legs_of

JUMP_S = 0.5
"""Wall time without a next tick after which a clock that jumps is believed, s. A world that waits
repeats its clock in less; the clock of another simulator is not taken while this robot walks."""


class CpgNode(SingleNode, Node):  # type: ignore[misc]
    """The central pattern generator: publishes the phase of the gait at every tick.

    A clock that is repeated is answered again. A clock that does not continue the last one is
    ignored while the ticks go on, and starts time anew when they do not.

    Subscribes: ``clock`` (rosgraph_msgs/Clock); for an oscillator with feedback also
    ``<leg>/joint_states`` and ``<leg>/contact`` (sensor_msgs/JointState) of all legs.
    Publishes: ``cpg/phase`` (sensor_msgs/JointState): stamp, and cycles since the start.
    Parameters: ``gait.*``, ``robot.*``, ``parts.*``; ``world``.
    """

    GROUPS = ("gait", "robot", "parts")
    OPTIONS = ("world",)

    def __init__(self, **kwargs: Any) -> None:
        """Make the node; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range, or the oscillator cannot be
                imported.
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
        self._publisher = topics.PHASE.publish(self)
        self._senses: dict[str, wire.SenseWire] = {}
        if self._beats.hears_legs:
            legs = legs_of(options["world"], params)
            self._senses = {leg: wire.SenseWire(leg, self._tick_ns) for leg in legs}
        sources = [f"{leg} {part}" for leg in self._senses for part in ("joints", "contact")]
        self._inbox = Inbox("clock", *sources)
        self._last_progress = float("-inf")  # wall time of the last clock that was one tick ahead
        self._throttle = Throttle(lambda text: self.get_logger().warning(text))
        topics.CLOCK.subscribe(self, self._on_clock)
        for leg, senses in self._senses.items():
            joints, contact = f"{leg} joints", f"{leg} contact"
            topics.joint_states(leg).subscribe(self, self._on_sense(joints, senses.read_joints))
            topics.contact(leg).subscribe(self, self._on_sense(contact, senses.read_contact))

    def _on_sense(
        self, source: str, read: Callable[[bytes], tuple[int, Any]]
    ) -> Callable[[bytes], None]:
        return lambda data: self._receive(source, data, read)

    def _on_clock(self, data: bytes) -> None:
        self._receive("clock", data, self._read_clock)

    def _read_clock(self, data: bytes) -> tuple[int, None]:
        # A time between two ticks belongs to the tick that has started.
        return cdr.read_clock(data, topics.CLOCK.name) // self._tick_ns, None

    def _receive(self, source: str, data: bytes, read: Callable[[bytes], tuple[int, Any]]) -> None:
        try:
            tick, value = read(data)
        except SignalError as why:
            self._throttle.remind("refused", f"refused: {why}")
            return
        if source == "clock" and not self._is_credible(tick):
            self._throttle.remind("jump", f"clock: tick {tick} does not follow {self._inbox.last}")
            return
        receipt = self._inbox.put(source, tick, value)
        if receipt is Receipt.NEW or self._inbox.time_restarted():
            self._publish(tick)
        elif receipt is Receipt.REPEATED and source == "clock":
            self._publisher.publish(self._wire.pack(self._beats.last))

    def _is_credible(self, tick: int) -> bool:
        """Return whether a clock follows the last one, or no clock has done so for a while."""
        now, step = time.monotonic(), tick - self._inbox.last
        if step == 0:
            return True
        if step != 1 and now - self._last_progress < JUMP_S:
            return False
        self._last_progress = now
        return True

    def _publish(self, tick: int) -> None:
        """Publish the beat of a tick if all messages that it depends on have arrived."""
        values = self._inbox.pop(tick)
        if values is None:
            return
        _, *sense_parts = values
        feedback = [
            senses.sense(tick, joints, contact)
            for senses, joints, contact in zip(
                self._senses.values(), sense_parts[::2], sense_parts[1::2], strict=True
            )
        ]
        self._publisher.publish(self._wire.pack(self._beats.at(tick, feedback)))

    def finish(self, spin: Callable[[], None]) -> None:
        """Do nothing: there is nothing to save."""


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal."""
    sys.exit(node_main(CpgNode, args))


if __name__ == "__main__":
    main()
