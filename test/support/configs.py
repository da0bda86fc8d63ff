"""Parameters and configurations of small runs."""

from __future__ import annotations

from typing import Any

from ember_ros.params import Params, replace
from ember_ros.run_config import RunConfig

TINY = replace(
    Params(),
    {"state.hip_bins": 3, "state.force_edges": [0.5], "state.inclination_edges": [-0.5]},
)
"""A small table, for small bags."""
SMALL = replace(
    Params(),
    {
        "state.hip_bins": 5,
        "state.force_edges": [0.25, 1.0],
        "state.inclination_edges": [-0.6, -0.4],
        "walk.epsilon_start": 0.2,
        "walk.epsilon_end": 0.2,
    },
)
"""A walker that explores, on a small table."""


def changed(base: Params, /, **changes: Any) -> Params:
    """Return parameters with changes; ``__`` in a name stands for a dot."""
    return replace(base, {name.replace("__", "."): value for name, value in changes.items()})


def small_config(cycles: int, *, world: str = "walker", seed: int = 3, **options: Any) -> RunConfig:
    """Return a configuration with a small table; options with ``__`` are parameters."""
    changes = {name: options.pop(name) for name in list(options) if "__" in name}
    return RunConfig(world, cycles, seed=seed, params=changed(SMALL, **changes), **options)
