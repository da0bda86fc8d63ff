"""Runs of the loop, and the values that two runs of one configuration must have in common."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

from ember_ros.loop import Loop
from ember_ros.report.run_statistics import RunStatistics
from ember_ros.run_config import RunConfig
from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, Transition
from leg_node.table import Table


class Bits(NamedTuple):
    """Values that are equal for all modes of running one configuration."""

    table: str
    senses: str
    commands: str
    falls: int


def run_and_record(config: RunConfig) -> tuple[Table, RunStatistics]:
    """Run a configuration in the loop; return the table and the statistics."""
    loop = Loop(config)
    try:
        recorder = RunStatistics(config.params, config.legs)
        for _ in range(config.cycles * config.params.gait.ticks):
            loop.tick(recorder)
        recorder.finish(loop.world.observe(), loop.world.body())
        return loop.finish(), recorder
    finally:
        loop.close()


@functools.cache
def by_loop(config: RunConfig) -> Bits:
    """Run a configuration in the loop, the reference; cached for the session."""
    table, recorder = run_and_record(config)
    return bits_of(table.sha256(), recorder.summary())


def bits_of(table_sha256: str, summary: dict[str, Any]) -> Bits:
    """Return the bits of a run from its table and its summary."""
    return Bits(
        table_sha256, summary["senses_sha256"], summary["commands_sha256"], summary["falls"]
    )


def by_graph(graph: Any) -> Bits:
    """Return the bits of a ``Graph`` that has run."""
    return bits_of(graph.nodes["table_node"].shared.table.sha256(), graph.sim.recorder.summary())


class SignalLog:
    """Observer that keeps all signals of a loop, one list per signal and one item per tick."""

    def __init__(self) -> None:
        """Start with empty lists."""
        self.phases: list[Beat] = []
        self.senses: list[tuple[LegSense, ...]] = []
        self.commands: list[tuple[LegCommand, ...]] = []
        self.bodies: list[BodyState] = []
        self.transitions: list[tuple[Transition, ...]] = []

    def tick(
        self,
        phase: Beat,
        senses: Sequence[LegSense],
        commands: Sequence[Any],
        body: BodyState,
        transitions: Sequence[Any],
    ) -> None:
        """Append a tick."""
        self.phases.append(phase)
        self.senses.append(tuple(senses))
        self.commands.append(tuple(commands))
        self.bodies.append(body)
        self.transitions.append(tuple(transitions))

    @property
    def signals(self) -> list[tuple[Beat, tuple[LegSense, ...], tuple[LegCommand, ...]]]:
        """Return phase, senses and commands of each tick."""
        return list(zip(self.phases, self.senses, self.commands, strict=True))
