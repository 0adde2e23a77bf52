"""A fitted parameter model, as identification tools have it: commands act late, slowly, by a gain and an offset.

Of each command a gain, an offset and a first-order lag, and one delay of whole steps for all, by least squares
on where the simulator is after up to ten of its own steps. Nothing else of the simulator is changed.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares

from astra_data.core.config import AtOnce, Config
from astra_data.grounding.paired_episodes import draw_steps
from astra_data.grounding.simulator import EpisodeSimulator, FittedGrounding
from astra_data.methods.method import Method, Table

NUDGE = 0.02


class ParameterConfig(Config):
    windows: AtOnce = 400
    window: AtOnce = 10  # steps
    longest_delay: AtOnce = 5  # steps


@dataclass(frozen=True)
class Response:
    """A sent action (..., A) becomes felt + share * (gain * delayed + offset - felt); still: no command, (A,)."""

    gain: torch.Tensor
    offset: torch.Tensor
    share: torch.Tensor  # 1 without a lag, 1 - exp(-step / time constant) with one
    still: torch.Tensor
    delay: int

    def initial(self, count):  # (B, M): the last `delay` actions, the newest first, and what is felt
        return self.still.repeat(count, self.delay + 1)

    def act(self, memory, action):  # (B, M), (B, A) -> what the simulator is given, (B, A), and memory
        size = action.shape[-1]
        sent = torch.cat([action, memory[:, : self.delay * size]], dim=-1)
        felt = memory[:, self.delay * size :]
        felt = felt + self.share * (self.gain * sent[:, self.delay * size :] + self.offset - felt)
        return felt, torch.cat([sent[:, : self.delay * size], felt], dim=-1)

    def sequence(self, action):  # (E, T, A) -> what is given in each step, and memory before it, (E, T, M)
        memory, given, before = self.initial(len(action)), [], []
        for now in action.unbind(1):
            before.append(memory)
            felt, memory = self.act(memory, now)
            given.append(felt)
        return torch.stack(given, dim=1), torch.stack(before, dim=1)


class ParameterSimulator(EpisodeSimulator):
    def __init__(self, simulator, response):
        super().__init__(simulator)
        self.response, self.memory = response, response.initial(len(simulator.state))

    def start(self, state, rows, goal, *, hidden=None, previous_action=None):
        super().start(state, rows, goal)
        self.memory[rows] = self.response.initial(len(rows)) if hidden is None else hidden

    @torch.no_grad()
    def step(self, action):
        felt, self.memory = self.response.act(self.memory, action)
        return super().step(felt)

    def state_dict(self):
        return super().state_dict() | {"response": self.memory}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.memory = state["response"].clone()


@dataclass(frozen=True)
class FittedParameters(FittedGrounding):
    kind = "fitted parameters"

    response: Response

    def corrected(self, simulator):
        return ParameterSimulator(simulator, self.response)

    def hidden_before(self, windows, every=1):
        return self.response.sequence(windows.action)[1][:, ::every]

    def to_file(self):
        tensors = {name: getattr(self.response, name) for name in ("gain", "offset", "share", "still")}
        return tensors, {"delay": self.response.delay}

    @classmethod
    def from_file(cls, tensors, metadata, device):
        return cls(Response(**{name: values.to(device) for name, values in tensors.items()}, delay=metadata["delay"]))


@torch.no_grad()
def fit(fitting):
    torch.manual_seed(fitting.seed)
    windows, lengths, config = fitting.training.windows, fitting.training.lengths, fitting.settings
    drawn, device, size = draw_steps(lengths, config.windows, config.window), fitting.device, windows.action.shape[-1]
    episode, steps, _ = drawn
    spread = fitting.training.steps(windows.next_state - windows.state).std(0)
    moves = spread > 1e-6
    still = fitting.task.limits.normal(torch.zeros(size, device=device)).clamp(-1.0, 1.0)
    simulator = fitting.task.simulator(len(steps), device)

    def response_of(values, delay):
        gain, offset, share = torch.tensor(values, dtype=torch.float32, device=device).view(3, size)
        return Response(gain, offset, share, still, delay)

    def errors(values, delay):
        given = response_of(values, delay).sequence(windows.action)[0][episode, steps]
        simulator.reset_to(windows.state[episode[:, 0], steps[:, 0]])
        wrong = []
        for number, action in enumerate(given.unbind(1)):
            after = simulator.step(action)
            wrong.append((after - windows.next_state[episode[:, 0], steps[:, number]])[:, moves] / spread[moves])
        return torch.stack(wrong).flatten().double().numpy(force=True)

    def slopes(values, delay):
        here, found = errors(values, delay), []
        for index, value in enumerate(values):
            nudge = -NUDGE if value + NUDGE > highest[index] else NUDGE
            moved = np.array(values)
            moved[index] += nudge
            found.append((errors(moved, delay) - here) / nudge)
        return np.stack(found, axis=1)

    lowest, highest = np.repeat([-3.0, -1.0, 0.02], size), np.repeat([3.0, 1.0, 1.0], size)
    begin, best = np.repeat([1.0, 0.0, 0.9], size), None
    for delay in range(config.longest_delay + 1):
        found = least_squares(errors, begin, slopes, (lowest, highest), x_scale=0.1, max_nfev=20, args=(delay,))
        if best is None or found.cost < best[0]:
            best = found.cost, found.x, delay
        fitting.progress((delay + 1) / (config.longest_delay + 1), f"delay of {delay} steps: {found.cost:.4g}")
    cost, values, delay = best
    names = ("gain", "offset", "share")
    metrics = {name: part.tolist() for name, part in zip(names, np.reshape(values, (3, size)), strict=True)}
    return FittedParameters(response_of(values, delay)), {"cost": cost, "delay": delay, **metrics}


METHOD = Method(
    name="parameters",
    title="Fitted parameters",
    color="#7F7F7F",
    fit=fit,
    grounding=FittedParameters,
    table=Table("parameters", ParameterConfig),
    configures="ground",
)
