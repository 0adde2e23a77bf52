"""Outcomes of N episodes that are run side by side."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import NamedTuple, Self

import numpy as np

from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.core.progress import Progress, silent
from astra_data.core.seeding import derive
from astra_data.dataset.columns import ACTION
from astra_data.dataset.reader import Dataset
from astra_data.grounding.simulator import Grounding
from astra_data.policies.running_policy import Observed, PolicyFile, RunningPolicy, running, target_observation
from astra_data.policies.simulator_env import SimulatorEnv, training_env
from astra_data.worlds.commands import Commands
from astra_data.worlds.protocols import Step
from astra_data.worlds.task import Task


@dataclass(frozen=True)
class Outcome:
    """Outcomes of N episodes."""

    success: list[float]  # 1 or 0
    failed: list[float]  # 1 or 0
    wall_contact: list[float]  # share of the steps
    steps: list[int]  # until the end
    returns: list[float]  # sum of rewards
    position: Tensor  # of what moves, (N, T + 1, 2 K) in m, from the start on, NaN after the end
    goal: Tensor  # (N, G)

    @property
    def start_goal(self) -> dict[str, Tensor]:
        """Where they began, "start" (N, 2 K), and "goal"."""
        return {"start": self.position[:, 0], "goal": self.goal}

    def to_json(self) -> dict[str, list[float]]:
        """Return the lists by name."""
        lists = (self.success, self.failed, self.wall_contact, [float(steps) for steps in self.steps], self.returns)
        return dict(zip(("success", "failed", "wall_contact", "steps", "return"), lists, strict=True))


class EpisodeRecord:
    """Record N episodes until each has ended: `active`, (N,) bool, have not; `total_steps` are those of all so far."""

    def __init__(self, position: Tensor, goal: Tensor) -> None:
        """Start at `position` (N, 2 K), with goals (N, G)."""
        count = len(position)
        self.active, self.total_steps = torch.ones(count, dtype=torch.bool), 0
        self._success, self._failed, self._contact, self._steps, self._return = torch.zeros(5, count)
        self._positions, self._goal = [position.clone()], goal.clone()

    def add(self, position: Tensor, reward: Tensor, success: Tensor, failed: Tensor, contact: Tensor) -> None:
        """Add one step; rows of ended episodes are ignored."""
        active = self.active
        self._success += success & active
        self._failed += failed & active
        self._contact += contact & active
        self._steps += active
        self._return += torch.where(active, reward, 0.0)
        self._positions.append(torch.where(active.unsqueeze(-1), position, torch.nan))
        self.total_steps += int(active.sum())
        self.active = active & ~success & ~failed

    def outcome(self) -> Outcome:
        """Return the outcomes so far."""
        return Outcome(
            success=self._success.tolist(),
            failed=self._failed.tolist(),
            wall_contact=(self._contact / self._steps).tolist(),
            steps=self._steps.long().tolist(),
            returns=self._return.tolist(),
            position=torch.stack(self._positions, dim=1),
            goal=self._goal,
        )


TOLERANCE = 0.01  # share of the recorded range by which a command may be beyond it


class RecordedRange:
    """Counts the steps in which any of A commands lies beyond what was recorded."""

    def __init__(self, least: Tensor, largest: Tensor, limits: Commands) -> None:
        """Take the range `least` to `largest`, both (A,), in the units of `limits`."""
        margin = TOLERANCE * (largest - least)
        self._least, self._largest, self._limits = least - margin, largest + margin, limits
        self._steps = self._beyond = 0

    @classmethod
    def of(cls, dataset: Path, limits: Commands) -> Self | None:
        """Return the range in a dataset; None if it cannot be read any more."""
        try:
            statistics = Dataset.open(dataset).statistics()
        except AstraDataError:
            return None
        least, largest = (torch.from_numpy(np.asarray(statistics[ACTION][end], np.float32)) for end in ("min", "max"))
        return cls(least, largest, limits)

    def count(self, action: Tensor, active: Tensor) -> None:
        """Count a step with actions of ±1 (B, A), of the robots in `active` (B,)."""
        command = self._limits.in_units(action)
        beyond = ((command < self._least) | (command > self._largest)).any(dim=-1)
        self._steps += int(active.sum())
        self._beyond += int((beyond & active).sum())

    @property
    def share(self) -> float:
        """The share of the steps so far that were beyond."""
        return self._beyond / self._steps


Act = Callable[[Tensor, Tensor], Tensor]
Begin = Callable[[Tensor], Act]  # given the goals (N, G) of new episodes, returns the function that acts in them


def started(policy: RunningPolicy, act: Act, goal: Tensor) -> Act:
    """Start a policy in as many episodes as there are goals (N, G), and return its `act`."""
    policy.start(len(goal))
    return act


@without_gradients
def in_simulator(
    world: SimulatorEnv,
    begin: Begin,
    horizon: int,
    seed: int,
    asked: RecordedRange | None = None,
    *,
    starts: tuple[Tensor, Tensor] | None = None,
) -> Outcome:
    """Run an episode in each row of `world`, from `starts` (B, X) with goals (B, G), by default the seed's."""
    torch.manual_seed(seed)
    if starts is None:
        world.reset()
    else:
        world.start_from(*starts, torch.arange(world.num_envs, device=world.device))
    act = begin(world.goal)
    record = EpisodeRecord(world.objective.places(world.simulator.state), world.goal)
    for number in range(horizon):
        action = act(world.simulator.state, world.goal)
        if asked is not None:
            asked.count(action, record.active)
        step = world.step(action)
        success = world.objective.succeeded(step.success, world.failed, number + 1)
        places = world.objective.places(world.simulator.state)
        record.add(places, step.reward, success, world.failed, world.simulator.blocked)
        if not record.active.any():
            break
    return record.outcome()


