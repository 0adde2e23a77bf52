"""What a correction leaves unexplained: how large it is at a moment, and in which forms it comes.

An abstract state does not tell where in its gait a robot is, so the next one is scattered whoever predicts
it: little while the robot walks steadily, much after a change of the command, and now and then by a stumble.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from astra_data.grounding.networks.history import mlp

_MOST = 2.0
"""Of the logarithm of a scale: off the data no moment shall scatter by more than e² times the usual."""


@dataclass(frozen=True)
class ScatterShape:
    """Sizes of the scatter model.

    Attributes:
        input_size: I, of what the correction sees. state_size: X.
        forms: F, residuals that are kept to draw from.
        hidden_sizes: of the network.
    """

    input_size: int
    state_size: int
    forms: int
    hidden_sizes: tuple[int, ...] = (64, 64)


class ScatterModel(nn.Module):
    """Draw residuals of a correction: a scale told by the moment, times the form of a recorded residual.

    Attributes:
        usual: deviation of the residuals, (X,).
        forms: residuals of held-out steps in units of their scales, (F, X).
    """

    def __init__(self, shape: ScatterShape) -> None:
        super().__init__()
        self.shape = shape
        self.network = mlp((shape.input_size, *shape.hidden_sizes, shape.state_size))
        # An untrained network says that every moment is usual.
        for parameter in list(self.network.parameters())[-2:]:
            nn.init.zeros_(parameter)
        self.register_buffer("usual", torch.ones(shape.state_size))
        self.register_buffer("forms", torch.zeros(shape.forms, shape.state_size))
        self.usual: Tensor
        self.forms: Tensor

    def log_scale(self, inputs: Tensor) -> Tensor:
        """Return the logarithm of the scale (..., X), in units of the usual, given `inputs` (..., I)."""
        return _MOST * torch.tanh(self.network(inputs) / _MOST)

    def nll(self, inputs: Tensor, residual: Tensor) -> Tensor:
        """Return the negative log-likelihood (..., X), but for a constant, of residuals (..., X)."""
        log_scale = self.log_scale(inputs)
        return log_scale + 0.5 * (residual / self.usual / log_scale.exp()).square()

    def in_units(self, inputs: Tensor, residual: Tensor) -> Tensor:
        """Return residuals (..., X) in units of their scales."""
        return residual / self.usual / self.log_scale(inputs).exp()

    def draw(self, inputs: Tensor) -> Tensor:
        """Draw a residual for each of `inputs` (B, I), (B, X)."""
        forms = self.forms[torch.randint(len(self.forms), (len(inputs),), device=inputs.device)]
        return forms * self.usual * self.log_scale(inputs).exp()
