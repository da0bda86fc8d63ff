"""Timers that no other process can stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.timer import Timer


def create_steady_timer(node: Node, period_s: float, callback: Callable[[], Any]) -> Timer:
    """Return a timer of ``node`` that runs on the steady clock of the machine.

    The timers of rclpy run on the node's own clock. With ``use_sim_time`` that is the topic
    ``/clock``: a world that waits for a dead leg would then wait for its own clock to go on.

    Args:
        node: owns the timer.
        period_s: wall time between two calls, s.
        callback: is called at every period.
    """
    from rclpy.clock import Clock
    from rclpy.clock_type import ClockType

    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
