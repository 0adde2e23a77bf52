"""The interface of groundings: corrections of a simulator that a method has learned."""

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self

from torch import Tensor

from astra_data.grounding.networks.history import LatentEncoder
from astra_data.grounding.networks.paired_windows import PairedWindows
from astra_data.grounding.simulator import EpisodeSimulator, abstract_simulator
from astra_data.worlds.protocols import PlacedSimulator
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation


class Grounding(Protocol):
    """How an abstract simulator is corrected, if it is.

    Attributes:
        start_stride: recorded steps between those that episodes may start from.
    """

    start_stride: ClassVar[int] = 1

    @property
    def encoder(self) -> LatentEncoder | None:
        """The source encoder ψ^s, whose latents policies observe; None where there are none."""
        return None

    def corrected(self, simulator: PlacedSimulator) -> EpisodeSimulator:
        """Wrap `simulator` in the correction."""
        return EpisodeSimulator(simulator)

    def simulator(
        self, task: Task, num_envs: int, device: str = "cpu", *, variation: Variation | None = None
    ) -> EpisodeSimulator:
        """Build `num_envs` abstract simulators of `task`, corrected.

        Args:
            task: the task.
            num_envs: B.
            device: torch device.
            variation: ranges of the simulator's parameters, unless the grounding has its own.
        """
        return self.corrected(abstract_simulator(task, num_envs, device, variation))

    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor | None:
        """Return its memory before each `every`-th step, (E, ceil(T / every), H); None if it has none.

        Histories begin where `windows` (E, T, ...) do.
        """
        return None

    def for_replay(self) -> "Grounding":
        """Return the grounding to replay recorded actions with: without noise of sensors and actions."""
        return self


class FittedGrounding(Grounding, Protocol):
    """A grounding that was fitted to pairs, and can be saved.

    Attributes:
        kind: names the class in files; see `files.KINDS`.
    """

    kind: ClassVar[str]

    def to_file(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        """Return tensors, at least one, and metadata (JSON values) from which `from_file` rebuilds it."""
        ...

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Rebuild it on `device`, with frozen parameters.

        Raises:
            KeyError, TypeError, ValueError, RuntimeError: something is missing or of another shape.
        """
        ...
