"""The world as a node: ``ros2 run ember_ros sim_node --ros-args -p world:=walker``."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.node import Node

from ember_ros import cdr, topics, wire
from ember_ros.bag.storage import BagOptions
from ember_ros.errors import BagError, ParameterError, SignalError
from ember_ros.name_lock import SingleNode
from ember_ros.observer import Observer
from ember_ros.report.run_statistics import RunStatistics
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.signals import Beat, LegCommand, Transition
from ember_ros.spinning import node_main
from ember_ros.throttle import Throttle
from ember_ros.worlds import World, make_world
from sim_node.recorders import BagObserver, RecorderLink, Waiting
from sim_node.reports import BodyPublisher, Diagnostics, Lateness

FINISHED = "summary.json"  # what `ember` writes last into the folder of a run
WATCH_S = 0.05  # wall time between looks at who is late
ANSWER_S = 5.0  # least wall time to wait for nodes to answer what determines the run


class SimNode(SingleNode, Node):  # type: ignore[misc]
    """Publishes what each leg senses at a tick, and steps when all commands of that tick are in.

    In ``lockstep`` a leg that does not answer within ``patience`` is declared absent: its joints
    are held still and nobody waits for it until it answers again. While nobody at all answers, or
    the phase is missing, the world stands still. In ``realtime`` every tick lasts its own length
    of wall time, and who is late is held still for that tick.

    A recorder node that tells how far it is is waited for too, so that it loses nothing: in
    lockstep the world is never further ahead of it than what lies between two processes can hold.

    Subscribes: ``cpg/phase`` (sensor_msgs/JointState), ``<leg>/command`` (sensor_msgs/JointState),
    ``<leg>/transition`` (sensor_msgs/JointState) of legs that publish one, ``recorder/tick``
    (std_msgs/Int64).
    Publishes: ``clock`` (rosgraph_msgs/Clock), ``<leg>/joint_states``, ``<leg>/contact``
    (sensor_msgs/JointState), ``falls`` (std_msgs/Int64), ``odometry`` (nav_msgs/Odometry),
    ``diagnostics`` (diagnostic_msgs/DiagnosticArray).
    Parameters: ``gait.*``, ``leg.*``, ``physics.*``, ``trainer.*``, ``walker.*``, ``robot.*``;
    ``world``, ``mode``, ``gui``, ``cycles``, ``patience``, ``out``, ``seed``; ``bag``,
    ``split_mb``, ``split_s`` to record a bag; ``recorder`` to wait for a node that does.
    """

    GROUPS = ("gait", "leg", "physics", "trainer", "walker", "robot")
    OPTIONS = (
        "world", "mode", "gui", "cycles", "patience", "out", "seed",
        "bag", "split_mb", "split_s", "recorder",
    )  # fmt: skip

    def __init__(self, world: World | None = None, **kwargs: Any) -> None:
        """Make the node.

        Args:
            world: where the legs are mounted; the one that the parameters name for None.
            **kwargs: go to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range, or PyBullet is missing.
            BagError: the bag cannot be made.
            NameTakenError: there is another world in this namespace.
        """
        super().__init__("sim_node", automatically_declare_parameters_from_overrides=True, **kwargs)
        self.done = False
        params = declare_params(self, self.GROUPS)
        options = declare_options(self, self.OPTIONS)
        self.lock_name(topics.CLOCK)
        out = Path(options["out"]) if options["out"] else None
        if out is not None and (out / FINISHED).exists():
            raise ParameterError(
                f"out = {str(out)!r} holds a run of `ember` ({FINISHED}); another folder would be "
                "right"
            )
        self._kind: str = options["world"]
        self.world = world or make_world(self._kind, params, options["seed"], gui=options["gui"])
        self.legs = self.world.legs
        self.recorder = RunStatistics(params, self.legs, out)
        self.observers: list[Observer] = [self.recorder]
        """Who is given every tick."""
        self._bag: BagObserver | None = None
        self._failed: BagError | None = None
        if options["bag"]:
            given = (options[name] for name in BagOptions._fields[1:])
            self._bag = BagObserver(self, self._kind, BagOptions(Path(options["bag"]), *given))
            self.observers.append(self._bag)
        self.refused = 0
        self._realtime = options["mode"] == "realtime"
        self._patience = options["patience"]
        self._tick_ns, self._ticks = params.gait.tick_ns, params.gait.ticks
        self._last = options["cycles"] * self._ticks if options["cycles"] >= 0 else math.inf
        self._tick = 0
        self._beat: Beat | None = None
        self._commands: dict[str, LegCommand] = {}
        self._transitions: dict[str, Transition] = {}
        self._with_transitions: set[str] = set()  # legs that publish them
        self._absent: set[str] = set()
        self._started = False
        self._held = False  # whether the next tick waits for the recorder
        self._since = time.monotonic()  # when the present tick was published, or held
        self._throttle = Throttle(lambda text: self.get_logger().warning(text))

        self._clock_publisher = topics.CLOCK.publish(self)
        self._senses = [wire.SenseWire(leg, self._tick_ns) for leg in self.legs]
        self._joints = [topics.joint_states(leg).publish(self) for leg in self.legs]
        self._contacts = [topics.contact(leg).publish(self) for leg in self.legs]
        self._body = BodyPublisher(self, self._tick_ns, self._ticks)
        self._diagnostics = Diagnostics(self, self.legs, self._tick_ns, self._ticks)
        self._lateness = Lateness(self)
        self._beats = wire.BeatWire(self._tick_ns)
        self._beat_subscription = topics.PHASE.subscribe(self, self._on_beat)
        self._command_subscriptions = {
            leg: topics.command(leg).subscribe(self, self._on_command(leg)) for leg in self.legs
        }
        self._transition_subscriptions = {
            leg: topics.transition(leg).subscribe(self, self._on_transition(leg))
            for leg in self.legs
        }
        self._recorder_link = RecorderLink(self, options["recorder"], self._refuse)
        self._recorder_link.on_progress = self._go_on_if_held
        self._waiting = Waiting(max(self._patience, ANSWER_S))
        if self._last == 0:
            self.done = True
        if self._realtime:
            self.create_timer(params.gait.tick_s, self._every_tick)
        else:
            self.create_timer(WATCH_S, self._watch)

    @property
    def tick(self) -> int:
        """Return the present tick: how many are done."""
        return self._tick

    # -- inputs ------------------------------------------------------------------------------

    def _refuse(self, why: Exception | str) -> None:
        """Count what is not used, and log it now and then."""
        self.refused += 1
        self._throttle.remind("refused", f"refused ({self.refused} so far): {why}")

    def _on_beat(self, data: bytes) -> None:
        if self.done:
            return
        try:
            beat = self._beats.read(data)
        except SignalError as why:
            self._refuse(why)
            return
        if beat.tick != self._tick:
            self._refuse(f"cpg/phase: tick {beat.tick} is not now, now is {self._tick}")
        elif self._started:
            self._beat = beat
            self._step_if_complete()

    def _on_command(self, leg: str) -> Callable[[bytes], None]:
        where, reader = f"{leg}/command", wire.CommandWire(leg, self._tick_ns)

        def callback(data: bytes) -> None:
            if self.done:
                return
            try:
                command = reader.read(data)
            except SignalError as why:
                self._refuse(why)
                return
            if command.tick > self._tick:
                self._refuse(f"{where}: tick {command.tick} is not yet, now is {self._tick}")
                return
            if leg in self._absent and not self._realtime:
                # Late or not, it lives: wait for it from now on.
                self._absent.discard(leg)
                self._throttle.log(leg, f"{leg} is back at tick {self._tick}")
                self._diagnose()
            if command.tick == self._tick and self._started:
                self._commands[leg] = command
                self._step_if_complete()
            else:
                self._refuse(f"{where}: tick {command.tick} is over, now is {self._tick}")

        return callback

    def _on_transition(self, leg: str) -> Callable[[bytes], None]:
        where, reader = f"{leg}/transition", wire.TransitionWire(leg, self._tick_ns)

        def callback(data: bytes) -> None:
            if self.done:
                return
            try:
                transition = reader.read(data)
            except SignalError as why:
                self._refuse(why)
                return
            self._with_transitions.add(leg)
            if transition.tick == self._tick and self._started:
                self._transitions[leg] = transition
                self._step_if_complete()
            elif transition.tick > self._tick:
                self._refuse(f"{where}: tick {transition.tick} is not yet, now is {self._tick}")

        return callback

    # -- one tick ----------------------------------------------------------------------------

    def _next(self) -> None:
        """Begin the present tick, unless a recorder is too far behind."""
        self._held = self._recorder_link.is_behind(self._tick) and not self._realtime
        self._since = time.monotonic()
        if not self._held:
            self._publish()

    def _go_on_if_held(self) -> None:
        if self._held:
            self._next()

    def _publish(self) -> None:
        """Publish what is sensed at the present tick, and what time it is."""
        self._beat = None
        self._commands.clear()
        self._transitions.clear()
        for senses, joints, contact, sense in zip(
            self._senses, self._joints, self._contacts, self.world.observe(), strict=True
        ):
            joints_data, contact_data = senses.pack(sense)
            joints.publish(joints_data)
            contact.publish(contact_data)
        self._clock_publisher.publish(cdr.pack_clock(self._tick * self._tick_ns))
        self._body.publish(self._tick, self.world.body())
        if self._tick % self._ticks == 0:
            self._diagnose()

    def _step_if_complete(self) -> None:
        """Step once the beat and the commands of everybody present are in."""
        if self._realtime or self._held or self._beat is None or not self._commands:
            return
        if all(self._has_answered(leg) or leg in self._absent for leg in self.legs):
            self._step()

    def _has_answered(self, leg: str) -> bool:
        """Return whether a leg's command is in, and its transition, if it publishes that."""
        return leg in self._commands and (
            leg in self._transitions or leg not in self._with_transitions
        )

    def _step(self) -> None:
        """Advance the world by the present tick, and begin the next one."""
        assert self._beat is not None
        commands = [self._commands.get(leg) for leg in self.legs]
        transitions = [self._transitions.get(leg) for leg in self.legs]
        senses, body = self.world.observe(), self.world.body()
        try:
            for observer in self.observers:
                observer.tick(self._beat, senses, commands, body, transitions)
        except BagError as error:
            self._end_for(error)
            return
        self.world.step(self._beat, commands)
        self._tick += 1
        if self._tick >= self._last or self.world.over:
            self.done = True
            self._started = False
        else:
            self._next()

    # -- waiting -----------------------------------------------------------------------------

    def _missing(self) -> list[str]:
        """Return who is not yet on the graph, both ways."""
        missing = []
        if not self._beat_subscription.handle.get_publisher_count():
            missing.append("cpg_node")
        for leg, joints, contact in zip(self.legs, self._joints, self._contacts, strict=True):
            hears = joints.get_subscription_count() and contact.get_subscription_count()
            if not (hears and self._command_subscriptions[leg].handle.get_publisher_count()):
                missing.append(leg)
        return missing

    def _start_if_all_there(self) -> None:
        if self.done:
            return
        missing = self._missing()
        if missing:
            if time.monotonic() - self._since > self._patience:
                self._throttle.remind("start", f"waiting for {', '.join(missing)}")
            return
        late = self._waiting.is_over()
        if self._recorder_link.is_missing(late):
            self._throttle.remind("recorder", "waiting for the recorder")
            return
        try:
            if self._bag is not None and not self._bag.begin(late):
                return
        except BagError as error:
            self._end_for(error)
            return
        self._with_transitions = {
            leg
            for leg, subscription in self._transition_subscriptions.items()
            if subscription.handle.get_publisher_count()
        }
        self._started = True
        self._log_beginning()
        self._next()

    def _end_for(self, error: BagError) -> None:
        """End the run; the error is raised when the node finishes: here it would look a crash."""
        self._failed, self.done, self._started = error, True, False

    def _watch(self) -> None:
        """In lockstep: begin when all are there; declare absent who is late."""
        self._throttle.flush()
        if not self._started:
            self._start_if_all_there()
            return
        if self._held and not self._recorder_link.is_there():
            self._recorder_link.tick = None  # it has ended: nothing to wait for
            self._next()
            return
        if time.monotonic() - self._since < self._patience:
            return
        if self._held:
            self.get_logger().warning(
                f"the recorder heard nothing after tick {self._recorder_link.tick}: not waited "
                "for any more"
            )
            self._recorder_link.tick = None
            self._next()
        elif self._beat is None:
            self._remind_of_beat()
            self._diagnose()
        elif not self._commands:
            self._throttle.remind("legs", f"no leg answers at tick {self._tick}: standing still")
            self._diagnose()
        else:
            for leg in self.legs:
                if leg in self._commands and not self._has_answered(leg):
                    self._with_transitions.discard(leg)  # it answers, without one
                elif leg not in self._commands and leg not in self._absent:
                    self._absent.add(leg)
                    self._throttle.log(
                        leg,
                        f"{leg} did not answer within {self._patience} s at tick {self._tick}: "
                        "absent, its joints are held still",
                    )
            self._diagnose()
            self._step_if_complete()

    def _every_tick(self) -> None:
        """In real time: step with whatever is there."""
        self._throttle.flush()
        if not self._started:
            self._start_if_all_there()
        elif self._beat is None:
            self._remind_of_beat()
        else:
            self._absent = {leg for leg in self.legs if leg not in self._commands}
            self._lateness.count(self._absent)
            self._step()

    def _remind_of_beat(self) -> None:
        self._throttle.remind("phase", f"the phase of tick {self._tick} is missing: standing still")

    # -- reports -----------------------------------------------------------------------------

    def _log_beginning(self) -> None:
        cycles = (
            "until stopped" if self._last == math.inf else f"{self._last // self._ticks} cycles"
        )
        mode = "realtime" if self._realtime else "lockstep"
        self.get_logger().info(f"{self._kind} begins: {', '.join(self.legs)}; {mode}, {cycles}")

    def _log_end(self) -> None:
        cycles, falls = self._tick // self._ticks, self.world.body().falls
        self.get_logger().info(f"{self._kind} ended after {cycles} cycles, {falls} falls")

    def _diagnose(self) -> None:
        """Publish who is absent and what was refused."""
        stuck, away = None, set(self._absent)
        if self._started and time.monotonic() - self._since >= self._patience:
            stuck = "no phase" if self._beat is None else "standing still"
            if self._beat is not None:
                away |= {leg for leg in self.legs if leg not in self._commands}
        falls = self.world.body().falls
        self._diagnostics.publish(self._tick, falls, self.refused, away, stuck)

    def finish(self, spin: Callable[[], None]) -> None:
        """Stop stepping and end the record.

        Raises:
            BagError: the bag could not be written to its end.
        """
        self.done, self._started = True, False
        if self._tick:
            self._log_end()
        self.recorder.finish(self.world.observe(), self.world.body())
        if self._failed is not None:
            raise self._failed
        if self._bag is not None:
            self._bag.finish()

    def destroy_node(self) -> None:
        """Destroy the node and let go of the world; a bag that was not finished ends here."""
        if self._bag is not None:
            self._bag.close()
        self.world.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """Run the node until its cycles are done or a signal comes."""
    sys.exit(node_main(SimNode, args))


if __name__ == "__main__":
    main()
