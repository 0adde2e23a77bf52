"""Judge policies without the target: by a simulator that was fitted to other episodes than theirs."""

from dataclasses import dataclass
from functools import partial
from statistics import fmean

from astra_data.grounding.protocols import Grounding
from astra_data.policies.running_policy import RunningPolicy
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.policies.simulator_episodes import in_simulator, started
from astra_data.worlds.task import Task


@dataclass(frozen=True)
class Judge:
    """A grounding of other episodes, in whose simulator its failure model, if it has one, ends episodes."""

    task: Task
    grounding: Grounding

    def simulator(self, episodes: int) -> SimulatorEnv:
        """Return its simulator."""
        simulator = self.grounding.simulator(self.task, episodes)
        return SimulatorEnv(self.task.objective, simulator, draws_failures=True)

    def success(self, policy: RunningPolicy, episodes: int, seed: int) -> float:
        """Return the share of so many episodes in which a policy succeeds; starts and goals are of `seed`."""
        begin = partial(started, policy, policy.act_in_simulator)
        outcome, _ = in_simulator(self.simulator(episodes), begin, self.task.objective.horizon, seed)
        return fmean(outcome.success)
