"""An ensemble of networks without memory, each of which predicts by how much the simulator's step is wrong.

They are fitted to bootstraps of the steps; the mean is the correction.
"""

from dataclasses import dataclass

import torch

from astra_data.grounding.simulator import EpisodeSimulator, FittedGrounding
from astra_data.methods.method import Method

MEMBERS, HIDDEN = 5, 64


class Ensemble(torch.nn.Module):
    def __init__(self, states, actions):
        super().__init__()
        self.sizes = [states, actions]
        sizes = (states + actions, HIDDEN, states)
        self.members = torch.nn.ModuleList(
            torch.nn.Sequential(torch.nn.Linear(*sizes[:2]), torch.nn.Tanh(), torch.nn.Linear(*sizes[1:]))
            for _ in range(MEMBERS)
        )
        for name, size in (("mean", states), ("std", states), ("error", states)):
            self.register_buffer(name, torch.ones(size))

    def inputs(self, state, action):
        return torch.cat([(state - self.mean) / self.std, action], dim=-1)

    def forward(self, state, action):  # (..., X), (..., A) -> corrections (..., X)
        inputs = self.inputs(state, action)
        return torch.stack([member(inputs) for member in self.members]).mean(0) * self.error


class EnsembleSimulator(EpisodeSimulator):
    def __init__(self, simulator, ensemble):
        super().__init__(simulator)
        self.ensemble = ensemble

    def step(self, action):
        before = self.state
        landed = self.simulator.step(action)
        with torch.no_grad():
            return self._settle(before, landed + self.ensemble(before, action))


@dataclass(frozen=True)
class ResidualEnsemble(FittedGrounding):
    kind = "residual ensemble"

    ensemble: Ensemble

    def corrected(self, simulator):
        return EnsembleSimulator(simulator, self.ensemble)

    def to_file(self):
        return self.ensemble.state_dict(), {"sizes": self.ensemble.sizes}

    @classmethod
    def from_file(cls, tensors, metadata, device):
        ensemble = Ensemble(*metadata["sizes"])
        ensemble.load_state_dict(tensors)
        return cls(ensemble.to(device).requires_grad_(False))


def fit(fitting):
    torch.manual_seed(fitting.seed)
    episodes, windows = fitting.training, fitting.training.windows
    state, action = episodes.steps(windows.state), episodes.steps(windows.action)
    error = episodes.steps(windows.next_state - windows.simulated_next)
    ensemble = Ensemble(state.shape[-1], action.shape[-1]).to(fitting.device)
    ensemble.mean, ensemble.std, ensemble.error = state.mean(0), state.std(0) + 1e-6, error.std(0) + 1e-6
    bootstraps = torch.randint(len(state), (MEMBERS, len(state)), device=fitting.device)
    optimizer = torch.optim.Adam(ensemble.parameters(), lr=3e-3)
    for update in range(fitting.descent.updates):
        drawn = torch.randint(len(state), (256,), device=fitting.device)
        loss = sum(
            (member(ensemble.inputs(state[rows], action[rows])) - error[rows] / ensemble.error).square().mean()
            for member, rows in zip(ensemble.members, bootstraps[:, drawn], strict=True)
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        fitting.progress(update / fitting.descent.updates, f"loss {loss.item():.3f}")
    ensemble.requires_grad_(False)
    return ResidualEnsemble(ensemble), {"loss": loss.item()}


METHOD = Method(
    name="residual_ensemble", title="Residual ensemble", color="#E377C2", fit=fit, grounding=ResidualEnsemble
)
