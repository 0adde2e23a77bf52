"""Train by SAC of Stable-Baselines3 in an abstract simulator of the humanoid, to be timed.

    uv run --with stable-baselines3 python tools/peers/stable_baselines_sac.py 32 8 64

Takes so many rows, updates per batched step, and batched steps. Does them once per line of its input, and
answers each with the number of updates.
"""

import sys

import torch
import typer
from stable_baselines3 import SAC

from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies.gymnasium import BatchedVectorEnv, SeededSimulatorEnv
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.policies.stable_baselines import StableBaselinesEnv
from astra_data.robots.registry import TASKS


def main(count: int, updates: int, steps: int) -> None:
    """Train on demand."""
    torch.set_num_threads(1)
    task = TASKS["humanoid-walker2d"]
    world = SeededSimulatorEnv(SimulatorEnv(task.objective, NO_GROUNDING.simulator(task, count)))
    learner = SAC(
        "MlpPolicy",
        StableBaselinesEnv(BatchedVectorEnv(world, task.objective.horizon)),
        learning_starts=0,
        batch_size=256,
        gradient_steps=updates,
        policy_kwargs={"net_arch": [256, 256]},
        device="cpu",
    )
    for _ in sys.stdin:
        learner.learn(steps * count, reset_num_timesteps=False)
        print(steps * updates, flush=True)


if __name__ == "__main__":
    typer.run(main)
