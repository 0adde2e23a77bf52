"""The task in the target itself, seen as a policy sees it: where policies are trained without a simulator."""

from torch import Tensor

from astra_data.batched import Step
from astra_data.tasks import Task
from astra_data.world import policy_observation


class TargetWorld:
    """B target environments whose observation (B, O) is made of φ(s) and the goal."""

    action_size = 2

    def __init__(self, task: Task, num_envs: int, *, seed: int, num_threads: int | None = None) -> None:
        self.num_envs = num_envs
        self._task = task
        self._env = task.target(num_envs, seed=seed, num_threads=num_threads)
        self.observation_size = self._observe().shape[1]

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Start the rows in `mask` (B,) anew, by default all; return observations (B, O)."""
        self._env.reset(mask)
        return self._observe()

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, 2), clipped to ±1 m/s per axis."""
        step = self._env.step(action)
        return Step(self._observe(), step.reward, step.terminated, step.success)

    def _observe(self) -> Tensor:
        abstract = self._task.abstraction(self._env.state)
        return policy_observation(self._task.maze, abstract, self._env.goal, None)
