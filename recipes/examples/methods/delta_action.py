"""Delta actions, as in ASAP: the simulator is given other actions than the robot, so that it moves alike.

The difference is fitted through the simulator's own step, which has to be differentiable.
"""

from dataclasses import dataclass

import torch

from astra_data.grounding.protocols import FittedGrounding
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.methods.method import Method


def network(states, actions):
    return torch.nn.Sequential(
        torch.nn.Linear(states + actions, 64), torch.nn.Tanh(), torch.nn.Linear(64, actions)
    )


class DeltaSimulator(EpisodeSimulator):
    """Step the simulator by action + f(state, action)."""

    def __init__(self, simulator, delta, *, scatter):
        super().__init__(simulator, scatter=scatter)
        self.delta = delta

    def step(self, action):
        with torch.no_grad():
            return super().step(action + self.delta(torch.cat([self.state, action], dim=-1)))


@dataclass(frozen=True)
class DeltaAction(FittedGrounding):
    kind = "delta action"

    delta: torch.nn.Module

    def corrected(self, simulator, scatter):
        return DeltaSimulator(simulator, self.delta, scatter=scatter)

    def scatter(self, episodes):
        size = episodes.windows.state.shape[-1]
        return torch.zeros(size, size, device=episodes.windows.state.device)

    def to_file(self):
        actions = self.delta[-1].out_features
        return self.delta.state_dict(), {"sizes": [self.delta[0].in_features - actions, actions]}

    @classmethod
    def from_file(cls, tensors, metadata, device):
        delta = network(*metadata["sizes"])
        delta.load_state_dict(tensors)
        return cls(delta.to(device).requires_grad_(False))


def fit(fitting):
    torch.manual_seed(fitting.seed)
    episodes, windows = fitting.training, fitting.training.windows
    state, action, after = map(episodes.steps, (windows.state, windows.action, windows.next_state))
    delta, count = network(state.shape[-1], action.shape[-1]).to(fitting.device), min(256, len(state))
    spread, simulator = (after - state).std(0) + 1e-6, fitting.task.simulator(count, fitting.device)
    optimizer = torch.optim.Adam(delta.parameters(), lr=3e-3)
    for update in range(fitting.config.updates):
        rows = torch.randint(len(state), (count,), device=fitting.device)
        simulator.reset_to(state[rows])
        landed = simulator.step(action[rows] + delta(torch.cat([state[rows], action[rows]], dim=-1)))
        loss = ((landed - after[rows]) / spread).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        fitting.progress(update / fitting.config.updates, f"loss {loss.item():.3f}")
    return DeltaAction(delta.requires_grad_(False)), {"loss": loss.item()}


METHOD = Method(
    name="delta_action", title="Delta action", colour="#8C564B", fit=fit, grounding=DeltaAction, fit_rates=()
)
