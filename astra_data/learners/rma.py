"""Rapid motor adaptation, phase 2: a student learns to estimate its teacher's extrinsics while it acts.

After Kumar et al. 2021. The student's own actions decide what it learns from, so that it knows the
histories that its mistakes lead to. Every iteration seeds torch from (seed, iteration), as in `ppo`.
"""

import math
import time
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from astra_data.batched import BatchedEnv
from astra_data.models.adaptation import SHORTEST_HISTORY, Student, Teacher
from astra_data.recipe import Config, Count, Positive
from astra_data.seeding import derive


class RmaConfig(Config):
    """Settings of rapid motor adaptation. The paper prints none; sizes are those of Kumar et al. 2021."""

    extrinsics_size: Count = 8
    """Numbers that the parameters of the simulator are encoded into."""
    history_length: Annotated[int, Field(ge=SHORTEST_HISTORY)] = 50
    """Steps that extrinsics are estimated from."""
    adaptation_steps: Count = 500_000
    """Environment steps of phase 2 in all."""
    adaptation_learning_rate: Positive = 1e-3
    """Of phase 2, at the start; falls linearly to zero."""


class Adaptation:
    """A phase 2 in progress: one update per step, on the current histories of all rows.

    Attributes:
        student: the networks; only the estimate of the extrinsics is trained. steps: environment steps done.
        world_seconds: the part of the time since the start, or since resuming, that the world took.
    """

    def __init__(
        self,
        env: BatchedEnv,
        teacher: Teacher,
        config: RmaConfig,
        *,
        rollout_steps: int,
        horizon: int,
        seed: int,
    ) -> None:
        """Prepare to train a student of `teacher` in `env`.

        Args:
            env: the world that the teacher was trained in.
            teacher: trained.
            config: settings.
            rollout_steps: steps of every environment per iteration.
            horizon: rows are restarted after so many steps, without ending the task.
            seed: of all randomness.
        """
        self.env, self.teacher, self.config = env, teacher, config
        self.rollout_steps, self.horizon, self.seed = rollout_steps, horizon, seed
        self.steps = 0
        self.world_seconds = 0.0
        self._iteration = 0
        torch.manual_seed(derive(seed, "student"))
        self.student = Student.of_teacher(teacher)
        learned = [parameter for parameter in self.student.parameters() if parameter.requires_grad]
        self._optimizer = torch.optim.Adam(learned, lr=config.adaptation_learning_rate)
        self._observation = env.reset()
        device = self._observation.device
        self._previous_action = torch.zeros(env.num_envs, env.action_size, device=device)
        self._hidden = self.student.initial_hidden(env.num_envs)
        # Staggered ages: restarts by the horizon do not all fall into one iteration.
        self._age = torch.randint(horizon, (env.num_envs,), device=device)

    @property
    def total_steps(self) -> int:
        """Environment steps in all."""
        return self.config.adaptation_steps

    @property
    def done(self) -> bool:
        """Whether all steps are done."""
        return self.steps >= self.total_steps

    def iterate(self) -> dict[str, float]:
        """Act and learn for one stretch of steps.

        Returns:
            "success" of the "episodes" that ended, NaN where none did; the mean "reward" of a step;
            "r2_extrinsics", the share of the extrinsics' variance that the estimates explain, with those at
            the start of episodes, when nothing has been seen; NaN where nothing varies.
        """
        torch.manual_seed(derive(self.seed, f"adaptation {self._iteration}"))
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.adaptation_learning_rate * (1.0 - self.steps / self.total_steps)
        finished = succeeded = rewarded = 0.0
        errors, true = [], []
        for _ in range(self.rollout_steps):
            extrinsics, features = self._learn()
            errors.append(features[:, -extrinsics.shape[1] :] - extrinsics)
            true.append(extrinsics)
            done, success, reward = self._act(features)
            finished += float(done.sum())
            succeeded += float(success.sum())
            rewarded += float(reward.mean())
        self.steps += self.env.num_envs * self.rollout_steps
        self._iteration += 1
        error = float(torch.cat(errors).square().mean(0).sum())
        variance = float(torch.cat(true).var(0, correction=0).sum())
        return {
            "success": succeeded / finished if finished else math.nan,
            "episodes": finished,
            "reward": rewarded / self.rollout_steps,
            "r2_extrinsics": 1.0 - error / variance if variance else math.nan,
        }

    def _learn(self) -> tuple[Tensor, Tensor]:
        """Take in the current observations and update; return true extrinsics (B, E), features (B, F)."""
        shape = self.student.shape
        with torch.no_grad():
            extrinsics = self.teacher.extrinsics(self._observation)
        seen = self._observation[:, : shape.observation_size]
        features, self._hidden = self.student.remember(seen, self._previous_action, self._hidden)
        loss = functional.mse_loss(features[:, -shape.extrinsics_size :], extrinsics)
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        return extrinsics, features.detach()

    @torch.no_grad()
    def _act(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take the student's step; return what is done, what succeeded and the rewards, (B,) each."""
        action, _ = self.student.policy(features)
        began = time.perf_counter()
        step = self.env.step(action)
        self.world_seconds += time.perf_counter() - began
        self._age += 1
        done = step.terminated | (self._age >= self.horizon)
        going = (~done).float().unsqueeze(-1)
        self._age = torch.where(done, 0, self._age)
        self._observation = self.env.reset(done) if bool(done.any()) else step.observation
        self._previous_action, self._hidden = action * going, self._hidden * going
        return done, step.success, step.reward

    def state_dict(self) -> dict[str, Any]:
        """Return everything but the environment's own state; see `load_state_dict`."""
        return {
            "student": self.student.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "steps": self.steps,
            "iteration": self._iteration,
            "previous_action": self._previous_action,
            "hidden": self._hidden,
            "age": self._age,
        }

    def load_state_dict(self, state: dict[str, Any], observation: Tensor) -> None:
        """Go on from `state`, with the environment already set back and showing `observation` (B, O + P)."""
        self.student.load_state_dict(state["student"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.steps, self._iteration = state["steps"], state["iteration"]
        device = observation.device
        self._previous_action, self._hidden = state["previous_action"].to(device), state["hidden"].to(device)
        self._age = state["age"].to(device)
        self._observation = observation
