"""Runs of the loop, and what two runs of one plan must agree in."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

from ember_ros.loop import Loop
from ember_ros.plan import Plan
from ember_ros.report.recorder import Recorder


class Bits(NamedTuple):
    """What two ways of running the same plan must agree in."""

    table: str
    senses: str
    commands: str
    falls: int


@functools.cache
def by_loop(plan: Plan) -> Bits:
    """Run a plan in the loop, the specification, once a session."""
    loop = Loop(plan)
    try:
        recorder = Recorder(plan.params, plan.legs)
        for _ in range(plan.cycles * plan.params.gait.ticks):
            loop.tick(recorder)
        recorder.finish(loop.world.observe(), loop.world.body())
        return bits_of(loop.finish().sha256(), recorder.summary())
    finally:
        loop.close()


def bits_of(table_sha256: str, summary: dict[str, Any]) -> Bits:
    """Return the bits of a run from its table and its summary."""
    return Bits(
        table_sha256, summary["senses_sha256"], summary["commands_sha256"], summary["falls"]
    )


def by_graph(graph: Any) -> Bits:
    """Return the bits of a ``Graph`` that has run."""
    return bits_of(graph.nodes["table_node"].shared.table.sha256(), graph.sim.recorder.summary())
