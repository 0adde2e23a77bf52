"""Rapid motor adaptation, phase 2: a student learns to estimate its teacher's extrinsics while it acts.

After Kumar et al. 2021. The student's own actions decide what it learns from, so that it knows the
histories that its mistakes lead to. Every iteration seeds torch from (seed, iteration), as in `ppo`.
"""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from astra_data.batched import BatchedEnv
from astra_data.learners.acting import Acting
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
        student: the networks; only the estimate of the extrinsics is trained. acting: how they act.
        steps: environment steps done.
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
        self.rollout_steps, self.seed = rollout_steps, seed
        self.steps = 0
        self._iteration = 0
        torch.manual_seed(derive(seed, "student"))
        self.student = Student.of_teacher(teacher)
        learned = [parameter for parameter in self.student.parameters() if parameter.requires_grad]
        self._optimizer = torch.optim.Adam(learned, lr=config.adaptation_learning_rate)
        hidden = self.student.initial_hidden(env.num_envs)
        self.acting = Acting(env, hidden, horizon=horizon, is_staggered=True)

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
            the figures of `Acting`, and "r2_extrinsics", the share of the extrinsics' variance that the
            estimates explain, with those at the start of episodes, when nothing has been seen; NaN where
            nothing varies.
        """
        torch.manual_seed(derive(self.seed, f"adaptation {self._iteration}"))
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.adaptation_learning_rate * (1.0 - self.steps / self.total_steps)
        errors, true = [], []
        for _ in range(self.rollout_steps):
            extrinsics, features, hidden = self._learn()
            errors.append(features[:, -extrinsics.shape[1] :] - extrinsics)
            true.append(extrinsics)
            with torch.no_grad():
                self.acting.take(self.student.act(features), hidden)
        self.steps += self.env.num_envs * self.rollout_steps
        self._iteration += 1
        error = float(torch.cat(errors).square().mean(0).sum())
        variance = float(torch.cat(true).var(0, correction=0).sum())
        return self.acting.figures() | {"r2_extrinsics": 1.0 - error / variance if variance else math.nan}

    def _learn(self) -> tuple[Tensor, Tensor, Tensor]:
        """Take in the current observations and update.

        Returns:
            the true extrinsics (B, E), the features (B, F), and the next hidden (B, H).
        """
        acting, shape = self.acting, self.student.shape
        with torch.no_grad():
            extrinsics = self.teacher.extrinsics(acting.observation)
        seen = acting.observation[:, : shape.observation_size]
        features, hidden = self.student.remember(seen, acting.previous_action, acting.hidden)
        loss = functional.mse_loss(features[:, -shape.extrinsics_size :], extrinsics)
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        return extrinsics, features.detach(), hidden

    def state_dict(self) -> dict[str, Any]:
        """Return everything but the environment's own state; see `load_state_dict`."""
        return {
            "student": self.student.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "steps": self.steps,
            "iteration": self._iteration,
            "acting": self.acting.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any], observation: Tensor) -> None:
        """Go on from `state`, with the environment already set back and showing `observation` (B, O + P)."""
        self.student.load_state_dict(state["student"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.steps, self._iteration = state["steps"], state["iteration"]
        self.acting.load_state_dict(state["acting"], observation)
