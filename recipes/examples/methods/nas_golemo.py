"""The neural-augmented simulator of Golemo et al. (2018): an LSTM adds the residual of each simulated state.

The residual is predicted from (s_i, a_i, simulated s_{i+1}) and all steps before; sizes and activations are
those of the authors' code. Policies observe no latent, so they have a memory of their own.
"""

from dataclasses import dataclass

import torch
from torch.nn.functional import leaky_relu

from astra_data.core.config import AtOnce, Config, Count
from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive, generator
from astra_data.grounding.simulator import EpisodeSimulator, FittedGrounding
from astra_data.methods.method import Method, Table


class GolemoConfig(Config):
    epochs: Count = 5  # each update uses one whole episode
    hidden_size: AtOnce = 128
    layers: AtOnce = 3
    learning_rate: float = 1e-3


class Residual(torch.nn.Module):
    """Correct simulated next states; the memory (B, M) holds hidden and cell states of all L layers."""

    def __init__(self, states, actions, hidden, layers):
        super().__init__()
        self.sizes = states, actions, hidden, layers
        self.embedding = torch.nn.Linear(2 * states + actions, hidden)
        self.recurrence = torch.nn.LSTM(hidden, hidden, layers, batch_first=True)
        self.output = torch.nn.Linear(hidden, states)
        self.register_buffer("state_mean", torch.zeros(states))
        self.register_buffer("state_std", torch.ones(states))
        self.register_buffer("residual_std", torch.ones(states))

    def memory(self, count):
        return self.state_mean.new_zeros(count, 2 * self.sizes[3] * self.sizes[2])

    def forward(self, state, action, simulated, memory):  # (B, T, X), (B, T, A), (B, T, X), (B, M)
        normal = [(one - self.state_mean) / self.state_std for one in (state, simulated)]
        embedded = leaky_relu(self.embedding(torch.cat([normal[0], action, normal[1]], dim=-1)))
        shape = (len(memory), 2, self.sizes[3], self.sizes[2])
        hidden, cell = memory.view(shape).permute(1, 2, 0, 3).contiguous()
        outputs, after = self.recurrence(embedded, (hidden, cell))
        corrected = simulated + self.output(leaky_relu(outputs)) * self.residual_std
        return corrected, torch.stack(after).permute(2, 0, 1, 3).flatten(1)


class ResidualSimulator(EpisodeSimulator):
    """Step the simulator, add the residual, and set it there."""

    def __init__(self, simulator, model):
        super().__init__(simulator)
        self.model, self.hidden = model, model.memory(len(simulator.state))

    def start(self, state, rows, goal, *, hidden=None, **history):
        super().start(state, rows, goal)
        self.hidden[rows] = self.model.memory(len(state)) if hidden is None else hidden

    @torch.no_grad()
    def step(self, action):
        before, landed = self.state, self.simulator.step(action)
        corrected, self.hidden = self.model(before[:, None], action[:, None], landed[:, None], self.hidden)
        return self._settle(before, corrected[:, 0])

    def state_dict(self):
        return super().state_dict() | {"hidden": self.hidden}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.hidden = state["hidden"].clone()


@dataclass(frozen=True)
class ResidualGrounding(FittedGrounding):
    kind = "nas_golemo"
    start_stride = 10  # the memory before each recorded step would take 300 MB for 100 k steps

    model: Residual

    def corrected(self, simulator):
        return ResidualSimulator(simulator, self.model)

    @torch.no_grad()
    def hidden_before(self, windows, every=1):
        memory, before = self.model.memory(len(windows.state)), []
        for first in range(0, windows.state.shape[1], every):
            before.append(memory)
            steps = slice(first, first + every)
            given = (one[:, steps] for one in (windows.state, windows.action, windows.simulated_next))
            _, memory = self.model(*given, memory)
        return torch.stack(before, dim=1)

    def to_file(self):
        return self.model.state_dict(), {"sizes": self.model.sizes}

    @classmethod
    def from_file(cls, tensors, metadata, device):
        model = Residual(*metadata["sizes"])
        model.load_state_dict(tensors)
        return cls(model.to(device).requires_grad_(False))


def fit(fitting):
    """Minimize the squared error of residuals, divided by their deviation, one whole episode an update."""
    torch.manual_seed(derive(fitting.seed, "grounding"))
    config, training, windows = fitting.settings, fitting.training, fitting.training.windows
    states, actions = windows.state.shape[-1], windows.action.shape[-1]
    model = Residual(states, actions, config.hidden_size, config.layers).to(fitting.device)
    seen, missing = training.steps(windows.state), training.steps(windows.next_state - windows.simulated_next)
    model.state_mean.copy_(seen.mean(0))
    model.state_std.copy_(seen.std(0).clamp_min(1e-3))
    model.residual_std.copy_(missing.std(0).clamp_min(1e-3))

    def loss_of(given, mask):
        corrected, _ = model(given.state, given.action, given.simulated_next, model.memory(len(given.state)))
        return ((corrected - given.next_state)[mask] / model.residual_std).square().mean()

    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    for epoch in range(config.epochs):
        for episode in generator(fitting.seed, f"grounding epoch {epoch}").permutation(len(training)).tolist():
            given = training.select(torch.tensor([episode])).windows
            loss = loss_of(given, given.mask.bool())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            held_out = fitting.held_out.windows
            missed = float(loss_of(held_out, held_out.mask.bool()))
        fitting.progress((epoch + 1) / config.epochs, f"held-out loss {missed:.3f}")
    if not torch.isfinite(torch.tensor(missed)):
        raise BadInputError("the fit diverged: lower learning_rate in [user_methods.nas_golemo]")
    return ResidualGrounding(model.requires_grad_(False)), {"loss": missed}


METHOD = Method(
    name="nas_golemo",
    title="NAS (Golemo et al.)",
    color="#0072B2",
    fit=fit,
    grounding=ResidualGrounding,
    table=Table("nas_golemo", GolemoConfig),
    configures="ground",
)
