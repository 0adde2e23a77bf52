"""Learners of the user's, in the environment of a row: their policies are rows like others."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.policies.own_policy import OwnPolicy, SavedPolicy
from astra_data.policies.policy_file import PolicyFile
from astra_data.policies.train import InSimulator, Training

if TYPE_CHECKING:
    from astra_data.policies.watched_env import WatchedEnv


@dataclass(frozen=True, kw_only=True)
class OwnLearner(InSimulator):
    """Train in the abstract simulator by a function of the user's.

    Attributes:
        learn: given the environment, a vector environment of Gymnasium, and the training, which has the
            recipe's settings (`training.config.total_steps`) and the seed, returns the policy. A hand-written
            one needs no step.
        policy: the class of what it returns.
    """

    learn: Callable[["WatchedEnv", Training], SavedPolicy]
    policy: type[SavedPolicy]

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the policy and its learning curve.

        Raises:
            BadInputError: what it returns is no such policy, or the device is no CPU.
        """
        if training.device != "cpu":
            raise BadInputError(
                f"--device {training.device}: a learner of your own gets an environment of numpy arrays, "
                "expected --device cpu; run the recipe again with it, finished artifacts are kept"
            )
        from astra_data.policies.watched_env import WatchedEnv

        env, simulation = self.world(training)
        watched = WatchedEnv(env, training)
        torch.manual_seed(derive(training.seed, "policy"))
        learned = self.learn(watched, training)
        if not isinstance(learned, self.policy):
            raise BadInputError(
                f"learn returned a {type(learned).__name__}, expected a {self.policy.__name__}"
            )
        watched.finish()
        own = OwnPolicy(learned, env.observation_size, env.action_size)
        episodes = training.episodes
        curve = {"points": watched.points}
        return PolicyFile(own, simulation, episodes.reference, episodes.content_hash), curve
