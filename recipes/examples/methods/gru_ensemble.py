"""An ensemble of GRUs, each of which predicts by how much the simulator's step is wrong, as in RWM-U.

Each is fitted to a random half of every batch of windows; an episode draws a member and keeps it until it ends,
so that a policy meets every member, and no mean of them that is none.
"""

from dataclasses import dataclass

import torch

from astra_data.grounding.simulator import EpisodeSimulator, FittedGrounding
from astra_data.methods.method import Method

MEMBERS, HIDDEN = 5, 64


class Ensemble(torch.nn.Module):
    """The corrections of every member from the history; memories are (B, members * HIDDEN)."""

    def __init__(self, seen, actions, states):
        super().__init__()
        self.sizes = [seen, actions, states]
        inputs = 2 * len(seen) + actions
        self.grus = torch.nn.ModuleList(torch.nn.GRU(inputs, HIDDEN, batch_first=True) for _ in range(MEMBERS))
        self.heads = torch.nn.ModuleList(torch.nn.Linear(HIDDEN, states) for _ in range(MEMBERS))
        for name, size in (("mean", inputs), ("std", inputs), ("error", states)):
            self.register_buffer(name, torch.ones(size))

    def inputs(self, state, action, landed):
        seen = self.sizes[0]
        return torch.cat([state[..., seen], (landed - state)[..., seen], action], dim=-1)

    def forward(self, state, action, landed, memory):  # (B, T, ...) -> corrections (members, B, T, X), memory
        inputs = (self.inputs(state, action, landed) - self.mean) / self.std
        corrections, after = [], []
        for gru, head, before in zip(self.grus, self.heads, memory.split(HIDDEN, dim=-1), strict=True):
            features, hidden = gru(inputs, before[None].contiguous())
            corrections.append(self.error * head(features))
            after.append(hidden[0])
        return torch.stack(corrections), torch.cat(after, dim=-1)


class EnsembleSimulator(EpisodeSimulator):
    def __init__(self, simulator, ensemble):
        super().__init__(simulator)
        count, device = len(simulator.state), simulator.state.device
        self.ensemble, self.hidden = ensemble, torch.zeros(count, MEMBERS * HIDDEN, device=device)
        self.member = torch.zeros(count, dtype=torch.long, device=device)

    def start(self, state, rows, goal, *, hidden=None, previous_action=None):
        super().start(state, rows, goal)
        self.hidden[rows] = 0.0 if hidden is None else hidden
        self.member[rows] = torch.randint(MEMBERS, (len(rows),), device=self.member.device)

    @torch.no_grad()
    def step(self, action):
        before, landed = self.state, self.simulator.step(action)
        every, self.hidden = self.ensemble(before[:, None], action[:, None], landed[:, None], self.hidden)
        return self._settle(before, landed + every[self.member, torch.arange(len(before)), 0])

    def state_dict(self):
        return super().state_dict() | {"hidden": self.hidden, "member": self.member}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.hidden, self.member = state["hidden"].clone(), state["member"].clone()


@dataclass(frozen=True)
class EnsembleGrounding(FittedGrounding):
    kind = "gru ensemble"
    start_stride = 10  # the memories before each recorded step would take 130 MB for 100 k steps

    ensemble: Ensemble

    def corrected(self, simulator):
        return EnsembleSimulator(simulator, self.ensemble)

    @torch.no_grad()
    def hidden_before(self, windows, every=1):
        memory, before = windows.state.new_zeros(len(windows.state), MEMBERS * HIDDEN), []
        for first in range(0, windows.state.shape[1], every):
            before.append(memory)
            given = (one[:, first : first + every] for one in (windows.state, windows.action, windows.simulated_next))
            memory = self.ensemble(*given, memory)[1]
        return torch.stack(before, dim=1)

    def to_file(self):
        return self.ensemble.state_dict(), {"sizes": self.ensemble.sizes}

    @classmethod
    def from_file(cls, tensors, metadata, device):
        ensemble = Ensemble(*metadata["sizes"])
        ensemble.load_state_dict(tensors)
        return cls(ensemble.to(device).requires_grad_(False))


def fit(fitting):
    torch.manual_seed(fitting.seed)
    episodes, windows, config = fitting.training, fitting.training.windows, fitting.config
    roles, states = fitting.task.abstract_state.roles, windows.state.shape[-1]
    places = {index for role, of in roles if role == "position" for index in range(of.start, of.stop)}
    seen = [index for index in range(states) if index not in places]  # what is learned holds anywhere
    ensemble = Ensemble(seen, windows.action.shape[-1], states).to(fitting.device)
    inputs = episodes.steps(ensemble.inputs(windows.state, windows.action, windows.simulated_next))
    ensemble.mean, ensemble.std = inputs.mean(0), inputs.std(0).clamp_min(1e-3)
    ensemble.error = episodes.steps(windows.next_state - windows.simulated_next).std(0).clamp_min(1e-6)
    optimizer = torch.optim.Adam(ensemble.parameters(), lr=3e-3)
    for update in range(fitting.descent.updates):
        drawn, _ = episodes.draw_windows(config.batch_windows, config.window)
        memory = drawn.state.new_zeros(len(drawn.state), MEMBERS * HIDDEN)
        corrections, _ = ensemble(drawn.state, drawn.action, drawn.simulated_next, memory)
        wrong = ((drawn.simulated_next + corrections - drawn.next_state) / ensemble.error).square().mean(-1)
        learns = torch.rand(MEMBERS, len(drawn.state), 1, device=fitting.device) < 0.5
        weight = learns * drawn.mask
        loss = (wrong * weight).sum() / weight.sum().clamp_min(1.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        fitting.progress(update / fitting.descent.updates, f"loss {loss.item():.3f}")
    return EnsembleGrounding(ensemble.requires_grad_(False)), {"loss": loss.item()}


METHOD = Method(name="gru_ensemble", title="GRU ensemble", color="#E377C2", fit=fit, grounding=EnsembleGrounding)
