"""The task in an abstract simulator, raw or grounded: the worlds that policies are trained in."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.grounding.build import Simulator, remembering_within, start_simulator, varied_within
from astra_data.grounding.residual_simulator import AugmentedSimulator
from astra_data.grounding.simulator import GroundedSimulator
from astra_data.worlds.batched import Step
from astra_data.worlds.objective import Objective
from astra_data.worlds.plane.free_space import FreeSpace

RewardSource = Literal["abstract", "predicted", "blend"]


@dataclass(frozen=True)
class DataStarts:
    """Moments of recorded episodes to start from.

    Attributes:
        state: φ(s_i), (N, X). goal: (N, G). previous_action: a_{i-1}, (N, A).
        hidden: the grounding's memory before s_i, (N, H); None where it remembers nothing.
    """

    state: Tensor
    goal: Tensor
    previous_action: Tensor
    hidden: Tensor | None


def policy_observation(objective: Objective, state: Tensor, goal: Tensor, latent: Tensor | None) -> Tensor:
    """Assemble what a policy sees (..., O): latent (..., Z) where there is one, then state and goal.

    A latent left at its own length, the square root of Z, drowns the rest: PPO then hardly learns to use the
    position. It is shortened to about one.
    """
    seen = objective.observe(state, goal)
    return seen if latent is None else torch.cat([latent / latent.shape[-1] ** 0.5, seen], dim=-1)


class SimulatorWorld:
    """A batched environment over an abstract simulator.

    Rewards: "abstract", the task's own on abstract states; "predicted", R_pred (Algorithm 2), on top of the
    task's own where it was fitted as its correction; "blend", the task's own plus the predicted risk of
    toppling. Steps that the task itself sees decided (goal reached, a ball beside it, a fallen body, a wall
    that must not be touched) pay the task's own reward also where it is predicted. With `topple`, toppling is
    drawn from the topple head and ends the episode. All randomness comes from torch's global generator.

    Attributes:
        latent_size: Z, of the latents in the observations; 0 where there are none.
        parameter_count: P, of the parameters in the observations; 0 where they are not told.
        failed: which episodes ended badly in the last step, (B,) bool.
        caution: factor on the penalties for thin data, doubt and risk; 1 unless the training ramps it up.
    """

    def __init__(
        self,
        objective: Objective,
        simulator: Simulator,
        *,
        reward: RewardSource = "abstract",
        topple: bool = False,
        risk_weight: float = 1.0,
        command_limit_m_s: float = 2.0,
        thinness: Tensor | None = None,
        doubt_penalty: float = 0.0,
        starts: DataStarts | None = None,
        data_start_share: float = 0.0,
        tells_parameters: bool = False,
    ) -> None:
        """Put the task into `simulator`.

        Args:
            objective: of the task.
            simulator: raw or grounded.
            reward: where the reward comes from.
            topple: end episodes by the topple head.
            risk_weight: how many topples a predicted one counts for in the reward "blend".
            command_limit_m_s: longer velocity commands are shortened to this.
            thinness: taken from the reward of a step to each cell of the maze's fine grid, (height, width);
                only where there is a maze.
            doubt_penalty: taken from the reward for the grounded simulator's doubt.
            starts: recorded moments to start from.
            data_start_share: share of the episodes that start from `starts`.
            tells_parameters: end observations with the parameters of a simulator that varies, normalised.
        """
        self.objective = objective
        self.simulator = simulator
        self.grounded = simulator if isinstance(simulator, GroundedSimulator) else None
        self.reward = reward
        self.topple = topple
        self.caution = 1.0
        self.risk_weight = risk_weight
        self.command_limit_m_s = command_limit_m_s
        maze, device = objective.layout, str(simulator.state.device)
        self.free = None if maze is None else FreeSpace.of_maze(maze, radius_m=0.0, device=device)
        self.thinness = thinness
        self.doubt_penalty = doubt_penalty
        self.starts = starts
        self.data_start_share = data_start_share
        self.device = simulator.state.device
        self.num_envs = len(simulator.state)
        self.action_size = objective.action_size
        self.goal = torch.zeros(self.num_envs, objective.goal_size, device=self.device)
        self.failed = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._told = varied_within(simulator) if tells_parameters else None
        self.parameter_count = 0 if self._told is None else self._told.parameters.shape[1]
        self.observation_size = self._observe().shape[1]
        self.latent_size = 0 if self.grounded is None else self.grounded.latent.shape[1]

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Start the rows in `mask` (B,) anew, by default all; return observations (B, O)."""
        rows = torch.arange(self.num_envs, device=self.device) if mask is None else mask.nonzero().squeeze(1)
        if len(rows):
            from_data = torch.rand(len(rows), device=self.device) < self.data_start_share
            self._start_task(rows[~from_data])
            if self.starts is not None:
                self._start_from_data(rows[from_data], self.starts)
        return self._observe()

    def _start_task(self, rows: Tensor) -> None:
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        state = self.objective.draw_starts(rng, len(rows))
        goal = self.objective.draw_goals(rng, len(rows))
        self._set(rows, self._tensor(state), self._tensor(goal))

    def _start_from_data(self, rows: Tensor, starts: DataStarts) -> None:
        moments = torch.randint(len(starts.state), (len(rows),), device=self.device)
        hidden = None if starts.hidden is None else starts.hidden[moments]
        self._set(rows, starts.state[moments], starts.goal[moments], hidden, starts.previous_action[moments])

    def _set(
        self,
        rows: Tensor,
        state: Tensor,
        goal: Tensor,
        hidden: Tensor | None = None,
        previous_action: Tensor | None = None,
    ) -> None:
        self.goal[rows] = goal
        start_simulator(self.simulator, state, rows, goal, hidden=hidden, previous_action=previous_action)

    def _tensor(self, values: NDArray[np.float64]) -> Tensor:
        return torch.from_numpy(values).float().to(self.device)

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, A), clipped to ±1 and to the command limit."""
        action = self.objective.limit_command(action, self.command_limit_m_s)
        before = self.simulator.state
        latent = None if self.grounded is None else self.grounded.latent
        after = self.simulator.step(action)
        success = self.objective.reached(after, self.goal)
        self.failed = self.objective.missed(after, self.goal)
        if self.objective.ends_at_walls:
            self.failed = self.failed | (self.simulator.blocked & ~success)
        decided = success | self.failed
        penalty = torch.zeros(self.num_envs, device=self.device)
        if self.thinness is not None and self.free is not None:
            penalty = -self.thinness[self.free.cells(after[:, :2])]
        if self.grounded is not None and self.doubt_penalty:
            penalty = penalty - self.doubt_penalty * self.grounded.doubt
        if self.grounded is not None and latent is not None and (self.topple or self.reward == "blend"):
            with torch.no_grad():
                risk = self.grounded.model.topple_risk(latent, action, after)
            if self.topple:
                self.failed = self.failed | ((torch.rand_like(risk) < risk) & ~success)
            else:
                penalty = penalty + self.risk_weight * self.objective.failure_reward * risk
        reward = self.objective.reward(before, after, self.goal, self.failed)
        if self.reward == "predicted" and self.grounded is not None and latent is not None:
            with torch.no_grad():
                predicted = self.grounded.model.predict_reward(latent, action)
            if self.grounded.model.shape.corrects_reward:
                none_failed = torch.zeros_like(decided)
                predicted = predicted + self.objective.reward(before, after, self.goal, none_failed)
            reward = torch.where(decided, reward, predicted)
        return Step(
            observation=self._observe(),
            reward=reward + self.caution * penalty,
            terminated=success | self.failed,
            success=success,
        )

    def _observe(self) -> Tensor:
        latent = None if self.grounded is None else self.grounded.latent
        observation = policy_observation(self.objective, self.simulator.state, self.goal, latent)
        if self._told is None:
            return observation
        return torch.cat([observation, self._told.variation.normal(self._told.parameters)], dim=-1)

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything that a later `load_state_dict` needs to go on from here."""
        state = {"state": self.simulator.state, "goal": self.goal}
        if isinstance(self.simulator, GroundedSimulator | AugmentedSimulator):
            state["hidden"] = self.simulator.hidden
        varied = varied_within(self.simulator)
        if varied is not None:
            state |= {"true": varied.true_state, "parameters": varied.parameters}
        remembering = remembering_within(self.simulator)
        if remembering is not None:
            state["memory"] = remembering.memory
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        """Go on from `state`; return the observations (B, O)."""
        self.goal = state["goal"].clone()
        if isinstance(self.simulator, GroundedSimulator | AugmentedSimulator):
            self.simulator.simulator.reset_to(state["state"])
            self.simulator.hidden = state["hidden"].clone()
        else:
            self.simulator.reset_to(state["state"])
        if self.grounded is not None:
            self.grounded.goal = state["goal"].clone()
        varied = varied_within(self.simulator)
        if varied is not None:
            varied.true_state, varied.parameters = state["true"].clone(), state["parameters"].clone()
        remembering = remembering_within(self.simulator)
        if remembering is not None:
            remembering.memory = state["memory"].clone()
        return self._observe()
