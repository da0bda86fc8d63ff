"""The table that all legs share, as a node: ``ros2 run ember_ros table_node``."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from ember_ros import topics
from ember_ros.errors import EmberError, TableError, UpdateError
from ember_ros.name_lock import SingleNode
from ember_ros.params import as_dict, cells_sha256
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.spinning import node_main
from ember_ros.throttle import Throttle
from leg_node import calls
from leg_node.assembly import empty_table, numbers_of
from leg_node.journal import MAX_BATCHES, Journal, from_json, to_json
from leg_node.shared import SharedTable
from leg_node.table import Table
from leg_node.table_file import describe_differences, load_table, save_table


class TableNode(SingleNode, Node):  # type: ignore[misc]
    """Stores the Q-table that all legs share.

    The legs push their updates of an epoch and pull the merged table. The order in which pushes
    arrive changes no bit of the result. The node never waits for a leg. With ``save`` set, each
    push is written to a journal before it is acknowledged, so a crash loses no acknowledged push;
    the table itself is written when the node ends and by ``table/save``.

    Services: ``table/push`` (rcl_interfaces/SetParametersAtomically),
    ``table/pull`` (rcl_interfaces/GetParameters), ``table/save`` (std_srvs/Trigger),
    ``table/learning`` (std_srvs/SetBool).
    Parameters: ``gait.*``, ``leg.*``, ``robot.*``, ``parts.*``, ``state.*``, ``train.*``,
    ``walk.*``; ``stage``, ``table``, ``save``, ``seed``.
    """

    GROUPS = ("gait", "leg", "robot", "parts", "state", "train", "walk")
    OPTIONS = ("stage", "table", "save", "seed")

    def __init__(self, **kwargs: Any) -> None:
        """Make the node; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range.
            TableError: the file ``table`` cannot be used.
            NameTakenError: there is another table in this namespace.
        """
        super().__init__(
            "table_node", automatically_declare_parameters_from_overrides=True, **kwargs
        )
        self.done = False
        self._params = params = declare_params(self, self.GROUPS)
        options = declare_options(self, self.OPTIONS)
        self.lock_name(topics.PUSH)  # before any file is touched: another table may own them
        self._save = Path(options["save"]) if options["save"] else None
        self._seed = options["seed"]
        self._numbers = numbers_of(params, options["stage"])
        self._journal = Journal(self._save) if self._save else None
        self._first_version = time.time_ns()  # greater than all versions of an earlier process
        self._generation = 0
        restored = self._recover()
        self._has_history = restored or bool(options["table"])
        if not restored:
            file = Path(options["table"]) if options["table"] else None
            if file is None and self._save is not None and self._save.exists():
                file = self._save  # never overwrite a learnt table with an empty one
                self._has_history = True
                self.get_logger().warning(f"continuing from {file}, which exists already")
            table, about = load_table(file, params) if file else (empty_table(params), {})
            if file:
                differences = describe_differences(file, about, params, self.GROUPS)
                if differences is not None:
                    self.get_logger().warning(differences)
            self.shared = self._shared_table(table)
        if self._journal:
            self._snapshot()
        else:
            self.get_logger().info("the table will not be saved; -p save:=FILE.npz saves it")
        self.refused = 0
        self._throttle = Throttle(lambda text: self.get_logger().warning(text))
        topics.PUSH.serve(self, self._on_push)
        topics.PULL.serve(self, self._on_pull)
        topics.SAVE.serve(self, self._on_save)
        topics.LEARNING.serve(self, self._on_learning)

    # -- durability --------------------------------------------------------------------------

    def _shared_table(self, table: Table) -> SharedTable:
        return SharedTable(
            table,
            legs=len(self._params.robot.legs),
            cells=cells_sha256(self._params),
            rate=self._numbers.rate,
            version=self._first_version,
        )

    def _recover(self) -> bool:
        """Restore the table of an earlier process that was killed and left its journal.

        Returns:
            False if there is no journal.

        Raises:
            TableError: there is a journal, but its snapshot cannot be used.
        """
        if self._save is None or self._journal is None or not self._journal.file.exists():
            return False
        try:
            table, about = load_table(self._journal.snapshot, self._params)
            state = about["shared"]
        except (TableError, KeyError) as why:
            raise TableError(
                f"{self._journal.file} is the journal of a table_node that was killed, but its "
                f"snapshot cannot be used ({why}); move both files away to start with a new table"
            ) from None
        self.shared = self._shared_table(table)
        self._generation = state["generation"]
        self.shared.restore(
            {int(leg): runs for leg, runs in state["done"].items()},
            [from_json(push) for push in state["pending"]],
        )
        later = self._journal.read(self._generation)
        for push in later:
            self.shared.push(push)
        self.get_logger().warning(
            f"recovered after a crash: {self._journal.snapshot} and {len(later)} later pushes; "
            "the parameter table is ignored"
        )
        return True

    def _snapshot(self) -> None:
        """Write the table and the pushes not merged yet, and start a new journal."""
        assert self._journal is not None
        self._generation += 1
        state = {
            "generation": self._generation,
            "done": self.shared.done(),
            "pending": [to_json(push) for push in self.shared.pending()],
        }
        notes = {"shared": state}
        save_table(self._journal.snapshot, self.shared.table, self._params, self._seed, notes)
        self._journal.start(self._generation)

    # -- services ----------------------------------------------------------------------------

    def _refuse(self, why: EmberError) -> str:
        """Count a request that is refused; log the count from time to time."""
        self.refused += 1
        self._throttle.remind("refused", f"refused ({self.refused} so far): {why}")
        return str(why)

    def _on_push(
        self,
        request: SetParametersAtomically.Request,
        response: SetParametersAtomically.Response,
    ) -> SetParametersAtomically.Response:
        try:
            push = calls.read_push(request)
            is_new = self.shared.push(push)
            if is_new and self._journal and self.shared.learning:
                self._journal.add(push)
                if self._journal.pushes >= MAX_BATCHES:
                    self._snapshot()
        except EmberError as why:
            response.result.successful = False
            response.result.reason = self._refuse(why)
        else:
            response.result.successful = True
            response.result.reason = "" if is_new else "received before: nothing changed"
        return response

    def _on_pull(
        self, request: GetParameters.Request, response: GetParameters.Response
    ) -> GetParameters.Response:
        try:
            since, upto, wanted = calls.read_pull(request)
            if since is not None and 0 <= since < self._first_version and not self._has_history:
                raise UpdateError(
                    f"pull: version {since} belongs to an earlier table_node; this one was started "
                    "without its file and does not overwrite what the leg has learnt"
                )
        except UpdateError as why:
            self._refuse(why)
            return response  # empty: this service type has no other way to refuse
        changes = self.shared.pull(since, upto)
        response.values = calls.write_pull_response(wanted, changes, self._about)
        return response

    def _about(self) -> str:
        return json.dumps({"seed": self._seed, "params": as_dict(self._params)})

    def save(self) -> str:
        """Write the table with all pushes, and return its SHA-256.

        The pushes are merged in a copy only: saving during an epoch must not change the learning.

        Raises:
            TableError: it cannot be written.
        """
        assert self._save is not None
        table = self.shared.preview()
        save_table(self._save, table, self._params, self._seed)
        return table.sha256()

    def _on_save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._save is None:
            response.message = "no file to save to: start the node with -p save:=FILE.npz"
            return response
        try:
            response.message = f"{self._save}: {self.save()}"
            response.success = True
        except TableError as why:
            response.message = str(why)
        return response

    def _on_learning(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self.shared.learning = request.data
        response.success = True
        response.message = "pushes are merged" if request.data else "pushes are dropped"
        self.get_logger().info(f"learning: {response.message}")
        return response

    def is_needed(self) -> bool:
        """Return whether a leg is connected that may still push updates."""
        return bool(self.count_clients(topics.PUSH.name))

    def finish(self, spin: Callable[[], None]) -> None:
        """Merge all pushes and write the table."""
        self.shared.merge()
        if self._journal is not None:
            sha = self.save()
            self._journal.remove()
            self.get_logger().info(f"table {sha[:12]} is in {self._save}")

    def destroy_node(self) -> None:
        """Destroy the node; the snapshot and the journal stay unless ``finish`` was called."""
        if self._journal is not None:
            self._journal.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal; serve legs that end at the same time; write the table."""
    sys.exit(node_main(TableNode, args, TableNode.is_needed))


if __name__ == "__main__":
    main()
