"""The environment that a learner of the user's is given; it keeps the learning curve."""

from typing import Any

from astra_data.core.seeding import derive
from astra_data.policies.gymnasium import Array, BatchedVectorEnv, SeededSimulatorEnv
from astra_data.policies.ramp import penalty_scale
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.policies.train import Training, lately

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
        self._simulated = env
        self._ramps = training.is_plus and not training.task.objective.is_lasting
        self._steps = self._ended = self._succeeded = self._lasted = 0

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Apply actions (B, A) for one control step."""
        self._simulated.penalty_scale = penalty_scale(self.points) if self._ramps else 1.0
        ages = self._age.numpy() + 1
        stepped = super().step(actions)
        infos = stepped[-1]
        self._steps += self.num_envs
        if "final_info" in infos:
            ended = infos["_final_info"]
            self._ended += int(ended.sum())
            self._lasted += int(ages[ended].sum())
            self._succeeded += int(infos["final_info"]["success"].sum())
        if self._steps * _POINTS >= (len(self.points) + 1) * self._total:
            self._note()
        return stepped

    def finish(self) -> None:
        """End the curve with the last step, if it does not yet."""
        if not self.points or self.points[-1]["steps"] != self._steps:
            self._note()

    def _note(self) -> None:
        """Add a point to the curve, of the episodes that ended since the last one."""
        ended, is_lasting = self._ended, self._training.task.objective.is_lasting
        point = {
            "steps": self._steps,
            "share": min(1.0, self._steps / self._total),
            "success": None if is_lasting or not ended else self._succeeded / ended,
            "episode_steps": self._lasted / ended if ended else None,
        }
        self.points.append(point)
        self._ended = self._succeeded = self._lasted = 0
        note = lately([point], "episode_steps" if is_lasting else "success")
        self._training.progress(min(1.0, self._steps / self._total), note)
