"""The table that all legs share, as a node: ``ros2 run ember_ros table_node``."""

from __future__ import annotations

import json
import secrets
import sys
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
from leg_node.assembly import empty_table, learning_params_of
from leg_node.durable_table import MAX_LIFE, DurableTable
from leg_node.store import Stored, TableStore
from leg_node.table import Table
from leg_node.table_file import describe_differences, load_table, save_table


class TableNode(SingleNode, Node):  # type: ignore[misc]
    """Stores the Q-table that all legs share.

    The legs push their updates of an epoch and pull the merged table. The order in which pushes
    arrive changes no bit of the result. The node never waits for a leg. With ``save`` set, each
    push is written to a database beside that file before it is acknowledged, so a crash loses no
    acknowledged push; the table itself is written when the node ends and by ``table/save``. A file
    ``save`` that exists is continued, whatever ``table`` says, unless ``fresh`` is true.

    Services: ``table/push`` (rcl_interfaces/SetParametersAtomically),
    ``table/pull`` (rcl_interfaces/GetParameters), ``table/save`` (std_srvs/Trigger),
    ``table/learning`` (std_srvs/SetBool).
    Parameters: ``gait.*``, ``leg.*``, ``robot.*``, ``parts.*``, ``state.*``, ``train.*``,
    ``walk.*``; ``stage``, ``table``, ``save``, ``fresh``, ``durability``, ``seed``.
    """

    GROUPS = ("gait", "leg", "robot", "parts", "state", "train", "walk")
    OPTIONS = ("stage", "table", "save", "fresh", "durability", "seed")

    def __init__(self, **kwargs: Any) -> None:
        """Make the node; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range.
            TableError: the file ``table`` or ``save`` cannot be used, or the database beside
                ``save`` belongs to another process.
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
        learning_params = learning_params_of(params, options["stage"])
        self._cells_sha256 = cells_sha256(params)
        self._store: TableStore | None = None
        if self._save is not None:
            self._store = TableStore(self._save, self._cells_sha256, options["durability"])
        try:
            stored = self._load_store()
            if stored is not None:
                file, table = None, stored.table
            else:
                start = Path(options["table"]) if options["table"] else None
                file = self._file_to_load(start, options["fresh"])
                table = self._load_table(file) if file else empty_table(params)
            self._has_history = stored is not None or file is not None
            self.shared = DurableTable(
                table,
                legs=len(params.robot.legs),
                cells=self._cells_sha256,
                rate=learning_params.rate,
                sync_every=learning_params.sync_every,
                life=1 + secrets.randbelow(MAX_LIFE),
                store=self._store,
            )
            if stored is not None:
                self.shared.resume(stored)
            elif self._store is None:
                self.get_logger().info("the table will not be saved; -p save:=FILE.npz saves it")
            self.shared.checkpoint()
        except BaseException:
            self._close_store()
            raise
        self.refused = 0
        self._throttle = Throttle(lambda text: self.get_logger().warning(text))
        topics.PUSH.serve(self, self._on_push)
        topics.PULL.serve(self, self._on_pull)
        topics.SAVE.serve(self, self._on_save)
        topics.LEARNING.serve(self, self._on_learning)

    # -- start -------------------------------------------------------------------------------

    def _load_store(self) -> Stored | None:
        """Return what an earlier process left that was killed; None if there is nothing.

        It is continued even if ``fresh`` is true: a node that is started again after a crash gets
        the options of its first start.

        Raises:
            TableError: the database cannot be used.
        """
        if self._store is None:
            return None
        empty = empty_table(self._params)
        stored = self._store.load(empty.states, empty.actions)
        if stored is None:
            return None
        self.get_logger().warning(
            f"recovered after a crash: {self._store.file} with {len(stored.pushes)} later pushes; "
            "the parameters table and fresh are ignored; to start anew, move the file away"
        )
        return stored

    def _file_to_load(self, start: Path | None, fresh: bool) -> Path | None:
        """Return the file to start from: ``save`` if it exists, otherwise ``table``, if any."""
        if self._save is None or fresh or not self._save.exists():
            return start
        ignored = f"; the parameter table = {start} is ignored" if start else ""
        self.get_logger().warning(
            f"continuing from {self._save}, which exists already{ignored}; -p fresh:=true starts "
            "anew"
        )
        return self._save  # never overwrite what was learned

    def _load_table(self, file: Path) -> Table:
        """Return the table in a file; log the parameters that differ.

        Raises:
            TableError: the file cannot be used.
        """
        table, about = load_table(file, self._params)
        differences = describe_differences(file, about, self._params, self.GROUPS)
        if differences is not None:
            self.get_logger().warning(differences)
        return table

    def _close_store(self) -> None:
        if self._store is not None:
            self._store.close()

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
        except TableError as why:
            response.result.successful = False
            response.result.reason = calls.NOT_STORED + self._refuse(why)
        except UpdateError as why:
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
            if since is not None and since < 0:
                since = None
            if since is not None and not self.shared.is_own(since) and not self._has_history:
                raise UpdateError(
                    f"pull: version {since} belongs to an earlier table_node; this one was started "
                    "without its file and does not overwrite what the leg has learnt"
                )
        except UpdateError as why:
            self._refuse(why)
            return response  # empty: this service type has no other way to refuse
        changes = self.shared.pull(since, upto)
        response.values = calls.write_pull_response(
            wanted, changes, self._cells_sha256, self._about
        )
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
        self.shared.merges_pushes = request.data
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
        if self._store is not None:
            sha = self.save()
            self._store.remove()
            self.get_logger().info(f"table {sha[:12]} is in {self._save}")

    def destroy_node(self) -> None:
        """Destroy the node; the database stays unless ``finish`` was called."""
        self._close_store()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal; serve legs that end at the same time; write the table."""
    sys.exit(node_main(TableNode, args, TableNode.is_needed))


if __name__ == "__main__":
    main()
