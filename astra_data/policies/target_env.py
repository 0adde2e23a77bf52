"""The task in the target itself, with a policy's observations: to train policies without a simulator."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.policies.running_policy import Observed, target_observation
from astra_data.worlds.batched import Step
from astra_data.worlds.task import Task


@dataclass(frozen=True)
class TargetStarts:
    """Moments of recorded episodes to start from.

    Attributes:
        state: s_i, (N, S). goal: (N, G).
    """

    state: Tensor
    goal: Tensor

    @classmethod
    def of(cls, episodes: PairedEpisodes) -> "TargetStarts":
        """Return every step of `episodes`."""
        state, goal = episodes.target_state, episodes.windows.goal
        return cls(episodes.steps(state).cpu(), episodes.steps(goal).cpu())


class ObservedTargetEnv:
    """B target environments whose observation (B, O) is made of their state and the goal.

    The physics runs on the CPU, whatever the device of observations and actions. All randomness comes from
    torch's global generator.

    Attributes:
        penalty_scale: without effect, as there are no penalties here.
    """

    penalty_scale = 1.0

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        observed: Observed = "abstract",
        starts: TargetStarts | None = None,
        data_start_share: float = 0.0,
        device: str = "cpu",
        num_threads: int | None = None,
    ) -> None:
        """Build B environments.

        Args:
            task: the task.
            num_envs: B.
            observed: whether φ of the state is observed, or the full state.
            starts: recorded moments to start from.
            data_start_share: share of the episodes that start from `starts`.
            device: torch device of observations and actions.
            num_threads: of the physics, by default one per core.
        """
        self.num_envs = num_envs
        self.action_size = task.objective.action_size
        self._task, self._observed, self._device = task, observed, device
        self._starts, self._data_start_share = starts, data_start_share
        self._env = task.target(num_envs, seed=0, num_threads=num_threads)
        self.observation_size = self._observe().shape[1]

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Reset the rows in `mask` (B,), by default all; return observations (B, O)."""
        anew = torch.ones(self.num_envs, dtype=torch.bool) if mask is None else mask.cpu()
        from_data = anew & (torch.rand(self.num_envs) < self._data_start_share)
        self._env.reseed(int(torch.randint(2**62, ())))
        self._env.reset(anew & ~from_data)
        rows = from_data.nonzero().squeeze(1)
        if self._starts is not None and len(rows):
            moments = torch.randint(len(self._starts.state), (len(rows),))
            self._env.goal[rows] = self._starts.goal[moments]
            self._env.reset_to(rows.numpy(), self._starts.state[moments].numpy().astype(np.float64))
        return self._observe()

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, A), clipped to ±1."""
        step = self._env.step(action.cpu())
        reward, terminated, success = (
            values.to(self._device) for values in (step.reward, step.terminated, step.success)
        )
        return Step(self._observe(), reward, terminated, success)

    def _observe(self) -> Tensor:
        env = self._env
        return target_observation(self._task, env.state, env.goal, None, self._observed).to(self._device)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        return self._env.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        """Continue from `state`; return the observations (B, O)."""
        self._env.load_state_dict({name: values.cpu() for name, values in state.items()})
        return self._observe()
