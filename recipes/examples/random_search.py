"""A learner of one's own, in the simulator that a run grounded: linear policies by the cross-entropy method.

python random_search.py RUN ROW [rounds]    learns, and writes linear.npy
astra-data evaluate RECIPE --method ROW --seed 0 --policy random_search.py:POLICY --out tested
"""

import sys
from pathlib import Path

import gymnasium
import numpy as np

import astra_data.envs  # noqa: F401 - registers Grounded-v0

FILE = Path("linear.npy")
CANDIDATES, KEPT = 256, 32


class Linear:
    def __init__(self, gains):
        self.gains = gains

    def act(self, observation):  # (B, O) in, (B, A) within ±1 out
        return np.tanh(observation @ self.gains)


def returns_of(gains, env, seed):
    """Let each candidate (B, O, A) act in a row of its own for an episode; return the sums of rewards."""
    observation, _ = env.reset(seed=seed)
    total, running = np.zeros(len(gains)), np.ones(len(gains), bool)
    while running.any():
        action = np.tanh(np.einsum("bo,boa->ba", observation, gains)).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        total += reward * running
        running &= ~(terminated | truncated)
    return total


def learn(run, row, rounds=20):
    env = gymnasium.make_vec("astra_data/Grounded-v0", num_envs=CANDIDATES, run=run, row=row, seed=0)
    rng = np.random.default_rng(0)
    mean = np.zeros((env.single_observation_space.shape[0], env.single_action_space.shape[0]))
    spread = np.ones_like(mean)
    for number in range(rounds):
        gains = rng.normal(mean, spread, (CANDIDATES, *mean.shape))
        total = returns_of(gains, env, seed=number)
        best = gains[np.argsort(total)[-KEPT:]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.05
        print(f"round {number}: return {total.mean():.2f}, of the best {np.sort(total)[-KEPT:].mean():.2f}")
    np.save(FILE, mean)


if __name__ == "__main__":
    learn(*sys.argv[1:3], *map(int, sys.argv[3:]))
elif FILE.is_file():
    POLICY = Linear(np.load(FILE))
