"""An abstract simulator of a batched NumPy function."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.worlds.free_states import FreeStates


class NumpySimulator(FreeStates):
    """B abstract states that a NumPy function steps; `partial` makes of it what builds B of them.

    Attributes:
        state: (B, X) float32.
        parameters: what a dataset paired with it records about it.

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from astra_data.worlds.numpy_simulator import NumpySimulator
        >>> def drive(state, command):
        ...     return state + 0.1 * command
        >>> make_simulator = partial(NumpySimulator, function=drive, size=2)
        >>> make_simulator(3).step(torch.ones(3, 2)).shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        num_envs: int,
        *,
        function: Callable[[Floats, Floats], NDArray[np.floating[Any]]],
        size: int,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        """Begin with B states of zeros.

        Args:
            num_envs: B.
            function: maps states (B, X) and commands (B, A), both float64, to the next states (B, X).
            size: of a state, X.
            parameters: numbers or texts about it, by default none.
        """
        super().__init__(torch.zeros(num_envs, size))
        self._function = function
        self.parameters: dict[str, float] = dict(parameters or {})

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, A); return the new states (B, X)."""
        landed = self._function(self.state.double().numpy(), action.double().numpy())
        self.state = torch.from_numpy(np.array(landed, dtype=np.float32))
        return self.state
