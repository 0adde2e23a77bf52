"""A grounding by identified parameters: the abstract simulator with other ranges of its parameters."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from torch import Tensor

from astra_data.grounding.raw import NoGrounding
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation


@dataclass(frozen=True)
class IdentifiedParameters(NoGrounding):
    """Draw the simulator's parameters from the ranges of `variation` for each episode.

    Its scatter is that around the raw simulator, whose next states the pairs hold.
    """

    kind: ClassVar[str] = "variation"

    variation: Variation

    def simulator(
        self,
        task: Task,
        num_envs: int,
        device: str = "cpu",
        *,
        variation: Variation | None = None,
        scatter: Tensor | None = None,
    ) -> EpisodeSimulator:
        """Build `num_envs` simulators with the identified ranges, in place of those of `variation`."""
        return super().simulator(task, num_envs, device, variation=self.variation, scatter=scatter)

    def for_replay(self) -> "IdentifiedParameters":
        """Return the same ranges without noise of sensors and actions."""
        return IdentifiedParameters(self.variation.noiseless())

    def to_file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the ranges twice: as a tensor (P, 2), and by name."""
        return {"ranges": self.variation.ranges()}, {"variation": self.variation.model_dump()}

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Read what `to_file` returned."""
        return cls(Variation.of_json(metadata["variation"]))
