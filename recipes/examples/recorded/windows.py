"""Two methods that correct a simulator's step from a window of the last steps, fitted to single steps.

`RIDGE` is linear, in closed form; `NETWORK` corrects what it leaves, by a network of two hidden layers. Both
see neither positions nor headings: what is learned holds anywhere.
"""

from dataclasses import dataclass
from functools import partial

import torch

from astra_data.grounding.simulator import EpisodeSimulator, FittedGrounding
from astra_data.methods.method import Method

STEPS, PENALTY, HIDDEN = 5, 1e-3, 64


class Window(torch.nn.Module):
    """The correction (B, X) of a step from what the window, the present state and the action say."""

    def __init__(self, seen, actions, states, is_network):
        super().__init__()
        self.sizes, self.is_network = [seen, actions, states], is_network
        self.memory = STEPS * (len(seen) + actions)
        inputs = self.memory + 2 * len(seen) + actions
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("std", torch.ones(inputs))
        self.register_buffer("error", torch.ones(states))
        self.linear = torch.nn.Linear(inputs, states)
        self.network = torch.nn.Sequential(
            *(torch.nn.Linear(inputs, HIDDEN), torch.nn.Tanh(), torch.nn.Linear(HIDDEN, HIDDEN)),
            *(torch.nn.Tanh(), torch.nn.Linear(HIDDEN, states)),
        )
        torch.nn.init.zeros_(self.network[-1].weight)
        torch.nn.init.zeros_(self.network[-1].bias)

    def remembered(self, memory, state, action):  # (..., M) after a step from `state` by `action`
        here = torch.cat([state[..., self.sizes[0]], action], dim=-1)
        return torch.cat([memory[..., here.shape[-1] :], here], dim=-1)

    def inputs(self, memory, state, action, landed):
        seen = self.sizes[0]
        return torch.cat([memory, state[..., seen], action, landed[..., seen]], dim=-1)

    def forward(self, inputs):
        inputs = (inputs - self.mean) / self.std
        correction = self.linear(inputs)
        return self.error * (correction + self.network(inputs) if self.is_network else correction)


class WindowSimulator(EpisodeSimulator):
    def __init__(self, simulator, window):
        super().__init__(simulator)
        self.window = window
        self.memory = simulator.state.new_zeros(len(simulator.state), window.memory)

    def start(self, state, rows, goal, *, hidden=None, previous_action=None):
        super().start(state, rows, goal)
        self.memory[rows] = 0.0 if hidden is None else hidden

    @torch.no_grad()
    def step(self, action):
        before = self.state
        landed = self.simulator.step(action)
        corrected = landed + self.window(self.window.inputs(self.memory, before, action, landed))
        self.memory = self.window.remembered(self.memory, before, action)
        return self._settle(before, corrected)

    def state_dict(self):
        return super().state_dict() | {"window": self.memory}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.memory = state["window"].clone()


@dataclass(frozen=True)
class WindowGrounding(FittedGrounding):
    kind = "window"

    window: Window

    def corrected(self, simulator):
        return WindowSimulator(simulator, self.window)

    def hidden_before(self, windows, every=1):
        memory = [windows.state.new_zeros(len(windows.state), self.window.memory)]
        for state, action in zip(windows.state.unbind(1), windows.action.unbind(1), strict=True):
            memory.append(self.window.remembered(memory[-1], state, action))
        return torch.stack(memory[:-1], dim=1)[:, ::every]

    def to_file(self):
        return self.window.state_dict(), {"sizes": self.window.sizes, "is_network": self.window.is_network}

    @classmethod
    def from_file(cls, tensors, metadata, device):
        window = Window(*metadata["sizes"], metadata["is_network"])
        window.load_state_dict(tensors)
        return cls(window.to(device).requires_grad_(False))


def fit(fitting, is_network):
    torch.manual_seed(fitting.seed)
    episodes, windows = fitting.training, fitting.training.windows
    roles = dict.fromkeys(range(windows.state.shape[-1]), "invariant")
    for role, group in fitting.task.abstract_state.roles:
        roles |= dict.fromkeys(range(group.start, group.stop), role)
    seen = [index for index, role in roles.items() if role == "invariant"]
    window = Window(seen, windows.action.shape[-1], len(roles), is_network).to(fitting.device)
    memory = WindowGrounding(window).hidden_before(windows)
    inputs = episodes.steps(window.inputs(memory, windows.state, windows.action, windows.simulated_next))
    error = episodes.steps(windows.next_state - windows.simulated_next)
    window.mean, window.std = inputs.mean(0), inputs.std(0).clamp_min(1e-3)
    window.error = error.std(0).clamp_min(1e-6)
    scaled = torch.cat([(inputs - window.mean) / window.std, torch.ones_like(inputs[:, :1])], -1).double()
    penalty = PENALTY * len(scaled) * torch.eye(scaled.shape[1], dtype=torch.float64, device=scaled.device)
    solved = torch.linalg.solve(scaled.T @ scaled + penalty, scaled.T @ (error / window.error).double())
    with torch.no_grad():
        window.linear.weight.copy_(solved[:-1].T)
        window.linear.bias.copy_(solved[-1])
    optimizer = torch.optim.AdamW(window.network.parameters(), lr=1e-3, weight_decay=0.1)
    for update in range(fitting.descent.updates if is_network else 0):
        rows = torch.randint(len(inputs), (256,), device=fitting.device)
        loss = ((window(inputs[rows]) - error[rows]) / window.error).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        fitting.progress(update / fitting.descent.updates, f"loss {loss.item():.3f}")
    return WindowGrounding(window.requires_grad_(False)), {"steps": len(inputs)}


fit_ridge, fit_network = (partial(fit, is_network=is_network) for is_network in (False, True))
RIDGE = Method(name="ridge", title="Ridge regression", color="#8C564B", fit=fit_ridge, grounding=WindowGrounding)
NETWORK = Method(
    name="network", title="Network of one step", color="#E377C2", fit=fit_network, grounding=WindowGrounding
)
