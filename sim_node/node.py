"""The world as a node: ``ros2 run ember_ros sim_node --ros-args -p world:=walker``."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from ember_ros import topics, wire
from ember_ros.bag.inquiry import Inquiry
from ember_ros.bag.recording import Recording, Told
from ember_ros.bag.scribe import Scribe
from ember_ros.bag.storage import BagOptions
from ember_ros.errors import BagError, ParameterError, SignalError
from ember_ros.observer import Observer
from ember_ros.report.recorder import Recorder
from ember_ros.ros_params import declare_options, declare_params
from ember_ros.seat import Seated
from ember_ros.signals import Beat, LegCommand, Transition
from ember_ros.spinning import main_of
from ember_ros.throttle import SAY_S, Throttle
from sim_node.world import World
from sim_node.worlds import make_world

FINISHED = "summary.json"  # what `ember` writes last into the folder of a run
WATCH_S = 0.05  # wall time between looks at who is late
ANSWER_S = 5.0  # least wall time to wait for nodes to say what they were told
AHEAD = 24  # ticks ahead of a recorder: Fast DDS holds 512 messages between two processes


class SimNode(Seated, Node):  # type: ignore[misc]
    """Publishes what each leg senses at a tick, and steps when all commands of that tick are in.

    In ``lockstep`` a leg that does not answer within ``patience`` is declared absent: its joints
    are held still and nobody waits for it until it speaks again. While nobody at all answers, or
    the phase is missing, the world stands still. In ``realtime`` every tick lasts its own length
    of wall time, and who is late is held still for that tick.

    A recorder node that says how far it is is waited for too, so that it loses nothing: in
    lockstep the world is never further ahead of it than what lies between two processes can hold.

    Subscribes: ``cpg/phase`` (sensor_msgs/JointState), ``<leg>/command`` (sensor_msgs/JointState),
    ``<leg>/transition`` (sensor_msgs/JointState) of legs that say what they were paid,
    ``recorder/tick`` (std_msgs/Int64).
    Publishes: ``clock`` (rosgraph_msgs/Clock), ``<leg>/joint_states``, ``<leg>/contact``
    (sensor_msgs/JointState), ``falls`` (std_msgs/Int64), ``odometry`` (nav_msgs/Odometry),
    ``diagnostics`` (diagnostic_msgs/DiagnosticArray).
    Parameters: ``gait.*``, ``leg.*``, ``physics.*``, ``trainer.*``, ``walker.*``,
    ``robot.*``; ``world``, ``mode``, ``gui``, ``cycles``, ``patience``, ``out``, ``seed``; ``bag``,
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
            TakenError: there is another world in this namespace.
        """
        super().__init__("sim_node", automatically_declare_parameters_from_overrides=True, **kwargs)
        self.done = False
        params = declare_params(self, self.GROUPS)
        options = declare_options(self, self.OPTIONS)
        self.take_seat(topics.CLOCK)
        out = Path(options["out"]) if options["out"] else None
        if out is not None and (out / FINISHED).exists():
            raise ParameterError(
                f"out = {str(out)!r} holds a run of `ember` ({FINISHED}); another folder would be "
                "right"
            )
        self.world = world or make_world(
            options["world"], params, options["seed"], gui=options["gui"]
        )
        self.legs = self.world.legs
        self.recorder = Recorder(params, self.legs, out)
        self.observers: list[Observer] = [self.recorder]
        """Who hears every tick."""
        self._kind: str = options["world"]
        self._bag: Scribe | None = None
        self._recording: Recording | None = None
        self._failed: BagError | None = None
        if options["bag"]:
            given = (options[name] for name in BagOptions._fields[1:])
            self._bag = Scribe(BagOptions(Path(options["bag"]), *given))
            self._inquiry = Inquiry(self, self.get_namespace())
        self._asked: float | None = None  # when all were there but for who records
        self._wants_recorder = options["recorder"]
        self.refused = 0
        self._realtime = options["mode"] == "realtime"
        self._patience = options["patience"]
        self._tick_ns, self._ticks = params.gait.tick_ns, params.gait.ticks
        self._last = options["cycles"] * self._ticks if options["cycles"] >= 0 else math.inf
        self._tick = 0
        self._beats = wire.BeatWire(self._tick_ns)
        self._beat: Beat | None = None
        self._commands: dict[str, LegCommand] = {}
        self._transitions: dict[str, Transition] = {}
        self._telling: set[str] = set()  # legs that say what they were paid
        self._heard: dict[str, bytes] = {}  # the same and the phase, as they came
        self._told: tuple[Any, ...] = ()  # what was published of the present tick, as it went
        self._absent: set[str] = set()
        self._started = False
        self._held = False  # whether the next tick waits for the recorder
        self._recorded: int | None = None  # how far it is; None where nobody is waited for
        self._since = time.monotonic()  # when the present tick was published, or held
        self._throttle = Throttle(lambda text: self.get_logger().warning(text))
        self._late: Counter[str] = Counter()  # ticks without a leg since lateness was told last
        self._late_since = self._since  # when that was
        self._was_late = False
        self._falls = -1

        self._clock_publisher = topics.CLOCK.publish(self)
        self._wires = [wire.SenseWire(leg, self._tick_ns) for leg in self.legs]
        self._joints = [topics.joint_states(leg).publish(self) for leg in self.legs]
        self._contacts = [topics.contact(leg).publish(self) for leg in self.legs]
        self._falls_publisher = topics.FALLS.publish(self)
        self._odometry = topics.ODOMETRY.publish(self)
        self._diagnostics = topics.DIAGNOSTICS.publish(self)
        self._phase_subscription = topics.PHASE.subscribe(self, self._hear_phase)
        self._subscriptions_by_leg = {
            leg: topics.command(leg).subscribe(self, self._listener(leg)) for leg in self.legs
        }
        self._transitions_by_leg = {
            leg: topics.transition(leg).subscribe(self, self._transition_listener(leg))
            for leg in self.legs
        }
        topics.RECORDED.subscribe(self, self._hear_recorder)
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

    # -- hearing -----------------------------------------------------------------------------

    def _refuse(self, why: Exception | str) -> None:
        """Count what is not used, and say so now and then."""
        self.refused += 1
        self._throttle.remind("refused", f"refused ({self.refused} so far): {why}")

    def _hear_phase(self, data: bytes) -> None:
        if self.done:
            return
        try:
            beat = self._beats.read(data)
        except SignalError as why:
            self._refuse(why)
            return
        if beat.tick == self._tick and self._started:
            self._beat = beat
            self._heard[topics.PHASE.name] = data
            self._step_if_complete()
        elif beat.tick != self._tick:
            self._refuse(f"cpg/phase: tick {beat.tick} is not now, now is {self._tick}")

    def _listener(self, leg: str) -> Callable[[bytes], None]:
        where, reader = f"{leg}/command", wire.CommandWire(leg, self._tick_ns)

        def hear(data: bytes) -> None:
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
                self._throttle.say(leg, f"{leg} is back at tick {self._tick}")
                self._diagnose()
            if command.tick == self._tick and self._started:
                self._commands[leg] = command
                self._heard[leg] = data
                self._step_if_complete()
            else:
                self._refuse(f"{where}: tick {command.tick} is over, now is {self._tick}")

        return hear

    def _transition_listener(self, leg: str) -> Callable[[bytes], None]:
        reader = wire.TransitionWire(leg, self._tick_ns)

        def hear(data: bytes) -> None:
            if self.done:
                return
            try:
                did = reader.read(data)
            except SignalError as why:
                self._refuse(why)
                return
            self._telling.add(leg)
            if did.tick == self._tick and self._started:
                self._transitions[leg] = did
                self._heard[topics.transition(leg).name] = data
                self._step_if_complete()
            elif did.tick > self._tick:
                self._refuse(f"{leg}/transition: tick {did.tick} is not yet, now is {self._tick}")

        return hear

    def _hear_recorder(self, data: bytes) -> None:
        try:
            self._recorded = wire.read_int(data, topics.RECORDED.name, -1)
        except SignalError as why:
            self._refuse(why)
            return
        if self._held:
            self._next()

    # -- one tick ----------------------------------------------------------------------------

    def _next(self) -> None:
        """Begin the present tick, unless a recorder is too far behind."""
        ahead = 0 if self._recorded is None else self._tick - self._recorded
        self._held = ahead > AHEAD and not self._realtime
        self._since = time.monotonic()
        if not self._held:
            self._publish()

    def _publish(self) -> None:
        """Say what is sensed at the present tick, and what time it is."""
        self._beat = None
        self._commands.clear()
        self._transitions.clear()
        self._heard.clear()
        ns, body, falls = self._tick * self._tick_ns, self.world.body(), None
        felt = [w.pack(sense) for w, sense in zip(self._wires, self.world.observe(), strict=True)]
        for (joints_data, contact_data), joints, contact in zip(
            felt, self._joints, self._contacts, strict=True
        ):
            joints.publish(joints_data)
            contact.publish(contact_data)
        clock, odometry = wire.pack_clock(ns), wire.pack_odometry(ns, body)
        self._clock_publisher.publish(clock)
        if body.falls != self._falls:
            if body.falls > max(self._falls, 0):
                self.get_logger().warning(
                    f"fall {body.falls} in cycle {self._tick // self._ticks}; put back on its feet"
                )
            self._falls = body.falls
            falls = wire.pack_int(body.falls)
            self._falls_publisher.publish(falls)
        self._odometry.publish(odometry)
        self._told = clock, falls, odometry, *zip(*felt, strict=True)
        if self._tick % self._ticks == 0:
            self._diagnose()

    def _step_if_complete(self) -> None:
        """Step once the phase and the commands of everybody present are in."""
        if self._realtime or self._held or self._beat is None or not self._commands:
            return
        if all(self._answered(leg) or leg in self._absent for leg in self.legs):
            self._step()

    def _answered(self, leg: str) -> bool:
        """Return whether a leg's command is in, and what it was paid, if it says that."""
        return leg in self._commands and (leg in self._transitions or leg not in self._telling)

    def _step(self) -> None:
        """Advance the world by the present tick, and begin the next one."""
        assert self._beat is not None
        commands = [self._commands.get(leg) for leg in self.legs]
        transitions = [self._transitions.get(leg) for leg in self.legs]
        for observer in self.observers:
            observer.tick(
                self._beat, self.world.observe(), commands, self.world.body(), transitions
            )
        if self._recording is not None:
            heard = self._heard.get
            said = (
                heard(topics.PHASE.name),
                [heard(leg) for leg in self.legs],
                [heard(topics.transition(leg).name) for leg in self.legs],
            )
            try:
                self._recording.put(self._tick, Told._make((*self._told, *said)))
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
        if not self._phase_subscription.handle.get_publisher_count():
            missing.append("cpg_node")
        for leg, joints, contact in zip(self.legs, self._joints, self._contacts, strict=True):
            hears = joints.get_subscription_count() and contact.get_subscription_count()
            if not (hears and self._subscriptions_by_leg[leg].handle.get_publisher_count()):
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
        if not self._recorders_are_ready():
            return
        self._telling = {
            leg
            for leg, subscription in self._transitions_by_leg.items()
            if subscription.handle.get_publisher_count()
        }
        self._started = True
        self._tell_the_beginning()
        self._next()

    def _recorders_are_ready(self) -> bool:
        """Return whether all who record have what they need, or had their time."""
        now = time.monotonic()
        if self._asked is None:
            self._asked = now
        late = now - self._asked >= max(self._patience, ANSWER_S)
        met = self.count_publishers(topics.RECORDED.name) and not late
        if self._recorded is None and (met or self._wants_recorder):
            self._throttle.remind("recorder", "waiting for the recorder")
            return False
        return self._bag is None or self._begin_bag(self._bag, late)

    def _begin_bag(self, bag: Scribe, late: bool) -> bool:
        """Ask what determines the run; begin to record, and return True, when all have answered.

        Who does not answer in time is not one of our nodes, and is not waited for.
        """
        if self._inquiry.ask() and not late:
            return False
        card, table, wrong = self._inquiry.card(self._kind, 0)
        for why in wrong:
            self.get_logger().warning(f"the bag cannot be replayed: {why}")
        try:
            self._recording = Recording(bag, card, table, namespace=self.get_namespace())
        except BagError as error:
            self._end_for(error)
            return False
        return True

    def _end_for(self, error: BagError) -> None:
        """End the run; the error is told when the node finishes: an executor would log a crash."""
        self._failed, self.done, self._started = error, True, False

    def _watch(self) -> None:
        """In lockstep: begin when all are there; declare absent who is late."""
        self._throttle.flush()
        if not self._started:
            self._start_if_all_there()
            return
        if self._held and not self.count_publishers(topics.RECORDED.name):
            self._recorded = None  # it has ended: nothing to wait for
            self._next()
            return
        if time.monotonic() - self._since < self._patience:
            return
        if self._held:
            self.get_logger().warning(
                f"the recorder heard nothing after tick {self._recorded}: not waited for any more"
            )
            self._recorded = None
            self._next()
        elif self._beat is None:
            self._throttle.remind(
                "phase", f"the phase of tick {self._tick} is missing: standing still"
            )
            self._diagnose()
        elif not self._commands:
            self._throttle.remind("legs", f"no leg answers at tick {self._tick}: standing still")
            self._diagnose()
        else:
            for leg in self.legs:
                if leg in self._commands and not self._answered(leg):
                    self._telling.discard(leg)  # it answers, and says no more what it was paid
                elif leg not in self._commands and leg not in self._absent:
                    self._absent.add(leg)
                    self._throttle.say(
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
            self._throttle.remind(
                "phase", f"the phase of tick {self._tick} is missing: standing still"
            )
        else:
            self._absent = {leg for leg in self.legs if leg not in self._commands}
            self._late.update(self._absent)
            self._tell_lateness()
            self._step()

    def _tell_lateness(self) -> None:
        """In real time: say now and then how often legs were late, and once that none is any more.

        A leg that misses every other tick comes and goes a thousand times a minute.
        """
        now = time.monotonic()
        if now - self._late_since < SAY_S or not (self._late or self._was_late):
            return
        if self._late:
            late = ", ".join(f"{leg} {ticks}" for leg, ticks in sorted(self._late.items()))
            self.get_logger().warning(f"ticks held still for want of a command in time: {late}")
        else:
            self.get_logger().info("all legs are in time again")
        self._was_late = bool(self._late)
        self._late.clear()
        self._late_since = now

    # -- telling -----------------------------------------------------------------------------

    def _tell_the_beginning(self) -> None:
        cycles = (
            "until stopped" if self._last == math.inf else f"{self._last // self._ticks} cycles"
        )
        mode = "realtime" if self._realtime else "lockstep"
        self.get_logger().info(f"{self._kind} begins: {', '.join(self.legs)}; {mode}, {cycles}")

    def _tell_the_end(self) -> None:
        cycles, falls = self._tick // self._ticks, self.world.body().falls
        self.get_logger().info(f"{self._kind} ended after {cycles} cycles, {falls} falls")

    def _diagnose(self) -> None:
        """Publish who is absent and what was refused."""
        stuck = self._started and time.monotonic() - self._since >= self._patience
        no_phase = stuck and self._beat is None
        message = DiagnosticArray()
        wire.set_stamp(message.header.stamp, self._tick * self._tick_ns)
        sim = DiagnosticStatus(
            name="sim_node",
            level=DiagnosticStatus.WARN if self._absent or stuck else DiagnosticStatus.OK,
            message="no phase" if no_phase else "standing still" if stuck else "walking",
            values=[
                KeyValue(key="cycle", value=str(self._tick // self._ticks)),
                KeyValue(key="falls", value=str(self.world.body().falls)),
                KeyValue(key="refused", value=str(self.refused)),
            ],
        )
        message.status = [sim]
        for leg in self.legs:
            away = leg in self._absent or (stuck and not no_phase and leg not in self._commands)
            message.status.append(
                DiagnosticStatus(
                    name=leg,
                    level=DiagnosticStatus.ERROR if away else DiagnosticStatus.OK,
                    message="absent" if away else "present",
                )
            )
        self._diagnostics.publish(message)

    def finish(self, spin: Callable[[], None]) -> None:
        """Stop stepping and end the record.

        Raises:
            BagError: the bag could not be written to its end.
        """
        self.done, self._started = True, False
        if self._tick:
            self._tell_the_end()
        self.recorder.finish(self.world.observe(), self.world.body())
        if self._failed is not None:
            raise self._failed
        if self._bag is not None:
            if self._recording is not None:
                self._recording.finish()
            self._bag.close()

    def destroy_node(self) -> None:
        """Destroy the node and let go of the world; a bag that was not finished ends here."""
        if self._bag is not None:
            self._bag.abandon()
        self.world.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """Run the node until its cycles are done or a signal comes."""
    sys.exit(main_of(SimNode, args))


if __name__ == "__main__":
    main()
