"""What abstract simulators without walls have in common: states that can be set and corrected at will."""

import torch
from torch import Tensor


class FreeStates:
    """B states (B, X) that nothing stops.

    Attributes:
        state: (B, X) float32.
    """

    def __init__(self, state: Tensor) -> None:
        """Begin at `state` (B, X)."""
        self.state = state

    @property
    def blocked(self) -> Tensor:
        """Which states were stopped at the edge of the free space: none, (B,) bool."""
        return torch.zeros(len(self.state), dtype=torch.bool, device=self.state.device)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X)."""
        # New tensors, so that those handed out earlier stay as they were.
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` to `landed`, both (B, X); return where that is (B, X)."""
        self.reset_to(landed)
        return self.state
