"""The machine without ROS: the specification of a tick, and the fast way to train.

The graph carries the same values in messages, and must end with the same bits as this loop.
"""

from __future__ import annotations

from cpg_node.cpg import Beats
from ember_ros import parts
from ember_ros.observer import Observer
from ember_ros.params import cells_sha256
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, LegCommand, LegSense
from ember_ros.worlds import World, make_world
from leg_node.assembly import empty_table, learning_params_of, make_leg
from leg_node.module import LegModule
from leg_node.shared import SharedTable
from leg_node.table import Table
from leg_node.table_file import load_table


def tick_leg(shared: SharedTable, leg: LegModule, sense: LegSense, beat: Beat) -> LegCommand:
    """Run one tick of a leg.

    Pull if an epoch begins; let the leg learn and act; push if an epoch ends. ``LegNode`` does the
    same over services.
    """
    upto = leg.copy.epoch_to_pull(sense.tick)
    if upto is not None:
        leg.copy.apply(shared.pull(leg.copy.version, upto), upto)
    command = leg.tick(sense, beat)
    if leg.copy.close_epoch(sense.tick):
        _push(shared, leg)
    return command


def flush(shared: SharedTable, leg: LegModule, last_tick: int) -> None:
    """Let a leg push what it learnt since its last epoch ended."""
    leg.finish()
    leg.copy.close_epoch(last_tick, early=True)
    _push(shared, leg)


def _push(shared: SharedTable, leg: LegModule) -> None:
    while (batch := leg.copy.oldest_unacknowledged()) is not None:
        shared.push(batch)
        leg.copy.acknowledged(batch)


class Loop:
    """One robot: a world, a central pattern generator, legs, and the table they share."""

    def __init__(self, config: RunConfig, world: World | None = None) -> None:
        """Build the configured robot, in ``world`` or in the one that ``config`` names.

        Raises:
            TableError: the table to start from cannot be used.
            ParameterError: a leg, a policy or a part does not exist.
        """
        params = config.params
        table = load_table(config.table, params)[0] if config.table else empty_table(params)
        learning_params = learning_params_of(params, config.stage)
        self.shared = SharedTable(
            table, legs=len(config.legs), cells=cells_sha256(params), rate=learning_params.rate
        )
        self.legs = [
            make_leg(
                params,
                leg,
                stage=config.stage,
                seed=config.seed,
                policy=config.policy,
                learning=config.learning,
                start_cycle=config.start_cycle,
            )
            for leg in config.legs
        ]
        self.beats = Beats(parts.make(params, "cpg", params))
        self.world = world or make_world(config.world, params, config.seed)
        self.now = 0
        """The present tick."""

    def tick(self, *observers: Observer) -> None:
        """Run one tick of the whole machine.

        1. The world is observed: one sense a leg.
        2. The oscillator gives the beat.
        3. Each leg has its tick, in the order of legs: it learns from tick t-1 and acts in tick t.
        4. Observers are shown the commands of tick t together with the transitions of tick t-1.
        5. The world steps with all commands.
        """
        senses = self.world.observe()
        beat = self.beats.at(self.now, senses)
        commands = [
            tick_leg(self.shared, leg, sense, beat)
            for leg, sense in zip(self.legs, senses, strict=True)
        ]
        transitions = [leg.last_transition for leg in self.legs]
        for observer in observers:
            observer.tick(beat, senses, commands, self.world.body(), transitions)
        self.world.step(beat, commands)
        self.now += 1

    def finish(self) -> Table:
        """End the run: bring what every leg has learnt into the shared table, and return it.

        The last action is never credited: its end is not sensed.
        """
        for leg in self.legs:
            flush(self.shared, leg, self.now - 1)
        self.shared.merge()
        return self.shared.table

    def close(self) -> None:
        """Let go of the world."""
        self.world.close()
