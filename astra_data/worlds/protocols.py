"""What the toolkit needs of an abstract simulator."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from torch import Tensor


class SteppedSimulator(Protocol):
    """B abstract states that can be set and stepped."""

    @property
    def state(self) -> Tensor:
        """The present states, (B, X) float32."""
        ...

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set `rows` (n,), by default all, to `state` (n, X)."""
        ...

    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the new states (B, X)."""
        ...


class PlacedSimulator(SteppedSimulator, Protocol):
    """B abstract states that something else may put where the simulator itself would not have taken them."""

    @property
    def blocked(self) -> Tensor:
        """Which states (B,) were stopped at the edge of the free space in the last step, bool."""
        ...

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` as far towards `landed`, both (B, X), as there is room; return where (B, X)."""
        ...


@runtime_checkable
class RememberingSimulator(Protocol):
    """A simulator whose next steps depend on more than its states."""

    memory: Tensor
    """What they depend on besides, (B, M); `reset_to` and `settle` forget what was."""


class AbstractSimulator(SteppedSimulator, Protocol):
    """A simulator that datasets can be paired with; bring your own by writing these four."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """What a dataset paired with this simulator records about it."""
        ...


class PairedSimulator(PlacedSimulator, AbstractSimulator, Protocol):
    """The abstract simulator of a task."""
