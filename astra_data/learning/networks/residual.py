"""The residual model of the neural-augmented simulator (Golemo et al. 2018): an LSTM that corrects steps.

Its sizes and activations are those of the authors' public code.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from astra_data.core.numbers import normalized


@dataclass(frozen=True)
class ResidualShape:
    """Sizes of the network.

    Attributes:
        state_size: X. action_size: A. hidden_size: of each layer of the LSTM. layers: of the LSTM, L.
    """

    state_size: int
    action_size: int
    hidden_size: int = 128
    layers: int = 3

    @property
    def memory_size(self) -> int:
        """M: hidden and cell states of all layers."""
        return 2 * self.layers * self.hidden_size


class ResidualModel(nn.Module):
    """Predict the error of a simulator's next state, from (s_i, a_i, simulated s_{i+1}) and all steps before.

    The memory (B, M) is an argument and a result, never kept. Scales are buffers, so checkpoints hold them;
    `set_scales` takes them from the training episodes.
    """

    def __init__(self, shape: ResidualShape) -> None:
        super().__init__()
        self.shape = shape
        states, hidden = shape.state_size, shape.hidden_size
        self.embedding = nn.Linear(2 * states + shape.action_size, hidden)
        self.recurrence = nn.LSTM(hidden, hidden, shape.layers, batch_first=True)
        self.output = nn.Linear(hidden, states)
        self.register_buffer("state_mean", torch.zeros(states))
        self.register_buffer("state_std", torch.ones(states))
        self.register_buffer("correction_std", torch.ones(states))
        self.register_buffer("residual_factor", torch.zeros(states, states))
        self.state_mean: Tensor
        self.state_std: Tensor
        self.correction_std: Tensor
        self.residual_factor: Tensor

    def set_scales(self, state: Tensor, correction: Tensor) -> None:
        """Take means and deviations from training steps: of states and of the simulator's errors, (N, X)."""
        self.state_mean.copy_(state.mean(0))
        self.state_std.copy_(state.std(0).clamp_min(1e-3))
        self.correction_std.copy_(correction.std(0).clamp_min(1e-3))

    def initial_memory(self, count: int) -> Tensor:
        """Return the memory (count, M) at the start of an episode."""
        return self.state_mean.new_zeros(count, self.shape.memory_size)

    def correct(
        self, state: Tensor, action: Tensor, simulated_next: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the corrected next states (B, T, X) and the memory (B, M) after the last of them.

        Args:
            state: s_i, (B, T, X).
            action: a_i, (B, T, A).
            simulated_next: where the simulator landed from there, (B, T, X).
            memory: before the first step, (B, M).
        """
        normal = [normalized(one, self.state_mean, self.state_std) for one in (state, simulated_next)]
        embedded = functional.leaky_relu(self.embedding(torch.cat([normal[0], action, normal[1]], dim=-1)))
        shape = (len(memory), 2, self.shape.layers, self.shape.hidden_size)
        hidden, cell = memory.view(shape).permute(1, 2, 0, 3).contiguous()
        outputs, after = self.recurrence(embedded, (hidden, cell))
        correction = self.output(functional.leaky_relu(outputs)) * self.correction_std
        return simulated_next + correction, torch.stack(after).permute(2, 0, 1, 3).flatten(1)
