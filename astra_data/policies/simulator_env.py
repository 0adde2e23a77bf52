"""The task in an abstract simulator, raw or grounded: the environment that policies are trained in."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from astra_data.core.config import Config, NotNegative, Positive, Share
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.grounding.paired_episodes import RISK_STEPS, PairedEpisodes, draw_steps
from astra_data.grounding.simulator import EpisodeSimulator, Grounding
from astra_data.worlds.objective import NO_LIMIT, Objective
from astra_data.worlds.protocols import Step
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation

if TYPE_CHECKING:
    from astra_data.policies.networks import Policy

RewardSource = Literal["abstract", "predicted", "priced"]
"""The task's own reward on abstract states; the target's, as R_pred predicts it (Algorithm 2), but where states decide;
the task's own minus the predicted cost of failures, times `RISK_WEIGHT`."""

RISK_WEIGHT = 4.0
"""How many failures a predicted one counts as in the reward "priced": a failure also costs the rest of the episode."""


class WorldConfig(Config):
    """The environment that a policy is trained in, as it is written beside the policy."""

    reward: RewardSource = "abstract"
    """Source of the reward; see `SimulatorEnv`."""
    change_penalty: NotNegative = 0.0
    """Subtracted from the reward of a step, multiplied by the squared change of the command."""
    command_limit: Positive = NO_LIMIT
    """Commands longer than this are shortened, in training and in the target; a multiple of the largest along
    an axis."""
    data_start_share: Share = 0.0
    """Fraction of the episodes that start from the middle of a recorded one."""


@dataclass(frozen=True)
class DataStarts:
    """N moments of recorded episodes to start from."""

    state: Tensor  # φ(s_i), (N, X)
    goal: Tensor  # (N, G)
    previous_action: Tensor  # a_{i-1}, (N, A)
    hidden: Tensor | None  # what the grounding, and its failure model, remember before s_i, (N, H), if anything


def policy_observation(objective: Objective, state: Tensor, goal: Tensor, latent: Tensor | None) -> Tensor:
    """Assemble a policy's observation (..., O): the latent (..., Z), if any, scaled to about 1, then state and goal."""
    seen = objective.observe(state.flatten(0, -2), goal.flatten(0, -2)).unflatten(0, state.shape[:-1])
    return seen if latent is None else torch.cat([latent / latent.shape[-1] ** 0.5, seen], dim=-1)


def without_padding(seen: Tensor, mask: Tensor) -> Tensor:
    """Return what was made (E, T, ...) of padded steps with 0 where the padding, by its mask (E, T), made no number."""
    return torch.where(mask.bool().unsqueeze(-1) | seen.isfinite(), seen, 0.0)


