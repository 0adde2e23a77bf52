"""Rapid motor adaptation: infer the simulator's parameters online (Section V-A; after Kumar et al. 2021)."""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.config import Config, Count, Positive, own_settings
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.progress import CLOCKS, part
from astra_data.core.seeding import derive
from astra_data.grounding.descent import refuse_divergence
from astra_data.methods.method import Method, Table
from astra_data.policies.learner import Learner
from astra_data.policies.ppo import Ppo
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.train import InSimulator, PpoTrainConfig, Training, optimize
from astra_data.worlds.protocols import BatchedEnv

if TYPE_CHECKING:
    from astra_data.policies.networks import Teacher

SHORTEST_HISTORY = 40  # steps that the student's convolutions span


class RmaConfig(Config):
    """Settings of rapid motor adaptation. The paper gives none; sizes are those of Kumar et al. 2021."""

    extrinsics_size: Count = 8
    """Size of the encoding of the simulator's parameters."""
    history_length: Annotated[int, Field(ge=SHORTEST_HISTORY)] = 50
    """Number of past steps from which the extrinsics are estimated."""
    adaptation_steps: Count = 500_000
    """Number of environment steps in phase 2."""
    adaptation_learning_rate: Positive = 1e-3
    """Learning rate of phase 2 at the start; decays linearly to zero."""


class Adaptation(Learner):
    """A phase 2 in progress: each step updates the `student`'s estimate of the extrinsics, and nothing else."""

    def __init__(
        self, env: BatchedEnv, teacher: "Teacher", config: RmaConfig, *, rollout_steps: int, horizon: int, seed: int
    ) -> None:
        from astra_data.policies.networks import Student

        self.teacher, self.config = teacher, config
        torch.manual_seed(derive(seed, "student"))
        self.student = Student.of_teacher(teacher)
        learned = [parameter for parameter in self.student.parameters() if parameter.requires_grad]
        self._optimizer = torch.optim.Adam(learned, lr=config.adaptation_learning_rate)
        super().__init__(
            env,
            self.student.initial_hidden(env.num_envs),
            {"student": self.student, "optimizer": self._optimizer},
            horizon=horizon,
            total_steps=config.adaptation_steps,
            rollout_steps=rollout_steps,
            seed=derive(seed, "adaptation"),
        )

    def _iterate(self) -> dict[str, float]:
        """Take `rollout_steps` batched steps, learning after each; return the estimates' R² as "r2_extrinsics"."""
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.adaptation_learning_rate * (1.0 - self.share)
        errors, true = [], []
        for _ in range(self.rollout_steps):
            extrinsics, features, hidden = self._learn()
            errors.append(features[:, -extrinsics.shape[1] :] - extrinsics)
            true.append(extrinsics)
            with torch.no_grad():
                self.take(self.student.act(features), hidden)
        error = float(torch.cat(errors).square().mean(0).sum())
        refuse_divergence(f"after step {self.steps}", {"squared error": error})
        variance = float(torch.cat(true).var(0, correction=0).sum())
        return {"r2_extrinsics": 1.0 - error / variance if variance else math.nan}

    def _learn(self) -> tuple[Tensor, Tensor, Tensor]:
        """Make one update; return the true extrinsics (B, E), the features (B, F) and the next hidden (B, H)."""
        shape = self.student.shape
        with torch.no_grad():
            extrinsics = self.teacher.extrinsics(self.observation)
        seen = self.observation[:, : shape.observation_size]
        features, hidden = self.student.remember(seen, self.previous_action, self.hidden)
        loss = torch.nn.functional.mse_loss(features[:, -shape.extrinsics_size :], extrinsics)
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        return extrinsics, features.detach(), hidden


@dataclass(frozen=True)
class TeacherThenStudent(InSimulator):
    """Train a teacher by PPO that observes the simulator's parameters, then a student that estimates them."""

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the student, and the teacher's learning curve with the student's as "adaptation"."""
        from astra_data.policies.networks import AdaptiveShape, Teacher

        config, seed = training.config, training.seed
        if not isinstance(config, PpoTrainConfig):
            raise BadInputError(f'rma: expected train.learner "ppo", got "{config.learner}"')
        settings = own_settings(training.settings, RmaConfig())
        env, simulation = self.world(training, shows_parameters=True)
        torch.manual_seed(derive(seed, "policy"))
        shape = AdaptiveShape(
            observation_size=env.observation_size - env.parameter_count,
            action_size=env.action_size,
            memory_size=config.memory_size,
            hidden_sizes=config.hidden_sizes,
            extrinsics_size=settings.extrinsics_size,
            history_length=settings.history_length,
        )
        teacher = Teacher(shape, env.parameter_count).to(training.device)
        horizon = training.simulated_steps
        first = config.total_steps / (config.total_steps + settings.adaptation_steps)
        phase_1 = replace(training, progress=part(training.progress, 0.0, first))
        phase_2 = replace(training, progress=part(training.progress, first, 1.0))
        curve = optimize(Ppo(env, teacher, config, horizon=horizon, seed=seed), env, phase_1)
        adaptation = Adaptation(env, teacher, settings, rollout_steps=config.rollout_steps, horizon=horizon, seed=seed)
        curve["adaptation"] = optimize(adaptation, env, phase_2, f"adaptation_{CHECKPOINT}")
        for clock in CLOCKS:
            curve[clock] += curve["adaptation"][clock]
        return training.learned(adaptation.student, simulation), curve


RMA = Method("rma", "RMA", "#A6761D", learn=TeacherThenStudent(ranges="wide"), table=Table("rma", RmaConfig))
