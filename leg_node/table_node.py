"""The table that all legs share, as a node: ``ros2 run ember_ros table_node``."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from ember_ros import topics, wire
from ember_ros.errors import PushError, TableError
from ember_ros.params import as_dict, cells_sha256
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.spinning import main_of
from leg_node.shared import SharedTable
from leg_node.table import empty_table, load_table, save_table


class TableNode(Node):  # type: ignore[misc]
    """Merges what the legs push, answers what they pull, never waits for anybody.

    Services: ``table/push`` (rcl_interfaces/SetParametersAtomically),
    ``table/pull`` (rcl_interfaces/GetParameters), ``table/save`` (std_srvs/Trigger),
    ``table/learning`` (std_srvs/SetBool).
    Parameters: ``gait.*``, ``leg.*``, ``state.*``, ``train.*``, ``walk.*``; ``stage``, ``table``,
    ``save``, ``seed``.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Make the node; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range.
            TableError: the file ``table`` cannot be used.
        """
        super().__init__(
            "table_node", automatically_declare_parameters_from_overrides=True, **kwargs
        )
        self.done = False
        self._params = declare_params(self, ("gait", "leg", "state", "train", "walk"))
        options = declare_options(self, ("stage", "table", "save", "seed"))
        self._save = Path(options["save"]) if options["save"] else None
        self._seed = options["seed"]
        params = self._params
        table = load_table(Path(options["table"]), params)[0] if options["table"] else None
        numbers = params.walk if options["stage"] == "walk" else params.train
        self.shared = SharedTable(
            table or empty_table(params), cells=cells_sha256(params), floor=numbers.alpha_floor
        )
        self.refused = 0
        topics.PUSH.serve(self, self._push)
        topics.PULL.serve(self, self._pull)
        topics.SAVE.serve(self, self._save_now)
        topics.LEARNING.serve(self, self._set_learning)

    def _refuse(self, why: PushError) -> str:
        self.refused += 1
        self.get_logger().warning(f"refused ({self.refused} so far): {why}")
        return str(why)

    def _push(
        self,
        request: SetParametersAtomically.Request,
        response: SetParametersAtomically.Response,
    ) -> SetParametersAtomically.Response:
        try:
            fresh = self.shared.push(wire.read_push(request))
        except PushError as why:
            response.result.successful = False
            response.result.reason = self._refuse(why)
        else:
            response.result.successful = True
            response.result.reason = "" if fresh else "taken before: nothing changed"
        return response

    def _pull(
        self, request: GetParameters.Request, response: GetParameters.Response
    ) -> GetParameters.Response:
        try:
            since, upto, wanted = wire.read_pull(request)
        except PushError as why:
            self._refuse(why)
            return response  # empty: all this type has to say no with
        changes = self.shared.pull(since, upto)
        response.values = wire.answer_pull(wanted, changes, self._about)
        return response

    def _about(self) -> str:
        return json.dumps({"seed": self._seed, "params": as_dict(self._params)})

    def save(self) -> str:
        """Merge all there is, write the table if there is where to, and return its SHA-256.

        Raises:
            TableError: it cannot be written.
        """
        self.shared.merge()
        if self._save is not None:
            save_table(self._save, self.shared.table, self._params, self._seed)
        return self.shared.table.sha256()

    def _save_now(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._save is None:
            response.message = "nowhere to save to: start the node with -p save:=FILE.npz"
            return response
        try:
            response.message = f"{self._save}: {self.save()}"
            response.success = True
        except TableError as why:
            response.message = str(why)
        return response

    def _set_learning(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self.shared.learning = request.data
        response.success = True
        response.message = "pushes are merged" if request.data else "pushes are dropped"
        self.get_logger().info(f"learning: {response.message}")
        return response

    def finish(self, spin: Callable[[], None]) -> None:
        """Write the table."""
        sha = self.save()
        if self._save is not None:
            self.get_logger().info(f"table {sha[:12]} is in {self._save}")


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal, then write the table."""
    sys.exit(main_of(TableNode, args))


if __name__ == "__main__":
    main()
