"""A policy that was stopped early: better than chance, far from good."""

import torch

from astra_data.deployment import DeployedPolicy
from astra_data.learners.ppo import Ppo, PpoConfig
from astra_data.models.actor_critic import ActorCritic, ActorCriticShape
from astra_data.progress import Progress
from astra_data.seeding import derive
from astra_data.target_world import TargetWorld
from astra_data.task import Task

_ENVS = 128
"""Targets that it is trained in."""


def suboptimal_policy(
    task: Task, *, steps: int, seed: int, num_threads: int | None, progress: Progress
) -> DeployedPolicy:
    """Train a policy without memory by PPO in the target, and stop after `steps` environment steps."""
    torch.manual_seed(derive(seed, "suboptimal policy"))
    world = TargetWorld(task, _ENVS, num_threads=num_threads)
    policy = ActorCritic(ActorCriticShape(world.observation_size, world.action_size))
    config = PpoConfig(total_steps=steps)
    ppo = Ppo(world, policy, config, horizon=task.objective.horizon, seed=seed)
    while not ppo.done:
        metrics = ppo.iterate()
        note = f"training the behaviour: reward per step {metrics['reward']:.3f}"
        progress(min(1.0, ppo.steps / steps), note)
    return DeployedPolicy(task, policy.requires_grad_(False))
