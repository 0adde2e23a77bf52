"""States of simulators without walls: any of them can be set, and any correction is taken over."""

import torch
from torch import Tensor


class FreeStates:
    """B states (B, X) in a space without obstacles.

    Attributes:
        state: (B, X) float32.
    """

    def __init__(self, state: Tensor) -> None:
        """Begin at `state` (B, X)."""
        self.state = state

    @property
    def blocked(self) -> Tensor:
        """Which states were stopped by an obstacle: none, (B,) bool."""
        return torch.zeros(len(self.state), dtype=torch.bool, device=self.state.device)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X)."""
        # New tensors, so that callers can keep earlier ones.
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` to `landed`, both (B, X); return `landed`."""
        self.reset_to(landed)
        return self.state
