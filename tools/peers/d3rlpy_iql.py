"""Implicit Q-learning by d3rlpy, in an environment of its own.

    uv run --no-project --python 3.12 --with d3rlpy tools/peers/d3rlpy_iql.py 8 2

Makes 50 updates on random data with observations and actions of these sizes per line of its input, and
answers each with their number.
"""

import sys

import d3rlpy
import numpy as np
import torch

BATCH = 256
UPDATES = 50
ANSWERS = sys.stdout


def keep_time(observation_size: int, action_size: int) -> None:
    """Make updates on demand."""
    rng, count = np.random.default_rng(0), 50_000
    timeout = np.zeros(count, dtype=np.float32)
    timeout[499::500] = 1.0
    observation = rng.normal(size=(count, observation_size)).astype(np.float32)
    action = rng.uniform(-1, 1, size=(count, action_size)).astype(np.float32)
    reward = rng.normal(size=count).astype(np.float32)
    buffer = d3rlpy.dataset.MDPDataset(observation, action, reward, np.zeros_like(reward), timeout)
    algorithm = d3rlpy.algos.IQLConfig(batch_size=BATCH).create(device="cpu")
    algorithm.build_with_dataset(buffer)
    for _ in sys.stdin:
        for _ in range(UPDATES):
            algorithm.update(buffer.sample_transition_batch(BATCH))
        print(UPDATES, file=ANSWERS, flush=True)


if __name__ == "__main__":
    sys.stdout = sys.stderr  # where d3rlpy may tell what it does
    torch.set_num_threads(1)
    keep_time(int(sys.argv[1]), int(sys.argv[2]))