class ObservedTargetEnv:
    """B target environments that show their state and goal; physics on the CPU, randomness of torch."""

    penalty_scale = 1.0  # without effect, as there are no penalties here

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        observed: Observed = "abstract",
        starts: tuple[Tensor, Tensor] | None = None,
        data_start_share: float = 0.0,
        device: str = "cpu",
        num_threads: int | None = None,
    ) -> None:
        """Build B; a share of their episodes start from `starts`, N recorded states (N, S) and goals (N, G)."""
        self.num_envs = num_envs
        self.action_size = task.objective.action_size
        self._task, self._observed, self._device = task, observed, device
        self._starts, self._data_start_share = starts, data_start_share
        self._env = task.target(num_envs, seed=0, num_threads=num_threads)
        self.observation_size = self._observe().shape[1]

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Reset the rows in `mask` (B,), by default all; return observations (B, O)."""
        anew = torch.ones(self.num_envs, dtype=torch.bool) if mask is None else mask.cpu()
        from_data = anew & (torch.rand(self.num_envs) < self._data_start_share)
        self._env.reseed(int(torch.randint(2**62, ())))
        self._env.reset(anew & ~from_data)
        rows = from_data.nonzero().squeeze(1)
        if self._starts is not None and len(rows):
            states, goals = self._starts
            moments = torch.randint(len(states), (len(rows),))
            self._env.goal[rows] = goals[moments]
            self._env.reset_to(rows.numpy(), states[moments].numpy().astype(np.float64))
        return self._observe()

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, A), clipped to ±1."""
        step = self._env.step(action.cpu())
        reward, terminated, success = (one.to(self._device) for one in (step.reward, step.terminated, step.success))
        return Step(self._observe(), reward, terminated, success)

    def _observe(self) -> Tensor:
        env = self._env
        return target_observation(self._task, env.state, env.goal, None, self._observed).to(self._device)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        return self._env.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        """Continue from `state`; return the observations (B, O)."""
        self._env.load_state_dict({name: values.cpu() for name, values in state.items()})
        return self._observe()