@dataclass(frozen=True)
class Recorded:
    """E recorded episodes of up to T steps as a policy sees them, padded."""

    observation: Tensor  # (E, T, O)
    previous_action: Tensor  # (E, T, A), zero at the start
    action: Tensor  # (E, T, A)
    lengths: Tensor  # (E,), the number of real steps

    def draw(self, count: int, length: int, burn_in: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Draw places of windows, episodes (count, 1) and steps (count, length), and which to learn from."""
        episodes, steps, learned = draw_steps(self.lengths, count, length)
        learned &= steps < self.lengths[episodes]
        learned &= (torch.arange(steps.shape[1], device=steps.device) >= burn_in) | (steps[:, :1] == 0)
        return (episodes, steps), learned

    def features(self, policy: "Policy", places: tuple[Tensor, Tensor]) -> Tensor:
        """Return the `policy`'s features (count, length, F) of windows as drawn, which it begins without memory."""
        seen = self.observation[..., : policy.shape.observation_size][places]
        start = torch.zeros(seen.shape[:2], device=seen.device)
        return policy.remember_sequence(seen, self.previous_action[places], policy.initial_hidden(len(seen)), start)


@without_gradients
def recorded_steps(task: Task, episodes: PairedEpisodes, grounding: Grounding) -> Recorded:
    """Return `episodes` as a policy would have seen them that is trained with `grounding`."""
    windows, latent = episodes.windows, None
    if (source := grounding.encoder) is not None:
        inputs = source.encoder_input(windows.state, windows.goal, windows.previous_action)
        latent, _ = source.encoder.sequence(inputs)
    seen = without_padding(policy_observation(task.objective, windows.state, windows.goal, latent), windows.mask)
    return Recorded(seen, windows.previous_action, windows.action, episodes.lengths)


class SimulatorEnv:
    """A batched environment over an abstract simulator; see `RewardSource`."""

    def __init__(
        self,
        objective: Objective,
        simulator: EpisodeSimulator,
        world: WorldConfig = WorldConfig(),
        *,
        starts: DataStarts | None = None,
        draws_failures: bool = False,
        shows_parameters: bool = False,
    ) -> None:
        """Set the task in `simulator`, raw or grounded; failures may be drawn as predicted, and parameters be shown."""
        self.objective = objective
        self.simulator = simulator
        self.world, self.starts, self.draws_failures = world, starts, draws_failures
        self.penalty_scale = 1.0
        self.device = simulator.state.device
        self.num_envs = len(simulator.state)
        self.action_size = objective.action_size
        self.goal = torch.zeros(self.num_envs, objective.goal_size, device=self.device)
        self._command = torch.zeros(self.num_envs, self.action_size, device=self.device)
        self.failed = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._shows_parameters = shows_parameters
        shown = simulator.parameters if shows_parameters else None
        self.parameter_count = 0 if shown is None else shown.shape[1]
        seen = policy_observation(objective, simulator.state, self.goal, simulator.latent)  # maybe of no episode's
        self.observation_size = seen.shape[1] + self.parameter_count

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Reset the rows in `mask` (B,), by default all; return observations (B, O)."""
        rows = torch.arange(self.num_envs, device=self.device) if mask is None else mask.nonzero().squeeze(1)
        if len(rows):
            share = 0.0 if self.starts is None else self.world.data_start_share
            from_data = torch.rand(len(rows), device=self.device) < share
            anew, recorded = rows[~from_data], rows[from_data]
            rng = np.random.default_rng(int(torch.randint(2**62, ())))
            if len(anew):  # a user's objective need not know what none is
                draws = self.objective.draw_starts(rng, len(anew)), self.objective.draw_goals(rng, len(anew))
                state, goal = (torch.from_numpy(drawn).float().to(self.device) for drawn in draws)
                self.start_from(state, goal, anew)
            if (starts := self.starts) is not None:
                moments = torch.randint(len(starts.state), (len(recorded),), device=self.device)
                hidden = None if starts.hidden is None else starts.hidden[moments]
                state, goal, action = (each[moments] for each in (starts.state, starts.goal, starts.previous_action))
                self.start_from(state, goal, recorded, hidden, action)
        return self._observe()

    def start_from(
        self, state: Tensor, goal: Tensor, rows: Tensor, hidden: Tensor | None = None, action: Tensor | None = None
    ) -> None:
        """Start episodes in `rows` (n,), from states (n, X) with goals (n, G), after what is given of a history."""
        self.goal[rows], self._command[rows] = goal, 0.0 if action is None else action
        self.simulator.start(state, rows, goal, hidden=hidden, previous_action=action)

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, A), clipped to ±1 and to the command limit."""
        before = self.simulator.state
        command = self.objective.limit_command(action, self.world.command_limit)
        after = self.simulator.step(command)
        success = self.objective.reached(after, self.goal)
        failed = self.objective.missed(after, self.goal)
        if self.objective.ends_at_walls:
            failed = failed | self.simulator.blocked
        risk = self.simulator.hazard
        if risk is not None and self.draws_failures:
            failed = failed | (torch.rand_like(risk) < risk)
        self.failed = failed & ~success
        reward = self.objective.reward(before, after, self.goal, self.failed)
        if self.world.reward == "priced" and risk is not None:
            reward = reward + self.penalty_scale * RISK_WEIGHT * self.objective.failure_reward * risk
        if self.world.reward == "predicted":
            decided = success | self.failed
            own = self.objective.reward(before, after, self.goal, torch.zeros_like(decided))
            predicted = self.simulator.predicted_reward(own)
            if predicted is not None:
                reward = torch.where(decided, reward, predicted)
        if self.world.change_penalty:
            reward = reward - self.world.change_penalty * (command - self._command).square().sum(-1)
            self._command = command
        self._refuse_not_finite("the reward", reward)
        return Step(self._observe(), reward, terminated=success | self.failed, success=success)

    def _observe(self) -> Tensor:
        simulator = self.simulator
        observation = policy_observation(self.objective, simulator.state, self.goal, simulator.latent)
        self._refuse_not_finite("objective.observe", observation)
        shown = simulator.parameters if self._shows_parameters else None
        return observation if shown is None else torch.cat([observation, shown], dim=-1)

    def _refuse_not_finite(self, maker: str, made: Tensor) -> None:
        if not bool(made.isfinite().all()):
            row = int((~made.isfinite()).view(len(made), -1).any(1).nonzero()[0])
            wrong = float(made[~made.isfinite()][0])
            where = f"the abstract state {self.simulator.state[row].tolist()} and the goal {self.goal[row].tolist()}"
            raise BadInputError(f"{maker}: expected finite numbers, got {wrong:g} for {where}")

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that `load_state_dict` needs to continue from here."""
        return {"goal": self.goal, "command": self._command} | self.simulator.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        """Continue from `state`; return the observations (B, O)."""
        self.goal, self._command = state["goal"].clone(), state["command"].clone()
        self.simulator.load_state_dict(state)
        return self._observe()


CHANGE_PENALTY = 0.02  # of the plus settings; recorded ants fall where commands change
_ALONG_AN_AXIS = 1.0
_LEAST_RATIO = 1.5  # of the rates of failures above and below the limit


@without_gradients
def command_limit(task: Task, episodes: PairedEpisodes) -> float:
    """Return 1, the largest velocity command along an axis, if failures are more frequent above, else `NO_LIMIT`."""
    if task.plane is None:
        return NO_LIMIT
    from astra_data.grounding.failures import failing

    windows = episodes.windows
    length = windows.action[..., :2].norm(dim=-1).double() * windows.mask
    total, count = length.cumsum(1), windows.mask.double().cumsum(1)
    total[:, RISK_STEPS:] -= length.cumsum(1)[:, :-RISK_STEPS]
    is_above = episodes.steps(total / count.clamp(min=1, max=RISK_STEPS)) > _ALONG_AN_AXIS
    fails = episodes.steps(failing(task, episodes, 1).windows.fails_soon).double()
    above, below = fails[is_above], fails[~is_above]
    if not above.any():
        return NO_LIMIT
    is_riskier = not len(below) or float(above.mean()) >= _LEAST_RATIO * float(below.mean())
    return _ALONG_AN_AXIS if is_riskier else NO_LIMIT


@dataclass(frozen=True)
class Simulation:
    """The abstract simulator that a policy is trained in."""

    world: WorldConfig
    variation: Variation | None = None  # ranges of the simulator's parameters, drawn for each episode


@without_gradients
def data_starts(task: Task, world: WorldConfig, episodes: PairedEpisodes, grounding: Grounding) -> DataStarts | None:
    """Return the recorded moments that episodes may start from; None unless `world` asks for them."""
    if not world.data_start_share:
        return None
    from astra_data.grounding.failures import averages_before
    from astra_data.grounding.history import HistoryGrounding

    windows, every, used = episodes.windows, grounding.start_stride, _used(grounding, world)
    moments = windows.mask[:, ::every].bool()
    hidden = used.hidden_before(windows, every)
    if hidden is not None and isinstance(used, HistoryGrounding) and used.failures is not None:
        averages = averages_before(task, used, used.failures, episodes)
        hidden = torch.cat([hidden, averages[:, ::every]], dim=-1)
    columns = (windows.state, windows.goal, windows.previous_action)
    state, goal, action = (values[:, ::every][moments] for values in columns)
    return DataStarts(state, goal, action, None if hidden is None else hidden[moments])


def _used(grounding: Grounding, world: WorldConfig) -> Grounding:
    """Return what `world` makes use of in a grounding: its failure model only where failures have a price."""
    from astra_data.grounding.history import HistoryGrounding

    if world.reward != "abstract" or not isinstance(grounding, HistoryGrounding):
        return grounding
    return replace(grounding, failures=None)


def training_env(
    task: Task,
    simulation: Simulation,
    grounding: Grounding,
    *,
    num_envs: int,
    device: str = "cpu",
    starts: DataStarts | None = None,
    shows_parameters: bool = False,
) -> SimulatorEnv:
    """Build the environment: the task in the raw, varied or grounded simulator, with `starts` of data or its own."""
    simulator = _used(grounding, simulation.world).simulator(task, num_envs, device, variation=simulation.variation)
    return SimulatorEnv(task.objective, simulator, simulation.world, starts=starts, shows_parameters=shows_parameters)
