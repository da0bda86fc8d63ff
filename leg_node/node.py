"""A leg as a node: ``ros2 run ember_ros leg_node --ros-args -p leg:=front_left``."""

from __future__ import annotations

import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.task import Future

from ember_ros import topics, wire
from ember_ros.errors import ParameterError, SignalError, UpdateError
from ember_ros.inbox import Inbox, Receipt
from ember_ros.name_lock import SingleNode
from ember_ros.params import cells_sha256
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.signals import Beat, LegCommand, LegSense
from ember_ros.spinning import FINAL_PUSH_S, node_main
from ember_ros.throttle import Throttle
from ember_ros.timers import create_steady_timer
from leg_node import calls
from leg_node.assembly import make_leg
from leg_node.shared import UpdateBatch
from leg_node.table_file import load_table, save_table

RESEND_S = 0.5  # wall time after which a leg that ends sends a push again
WATCH_S = 0.1  # wall time between checks whether the table responds
MAX_PATIENCE_S = 30.0  # longest wall time between two requests for the first table
WAIT_S = 2.0  # wall time after which a leg logs that it cannot start without the table


UPDATES_LOST = 4
"""Exit code of a leg that ended before the table had all of its updates."""


class LegNode(SingleNode, Node):  # type: ignore[misc]
    """Controls one leg, and learns from what the leg does.

    At each tick the node receives the leg's own sensors and the phase, chooses an action and
    publishes the motor command. It senses no other leg. If the table is shared, it pushes its
    updates to the table_node and pulls the merged table after every epoch. While the table_node
    does not respond, the leg continues alone and keeps its updates for it. When the sensors of a
    tick are repeated, because the world waits for a message that was lost, the command is too.

    Subscribes: ``<leg>/joint_states``, ``<leg>/contact`` (sensor_msgs/JointState), ``cpg/phase``
    (sensor_msgs/JointState).
    Publishes: ``<leg>/command``, ``<leg>/transition`` (sensor_msgs/JointState).
    Calls: ``table/push`` (rcl_interfaces/SetParametersAtomically), ``table/pull``
    (rcl_interfaces/GetParameters); neither if ``shared`` is false, or if the leg needs no table
    (``policy`` is not ``learned`` and ``learning`` is false).
    Parameters: ``gait.*``, ``leg.*``, ``robot.*``, ``parts.*``, ``state.*``, ``reward.*``,
    ``script.*``, ``train.*``, ``walk.*``; ``leg``, ``stage``, ``seed``, ``policy``, ``learning``,
    ``shared``, ``start_cycle``, ``table_patience``; ``table`` and ``save`` only if ``shared`` is
    false.
    """

    GROUPS = ("gait", "leg", "robot", "parts", "state", "reward", "script", "train", "walk")
    OPTIONS = (
        "leg", "stage", "seed", "policy", "learning", "shared", "start_cycle", "table", "save",
        "table_patience",
    )  # fmt: skip

    def __init__(self, **kwargs: Any) -> None:
        """Make the node; ``kwargs`` go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range, or there is no such leg.
            TableError: the file ``table`` cannot be used.
            NameTakenError: there is another such leg in this namespace.
        """
        kwargs.setdefault("node_name", "leg_node")
        super().__init__(automatically_declare_parameters_from_overrides=True, **kwargs)
        self.done = False
        self.exit_code = 0
        params = declare_params(self, self.GROUPS)
        options = declare_options(self, self.OPTIONS)
        self._patience = options["table_patience"]  # shorter than the world waits for a leg
        shared = options["shared"]
        if shared and (options["table"] or options["save"]):
            raise ParameterError(
                "a leg that shares its table neither loads nor saves one; set table and save on "
                "the table_node, or set shared to false"
            )
        self._params, self._seed = params, options["seed"]
        self._save = Path(options["save"]) if options["save"] else None
        self.module = make_leg(
            params,
            options["leg"],
            stage=options["stage"],
            seed=options["seed"],
            policy=options["policy"],
            learning=options["learning"],
            shared=shared,
            table=load_table(Path(options["table"]), params)[0] if options["table"] else None,
            run=uuid.uuid4().hex,
            start_cycle=options["start_cycle"],
        )
        self.refused = 0
        leg = self.module.leg
        self.lock_name(topics.command(leg))
        self._cells_sha256 = cells_sha256(params)
        self._inbox = Inbox("joints", "contact", "phase")
        self._beat_wire = wire.BeatWire(params.gait.tick_ns)
        self._sense_wire = wire.SenseWire(leg, params.gait.tick_ns)
        self._command_wire = wire.CommandWire(leg, params.gait.tick_ns)
        self._transition_wire = wire.TransitionWire(leg, params.gait.tick_ns)
        self._throttle = Throttle(lambda text: self.get_logger().warning(text))
        self._last_answer: tuple[int, bytes, bytes] | None = None  # tick, transition, command
        self._start = time.monotonic()
        # A leg is in one of four states: no tick waits for the table (`_waiting` is None), or one
        # waits for the first table, for a pull, or for the response to a push. `_on_pull_response`
        # and `_on_push_response` end a wait; so does `_watch_table`, every WATCH_S, after
        # `_deadline`. `_waiting` continues the tick, and identifies the wait.
        self._waiting: Callable[[], None] | None = None
        self._on_timeout: Callable[[], None] | None = None
        self._first_pull_patience = self._patience
        self._push_wait: Callable[[], None] | None = None  # the last one that waited for a push
        self._deadline = 0.0
        self._table_absent = False
        self._pushing: UpdateBatch | None = None

        # Created before the command: endpoints are discovered in the order of their creation, so a
        # world that knows the command's publisher knows that this leg publishes transitions.
        self._transition_publisher = topics.transition(leg).publish(self)
        self._command_publisher = topics.command(leg).publish(self)
        topics.joint_states(leg).subscribe(self, self._on_joint_states)
        topics.contact(leg).subscribe(self, self._on_contact)
        topics.PHASE.subscribe(self, self._on_phase)
        if self.module.shared:
            self._push_client = topics.PUSH.call(self)
            self._pull_client = topics.PULL.call(self)
            create_steady_timer(self, WATCH_S, self._watch_table)

    # -- inputs ------------------------------------------------------------------------------

    def _refuse(self, why: Exception | str) -> None:
        """Count a message that is not used; log the count from time to time."""
        self.refused += 1
        self._throttle.remind("refused", f"refused ({self.refused} so far): {why}")

    def _on_joint_states(self, data: bytes) -> None:
        self._receive("joints", data, self._sense_wire.read_joints)

    def _on_contact(self, data: bytes) -> None:
        self._receive("contact", data, self._sense_wire.read_contact)

    def _on_phase(self, data: bytes) -> None:
        self._receive("phase", data, self._read_beat)

    def _read_beat(self, data: bytes) -> tuple[int, Beat]:
        beat = self._beat_wire.read(data)
        return beat.tick, beat

    def _receive(self, source: str, data: bytes, read: Callable[[bytes], tuple[int, Any]]) -> None:
        try:
            tick, value = read(data)
        except SignalError as why:
            self._refuse(why)
        else:
            self._store(source, tick, value)

    def _store(self, source: str, tick: int, value: Any) -> None:
        if self.done:
            return  # the last updates are being pushed
        last = self._inbox.last
        receipt = self._inbox.put(source, tick, value)
        if receipt is Receipt.NEW:
            if self._waiting is None:
                self._start_if_complete(tick)
        elif self._inbox.time_restarted():
            self._restart_time(tick, last)
        elif receipt is Receipt.OVER:
            self._refuse(f"{self.module.leg} {source}: tick {tick} is over, last was {last}")
        elif source == "joints":  # they stand for all three messages of a repeated tick
            self._publish_answer(tick)

    def _restart_time(self, tick: int, last: int) -> None:
        """Begin anew at the first tick of a new world; what was learned stays."""
        self.get_logger().warning(f"time restarted at tick {tick}, the last was {last}")
        self.module.reset(last, uuid.uuid4().hex)
        self._start_if_complete(tick)

    def _start_if_complete(self, tick: int) -> None:
        """Start a tick if all its messages have arrived and the table is or was available."""
        if self.done:
            return
        if self.module.shared and self.module.copy.version is None and not self._table_available():
            return  # a leg does not start with an empty table while the table_node is starting
        values = self._inbox.pop(tick)
        if values is not None:
            joints, contact, beat = values
            self._start_tick(self._sense_wire.sense(tick, joints, contact), beat)

    def _start_available_ticks(self) -> None:
        """Start the ticks whose messages arrived while another tick waited for the table."""
        for tick in self._inbox.pending("phase"):
            if self._waiting is None:
                self._start_if_complete(tick)

    def _table_available(self) -> bool:
        return bool(self._pull_client.service_is_ready() and self._push_client.service_is_ready())

    # -- one tick ----------------------------------------------------------------------------

    def _start_tick(self, sense: LegSense, beat: Beat) -> None:
        """Pull the table if an epoch begins, then act."""
        upto = self.module.copy.epoch_to_pull(sense.tick)
        if upto is None or self._table_absent:
            self._act(sense, beat)
            return

        def act() -> None:
            self._act(sense, beat)

        self._send_pull(upto, act)
        if self.module.copy.version is not None:
            self._wait(act)
        else:
            self._wait_for_first_table(upto, act)

    def _send_pull(self, upto: int, then: Callable[[], None]) -> None:
        """Request what changed up to an epoch; the response continues the tick with ``then``."""
        future = self._pull_client.call_async(calls.write_pull(self.module.copy.version, upto))
        future.add_done_callback(lambda done: self._on_pull_response(done, upto, then))

    def _wait_for_first_table(self, upto: int, then: Callable[[], None]) -> None:
        """Wait for the first table, without which the leg does not start; ask for it repeatedly.

        Any of the responses is welcome, the late ones too: on a slow network all may be late.
        """

        def ask_again() -> None:
            self._first_pull_patience = min(2.0 * self._first_pull_patience, MAX_PATIENCE_S)
            self._throttle.remind("waiting", "waiting for the first table from the table_node")
            self._send_pull(upto, then)
            self._wait_for_first_table(upto, then)

        self._wait(then, ask_again, self._first_pull_patience)

    def _on_pull_response(self, future: Future, upto: int, waiting: Callable[[], None]) -> None:
        if self._waiting is not waiting:
            return  # too late: the tick has continued without it
        copy = self.module.copy
        try:
            changes = calls.read_changes(future.result(), copy.table, self._cells_sha256)
        except UpdateError as why:
            self._refuse(why)
            if copy.version is None:
                return  # a leg does not start without the shared table; it asks again
            copy.skip_sync(upto)
        else:
            copy.apply(changes, upto)
        self._resume()

    def _act(self, sense: LegSense, beat: Beat) -> None:
        """Choose the action, push if an epoch ends, then publish the command."""
        command = self.module.tick(sense, beat)
        self.module.copy.close_epoch(sense.tick)
        if self.module.copy.oldest_unacknowledged() is None:
            self._publish(command)
            return
        self._send_push()
        if self._table_absent:
            self._publish(command)
        else:
            self._push_wait = lambda: self._publish(command)
            self._wait(self._push_wait)

    def _publish(self, command: LegCommand) -> None:
        self._last_answer = (
            command.tick,
            self._transition_wire.pack(self.module.last_transition),
            self._command_wire.pack(command),
        )
        self._publish_answer(command.tick)
        self._start_available_ticks()

    def _publish_answer(self, tick: int) -> None:
        """Publish transition and command of a tick, if it is the last one that was answered."""
        if self._last_answer is not None and self._last_answer[0] == tick:
            _, transition, command = self._last_answer
            self._transition_publisher.publish(transition)
            self._command_publisher.publish(command)

    # -- the table ---------------------------------------------------------------------------

    def _send_push(self) -> None:
        """Send the oldest push that is not acknowledged, unless its response is still awaited."""
        push = self.module.copy.oldest_unacknowledged()
        if push is None or push is self._pushing:
            return
        self._pushing = push
        future = self._push_client.call_async(calls.write_push(push))
        future.add_done_callback(lambda done: self._on_push_response(done, push))

    def _on_push_response(self, future: Future, push: UpdateBatch) -> None:
        if push is self._pushing:
            self._pushing = None
        result = future.result().result
        if not result.successful:
            self._refuse(f"the table refused a push: {result.reason}")
            if result.reason.startswith(calls.NOT_STORED):
                if self.done:
                    self._pushing = push  # `finish` sends it again after a while
                else:
                    self._leave_table()
                return
        # A refused push is dropped: the table would refuse it again.
        self.module.copy.acknowledged(push)
        self._mark_table_present()
        if self.module.copy.oldest_unacknowledged() is not None:
            self._send_push()
        elif self._push_wait is not None and self._waiting is self._push_wait:
            self._resume()

    def _wait(
        self,
        then: Callable[[], None],
        on_timeout: Callable[[], None] | None = None,
        patience: float | None = None,
    ) -> None:
        """Hold the tick until the table responds.

        Args:
            then: continues the tick, and identifies this wait.
            on_timeout: is called by ``_watch_table`` if the table does not respond in time; for
                None, the tick continues without the table.
            patience: wall time to wait, s; ``table_patience`` for None.
        """
        self._waiting, self._on_timeout = then, on_timeout
        self._deadline = time.monotonic() + (self._patience if patience is None else patience)

    def _resume(self) -> None:
        then, self._waiting = self._waiting, None
        if then is not None:
            then()

    def _watch_table(self) -> None:
        """Continue without a table that does not respond; probe it again while it is absent."""
        if self.done:
            return
        self._throttle.flush()
        if (
            self.module.copy.version is None
            and time.monotonic() - self._start >= WAIT_S
            and not self._table_available()
        ):
            names = (self.resolve_service_name(each.name) for each in (topics.PUSH, topics.PULL))
            self._throttle.remind(
                "waiting", f"waiting for the table_node: no node serves {', '.join(names)}"
            )
        if self._waiting is None:
            if self._table_absent and time.monotonic() > self._deadline:
                self._probe()
            self._start_available_ticks()  # the first tick may have waited for the table
        elif time.monotonic() > self._deadline:
            if self._on_timeout is not None:
                self._on_timeout()
                return
            self._throttle.log(
                "table",
                f"the table does not respond within {self._patience} s: "
                "continuing without it, keeping the updates for it",
            )
            self._leave_table()

    def _leave_table(self) -> None:
        """Continue the tick without the table; the updates are kept for it."""
        self._table_absent = True
        self._pushing = None
        self._deadline = time.monotonic() + self._patience
        self._resume()

    def _probe(self) -> None:
        """Send a request to a table that did not respond; no tick waits for its response."""
        self._deadline = time.monotonic() + self._patience
        self._pushing = None
        if self.module.copy.oldest_unacknowledged() is not None:
            self._send_push()
        else:  # a leg that does not learn has nothing to push
            future = self._pull_client.call_async(calls.write_pull(self.module.copy.version, -1))
            future.add_done_callback(lambda done: self._mark_table_present())

    def _mark_table_present(self) -> None:
        if self._table_absent:
            self._table_absent = False
            self._throttle.log("table", "the table is back")

    def finish(self, spin: Callable[[], None]) -> None:
        """Push the updates of the current epoch and wait a limited time for the response.

        If ``save`` is set, write the leg's own table.
        """
        self.done = True
        self._waiting = self._push_wait = None  # a tick without an action yields no update
        self.module.finish()
        copy = self.module.copy
        copy.close_epoch(self._inbox.last, early=True)
        now = resend_at = time.monotonic()
        deadline = now + max(FINAL_PUSH_S, self._patience)
        while copy.oldest_unacknowledged() is not None and (now := time.monotonic()) < deadline:
            if not self._push_client.service_is_ready():
                break
            if now >= resend_at:  # the table may have restarted; a repeated push changes nothing
                self._pushing, resend_at = None, now + RESEND_S
            self._send_push()
            spin()
        if copy.oldest_unacknowledged() is not None:
            self.get_logger().error(
                "the table_node did not acknowledge the last updates; they are lost"
            )
            self.exit_code = UPDATES_LOST
        if self._save is not None:
            save_table(self._save, copy.table, self._params, self._seed)


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal."""
    sys.exit(node_main(LegNode, args))


if __name__ == "__main__":
    main()
