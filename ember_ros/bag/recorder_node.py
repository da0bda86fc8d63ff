"""Records any running robot: ``ros2 run ember_ros recorder_node --ros-args -p bag:=DIR``.

It publishes how far it is, and a world in lockstep waits for it. Of a robot that waits for nothing
it may miss messages; it counts these and logs the count. A world can also record itself, with the
same bytes and at less cost (``ember walk --bag``, ``sim_node -p bag:=DIR``).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.node import Node

from ember_ros import topics
from ember_ros.bag.robot_recorder import LOG_S, RobotRecorder
from ember_ros.bag.storage import BagOptions, size_of
from ember_ros.bag.writer_process import WriterProcess
from ember_ros.errors import BagError, ParameterError
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.spinning import node_main
from ember_ros.timers import create_steady_timer

POLL_S = 0.1
"""Wall time between two polls of the graph and of the metadata clients."""


class RecorderNode(Node):  # type: ignore[misc]
    """Subscribes to a robot and writes a bag.

    Subscribes: all topics of a robot, as their bytes. Publishes: ``recorder/tick``
    (std_msgs/Int64), -1 when it is ready. Calls, once each, before it begins: the
    nodes' ``get_parameters`` and ``table/pull``, for what determines the run.
    Parameters: ``bag``, ``split_mb``, ``split_s``, ``all_robots``.
    """

    GROUPS = ()
    OPTIONS = ("bag", "split_mb", "split_s", "all_robots")

    def __init__(self, **kwargs: Any) -> None:
        """Make the node and the bag; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range, or ``bag`` is not given.
            BagError: the bag cannot be made.
        """
        super().__init__(
            "recorder_node", automatically_declare_parameters_from_overrides=True, **kwargs
        )
        self.done = False
        declare_params(self, self.GROUPS)  # refuses unknown names
        options = declare_options(self, self.OPTIONS)
        if not options["bag"]:
            raise ParameterError("give the folder of a new bag: --ros-args -p bag:=DIR")
        self._folder = Path(options["bag"])
        splits = (options[name] for name in BagOptions._fields[1:])
        self._writer = WriterProcess(BagOptions(self._folder, *splits))
        self._writer.flush()  # returns when the process is ready: no message waits for its start
        self._all = options["all_robots"]
        self._robots: dict[str, RobotRecorder] = {}
        if not self._all:
            self._add_robot(self.get_namespace().strip("/"))
        self._logged = time.monotonic()
        self._poll_timer = create_steady_timer(self, POLL_S, self._poll)

    def _add_robot(self, namespace: str) -> None:
        self._robots[namespace] = RobotRecorder(self, self._writer, namespace)

    def _poll(self) -> None:
        if self._all:
            end = "/" + topics.PHASE.name
            for topic, _ in sorted(self.get_topic_names_and_types()):
                namespace = topic[: -len(end)].strip("/")
                if topic.endswith(end) and namespace not in self._robots:
                    self._add_robot(namespace)
        for robot in self._robots.values():
            robot.poll()
            if robot.restarted and not self.done:
                self.done = True
                self.get_logger().warning(
                    f"the time of /{robot.namespace} went back after tick {robot.last_tick}: a bag "
                    "holds one run, and ends here"
                )
        now = time.monotonic()
        if now - self._logged >= LOG_S:
            self._logged = now
            self._log_progress()

    def _log_progress(self) -> None:
        lines = "; ".join(robot.progress() for robot in self._robots.values())
        lines = lines or "no robot on the graph yet"
        self.get_logger().info(f"{lines}; {size_of(self._folder) / 1e6:.1f} MB")

    def finish(self, spin: Callable[[], None]) -> None:
        """Write what was received, and close the bag.

        Raises:
            BagError: nothing was received, or the bag could not be written to its end.
        """
        self.done = True
        for robot in self._robots.values():
            robot.finish()
        self._writer.close()
        if not any(robot.run_writer for robot in self._robots.values()):
            where = "anywhere" if self._all else f"in {self.get_namespace()}"
            raise BagError(
                f"no robot was found {where}: the bag {self._folder} is empty; the "
                "robot must be in the same namespace, domain and discovery range"
            )
        self._log_progress()

    def destroy_node(self) -> None:
        """Destroy the node; a bag that was not finished ends here."""
        self._writer.abandon()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal."""
    sys.exit(node_main(RecorderNode, args))


if __name__ == "__main__":
    main()
