"""The machine without ROS: the specification of a tick, and the fast way to train.

The graph carries the same values in messages and must end with the same bits.
"""

from __future__ import annotations

from cpg_node.cpg import FixedPeriod
from ember_ros.observer import Observer
from ember_ros.params import cells_sha256
from ember_ros.plan import Plan, make_world
from ember_ros.signals import LegCommand, LegSense, Phase
from leg_node.module import LegModule
from leg_node.shared import SharedTable
from leg_node.table import Table, empty_table
from leg_node.table_file import load_table
from sim_node.world import World


def act(shared: SharedTable, leg: LegModule, sense: LegSense, phase: Phase) -> LegCommand:
    """Let a leg have its tick, between the two ends of its epoch."""
    upto = leg.copy.pull_due(sense.tick)
    if upto is not None:
        leg.copy.take(shared.pull(leg.copy.version, upto), upto)
    command = leg.tick(sense, phase)
    if leg.copy.close_epoch(sense.tick):
        _push(shared, leg)
    return command


def hand_in(shared: SharedTable, leg: LegModule, last_tick: int) -> None:
    """Let a leg push what it learnt since its last epoch ended."""
    leg.copy.close_epoch(last_tick, early=True)
    _push(shared, leg)


def _push(shared: SharedTable, leg: LegModule) -> None:
    while (push := leg.copy.push_due()) is not None:
        shared.push(push)
        leg.copy.acknowledged(push)


class Loop:
    """One robot: a world, a central pattern generator, legs, and the table they share."""

    def __init__(self, plan: Plan, world: World | None = None) -> None:
        """Build the robot of a plan, in ``world`` or in the one that the plan names.

        Raises:
            TableError: the plan's table cannot be used.
            ParameterError: a leg or a policy does not exist.
        """
        params = plan.params
        table = load_table(plan.table, params)[0] if plan.table else empty_table(params)
        numbers = params.walk if plan.stage == "walk" else params.train
        self.shared = SharedTable(table, cells=cells_sha256(params), rate=numbers.rate)
        self.legs = [
            LegModule(
                params,
                leg,
                stage=plan.stage,
                seed=plan.seed,
                policy=plan.policy,
                learning=plan.learning,
                start_cycle=plan.start_cycle,
            )
            for leg in plan.legs
        ]
        self.cpg = FixedPeriod(params.gait)
        self.world = world or make_world(plan.world, params, plan.seed)
        self.now = 0
        """The present tick."""
        self._tick_ns = params.gait.tick_ns

    def tick(self, *observers: Observer) -> None:
        """Run one tick of the whole machine."""
        senses = self.world.observe()
        phase = self.cpg.phase(self.now * self._tick_ns)
        commands = [
            act(self.shared, leg, sense, phase)
            for leg, sense in zip(self.legs, senses, strict=True)
        ]
        transitions = [leg.transition for leg in self.legs]
        for observer in observers:
            observer.tick(phase, senses, commands, self.world.body(), transitions)
        self.world.step(phase, commands)
        self.now += 1

    def finish(self) -> Table:
        """End the run: bring what every leg has learnt into the shared table, and return it."""
        for leg in self.legs:
            hand_in(self.shared, leg, self.now - 1)
        self.shared.merge()
        return self.shared.table

    def close(self) -> None:
        """Let go of the world."""
        self.world.close()
