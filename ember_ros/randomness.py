"""Random numbers: one generator for whoever draws, all spawned from the run's one seed."""

from __future__ import annotations

import numpy as np

WORLD = 100
"""Spawn key of the world; legs have their position in the order of legs."""
LEARNER = 200
"""Spawn key of the first leg's learner; those of the others follow."""


def generator(seed: int, who: int) -> np.random.Generator:
    """Return the generator of one drawer; different drawers are independent of each other.

    Args:
        seed: of the run, at least 0.
        who: spawn key, the leg's position or ``WORLD``.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(who,)))
