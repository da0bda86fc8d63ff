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
from ember_ros.inbox import Inbox
from ember_ros.name_lock import SingleNode
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.signals import Beat, LegCommand, LegSense
from ember_ros.spinning import FINAL_PUSH_S, node_main
from ember_ros.throttle import Throttle
from leg_node import calls
from leg_node.assembly import make_leg
from leg_node.shared import UpdateBatch
from leg_node.table_file import load_table, save_table

AGAIN_S = 0.5  # wall time until a leg that ends says a push again
WATCH_S = 0.1  # wall time between looks at whether the table answers
WAIT_S = 2.0  # wall time after which a leg says that it cannot begin without the table


class LegNode(SingleNode, Node):  # type: ignore[misc]
    """One leg: hears its own senses and the phase, calls the table, says its own command.

    Subscribes: ``<leg>/joint_states``, ``<leg>/contact`` (sensor_msgs/JointState), ``cpg/phase``
    (sensor_msgs/JointState).
    Publishes: ``<leg>/command``, ``<leg>/transition`` (sensor_msgs/JointState).
    Calls: ``table/push``, ``table/pull``, unless ``shared`` is false or it has no use for a table
    (another policy than ``learned``, and ``learning`` false).
    Parameters: ``gait.*``, ``leg.*``, ``robot.*``, ``parts.*``, ``state.*``, ``reward.*``,
    ``script.*``, ``train.*``, ``walk.*``; ``leg``, ``stage``, ``seed``, ``policy``, ``learning``,
    ``shared``, ``start_cycle``, ``table_patience``; ``table`` and ``save`` for a leg that does not
    share.
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
        params = declare_params(self, self.GROUPS)
        options = declare_options(self, self.OPTIONS)
        self._patience = options["table_patience"]  # less than a world waits for a leg
        shared = options["shared"]
        if shared and (options["table"] or options["save"]):
            raise ParameterError(
                "a leg that shares its table neither loads nor saves one: give table and save to "
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
        self._inbox = Inbox("joints", "contact", "phase")
        self._beats = wire.BeatWire(params.gait.tick_ns)
        self._senses = wire.SenseWire(leg, params.gait.tick_ns)
        self._commands = wire.CommandWire(leg, params.gait.tick_ns)
        self._transitions = wire.TransitionWire(leg, params.gait.tick_ns)
        self._throttle = Throttle(lambda text: self.get_logger().warning(text))
        self._born = time.monotonic()
        # What a tick waits for: an answer of the table. None when it waits for nothing.
        self._waiting: Callable[[], None] | None = None
        self._else: Callable[[], None] | None = None
        self._held: Callable[[], None] | None = None  # what last waited for a push
        self._deadline = 0.0
        self._table_away = False
        self._pushing: UpdateBatch | None = None

        # Before the command: endpoints are discovered in the order they are made, so a world that
        # knows of the command knows that this leg says what it is paid.
        self._transition = topics.transition(leg).publish(self)
        self._command = topics.command(leg).publish(self)
        topics.joint_states(leg).subscribe(self, self._hear_joints)
        topics.contact(leg).subscribe(self, self._hear_contact)
        topics.PHASE.subscribe(self, self._hear_phase)
        if self.module.shared:
            self._push = topics.PUSH.call(self)
            self._pull = topics.PULL.call(self)
            self.create_timer(WATCH_S, self._watch_table)

    # -- hearing -----------------------------------------------------------------------------

    def _refuse(self, why: Exception | str) -> None:
        """Count what is not used, and say so now and then."""
        self.refused += 1
        self._throttle.remind("refused", f"refused ({self.refused} so far): {why}")

    def _hear_joints(self, data: bytes) -> None:
        self._hear("joints", data, self._senses.read_joints)

    def _hear_contact(self, data: bytes) -> None:
        self._hear("contact", data, self._senses.read_contact)

    def _hear_phase(self, data: bytes) -> None:
        self._hear("phase", data, self._read_beat)

    def _read_beat(self, data: bytes) -> tuple[int, Beat]:
        beat = self._beats.read(data)
        return beat.tick, beat

    def _hear(self, source: str, data: bytes, read: Callable[[bytes], tuple[int, Any]]) -> None:
        try:
            tick, value = read(data)
        except SignalError as why:
            self._refuse(why)
        else:
            self._put(source, tick, value)

    def _put(self, source: str, tick: int, value: Any) -> None:
        if self.done:
            return  # what is learnt is being handed in
        last = self._inbox.last
        if not self._inbox.put(source, tick, value):
            if self._inbox.time_restarted():
                self.get_logger().warning(f"time began anew at tick {tick}, the last was {last}")
                self.module.reset(last, uuid.uuid4().hex)
                self._look(tick)
            else:
                self._refuse(f"{self.module.leg} {source}: tick {tick} is over, last was {last}")
        elif self._waiting is None:
            self._look(tick)

    def _look(self, tick: int) -> None:
        """Begin a tick if all of it is there, and the table was met."""
        if self.done:
            return
        if self.module.shared and self.module.copy.version is None and not self._table_is_there():
            return  # a leg does not start from nothing while the table is still starting
        values = self._inbox.pop(tick)
        if values is not None:
            joints, contact, beat = values
            self._begin(self._senses.sense(tick, joints, contact), beat)

    def _table_is_there(self) -> bool:
        return bool(self._pull.service_is_ready() and self._push.service_is_ready())

    # -- one tick ----------------------------------------------------------------------------

    def _begin(self, sense: LegSense, beat: Beat) -> None:
        """Pull if an epoch begins, then act."""
        upto = self.module.copy.pull_due(sense.tick)
        if upto is None or self._table_away:
            self._act(sense, beat)
            return
        future = self._pull.call_async(calls.write_pull(self.module.copy.version, upto))
        if self.module.copy.version is None:
            waiting = self._wait(lambda: self._act(sense, beat), lambda: self._begin(sense, beat))
        else:
            waiting = self._wait(lambda: self._act(sense, beat))
        future.add_done_callback(lambda done: self._pulled(done, upto, waiting))

    def _pulled(self, future: Future, upto: int, waiting: Callable[[], None]) -> None:
        if self._waiting is not waiting:
            return  # too late: the tick went on without
        try:
            self.module.copy.apply(calls.read_changes(future.result()), upto)
        except UpdateError as why:
            self._refuse(why)
            self.module.copy.skip_sync(upto)
        self._go_on()

    def _act(self, sense: LegSense, beat: Beat) -> None:
        """Have the tick, push if an epoch ends, then say the command."""
        command = self.module.tick(sense, beat)
        self.module.copy.close_epoch(sense.tick)
        if self.module.copy.push_due() is None:
            self._say(command)
            return
        self._send_push()
        if self._table_away:
            self._say(command)
        else:
            self._held = self._wait(lambda: self._say(command))

    def _say(self, command: LegCommand) -> None:
        self._transition.publish(self._transitions.pack(self.module.transition))
        self._command.publish(self._commands.pack(command))
        for tick in self._inbox.pending("phase"):  # what came while this tick waited
            if self._waiting is None:
                self._look(tick)

    # -- the table ---------------------------------------------------------------------------

    def _send_push(self) -> None:
        """Send the oldest push that is not acknowledged, unless it is under way."""
        push = self.module.copy.push_due()
        if push is None or push is self._pushing:
            return
        self._pushing = push
        future = self._push.call_async(calls.write_push(push))
        future.add_done_callback(lambda done: self._pushed(done, push))

    def _pushed(self, future: Future, push: UpdateBatch) -> None:
        if push is self._pushing:
            self._pushing = None
        result = future.result().result
        if not result.successful:
            self._refuse(f"the table refused a push: {result.reason}")
        # A push that is refused is dropped: said again, it would be refused again.
        self.module.copy.acknowledged(push)
        self._table_is_back()
        if self.module.copy.push_due() is not None:
            self._send_push()
        elif self._held is not None and self._waiting is self._held:
            self._go_on()

    def _wait(
        self, then: Callable[[], None], else_: Callable[[], None] | None = None
    ) -> Callable[[], None]:
        """Hold the tick until the table answers: ``then`` goes on with it.

        ``else_`` is done when the table does not answer in time; going on without it for None.
        """
        self._waiting, self._else = then, else_
        self._deadline = time.monotonic() + self._patience
        return then

    def _go_on(self) -> None:
        then, self._waiting = self._waiting, None
        if then is not None:
            then()

    def _watch_table(self) -> None:
        """Go on alone when the table does not answer; knock again while it is away."""
        if self.done:
            return
        self._throttle.flush()
        if (
            self.module.copy.version is None
            and time.monotonic() - self._born >= WAIT_S
            and not self._table_is_there()
        ):
            served = (self.resolve_service_name(topic.name) for topic in (topics.PUSH, topics.PULL))
            self._throttle.remind(
                "waiting", f"waiting for the table_node: nobody serves {', '.join(served)}"
            )
        if self._waiting is None:
            if self._table_away and time.monotonic() > self._deadline:
                self._probe()
            for tick in self._inbox.pending("phase"):  # a first tick that waited for the table
                if self._waiting is None:
                    self._look(tick)
        elif time.monotonic() > self._deadline:
            if self._else is not None:
                self._waiting = None
                self._else()
                return
            self._table_away = True
            self._pushing = None
            self._throttle.log(
                "table",
                f"the table does not answer within {self._patience} s: "
                "going on alone, keeping what is learnt for it",
            )
            self._go_on()

    def _probe(self) -> None:
        """Ask a table that did not answer whether it is there, and wait for no reply."""
        self._deadline = time.monotonic() + self._patience
        self._pushing = None
        if self.module.copy.push_due() is not None:
            self._send_push()
        else:  # a leg that learns nothing has nothing to push
            future = self._pull.call_async(calls.write_pull(self.module.copy.version, -1))
            future.add_done_callback(lambda done: self._table_is_back())

    def _table_is_back(self) -> None:
        if self._table_away:
            self._table_away = False
            self._throttle.log("table", "the table is back")

    def finish(self, spin: Callable[[], None]) -> None:
        """Hand in what was learnt since the last epoch; wait a moment for the table to have it."""
        self.done = True
        self._waiting = self._held = None  # a tick that is not acted on yet teaches nothing more
        self.module.finish()
        copy = self.module.copy
        copy.close_epoch(self._inbox.last, early=True)
        now = again = time.monotonic()
        deadline = now + max(FINAL_PUSH_S, self._patience)
        while copy.push_due() is not None and (now := time.monotonic()) < deadline:
            if not self._push.service_is_ready():
                break
            if now >= again:  # said to a table that died meanwhile: twice changes nothing
                self._pushing, again = None, now + AGAIN_S
            self._send_push()
            spin()
        if copy.push_due() is not None:
            self.get_logger().error("the table did not take what was learnt last; it is lost")
        if self._save is not None:
            save_table(self._save, copy.table, self._params, self._seed)


def main(args: list[str] | None = None) -> None:
    """Run the node until a signal."""
    sys.exit(node_main(LegNode, args))


if __name__ == "__main__":
    main()
