"""A real leg in the place of the trainer: a driver, with pretended hardware inside.

The sim_node publishes the senses of all legs of a world, so today a real leg replaces the whole
world and not one of four simulated legs. This is that world: it holds the leg's driver, and the
sim_node around it does the rest as it does for Bullet: it publishes <leg>/joint_states,
<leg>/contact and clock, hears <leg>/command and the phase, waits for all of a tick (lockstep), and
records bags. The other nodes do not notice. Runs for some seconds, and needs ROS 2:

    python examples/leg_driver.py --cycles 50

As a node of its own, beside the others of `ember walk`'s graph:

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
    """What the driver of a real leg has to do: put your bus, encoders and sensors behind it."""

    def read(self, tick: int) -> LegSense:
        """Return what the leg senses now; force and slip are of the tick that just ended.

        Encoders give joint angles and speeds, a load cell in the foot the force, an accelerometer
        on the shank the inclination, and whatever you have the slip and the hair.
        """
        ...

    def drive(self, command: LegCommand | None) -> None:
        """Drive the motors so for one tick and return when it is over; None: hold still."""
        ...

    def home(self) -> None:
        """Bring the leg to where a run begins, by motor or by hand."""
        ...


class Pretended:
    """Hardware that is none: joints follow at once, and time takes no time."""

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
    """The trainer with a real leg: what ``ember_ros.worlds.World`` asks for."""

    stage = "train"
    legs: tuple[str, ...] = (TRAINER_LEG,)
    over = False
    work = 0.0  # no meter measures what the motors did

    @staticmethod
    def legs_of(params: Params) -> tuple[str, ...]:
        """Return the names of the legs, before the world is made."""
        return (TRAINER_LEG,)

    def __init__(self, params: Params, *, seed: int = 0, gui: bool = False) -> None:
        """Connect; nothing of a real leg hangs on the seed, and there is no window."""
        self._height = params.leg.operating_height
        self._driver: Driver = Pretended(params)
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
        """Return a body that nobody tracks; an axle encoder would tell ``x``."""
        return BodyState(0.0, 0.0, self._height, 0.0, 0.0, 0.0, 0)

    def close(self) -> None:
        """Let go of the bus: the pretended one has none."""


def main() -> None:
    """Let the leg learn for some cycles, on a graph of nodes."""
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
