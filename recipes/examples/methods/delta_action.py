"""Delta actions, as in ASAP: the simulator is given other actions than the robot, so that it moves alike.

By how much they differ is told from the history, by a GRU that is fitted through the simulator's own step. A
step without a gradient is replaced by its slope, which is measured by trying actions a little to either side.
"""

from dataclasses import dataclass

import torch
from torch.nn import GRU, Linear

from astra_data.core.config import AtOnce, Config
from astra_data.grounding.simulator import EpisodeSimulator, FittedGrounding
from astra_data.methods.method import Method, Table

NUDGE = 0.05


class DeltaConfig(Config):
    memory: AtOnce = 32
    learning_rate: float = 3e-3


class Delta(torch.nn.Module):
    """f of the states and actions so far."""

    def __init__(self, states, actions, memory):
        super().__init__()
        self.sizes = [states, actions, memory]
        self.gru, self.head = GRU(states + actions, memory, batch_first=True), Linear(memory, actions)

    def forward(self, state, action, hidden=None):  # (E, T, X), (E, T, A) -> (E, T, A)
        after, hidden = self.gru(torch.cat([state, action], dim=-1), hidden)
        return self.head(after), hidden


class DeltaSimulator(EpisodeSimulator):
    """Step the simulator by action + f(history)."""

    def __init__(self, simulator, delta):
        super().__init__(simulator)
        self.delta, count = delta, len(simulator.state)
        self.hidden = torch.zeros(1, count, delta.sizes[2], device=simulator.state.device)

    def start(self, state, rows, goal, *, hidden=None, previous_action=None):
        super().start(state, rows, goal)
        self.hidden[:, rows] = 0.0 if hidden is None else hidden

    @torch.no_grad()
    def step(self, action):
        added, self.hidden = self.delta(self.state[:, None], action[:, None], self.hidden)
        return super().step(action + added[:, 0])

    def state_dict(self):
        return super().state_dict() | {"hidden": self.hidden}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.hidden = state["hidden"].clone()


@dataclass(frozen=True)
class DeltaAction(FittedGrounding):
    kind = "delta action"
    start_stride = 10  # the memories before each recorded step would take 13 MB for 100 k steps

    delta: Delta

    def corrected(self, simulator):
        return DeltaSimulator(simulator, self.delta)

    @torch.no_grad()
    def hidden_before(self, windows, every=1):
        hidden, before = windows.state.new_zeros(1, len(windows.state), self.delta.sizes[2]), []
        for first in range(0, windows.state.shape[1], every):
            before.append(hidden[0])
            given = (one[:, first : first + every] for one in (windows.state, windows.action))
            hidden = self.delta(*given, hidden)[1]
        return torch.stack(before, dim=1)

    def to_file(self):
        return self.delta.state_dict(), {"sizes": self.delta.sizes}

    @classmethod
    def from_file(cls, tensors, metadata, device):
        delta = Delta(*metadata["sizes"])
        delta.load_state_dict(tensors)
        return cls(delta.to(device).requires_grad_(False))


def stepped(task, state, action):
    """Step simulators from states (N, X) by actions (N, A); the gradient is the simulator's, or its slope."""

    def landed(given):
        simulator = task.simulator(len(state), str(state.device))
        simulator.reset_to(state)
        return simulator.step(given)

    after = landed(action)
    if after.requires_grad:
        return after
    with torch.no_grad():
        nudges = NUDGE * torch.eye(action.shape[-1], device=action.device)
        slopes = [(landed(action + nudge) - landed(action - nudge)) / (2 * NUDGE) for nudge in nudges]
        slope = torch.stack(slopes, dim=-1)
    return after + (slope @ (action - action.detach())[..., None])[..., 0]


def fit(fitting):
    torch.manual_seed(fitting.seed)
    windows, steps, config = fitting.training.windows, fitting.training.steps, fitting.config
    delta = Delta(windows.state.shape[-1], windows.action.shape[-1], fitting.settings.memory)
    delta.to(fitting.device)
    spread = steps(windows.next_state - windows.state).std(0) + 1e-6
    optimizer = torch.optim.Adam(delta.parameters(), lr=fitting.settings.learning_rate)
    for update in range(fitting.descent.updates):
        drawn, _ = fitting.training.draw_windows(config.batch_windows, config.window)
        is_real = drawn.mask.bool()
        action = drawn.action + delta(drawn.state, drawn.action)[0]
        after = stepped(fitting.task, drawn.state[is_real], action[is_real])
        loss = ((after - drawn.next_state[is_real]) / spread).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        fitting.progress(update / fitting.descent.updates, f"loss {loss.item():.3f}")
    return DeltaAction(delta.requires_grad_(False)), {"loss": loss.item()}


METHOD = Method(
    name="delta_action",
    title="Delta action",
    color="#8C564B",
    fit=fit,
    grounding=DeltaAction,
    table=Table("delta_action", DeltaConfig),
    configures="ground",
)
