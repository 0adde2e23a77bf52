"""Act in a batched environment: the policy's memory, restarts at the horizon, and figures."""

import math
import time
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from astra_data.worlds.batched import BatchedEnv, Step


@dataclass(frozen=True)
class Taken:
    """The outcome of one step of all rows.

    Attributes:
        step: its outcome.
        action: as applied, (B, A) in ±1.
        expired: episodes that reached the horizon, (B,) bool.
        done: episodes that ended, expired or terminated, (B,) bool.
    """

    step: Step
    action: Tensor
    expired: Tensor
    done: Tensor


class Acting:
    """B rows of an environment in which a policy acts.

    Attributes:
        observation: (B, O), to act on next.
        previous_action: (B, A) in ±1. hidden: the policy's memory, (B, H). Both are zero at the start.
        first: whether an episode begins with it, (B,) bool.
        world_seconds: the time that the environment's steps took, since the start or since resuming.
    """

    def __init__(self, env: BatchedEnv, hidden: Tensor, *, horizon: int, is_staggered: bool) -> None:
        """Start all rows.

        Args:
            env: the environment.
            hidden: the policy's memory at the start, (B, H).
            horizon: steps after which an episode is truncated and its row restarted.
            is_staggered: begin at random ages, so that rows do not all reach the horizon at once.
        """
        self.env, self.horizon = env, horizon
        self.world_seconds = 0.0
        self.observation = env.reset()
        device = self.observation.device
        self.previous_action = torch.zeros(env.num_envs, env.action_size, device=device)
        self.hidden = hidden
        self.first = torch.ones(env.num_envs, dtype=torch.bool, device=device)
        self._lasted = torch.zeros(env.num_envs, dtype=torch.int64, device=device)
        self._age = torch.randint_like(self._lasted, horizon) if is_staggered else self._lasted
        self._forget()

    def _forget(self) -> None:
        self._steps = self._finished = self._succeeded = self._survived = self._rewarded = 0.0

    def take(self, action: Tensor, hidden: Tensor) -> Taken:
        """Apply `action` (B, A), clipped to ±1, keep `hidden` (B, H), and reset the rows that are done."""
        began = time.perf_counter()
        step = self.env.step(action)
        self.world_seconds += time.perf_counter() - began
        self._age, self._lasted = self._age + 1, self._lasted + 1
        expired = (self._age >= self.horizon) & ~step.terminated
        done = step.terminated | expired
        self._steps += 1
        self._finished += float(done.sum())
        self._succeeded += float(step.success.sum())
        self._survived += float(self._lasted[done].sum())
        self._rewarded += float(step.reward.mean())
        self._age, self._lasted = (torch.where(done, 0, steps) for steps in (self._age, self._lasted))
        self.observation = self.env.reset(done) if bool(done.any()) else step.observation
        executed, going = action.clamp(-1.0, 1.0), (~done).float().unsqueeze(-1)
        self.previous_action, self.hidden, self.first = executed * going, hidden * going, done
        return Taken(step, executed, expired, done)

    def figures(self) -> dict[str, float]:
        """Return figures on the steps since the last call.

        Returns:
            the share of "success" among the "episodes" that ended, wherever in the task they began, and their
            mean "episode_steps", NaN if none ended; the mean "reward" of a step.
        """
        figures = {
            "success": self._succeeded / self._finished if self._finished else math.nan,
            "episode_steps": self._survived / self._finished if self._finished else math.nan,
            "episodes": self._finished,
            "reward": self._rewarded / self._steps,
        }
        self._forget()
        return figures

    def state_dict(self) -> dict[str, Any]:
        """Return everything but the environment's own state, after `figures`; see `load_state_dict`."""
        return {
            "previous_action": self.previous_action,
            "hidden": self.hidden,
            "first": self.first,
            "age": self._age,
            "lasted": self._lasted,
        }

    def load_state_dict(self, state: dict[str, Any], observation: Tensor) -> None:
        """Continue from `state`, once the environment is restored and returned `observation` (B, O)."""
        device = observation.device
        self.observation = observation
        self.previous_action, self.hidden = state["previous_action"].to(device), state["hidden"].to(device)
        self.first = state["first"].to(device)
        self._age, self._lasted = state["age"].to(device), state["lasted"].to(device)
