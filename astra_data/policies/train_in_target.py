"""The paper's upper bounds: policies that are trained in the target itself (Section V-A)."""

from dataclasses import dataclass
from typing import Any

from astra_data.core.config import AtOnce, Config, Count, CountFromZero
from astra_data.policies.policy_file import PolicyFile
from astra_data.policies.running_policy import Observed
from astra_data.policies.target_env import ObservedTargetEnv, TargetStarts
from astra_data.policies.train import Training, train_in


class TargetConfig(Config):
    """Settings that may differ from `[train]` in the target, whose steps are slow; not in the paper."""

    total_steps: Count | None = None
    """Number of environment steps; by default as in `[train]`."""
    num_envs: AtOnce | None = None
    """Target environments stepped in parallel; by default as in `[train]`."""
    memory_size: CountFromZero | None = None
    """Size of the policy's own GRU; by default as in `[train]`. A policy that observes the full state needs
    none."""


@dataclass(frozen=True)
class InTarget:
    """Train in the target, from its own rewards.

    Attributes:
        observed: whether the policy observes φ of the state or the full state.
    """

    observed: Observed

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the policy and its learning curve."""
        settings, episodes = training.settings, training.episodes
        config = training.config.model_copy(update=settings.model_dump(exclude_none=True) if settings else {})
        env = ObservedTargetEnv(
            training.task,
            config.num_envs,
            observed=self.observed,
            starts=TargetStarts.of(episodes),
            data_start_share=config.data_start_share,
            device=training.device,
            num_threads=training.num_threads,
        )
        policy, curve = train_in(env, config, config.memory_size, training, training.task.objective.horizon)
        return PolicyFile(policy, None, episodes.reference, episodes.content_hash, self.observed), curve
