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
    """Merges what the legs push, answers what they pull, never waits for anybody.

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
        self.lock_name(topics.PUSH)  # before any file: they are the other one's, maybe
        self._save = Path(options["save"]) if options["save"] else None
        self._seed = options["seed"]
        self._numbers = numbers_of(params, options["stage"])
        self._journal = Journal(self._save) if self._save else None
        self._born = time.time_ns()  # versions of a later life are greater than all before
        self._generation = 0
        restored = self._take_up()
        self._has_past = restored or bool(options["table"])
        if not restored:
            given = Path(options["table"]) if options["table"] else None
            if given is None and self._save is not None and self._save.exists():
                given = self._save  # never replace what was learnt by less
                self._has_past = True
                self.get_logger().warning(f"going on from {given}, which is there already")
            table, about = load_table(given, params) if given else (empty_table(params), {})
            if given:
                other = describe_differences(given, about, params, self.GROUPS)
                if other is not None:
                    self.get_logger().warning(other)
            self.shared = self._share(table)
        if self._journal:
            self._snapshot()
        else:
            self.get_logger().info("what is learnt will be lost: no -p save:=FILE.npz was given")
        self.refused = 0
        self._throttle = Throttle(lambda text: self.get_logger().warning(text))
        topics.PUSH.serve(self, self._push)
        topics.PULL.serve(self, self._pull)
        topics.SAVE.serve(self, self._save_now)
        topics.LEARNING.serve(self, self._set_learning)

    # -- lasting -----------------------------------------------------------------------------

    def _share(self, table: Table) -> SharedTable:
        return SharedTable(
            table,
            legs=len(self._params.robot.legs),
            cells=cells_sha256(self._params),
            rate=self._numbers.rate,
            version=self._born,
        )

    def _take_up(self) -> bool:
        """Go on where an earlier life was cut off: its journal is still there."""
        if self._save is None or self._journal is None or not self._journal.file.exists():
            return False
        try:
            table, about = load_table(self._journal.snapshot, self._params)
            state = about["shared"]
        except (TableError, KeyError) as why:
            raise TableError(
                f"{self._journal.file} is left of a table that was cut off, but its snapshot "
                f"cannot be used ({why}); move both away to start anew"
            ) from None
        self.shared = self._share(table)
        self._generation = state["generation"]
        self.shared.restore(
            {int(leg): runs for leg, runs in state["done"].items()},
            [from_json(push) for push in state["pending"]],
        )
        later = self._journal.read(self._generation)
        for push in later:
            self.shared.push(push)
        self.get_logger().warning(
            f"taken up where it was cut off: {self._journal.snapshot} and {len(later)} pushes "
            "after; a table given by table:= is not used"
        )
        return True

    def _snapshot(self) -> None:
        """Write the table with what is not merged, and begin a new journal behind it."""
        assert self._journal is not None
        self._generation += 1
        state = {
            "generation": self._generation,
            "done": self.shared.done(),
            "pending": [to_json(push) for push in self.shared.pending()],
        }
        notes = {"shared": state}
        save_table(self._journal.snapshot, self.shared.table, self._params, self._seed, notes)
        self._journal.begin(self._generation)

    # -- answering ---------------------------------------------------------------------------

    def _refuse(self, why: EmberError) -> str:
        self.refused += 1
        self._throttle.remind("refused", f"refused ({self.refused} so far): {why}")
        return str(why)

    def _push(
        self,
        request: SetParametersAtomically.Request,
        response: SetParametersAtomically.Response,
    ) -> SetParametersAtomically.Response:
        try:
            push = calls.read_push(request)
            fresh = self.shared.push(push)
            if fresh and self._journal and self.shared.learning:
                self._journal.add(push)
                if self._journal.pushes >= MAX_BATCHES:
                    self._snapshot()
        except EmberError as why:
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
            since, upto, wanted = calls.read_pull(request)
            if since is not None and 0 <= since < self._born and not self._has_past:
                raise UpdateError(
                    f"pull: version {since} is of a table that was here before; this one was "
                    "started without its file, and does not overwrite what the leg knows"
                )
        except UpdateError as why:
            self._refuse(why)
            return response  # empty: all this type has to say no with
        changes = self.shared.pull(since, upto)
        response.values = calls.write_pull_response(wanted, changes, self._about)
        return response

    def _about(self) -> str:
        return json.dumps({"seed": self._seed, "params": as_dict(self._params)})

    def save(self) -> str:
        """Write the table with all that was pushed, and return its SHA-256.

        Nothing is merged for it: a save in the middle of an epoch must not change what is learnt.

        Raises:
            TableError: it cannot be written.
        """
        assert self._save is not None
        table = self.shared.preview()
        save_table(self._save, table, self._params, self._seed)
        return table.sha256()

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

    def is_needed(self) -> bool:
        """Return whether a leg is there that could hand in what it has learnt."""
        return bool(self.count_clients(topics.PUSH.name))

    def finish(self, spin: Callable[[], None]) -> None:
        """Merge and write the table."""
        self.shared.merge()
        if self._journal is not None:
            sha = self.save()
            self._journal.remove()
            self.get_logger().info(f"table {sha[:12]} is in {self._save}")

    def destroy_node(self) -> None:
        """Destroy the node; snapshot and journal stay unless it was finished."""
        if self._journal is not None:
            self._journal.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal, serve legs that end at the same time, then write the table."""
    sys.exit(node_main(TableNode, args, TableNode.is_needed))


if __name__ == "__main__":
    main()
