"""A real leg instead of the trainer: a world with a hardware driver, here with mock hardware.

The sim_node publishes the senses of all legs of a world, so a real leg replaces the whole world,
not one of four simulated legs. This world contains the driver of the leg. The sim_node does the
same as with Bullet: it publishes <leg>/joint_states, <leg>/contact and clock, subscribes to
<leg>/command and the phase, waits for all messages of a tick (lockstep), and records bags. The
other nodes need no change. Takes some seconds, and needs ROS 2:

    python examples/leg_driver.py --cycles 50

As a separate node, with the other nodes of the graph of `ember walk`:

    PYTHONPATH=examples ros2 run ember_ros sim_node --ros-args -p world:=leg_driver.HardwareLeg
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Protocol

from ember_ros.params import TRAINER_LEG, Params
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense
from sim_node.fake import FakeWorld


class Driver(Protocol):
    """Interface of the driver of a real leg; implement it for your bus, encoders and sensors."""

    def read(self, tick: int) -> LegSense:
        """Return the present senses; force and slip are those of the tick that just ended.

        Typical sensors: encoders for joint angles and speeds, a load cell in the foot for the
        force, an accelerometer on the shank for the inclination; slip and hair depend on the
        hardware.
        """
        ...

    def drive(self, command: LegCommand | None) -> None:
        """Apply a command for one tick and return at its end; None: hold the joints still."""
        ...

    def home(self) -> None:
        """Move the leg to its start position, by motor or by hand."""
        ...


class MockDriver:
    """A driver without hardware: joints follow at once, and a tick takes no wall time."""

    def __init__(self, params: Params) -> None:
        self._leg = FakeWorld([TRAINER_LEG], params)
        self._now = Beat(0, 0.0)

    def read(self, tick: int) -> LegSense:
        return self._leg.observe()[0]._replace(tick=tick)

    def drive(self, command: LegCommand | None) -> None:
        self._leg.step(self._now, [command])

    def home(self) -> None:
        self._leg.reset()


class HardwareLeg:
    """The trainer with a real leg; implements ``ember_ros.worlds.World``."""

    stage = "train"
    legs: tuple[str, ...] = (TRAINER_LEG,)
    over = False
    work = 0.0  # the mechanical work of the motors is not measured

    @staticmethod
    def legs_of(params: Params) -> tuple[str, ...]:
        """Return the names of the legs, before the world is created."""
        return (TRAINER_LEG,)

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        """Connect to the leg; ``seed`` and ``gui`` have no effect."""
        self._height = params.leg.operating_height
        self._driver: Driver = MockDriver(params)
        self.reset()

    def reset(self) -> None:
        self._driver.home()
        self._tick = 0
        self._sense = self._driver.read(0)

    def observe(self) -> tuple[LegSense, ...]:
        return (self._sense,)

    def step(self, beat: Beat, commands: Sequence[LegCommand | None]) -> None:
        self._driver.drive(commands[0])
        self._tick += 1
        self._sense = self._driver.read(self._tick)

    def body(self) -> BodyState:
        """Return a constant pose; an encoder at the axle could measure ``x``."""
        return BodyState(0.0, 0.0, self._height, 0.0, 0.0, 0.0, 0)

    def close(self) -> None:
        """Close the connection to the hardware; the mock has none."""


def main() -> None:
    """Let the leg learn for some cycles on a graph of nodes."""
    from ember_ros.graph import Graph
    from ember_ros.run_config import RunConfig

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cycles", type=int, default=50)
    graph = Graph(RunConfig("leg_driver.HardwareLeg", parser.parse_args().cycles))
    graph.run()
    table = graph.nodes["table_node"].shared.table
    print(f"{graph.sim.tick} ticks of {TRAINER_LEG}; {int(table.visits.sum())} updates learnt")
    graph.close()


if __name__ == "__main__":
    main()
