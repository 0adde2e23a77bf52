"""Run a policy in worlds: step by step, with its encoders and memory carried along."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from astra_data.learning.networks.alignment import TargetEncoder
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.learning.networks.policy import Policy
from astra_data.training.simulator_env import policy_observation
from astra_data.worlds.task import Task

EncoderKind = Literal["target", "source"]
Observed = Literal["abstract", "full"]


def target_observation(
    task: Task, state: Tensor, goal: Tensor, latent: Tensor | None, observed: Observed
) -> Tensor:
    """Assemble what a policy sees (..., O) of target states (..., S) with goals (..., G) and latents, if any.

    It is what it would see of φ(s), and where the full state is observed, everything else of it behind that.
    """
    abstract = policy_observation(task.objective, task.abstraction(state), goal, latent)
    return abstract if observed == "abstract" else torch.cat([abstract, task.beyond(state)], dim=-1)


@dataclass
class DeployedPolicy:
    """A policy at work on B robots. Latents come from ψ^t on full states, or from ψ^s on φ of them.

    Attributes:
        task: what to do. policy: the networks. model: the grounding, whose encoder is ψ^s.
        target_encoder: ψ^t; where it is None, ψ^s is used.
        command_limit_m_s: of the world that the policy was trained in.
        observed: whether it is shown φ of the target's state, or that state in full.
    """

    task: Task
    policy: Policy
    model: GroundingModel | None = None
    target_encoder: TargetEncoder | None = None
    command_limit_m_s: float = 2.0
    observed: Observed = "abstract"

    @property
    def observation_size(self) -> int:
        """Values that the task and the grounding show to a policy."""
        state = torch.zeros(self.task.state_columns[0].size)
        goal = torch.zeros(self.task.objective.goal_size)
        seen = len(target_observation(self.task, state, goal, None, self.observed))
        return seen + (self.model.shape.latent_size if self.model is not None else 0)

    def start(self, count: int, generator: torch.Generator | None = None) -> None:
        """Forget everything; B = `count`. With `generator`, actions are drawn as in training."""
        self._generator = generator
        self._previous_output = torch.zeros(count, self.policy.shape.action_size)
        self._previous_action = torch.zeros_like(self._previous_output)
        self._hidden = self.policy.initial_hidden(count)
        latent_size = self.model.shape.latent_size if self.model is not None else 0
        self._encoder_hidden = torch.zeros(count, latent_size)

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for target states (B, S) and goals (B, G)."""
        seen = self.task.abstraction(state) if self.target_encoder is None else state
        latent = self._latent(self.target_encoder or self.model, seen, goal)
        return self._act(target_observation(self.task, state, goal, latent, self.observed))

    def act_in_simulator(self, abstract: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for abstract states (B, X) and goals (B, G); latents come from ψ^s."""
        latent = self._latent(self.model, abstract, goal)
        return self._act(policy_observation(self.task.objective, abstract, goal, latent))

    @torch.no_grad()
    def _latent(
        self, encoder: TargetEncoder | GroundingModel | None, seen: Tensor, goal: Tensor
    ) -> Tensor | None:
        if encoder is None:
            return None
        inputs = encoder.encoder_input(seen, goal, self._previous_action)
        self._encoder_hidden = encoder.encoder.step(inputs, self._encoder_hidden)
        return encoder.encoder.latent(self._encoder_hidden)

    @torch.no_grad()
    def _act(self, observation: Tensor) -> Tensor:
        features, self._hidden = self.policy.remember(observation, self._previous_output, self._hidden)
        self._previous_output = self.policy.act(features, self._generator)
        self._previous_action = self.task.objective.limit_command(
            self._previous_output, self.command_limit_m_s
        )
        return self._previous_action
