"""The central pattern generator as a node: ``ros2 run ember_ros cpg_node``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from cpg_node.cpg import FixedPeriod
from ember_ros import topics, wire
from ember_ros.errors import SignalError
from ember_ros.ros_params import declare_params
from ember_ros.seat import Seated
from ember_ros.spinning import main_of


class CpgNode(Seated, Node):  # type: ignore[misc]
    """Hears the clock, says the phase.

    Subscribes: ``clock`` (rosgraph_msgs/Clock).
    Publishes: ``cpg/phase`` (std_msgs/Float64), cycles since the start.
    Parameters: ``gait.*``.
    """

    GROUPS = ("gait",)
    OPTIONS = ()

    def __init__(self, **kwargs: Any) -> None:
        """Make the node; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range.
            TakenError: there is another CPG in this namespace.
        """
        super().__init__("cpg_node", automatically_declare_parameters_from_overrides=True, **kwargs)
        self.done = False
        params = declare_params(self, self.GROUPS)
        self.take_seat(topics.PHASE)
        self._oscillator = FixedPeriod(params.gait)
        self._said: float | None = None
        self._publisher = topics.PHASE.publish(self)
        topics.CLOCK.subscribe(self, self._hear)

    def _hear(self, data: bytes) -> None:
        try:
            phase = self._oscillator.phase(wire.read_clock(data, topics.CLOCK.name))
        except SignalError as why:
            self.get_logger().warning(f"refused: {why}", throttle_duration_sec=5.0)
            return
        if phase != self._said:  # once a tick, however often the clock is told
            self._said = phase
            self._publisher.publish(wire.pack_phase(phase))

    def finish(self, spin: Callable[[], None]) -> None:
        """Nothing to bring home."""


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal."""
    sys.exit(main_of(CpgNode, args))


if __name__ == "__main__":
    main()
