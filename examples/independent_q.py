"""Your own algorithm on ember_ros.envs: four Q-learners written from scratch, in one file.

Nothing of leg_node's learner is in it: a table a leg, one-step Q-learning, epsilon-greedy, and no
leg knows another's table. One leg learns on the trainer; four copies of it carry the body and each
goes on learning for itself. Prints how far a cycle went and how often the robot fell; a minute or
two with the defaults:

    pip install 'ember_ros[envs,sim]'
    python examples/independent_q.py --seed 1

To bring another algorithm, replace QLearner: choose(), learn(), and what a copy of it is.
"""

from __future__ import annotations

import argparse
import copy
from dataclasses import dataclass, fields

import numpy as np

from ember_ros.envs import WalkerEnv


@dataclass
class Args:
    """What can be set from the command line."""

    seed: int = 1
    train_cycles: int = 3000  # on the trainer
    walk_cycles: int = 400  # on the body
    report_cycles: int = 100  # between two lines
    gamma: float = 0.8  # discount a tick
    alpha: float = 0.1  # learning rate on the trainer
    alpha_walk: float = 0.03  # a rate that suits the trainer ruins a good table on the body
    epsilon: float = 0.3  # share of random actions at first, on the trainer; it falls to 0


class QLearner:
    """One leg's table."""

    def __init__(self, states: int, actions: int, args: Args, seed: list[int]) -> None:
        self.q = np.zeros((states, actions))
        self.gamma, self.alpha, self.epsilon = args.gamma, args.alpha, args.epsilon
        self.rng = np.random.default_rng(seed)

    def choose(self, state: int) -> int:
        """Return the best action, ties at random, or any with probability epsilon."""
        row = self.q[state]
        if self.rng.random() < self.epsilon:
            return int(self.rng.integers(len(row)))
        return int(self.rng.choice(np.flatnonzero(row == row.max())))

    def learn(self, state: int, action: int, reward: float, then: int) -> None:
        """Move a value towards the reward and the best that the next state promises."""
        target = reward + self.gamma * self.q[then].max()
        self.q[state, action] += self.alpha * (target - self.q[state, action])


def run(env: WalkerEnv, learners: dict[str, QLearner], cycles: int, args: Args) -> float:
    """Let the learners act and learn; return the way ahead a cycle in the last lines, m."""
    start = {leg: learner.epsilon for leg, learner in learners.items()}
    states, _ = env.reset(seed=args.seed)
    x = y = yaw = way = 0.0
    falls = 0
    for cycle in range(cycles):
        for leg, learner in learners.items():
            learner.epsilon = start[leg] * (1.0 - cycle / cycles)
        for _ in range(env.params.gait.ticks):
            actions = {leg: learners[leg].choose(states[leg]) for leg in env.agents}
            seen, rewards, _, _, infos = env.step(actions)
            for leg, action in actions.items():
                if not infos[leg]["first_tick"]:  # nothing is learnt across a fall
                    learners[leg].learn(states[leg], action, rewards[leg], seen[leg])
            states = seen
        if (cycle + 1) % args.report_cycles == 0 or cycle + 1 == cycles:
            body, done = env.body, cycle % args.report_cycles + 1
            way = ((body.x - x) * np.cos(yaw) + (body.y - y) * np.sin(yaw)) / done
            print(f"  cycle {cycle + 1:5d}: {way:.3f} m a cycle, {body.falls - falls} falls")
            x, y, yaw, falls = body.x, body.y, body.yaw, body.falls
    env.close()
    return way


def main(args: Args) -> float:
    """Train one leg, walk on four; return how far the last cycles went, m a cycle."""
    most = max(args.train_cycles, args.walk_cycles) + 1
    trainer = WalkerEnv(world="trainer", observation="state", max_cycles=most)
    walker = WalkerEnv(observation="state", max_cycles=most)
    (alone,) = trainer.possible_agents
    sizes = int(trainer.observation_space(alone).n), int(trainer.action_space(alone).n)
    teacher = QLearner(*sizes, args, [args.seed, 0])
    print("one leg on the trainer")
    run(trainer, {alone: teacher}, args.train_cycles, args)
    learners = {leg: copy.deepcopy(teacher) for leg in walker.possible_agents}
    for n, learner in enumerate(learners.values()):
        learner.alpha, learner.epsilon = args.alpha_walk, 0.0
        learner.rng = np.random.default_rng([args.seed, n + 1])
    print(f"{len(learners)} copies of it on the body, each on its own")
    return run(walker, learners, args.walk_cycles, args)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for each in fields(Args):
        name = f"--{each.name.replace('_', '-')}"
        parser.add_argument(name, type=type(each.default), default=each.default)
    main(Args(**vars(parser.parse_args())))
