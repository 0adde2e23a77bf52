"""Does a policy use its latents? Run it with those of other robots, or with none."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from astra_data.learning.networks.history import LatentEncoder
from astra_data.training import target_episodes
from astra_data.training.episode_record import Outcome
from astra_data.training.running_policy import RunningPolicy
from astra_data.training.simulator_episodes import Act, started

Alteration = Callable[[Tensor], Tensor]
"""Latents (B, Z) to those that the policy is shown."""


def of_another(latent: Tensor) -> Tensor:
    """Give each robot the latent of another one, drawn anew at every call."""
    order = torch.randperm(len(latent))
    altered = torch.empty_like(latent)
    altered[order] = latent[order.roll(1)]
    return altered


ALTERATIONS: Mapping[str, Alteration] = {
    "own": torch.clone,
    "another's": of_another,
    "zeros": torch.zeros_like,
}


@dataclass
class AlteredLatents(RunningPolicy):
    """A policy whose latents are altered after they were encoded; its encoder goes on as if they were not."""

    alter: Alteration = torch.clone

    @classmethod
    def of(cls, deployed: RunningPolicy, alter: Alteration) -> "AlteredLatents":
        """Return `deployed` with `alter`."""
        return cls(
            deployed.task,
            deployed.policy,
            deployed.source_encoder,
            deployed.target_encoder,
            deployed.command_limit,
            deployed.observed,
            alter,
        )

    def _latent(self, encoder: LatentEncoder | None, seen: Tensor, goal: Tensor) -> Tensor | None:
        latent = super()._latent(encoder, seen, goal)
        return None if latent is None else self.alter(latent)


def in_target(policy: RunningPolicy, episodes: int, seed: int, num_threads: int | None = None) -> Outcome:
    """Run a policy in B = `episodes` target environments, from the task's starts."""

    def begin(goal: Tensor) -> Act:
        torch.manual_seed(seed)
        return started(policy, policy.act, goal)

    return target_episodes.in_target(policy.task, begin, episodes, seed, num_threads=num_threads).outcome
