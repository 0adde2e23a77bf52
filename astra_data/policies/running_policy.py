"""Run a policy step by step, in the target or a simulator, with its encoder and memory."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.grounding.networks.history import LatentEncoder
from astra_data.policies.networks.policy import Policy
from astra_data.policies.simulator_env import policy_observation
from astra_data.worlds.objective import NO_LIMIT
from astra_data.worlds.task import Task

Given = Tensor | NDArray[np.float32] | NDArray[np.float64]
"""What measures and goals come in."""

EncoderKind = Literal["target", "source"]
Observed = Literal["abstract", "full"]


def target_observation(
    task: Task, state: Tensor, goal: Tensor, latent: Tensor | None, observed: Observed
) -> Tensor:
    """Assemble a policy's observation (..., O) of target states (..., S), goals (..., G) and latents, if any.

    It is the observation of φ(s), followed, where the full state is observed, by the rest of the state.
    """
    abstract = policy_observation(task.objective, task.abstraction(state), goal, latent)
    return abstract if observed == "abstract" else torch.cat([abstract, task.beyond(state)], dim=-1)


class Memory(NamedTuple):
    """What B robots remember of their episodes: zeros at the start.

    Attributes:
        previous_output: what the policy put out last, (B, A). previous_action: the same as it was given to
            the robot, (B, A).
        policy: the policy's own memory, (B, M). encoder: that of the encoder, (B, Z).
    """

    previous_output: Tensor
    previous_action: Tensor
    policy: Tensor
    encoder: Tensor


@dataclass
class RunningPolicy:
    """A policy that acts on B robots. Latents come from ψ^t on full states, or from ψ^s on φ of them.

    Attributes:
        task: the task. policy: the networks.
        source_encoder: ψ^s; None for a policy without latents.
        target_encoder: ψ^t; where it is None, ψ^s is used.
        command_limit: that of the environment in which the policy was trained.
        observed: whether the policy observes φ of the target's state, or the full state.
    """

    task: Task
    policy: Policy
    source_encoder: LatentEncoder | None = None
    target_encoder: LatentEncoder | None = None
    command_limit: float = NO_LIMIT
    observed: Observed = "abstract"

    @property
    def observation_size(self) -> int:
        """O, of what the task and the grounding give a policy to observe."""
        state = torch.zeros(1, self.task.state_columns[0].size)
        goal = torch.zeros(1, self.task.objective.goal_size)
        seen = target_observation(self.task, state, goal, None, self.observed)
        return seen.shape[1] + self._latent_size

    def start(self, count: int, generator: torch.Generator | None = None) -> None:
        """Start B = `count` episodes without history; with `generator`, draw actions as in training."""
        still = torch.zeros(count, self.policy.shape.action_size)
        latent = torch.zeros(count, self._latent_size)
        self.resume(Memory(still, still, self.policy.initial_hidden(count), latent))
        self._generator = generator

    def resume(self, memory: Memory) -> None:
        """Go on with episodes from what is remembered of them, with the modes of the actions."""
        self.memory = memory
        self._generator = None

    def command(self, state: Given, goal: Given) -> Tensor:
        """Return commands (B, A), in their own units, for target states (B, S) and goals (B, G).

        Raises:
            BadInputError: `start` was not called, or the state or the goal is of another shape or not finite.
        """
        if not hasattr(self, "memory"):
            raise BadInputError("expected start(count) before the first command")
        state = self._checked("state", state, self.task.state.size)
        goal = self._checked("goal", goal, self.task.objective.goal_size)
        return self.task.limits.in_units(self.act(state, goal))

    def _checked(self, name: str, given: Given, size: int) -> Tensor:
        values, shape = torch.as_tensor(given, dtype=torch.float32), (len(self.memory.policy), size)
        if values.shape != shape:
            raise BadInputError(f"{name}: expected the shape {shape}, got {tuple(values.shape)}")
        if not values.isfinite().all():
            row, entry = (~values.isfinite()).nonzero()[0].tolist()
            raise BadInputError(
                f"{name}: expected finite values, got {values[row, entry]:g} in row {row}, entry {entry}"
            )
        return values

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A), of ±1 along each axis, for target states (B, S) and goals (B, G)."""
        seen = self.task.abstraction(state) if self.target_encoder is None else state
        latent = self._latent(self.target_encoder or self.source_encoder, seen, goal)
        return self._act(target_observation(self.task, state, goal, latent, self.observed))

    def act_in_simulator(self, abstract: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for abstract states (B, X) and goals (B, G); latents come from ψ^s."""
        latent = self._latent(self.source_encoder, abstract, goal)
        return self._act(policy_observation(self.task.objective, abstract, goal, latent))

    @property
    def _latent_size(self) -> int:
        return self.source_encoder.encoder.latent_size if self.source_encoder is not None else 0

    @torch.no_grad()
    def _latent(self, encoder: LatentEncoder | None, seen: Tensor, goal: Tensor) -> Tensor | None:
        if encoder is None:
            return None
        inputs = encoder.encoder_input(seen, goal, self.memory.previous_action)
        hidden = encoder.encoder.step(inputs, self.memory.encoder)
        self.memory = self.memory._replace(encoder=hidden)
        return encoder.encoder.latent(hidden)

    @torch.no_grad()
    def _act(self, observation: Tensor) -> Tensor:
        before = self.memory
        features, hidden = self.policy.remember(observation, before.previous_output, before.policy)
        output = self.policy.act(features, self._generator)
        action = self.task.objective.limit_command(output, self.command_limit)
        self.memory = Memory(output, action, hidden, before.encoder)
        return action
