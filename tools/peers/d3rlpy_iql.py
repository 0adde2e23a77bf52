"""Implicit Q-learning by d3rlpy, in an environment of its own.

    uv run --no-project --python 3.12 --with d3rlpy tools/peers/d3rlpy_iql.py time 8 2
    uv run --no-project --python 3.12 --with d3rlpy tools/peers/d3rlpy_iql.py learn episodes.npz 5000 0

`time OBSERVATION ACTION` makes 50 updates on random data of these sizes per line of its input, and answers
each with their number. `learn FILE UPDATES SEED` learns from the pendulum's transitions in FILE, plays, and
writes the returns of 100 episodes into one line.
"""

import sys
from typing import Any

import d3rlpy
import gymnasium
import numpy as np
import torch

BATCH = 256
UPDATES = 50
EPISODES = 100
ANSWERS = sys.stdout


def learner(data: dict[str, Any]) -> tuple[Any, Any]:
    """Return the algorithm, with its own settings, and its data."""
    never = np.zeros_like(data["reward"])
    buffer = d3rlpy.dataset.MDPDataset(
        data["observation"], data["action"], data["reward"], never, data["timeout"]
    )
    algorithm = d3rlpy.algos.IQLConfig(batch_size=BATCH).create(device="cpu")
    algorithm.build_with_dataset(buffer)
    return algorithm, buffer


def keep_time(observation_size: int, action_size: int) -> None:
    """Make updates on demand."""
    rng, count = np.random.default_rng(0), 50_000
    timeout = np.zeros(count, dtype=np.float32)
    timeout[499::500] = 1.0
    data = {
        "observation": rng.normal(size=(count, observation_size)).astype(np.float32),
        "action": rng.uniform(-1, 1, size=(count, action_size)).astype(np.float32),
        "reward": rng.normal(size=count).astype(np.float32),
        "timeout": timeout,
    }
    algorithm, buffer = learner(data)
    for _ in sys.stdin:
        for _ in range(UPDATES):
            algorithm.update(buffer.sample_transition_batch(BATCH))
        print(UPDATES, file=ANSWERS, flush=True)


def learn(path: str, updates: int, seed: int) -> None:
    """Learn from a file, and play."""
    d3rlpy.seed(seed)
    algorithm, buffer = learner(dict(np.load(path)))
    for _ in range(updates):
        algorithm.update(buffer.sample_transition_batch(BATCH))
    env = gymnasium.make("Pendulum-v1")
    returns = []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=10_000 + 1_000 * seed + episode)
        total, over = 0.0, False
        while not over:
            action = 2.0 * algorithm.predict(observation[None])[0].clip(-1.0, 1.0)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    print(*returns, file=ANSWERS)


if __name__ == "__main__":
    sys.stdout = sys.stderr  # where d3rlpy may tell what it does
    torch.set_num_threads(1)
    if sys.argv[1] == "time":
        keep_time(int(sys.argv[2]), int(sys.argv[3]))
    else:
        learn(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
