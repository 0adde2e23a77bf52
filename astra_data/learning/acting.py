"""Rollouts in a batched environment: what is carried between steps, restarts at the horizon, metrics."""

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
        step: what the environment returned.
        action: the executed actions, (B, A) in ±1.
        expired: episodes that reached the horizon without terminating, (B,) bool.
        done: episodes that are over, expired or terminated, (B,) bool.
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
        first: where an episode begins, (B,) bool.
        world_seconds: wall time of the environment's steps, since the start or since resuming.
    """

    def __init__(self, env: BatchedEnv, hidden: Tensor, *, horizon: int, is_staggered: bool) -> None:
        """Start all rows.

        Args:
            env: the environment.
            hidden: the policy's memory at the start, (B, H).
            horizon: episodes are truncated after this many steps.
            is_staggered: start episodes at random ages, so that they do not all reach the horizon at once.
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
        """Step with `action` (B, A), clipped to ±1, and keep `hidden` (B, H); reset rows that are done."""
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
        """Return metrics of the steps since the last call.

        Returns:
            the "success" rate of the "episodes" that ended, wherever in the task they started, and their mean
            "episode_steps", both NaN where none ended; the mean "reward" of a step.
        """
        metrics = {
            "success": self._succeeded / self._finished if self._finished else math.nan,
            "episode_steps": self._survived / self._finished if self._finished else math.nan,
            "episodes": self._finished,
            "reward": self._rewarded / self._steps,
        }
        self._forget()
        return metrics

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
        """Restore `state`; the environment is restored already and shows `observation` (B, O)."""
        device = observation.device
        self.observation = observation
        self.previous_action, self.hidden = state["previous_action"].to(device), state["hidden"].to(device)
        self.first = state["first"].to(device)
        self._age, self._lasted = state["age"].to(device), state["lasted"].to(device)
