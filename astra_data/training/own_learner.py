"""Learners of the user's, in the environment of a row: their policies are rows like others."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.training.gymnasium import Array, BatchedVectorEnv, SeededSimulatorEnv
from astra_data.training.own_policy import OwnPolicy, SavedPolicy
from astra_data.training.policy_file import PolicyFile
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.training.train import InSimulator, Training

_POINTS = 50
"""Of a learning curve."""


class WatchedEnv(BatchedVectorEnv):
    """The environment that a row is trained in, which keeps the learning curve of who learns there.

    Attributes:
        points: of the curve so far.
    """

    def __init__(self, env: SimulatorEnv, training: Training) -> None:
        """Show `env`; its randomness comes from the training's seed."""
        seeded = SeededSimulatorEnv(env)
        seeded.reseed(derive(training.seed, "own learner"))
        super().__init__(seeded, training.simulated_steps)
        self.points: list[dict[str, Any]] = []
        self._training, self._total = training, training.config.total_steps
        self._steps = self._ended = self._succeeded = 0

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Apply actions (B, A) for one control step."""
        stepped = super().step(actions)
        infos = stepped[-1]
        self._steps += self.num_envs
        if "final_info" in infos:
            self._ended += int(infos["_final_info"].sum())
            self._succeeded += int(infos["final_info"]["success"].sum())
        if self._steps * _POINTS >= (len(self.points) + 1) * self._total:
            self.note()
        return stepped

    def note(self) -> None:
        """Add a point to the curve, of the episodes that ended since the last one."""
        lasts = self._training.task.objective.is_lasting
        success = None if lasts or not self._ended else self._succeeded / self._ended
        self.points.append({"steps": self._steps, "success": success})
        self._ended = self._succeeded = 0
        note = "unknown yet" if success is None else f"{success:.2f}"
        self._training.progress(min(1.0, self._steps / self._total), f"success of training episodes {note}")


@dataclass(frozen=True, kw_only=True)
class OwnLearner(InSimulator):
    """Train in the abstract simulator by a function of the user's.

    Attributes:
        learn: given the environment, a vector environment of Gymnasium, and the training, which has the
            recipe's settings (`training.config.total_steps`) and the seed, returns the policy. A hand-written
            one needs no step.
        policy: the class of what it returns.
    """

    learn: Callable[[WatchedEnv, Training], SavedPolicy]
    policy: type[SavedPolicy]

    def __call__(self, training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        """Return the policy and its learning curve.

        Raises:
            BadInputError: what it returns is no such policy.
        """
        env, simulation = self.world(training)
        watched = WatchedEnv(env, training)
        torch.manual_seed(derive(training.seed, "policy"))
        learned = self.learn(watched, training)
        if not isinstance(learned, self.policy):
            raise BadInputError(
                f"learn returned a {type(learned).__name__}, expected a {self.policy.__name__}"
            )
        watched.note()
        own = OwnPolicy(learned, env.observation_size, env.action_size)
        episodes = training.episodes
        curve = {"points": watched.points}
        return PolicyFile(own, simulation, episodes.reference, episodes.content_hash), curve
