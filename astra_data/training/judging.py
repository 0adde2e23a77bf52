"""Judge policies without the target: by a simulator that was fitted to other episodes than theirs."""

from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

from torch import Tensor

from astra_data.grounding.failures import fit_failures, tells_failures
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.training.running_policy import RunningPolicy
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.training.simulator_episodes import in_simulator, started
from astra_data.worlds.task import Task


@dataclass(frozen=True)
class Judge:
    """A grounding of other episodes, and the factor (X, X) of the target's scatter around it."""

    task: Task
    grounding: Grounding
    scatter: Tensor

    @classmethod
    def of(
        cls,
        task: Task,
        grounding: Grounding,
        episodes: PairedEpisodes,
        failure_members: int = 0,
        failure_steps: int = 1,
    ) -> "Judge":
        """Return the judge that a grounding makes, with the scatter of the `episodes` it was fitted to.

        It is the model that was fitted to all of these, which the scatter and the failure model are of, too.
        Where these tell failures and it has no failure model, one of `failure_members` networks is fitted,
        which foresees failures within `failure_steps`.
        """
        grounding, scatter = grounding.reduced(members=False, failures=True), grounding.scatter(episodes)
        if (
            failure_members
            and isinstance(grounding, HistoryGrounding)
            and grounding.failures is None
            and tells_failures(task, episodes, failure_steps)
        ):
            failures = fit_failures(task, grounding, episodes, failure_members, 0, failure_steps)
            grounding = replace(grounding, failures=failures)
        return cls(task, grounding, scatter)

    def simulator(self, episodes: int) -> SimulatorEnv:
        """Return its simulator, in which its failure model ends episodes, if it has one.

        Otherwise its states are scattered, unless the grounding does so itself. With a failure model, which
        is shown that scatter, they are not: white noise slows a walk down as no target does.
        """
        made = self.grounding
        history = made if isinstance(made, HistoryGrounding) else None
        foresees = history is not None and history.failures is not None
        scatters_itself = history is not None and history.scatter_model is not None
        scatter = None if foresees or scatters_itself else self.scatter
        if history is not None and foresees:
            made = history.foreseeing(self.task.objective)
        simulator = made.simulator(self.task, episodes, scatter=scatter)
        return SimulatorEnv(self.task.objective, simulator, topple=foresees)

    def success(self, policy: RunningPolicy, episodes: int, seed: int) -> float:
        """Return the share of so many episodes in which a policy succeeds; starts and goals are of `seed`."""
        begin = partial(started, policy, policy.act_in_simulator)
        outcome, _ = in_simulator(self.simulator(episodes), begin, self.task.objective.horizon, seed)
        return fmean(outcome.success)
