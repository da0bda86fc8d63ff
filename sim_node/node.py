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
from ember_ros.timers import create_steady_timer
from ember_ros.worlds import World, make_world
from sim_node.recorders import BagRecorder, RecorderLink, Timeout
from sim_node.reports import BodyPublisher, Diagnostics, Lateness

FINISHED = "summary.json"  # the last file that `ember` writes into the folder of a run
WATCH_S = 0.05  # wall time between checks for late legs
REPEAT_S = 0.2  # wall time after which a tick that is not complete is published again
METADATA_S = 5.0  # minimum wall time to wait for the nodes' part of the run's metadata


class SimNode(SingleNode, Node):  # type: ignore[misc]
    """Simulates the robot's world: publishes the sensors of each leg, applies the legs' commands.

    In ``lockstep`` a tick ends when the phase and the commands of all legs have arrived. A leg
    that does not respond within ``patience`` becomes absent: its joints are held still, and the
    world does not wait for it until it responds again. While no leg responds, or the phase is
    missing, the world stands still. It publishes a tick that is not complete again, several times
    a second, so that a lost message stops nobody for ever. In ``realtime`` every tick lasts its
    length in wall time, and a leg whose command is late is held still for that tick.

    In lockstep the world also waits for a recorder node that publishes ``recorder/tick``, so that
    no message queue between the two overflows and the recorder loses nothing.

    Subscribes: ``cpg/phase`` (sensor_msgs/JointState), ``<leg>/command`` (sensor_msgs/JointState),
    ``<leg>/transition`` (sensor_msgs/JointState) of legs that publish one, ``recorder/tick``
    (std_msgs/Int64).
    Publishes: ``clock`` (rosgraph_msgs/Clock), ``<leg>/joint_states``, ``<leg>/contact``
    (sensor_msgs/JointState), ``falls`` (std_msgs/Int64), ``odometry`` (nav_msgs/Odometry),
    ``diagnostics`` (diagnostic_msgs/DiagnosticArray).
    Parameters: ``gait.*``, ``leg.*``, ``physics.*``, ``trainer.*``, ``walker.*``, ``robot.*``;
    ``world``, ``mode``, ``gui``, ``cycles``, ``patience``, ``out``, ``seed``; ``bag``,
    ``split_mb``, ``split_s`` to record a bag; ``recorder`` to wait for a recorder node.
    """

    GROUPS = ("gait", "leg", "physics", "trainer", "walker", "robot")
    OPTIONS = (
        "world", "mode", "gui", "cycles", "patience", "out", "seed",
        "bag", "split_mb", "split_s", "recorder",
    )  # fmt: skip

    def __init__(self, world: World | None = None, **kwargs: Any) -> None:
        """Make the node.

        Args:
            world: the world to simulate; the one that the parameters name for None.
            **kwargs: passed to rclpy's ``Node``.

        Raises:
            ParameterError: a parameter is unknown or out of range, or PyBullet is missing.
            BagError: the bag cannot be created.
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
        """Objects whose ``tick`` is called for every tick."""
        self._bag: BagRecorder | None = None
        self._failed: BagError | None = None
        if options["bag"]:
            split = (options[name] for name in BagOptions._fields[1:])
            self._bag = BagRecorder(self, self._kind, BagOptions(Path(options["bag"]), *split))
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
        self._since = time.monotonic()  # when the present tick was published, or first held
        self._published = self._since  # when it was published the last time
        # What the last tick was made of: messages that repeat it are not refused.
        self._last_beat: Beat | None = None
        self._last_commands: dict[str, LegCommand] = {}
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
        self._recorder_link.on_progress = self._continue_if_held
        self._metadata_timeout = Timeout(max(self._patience, METADATA_S))
        if self._last == 0:
            self.done = True
        if self._realtime:
            create_steady_timer(self, params.gait.tick_s, self._on_realtime_tick)
        else:
            create_steady_timer(self, WATCH_S, self._on_watch)

    @property
    def tick(self) -> int:
        """Return the present tick, which equals the number of finished ticks."""
        return self._tick

    # -- inputs ------------------------------------------------------------------------------

    def _refuse(self, why: Exception | str) -> None:
        """Count a message that is not used; log the count from time to time."""
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
        if beat == self._last_beat:
            return
        if beat.tick != self._tick:
            self._refuse(f"cpg/phase: tick {beat.tick}, but the present tick is {self._tick}")
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
            if command == self._last_commands.get(leg):
                return
            if command.tick > self._tick:
                self._refuse(f"{where}: tick {command.tick}, but the present tick is {self._tick}")
                return
            if leg in self._absent and not self._realtime:
                # Even a late command shows that the leg is alive: wait for it from now on.
                self._absent.discard(leg)
                self._throttle.log(leg, f"{leg} is back at tick {self._tick}")
                self._diagnose()
            if command.tick == self._tick and self._started:
                self._commands[leg] = command
                self._step_if_complete()
            else:
                self._refuse(f"{where}: tick {command.tick} is over, the present is {self._tick}")

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
                self._refuse(f"{where}: tick {transition.tick}, but the present is {self._tick}")

        return callback

    # -- one tick ----------------------------------------------------------------------------

    def _next(self) -> None:
        """Start the present tick, unless a recorder is too far behind."""
        self._held = self._recorder_link.is_behind(self._tick) and not self._realtime
        self._since = time.monotonic()
        if not self._held:
            self._publish()

    def _continue_if_held(self) -> None:
        if self._held:
            self._next()

    def _publish(self) -> None:
        """Publish all sensors of the present tick, and the clock, for the first time."""
        self._last_beat, self._last_commands = self._beat, self._commands
        self._beat, self._commands = None, {}
        self._transitions.clear()
        self._publish_senses()
        self._body.publish(self._tick, self.world.body())
        if self._tick % self._ticks == 0:
            self._diagnose()

    def _publish_senses(self) -> None:
        """Publish the sensors of the legs at the present tick, and the clock."""
        self._published = time.monotonic()
        for senses, joints, contact, sense in zip(
            self._senses, self._joints, self._contacts, self.world.observe(), strict=True
        ):
            joints_data, contact_data = senses.pack(sense)
            joints.publish(joints_data)
            contact.publish(contact_data)
        self._clock_publisher.publish(cdr.pack_clock(self._tick * self._tick_ns))

    def _repeat(self) -> None:
        """Publish the present tick again if it is not complete for a while."""
        if time.monotonic() - self._published >= REPEAT_S:
            self._publish_senses()

    def _step_if_complete(self) -> None:
        """Step if the beat and the commands of all legs that are not absent have arrived."""
        if self._realtime or self._held or self._beat is None or not self._commands:
            return
        if all(self._has_responded(leg) or leg in self._absent for leg in self.legs):
            self._step()

    def _has_responded(self, leg: str) -> bool:
        """Return whether a leg's command has arrived, and its transition if it publishes one."""
        return leg in self._commands and (
            leg in self._transitions or leg not in self._with_transitions
        )

    def _step(self) -> None:
        """Advance the world by the present tick, and start the next one."""
        assert self._beat is not None
        commands = [self._commands.get(leg) for leg in self.legs]
        transitions = [self._transitions.get(leg) for leg in self.legs]
        senses, body = self.world.observe(), self.world.body()
        try:
            for observer in self.observers:
                observer.tick(self._beat, senses, commands, body, transitions)
        except BagError as error:
            self._end_with(error)
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
        """Return the nodes that are not connected yet, in both directions."""
        missing = []
        if not self._beat_subscription.handle.get_publisher_count():
            missing.append("cpg_node")
        for leg, joints, contact in zip(self.legs, self._joints, self._contacts, strict=True):
            subscribed = joints.get_subscription_count() and contact.get_subscription_count()
            if not (subscribed and self._command_subscriptions[leg].handle.get_publisher_count()):
                missing.append(leg)
        return missing

    def _start_if_connected(self) -> None:
        if self.done:
            return
        missing = self._missing()
        if missing:
            if time.monotonic() - self._since > self._patience:
                self._throttle.remind("start", f"waiting for {', '.join(missing)}")
            return
        late = self._metadata_timeout.is_over()
        if self._recorder_link.is_missing(late):
            self._throttle.remind("recorder", "waiting for the recorder")
            return
        try:
            if self._bag is not None:
                observer = self._bag.start(late)
                if observer is None:
                    return
                self.observers.append(observer)
        except BagError as error:
            self._end_with(error)
            return
        self._with_transitions = {
            leg
            for leg, subscription in self._transition_subscriptions.items()
            if subscription.handle.get_publisher_count()
        }
        self._started = True
        self._log_start()
        self._next()

    def _end_with(self, error: BagError) -> None:
        """End the run; ``finish`` raises the error, because in a callback it would be a crash."""
        self._failed, self.done, self._started = error, True, False

    def _on_watch(self) -> None:
        """In lockstep: start when all nodes are connected; declare late legs absent."""
        self._throttle.flush()
        if not self._started:
            self._start_if_connected()
            return
        if self._held and not self._recorder_link.is_present():
            self._recorder_link.tick = None  # the recorder has ended: do not wait for it
            self._next()
            return
        if not self._held:
            self._repeat()
        if time.monotonic() - self._since < self._patience:
            return
        if self._held:
            self.get_logger().warning(
                f"the recorder received nothing after tick {self._recorder_link.tick}: the world "
                "no longer waits for it"
            )
            self._recorder_link.tick = None
            self._next()
        elif self._beat is None:
            self._remind_of_beat()
            self._diagnose()
        elif not self._commands:
            self._throttle.remind("legs", f"no leg responds at tick {self._tick}: standing still")
            self._diagnose()
        else:
            for leg in self.legs:
                if leg in self._commands and not self._has_responded(leg):
                    self._with_transitions.discard(leg)  # it publishes commands only
                elif leg not in self._commands and leg not in self._absent:
                    self._absent.add(leg)
                    self._throttle.log(
                        leg,
                        f"{leg} did not respond within {self._patience} s at tick {self._tick}: "
                        "absent, its joints are held still",
                    )
            self._diagnose()
            self._step_if_complete()

    def _on_realtime_tick(self) -> None:
        """In real time: step with the commands that have arrived."""
        self._throttle.flush()
        if not self._started:
            self._start_if_connected()
        elif self._beat is None:
            self._remind_of_beat()
            self._repeat()
        else:
            self._absent = {leg for leg in self.legs if leg not in self._commands}
            self._lateness.count(self._absent)
            self._step()

    def _remind_of_beat(self) -> None:
        self._throttle.remind("phase", f"the phase of tick {self._tick} is missing: standing still")

    # -- reports -----------------------------------------------------------------------------

    def _log_start(self) -> None:
        cycles = (
            "until stopped" if self._last == math.inf else f"{self._last // self._ticks} cycles"
        )
        mode = "realtime" if self._realtime else "lockstep"
        self.get_logger().info(f"{self._kind} starts: {', '.join(self.legs)}; {mode}, {cycles}")

    def _log_end(self) -> None:
        cycles, falls = self._tick // self._ticks, self.world.body().falls
        self.get_logger().info(f"{self._kind} ended after {cycles} cycles, {falls} falls")

    def _diagnose(self) -> None:
        """Publish the absent legs and the number of refused messages."""
        stalled, absent = None, set(self._absent)
        if self._started and time.monotonic() - self._since >= self._patience:
            stalled = "no phase" if self._beat is None else "standing still"
            if self._beat is not None:
                absent |= {leg for leg in self.legs if leg not in self._commands}
        falls = self.world.body().falls
        self._diagnostics.publish(self._tick, falls, self.refused, absent, stalled)

    def finish(self, spin: Callable[[], None]) -> None:
        """Stop stepping, and write the last lines of the record and the bag.

        Raises:
            BagError: the bag could not be written completely.
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
        """Destroy the node and close the world; a bag without ``finish`` is abandoned."""
        if self._bag is not None:
            self._bag.close()
        self.world.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """Run the node until its cycles are done or a signal arrives."""
    sys.exit(node_main(SimNode, args))


if __name__ == "__main__":
    main()
