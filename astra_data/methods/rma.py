"""Rapid motor adaptation: infer the simulator's parameters online (Section V-A; after Kumar et al. 2021)."""

from dataclasses import dataclass, replace
from typing import Any

import torch

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.config import own_settings
from astra_data.core.errors import BadInputError
from astra_data.core.progress import CLOCKS, part
from astra_data.core.seeding import derive
from astra_data.methods.method import Method, Table
from astra_data.policies.networks import AdaptiveShape, Teacher
from astra_data.policies.ppo import Ppo
from astra_data.policies.rma import Adaptation, RmaConfig
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.train import InSimulator, PpoTrainConfig, Training, optimize


@dataclass(frozen=True)
class TeacherThenStudent(InSimulator):
    """Train a teacher by PPO that observes the simulator's parameters, then a student that estimates them."""

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the student, and the teacher's learning curve with the student's as "adaptation"."""
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
        ppo = Ppo(env, teacher, config, horizon=horizon, seed=seed)
        curve = optimize(ppo, env, phase_1)
        adaptation = Adaptation(env, teacher, settings, rollout_steps=config.rollout_steps, horizon=horizon, seed=seed)
        curve["adaptation"] = optimize(adaptation, env, phase_2, f"adaptation_{CHECKPOINT}")
        for clock in CLOCKS:
            curve[clock] += curve["adaptation"][clock]
        return training.learned(adaptation.student, simulation), curve


RMA = Method(
    name="rma", title="RMA", color="#A6761D", learn=TeacherThenStudent(ranges="wide"), table=Table("rma", RmaConfig)
)
