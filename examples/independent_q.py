"""Your own algorithm on ember_ros.envs: independent Q-learners, written from scratch in one file.

It does not use the learner of leg_node: one table per leg, one-step Q-learning, epsilon-greedy, and
no leg reads the table of another one. One leg learns on the trainer; four copies of it walk, and
each continues to learn on its own. Prints the distance per cycle and the number of falls; takes a
minute or two with the defaults:

    pip install 'ember_ros[envs,sim]'
    python examples/independent_q.py --seed 1

To use another algorithm, replace QLearner: choose(), learn() and deepcopy() are used.
"""

from __future__ import annotations

import argparse
import copy
from dataclasses import dataclass, fields

import numpy as np

from ember_ros.envs import WalkerEnv


@dataclass
class Args:
    """Command-line options."""

    seed: int = 1
    train_cycles: int = 3000  # on the trainer
    walk_cycles: int = 400  # with four legs
    report_cycles: int = 100  # cycles per printed line
    gamma: float = 0.8  # discount factor per tick
    alpha: float = 0.1  # learning rate on the trainer
    alpha_walk: float = 0.03  # learning rate with four legs; alpha would be too high
    epsilon: float = 0.3  # share of random actions at the start of the training; it decreases to 0


class QLearner:
    """Tabular Q-learning of one leg."""

    def __init__(self, states: int, actions: int, args: Args, seed: list[int]) -> None:
        self.q = np.zeros((states, actions))
        self.gamma, self.alpha, self.epsilon = args.gamma, args.alpha, args.epsilon
        self.rng = np.random.default_rng(seed)

    def choose(self, state: int) -> int:
        """Return a random action with probability epsilon, otherwise one of the best."""
        row = self.q[state]
        if self.rng.random() < self.epsilon:
            return int(self.rng.integers(len(row)))
        return int(self.rng.choice(np.flatnonzero(row == row.max())))

    def learn(self, state: int, action: int, reward: float, next_state: int) -> None:
        """Update a value towards the reward plus the discounted maximum of the next state."""
        target = reward + self.gamma * self.q[next_state].max()
        self.q[state, action] += self.alpha * (target - self.q[state, action])


def run(env: WalkerEnv, learners: dict[str, QLearner], cycles: int, args: Args) -> float:
    """Act and learn; return the forward distance per cycle of the last printed line, m."""
    start = {leg: learner.epsilon for leg, learner in learners.items()}
    states, _ = env.reset(seed=args.seed)
    x = y = yaw = distance = 0.0
    falls = 0
    for cycle in range(cycles):
        for leg, learner in learners.items():
            learner.epsilon = start[leg] * (1.0 - cycle / cycles)
        for _ in range(env.params.gait.ticks):
            actions = {leg: learners[leg].choose(states[leg]) for leg in env.agents}
            next_states, rewards, _, _, infos = env.step(actions)
            for leg, action in actions.items():
                if not infos[leg]["first_tick"]:  # no transition across a fall
                    learners[leg].learn(states[leg], action, rewards[leg], next_states[leg])
            states = next_states
        if (cycle + 1) % args.report_cycles == 0 or cycle + 1 == cycles:
            body, done = env.body, cycle % args.report_cycles + 1
            distance = ((body.x - x) * np.cos(yaw) + (body.y - y) * np.sin(yaw)) / done
            print(f"  cycle {cycle + 1:5d}: {distance:.3f} m per cycle, {body.falls - falls} falls")
            x, y, yaw, falls = body.x, body.y, body.yaw, body.falls
    env.close()
    return distance


def main(args: Args) -> float:
    """Train one leg, walk with four; return the distance per cycle at the end, m."""
    max_cycles = max(args.train_cycles, args.walk_cycles) + 1
    trainer = WalkerEnv(world="trainer", observation="state", max_cycles=max_cycles)
    walker = WalkerEnv(observation="state", max_cycles=max_cycles)
    (trainer_leg,) = trainer.possible_agents
    sizes = int(trainer.observation_space(trainer_leg).n), int(trainer.action_space(trainer_leg).n)
    trained = QLearner(*sizes, args, [args.seed, 0])
    print("one leg on the trainer")
    run(trainer, {trainer_leg: trained}, args.train_cycles, args)
    learners = {leg: copy.deepcopy(trained) for leg in walker.possible_agents}
    for n, learner in enumerate(learners.values()):
        learner.alpha, learner.epsilon = args.alpha_walk, 0.0
        learner.rng = np.random.default_rng([args.seed, n + 1])
    print(f"{len(learners)} copies of it on the body, each learning on its own")
    return run(walker, learners, args.walk_cycles, args)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for each in fields(Args):
        name = f"--{each.name.replace('_', '-')}"
        parser.add_argument(name, type=type(each.default), default=each.default)
    main(Args(**vars(parser.parse_args())))
