"""Puts a leg together from its parameters: the one place where its parts meet. Pure.

The loop, the leg's node, a replay, learning from bags and the experiments all make their legs here.
"""

from __future__ import annotations

from typing import Any

from ember_ros import parts
from ember_ros.errors import ParameterError, shown
from ember_ros.params import MAX_CELLS, TRAINER_LEG, LearningParams, Params, cells_sha256
from ember_ros.randomness import LEARNER, generator
from leg_node.discretizer import Discretizer, states_of
from leg_node.learner import Learner
from leg_node.module import LegModule
from leg_node.policy import POLICIES, Policy
from leg_node.shared import LocalCopy
from leg_node.table import Table
from leg_node.task import LegTask

STAGES = ("train", "walk")
BLIND = ("scripted", "random")
"""Policies that choose without the table."""


def learning_params_of(params: Params, stage: str) -> LearningParams:
    """Return the learning parameters of a stage.

    Raises:
        ParameterError: there is no such stage.
    """
    if stage not in STAGES:
        raise ParameterError(f"there is no stage {stage!r}; it is {' or '.join(STAGES)}")
    return params.walk if stage == "walk" else params.train


def position_of(params: Params, leg: str) -> int:
    """Return a leg's position in the order of legs.

    Raises:
        ParameterError: there is no such leg.
    """
    if leg == TRAINER_LEG:
        return 0
    try:
        return params.robot.legs.index(leg)
    except ValueError:
        raise ParameterError(
            f"there is no leg {leg!r}; it is one of {', '.join(params.robot.legs)} on the walker, "
            f"{TRAINER_LEG} on the trainer"
        ) from None


def make_discretizer(params: Params) -> Discretizer:
    """Return the discretizer that ``parts.discretizer`` names.

    Raises:
        ParameterError: there is none, or its states are none or too many.
    """
    made: Discretizer = parts.make(params, "discretizer", params)
    try:
        shape, neighbours = tuple(made.shape), tuple(made.neighbours)
    except (AttributeError, TypeError) as error:
        raise ParameterError(
            f"parts.discretizer = {shown(params.parts.discretizer)}: {error}; a tuple of numbers "
            "of bins as shape, and one of bits as neighbours, would be right"
        ) from error
    sizes = [n for n in shape if type(n) is int and n > 0]
    if not shape or len(sizes) != len(shape) or len(neighbours) != len(shape):
        raise ParameterError(
            f"parts.discretizer = {shown(params.parts.discretizer)}: shape {shown(shape)} and "
            f"neighbours {shown(neighbours)}; as many numbers of bins, 1 or more each, as bits "
            "would be right"
        )
    cells = states_of(made) * _table_count(params) * len(params.leg.knee_speeds)
    if cells > MAX_CELLS:
        raise ParameterError(
            f"parts.discretizer and leg.knee_speeds make a table of {states_of(made)} states "
            f"({' x '.join(map(str, shape))}) x {len(params.leg.knee_speeds)} actions, "
            f"{cells} cells; up to {MAX_CELLS} would be right"
        )
    return made


def _table_count(params: Params) -> int:
    """Return how many tables the learner keeps, one behind the other."""
    return int(getattr(parts.find(params.parts.learner, "parts.learner"), "tables", 1))


def empty_table(params: Params) -> Table:
    """Return an empty table of the size that a robot's parts ask for.

    Raises:
        ParameterError: a part cannot be used.
    """
    return _table_over(make_discretizer(params), params)


def _table_over(discretizer: Discretizer, params: Params) -> Table:
    """Return an empty table of a discretizer's states."""
    states = states_of(discretizer) * _table_count(params)
    return Table(states, len(params.leg.knee_speeds))


def make_task(params: Params, leg: str) -> LegTask:
    """Return a leg without policy and learner: what it knows, is paid, and can do.

    Args:
        params: every number, and which parts.
        leg: one of ``robot.legs``, or ``TRAINER_LEG``.

    Raises:
        ParameterError: there is no such leg or part.
    """
    position = position_of(params, leg)
    offset = 0.0 if leg == TRAINER_LEG else params.robot.offset[position]
    return LegTask(
        leg,
        params,
        gait=parts.make(params, "gait", params, offset),
        discretizer=make_discretizer(params),
        reward=parts.make(params, "reward", params),
    )


def make_leg(
    params: Params,
    leg: str,
    *,
    stage: str = "walk",
    seed: int = 0,
    policy: str | Policy = "learned",
    learning: bool = True,
    shared: bool = True,
    table: Table | None = None,
    run: str = "run",
    start_cycle: int = 0,
) -> LegModule:
    """Return a leg, put together as its parameters say.

    Args:
        params: every number, and which parts.
        leg: one of ``robot.legs``, or ``TRAINER_LEG``.
        stage: which learning parameters hold, ``train`` or ``walk``.
        seed: of the run; each leg draws from its own generator.
        policy: ``learned``, ``scripted``, ``random``, the dotted path of one, or one.
        learning: whether the table changes.
        shared: whether the table is shared with other legs, or this leg's own.
        table: what was learnt before, owned by this leg from now on; empty for None.
        run: names this life of the leg for the shared table.
        start_cycle: nominal cycles that were learnt before: exploration goes on from there.

    Raises:
        ParameterError: there is no such leg, stage, policy or part.
    """
    learning_params = learning_params_of(params, stage)
    position = position_of(params, leg)
    task = make_task(params, leg)
    # A policy object was made without q_values, so it cannot read the table.
    reads_table = isinstance(policy, str) and policy not in BLIND
    needs_shared = shared and (learning or reads_table)
    copy = LocalCopy(
        table if table is not None else _table_over(task.discretizer, params),
        leg=position,
        run=run,
        cells=cells_sha256(params),
        rate=learning_params.rate,
        sync_every=learning_params.sync_every if needs_shared else 0,
    )
    learner = _make_learner(params, learning_params, task.discretizer, copy.table, seed, position)
    if isinstance(policy, str):
        rng = generator(seed, position)
        given = (params, learning_params, learner.q_values, rng, start_cycle)
        made: Policy = parts.build(
            _policy_of(policy), "policy", f"policy = {shown(policy)}", *given
        )
    else:
        made = policy
    return LegModule(
        task,
        learner=learner,
        policy=made,
        copy=copy,
        learning=learning,
        shared=needs_shared,
    )


def _policy_of(name: str) -> Any:
    """Return the class of a policy."""
    if name in POLICIES:
        return POLICIES[name]
    if "." not in name:
        raise ParameterError(
            f"there is no policy {name!r}; it is {', '.join(POLICIES)}, or the dotted path of a "
            "class of your own"
        )
    return parts.find(name, "policy")


def _make_learner(
    params: Params,
    learning_params: LearningParams,
    discretizer: Discretizer,
    table: Table,
    seed: int,
    position: int,
) -> Learner:
    states, ticks = states_of(discretizer), params.gait.ticks
    estimates = [
        parts.make(params, "value", part, discretizer, learning_params, ticks)
        for part in table.split(_table_count(params))
    ]
    shape, rng = (states, table.actions), generator(seed, LEARNER + position)
    learner: Learner = parts.make(params, "learner", estimates, learning_params, shape, rng)
    return learner