def in_target(
    task: Task,
    begin: Begin,
    episodes: int,
    seed: int,
    *,
    leg_scale: float = 1.0,
    num_threads: int | None = None,
    progress: Progress = silent,
    asked: RecordedRange | None = None,
) -> Outcome:
    """Run so many episodes side by side, with any `num_threads`; `leg_scale` is a factor on the ant's legs."""
    if leg_scale != 1.0 and "leg_scale" not in task.facts:
        raise BadInputError(f"leg_scale: {task.name} has legs of one length: expected 1, got {leg_scale:g}")
    legs = {} if leg_scale == 1.0 else {"leg_scale": leg_scale}
    env = task.target(episodes, seed=seed, num_threads=num_threads, **legs)
    env.reset()
    act = begin(env.goal)
    record = EpisodeRecord(env.position, env.goal)
    began = time.perf_counter()
    for step in range(task.objective.horizon):
        action = act(env.state, env.goal)
        if asked is not None:
            asked.count(action, record.active)
        outcome = env.step(action, record.active)
        success = task.objective.succeeded(outcome.success, env.failed, step + 1)
        record.add(env.position, outcome.reward, success, env.failed, env.wall_contact)
        rate = record.total_steps / (time.perf_counter() - began)
        progress((step + 1) / task.objective.horizon * 0.99, f"{rate:,.0f} target steps/s")
        if not record.active.any():
            break
    return record.outcome()


def judged_success(task: Task, judge: Grounding, policy: RunningPolicy, episodes: int, seed: int) -> float:
    """Return the share of episodes that succeed in the simulator of a `judge`, whose failure model ends episodes."""
    return fmean(_judged(task, judge, policy, episodes, seed))


_REPEATS = 10  # episodes from a start with each judge


def judged_from(task: Task, judge: Grounding, policy: RunningPolicy, state: Tensor, goal: Tensor, seed: int) -> Tensor:
    """Return the share (N,) of episodes that succeed with a `judge` from each of N states (N, X) with goals (N, G)."""
    starts = state.float().repeat(_REPEATS, 1), goal.float().repeat(_REPEATS, 1)
    return torch.tensor(_judged(task, judge, policy, len(starts[0]), seed, starts)).view(_REPEATS, -1).mean(0)


def _judged(
    task: Task,
    judge: Grounding,
    policy: RunningPolicy,
    episodes: int,
    seed: int,
    starts: tuple[Tensor, Tensor] | None = None,
) -> list[float]:
    world = SimulatorEnv(task.objective, judge.simulator(task, episodes), draws_failures=True)
    begin = partial(started, policy, policy.act_in_simulator)
    return in_simulator(world, begin, task.objective.horizon, seed, starts=starts).success


_EPISODES = 100


class Reached(NamedTuple):
    """What a policy reaches in its own simulator."""

    success: float  # share of the episodes
    steps: float  # mean of those that succeed; the horizon without any


def reached_in_own_world(task: Task, trained: PolicyFile, grounding: Grounding, seed: int) -> Reached:
    """Test a policy in the simulator of its training, from the task's starts, by the mean of its actions."""
    if trained.simulation is None:
        advice = "give PolicyFile its simulation, or set tries = 1"
        raise BadInputError(f"tries: expected a policy that knows its simulator, got one without: {advice}")
    policy, horizon = running(task, trained, grounding), task.objective.horizon
    world = training_env(task, trained.simulation, grounding, num_envs=_EPISODES)
    begin = partial(started, policy, policy.act_in_simulator)
    outcome = in_simulator(world, begin, horizon, derive(seed, "trial in its own simulator"))
    steps = [steps for steps, success in zip(outcome.steps, outcome.success, strict=True) if success]
    return Reached(fmean(outcome.success), fmean(steps) if steps else float(horizon))
