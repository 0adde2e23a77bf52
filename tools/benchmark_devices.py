"""Measure how fast policies are trained on each device of torch, one alone and many at once.

    uv run python tools/benchmark_devices.py
    uv run python tools/benchmark_devices.py --envs 256 --at-once 1 --at-once 16 --seconds 5

Each policy is trained by PPO in the grounded simulator of the Long Maze, in a process of its own with one
thread, as `astra-data run --jobs` does it. What the model has learned is the same to the speed.
"""

import multiprocessing
import time
from itertools import product
from multiprocessing.synchronize import Barrier
from typing import Annotated

import torch
import typer
from benchmark_training import SETTINGS, SHAPE, TASK
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor
from torch.multiprocessing.spawn import spawn

from astra_data.grounding.history import HistoryGrounding
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.learning.ppo import Ppo
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.training.train import PpoTrainConfig


def main(
    device: Annotated[list[str] | None, typer.Option(help="By default cpu, and cuda if it is there.")] = None,
    envs: Annotated[list[int], typer.Option(help="Environments of a policy.")] = [64, 256, 1024, 4096],  # noqa: B006
    at_once: Annotated[list[int], typer.Option(help="Policies at once.")] = [1, 16],  # noqa: B006
    seconds: Annotated[float, typer.Option(help="How long each is measured.")] = 10.0,
) -> None:
    """Print the steps per second of all policies together."""
    devices = device or ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    table = Table("environments", "policies at once", *(f"{name}, steps/s" for name in devices))
    for count, policies in track([*product(envs, at_once)], transient=True):
        rates = [together(name, count, policies, seconds) for name in devices]
        table.add_row(f"{count}", f"{policies}", *(f"{rate:,.0f}" for rate in rates))
    Console().print(table)


def together(device: str, envs: int, policies: int, seconds: float) -> float:
    """Return the steps per second of `policies` trainings at once, each in `envs` environments."""
    barrier = multiprocessing.get_context("spawn").Barrier(policies)
    rates = torch.zeros(policies).share_memory_()
    spawn(train, (device, envs, seconds, barrier, rates), policies)
    return float(rates.sum())


def train(seed: int, device: str, envs: int, seconds: float, barrier: Barrier, rates: Tensor) -> None:
    """Train a policy for a while, once all have begun, and note its steps per second."""
    torch.set_num_threads(1)
    assert isinstance(SETTINGS.train, PpoTrainConfig)
    config = SETTINGS.train.model_copy(update={"num_envs": envs})
    grounding = HistoryGrounding(GroundingModel(SHAPE).requires_grad_(False).to(device))
    env = SimulatorEnv(TASK.objective, grounding.simulator(TASK, envs, device))
    shape = ActorCriticShape(env.observation_size, env.action_size, 0, hidden_sizes=config.hidden_sizes)
    ppo = Ppo(env, ActorCritic(shape).to(device), config, horizon=TASK.objective.horizon, seed=seed)
    ppo.iterate()
    barrier.wait()
    began, iterations = time.perf_counter(), 0
    while time.perf_counter() - began < seconds:
        ppo.iterate()
        iterations += 1
    rates[seed] = iterations * envs * config.rollout_steps / (time.perf_counter() - began)


if __name__ == "__main__":
    typer.run(main)
