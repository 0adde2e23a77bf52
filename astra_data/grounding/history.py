"""A grounding by a history model: each step is corrected given a latent of the history (Algorithm 2)."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn import functional

from astra_data.core.checkpoint import as_part, loaded, part_of
from astra_data.grounding.grounded_simulator import GroundedSimulator
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import FittedGrounding
from astra_data.learning.networks.failure import FailureModel, FailureShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.learning.networks.scatter import ScatterModel, ScatterShape
from astra_data.worlds.objective import Objective
from astra_data.worlds.protocols import PlacedSimulator

_FAILURES, _MEMBERS, _SCATTER = "failures", "members", "scatter"
"""Of the tensors and sizes of a failure model, of members, and of a scatter model, in files."""


@dataclass(frozen=True)
class HistoryGrounding(FittedGrounding):
    """Correct each step by a history model, whose latents policies observe.

    Attributes:
        model: fitted to all training episodes. failures: the failure model, if there is one.
        members: models that were fitted to other draws of the episodes, and correct in its place.
        clearance_m: how close to walls corrections may end; None for as close as the simulator itself.
        scatter_model: the model of the target's scatter around the correction, if one was fitted.
    """

    kind: ClassVar[str] = "history"

    model: GroundingModel
    failures: FailureModel | None = None
    members: tuple[GroundingModel, ...] = ()
    clearance_m: float | None = None
    scatter_model: ScatterModel | None = None

    @property
    def encoder(self) -> GroundingModel:
        """The model, whose encoder is ψ^s."""
        return self.model

    def reduced(self, *, members: bool, failures: bool) -> "HistoryGrounding":
        """Return the grounding without what is not asked for."""
        return replace(
            self, failures=self.failures if failures else None, members=self.members if members else ()
        )

    def foreseeing(self, objective: Objective) -> "HistoryGrounding":
        """Return the grounding for a failure model to tell failures in.

        Where touching a wall is one, corrections end as close to walls as the simulator itself: within the
        recorded clearance the robot mostly touched nothing, and whoever ended episodes there would fail it
        several times too often.
        """
        return replace(self, clearance_m=None) if objective.ends_at_walls else self

    def for_replay(self) -> "HistoryGrounding":
        """Return the model alone."""
        return replace(self.reduced(members=False, failures=False), scatter_model=None)

    def corrected(self, simulator: PlacedSimulator, scatter: Tensor | None) -> GroundedSimulator:
        """Wrap `simulator`; see `Grounding.corrected`."""
        return GroundedSimulator(
            simulator,
            self.model,
            scatter=scatter,
            failures=self.failures,
            members=self.members,
            clearance_m=self.clearance_m,
            scatter_model=self.scatter_model,
        )

    @torch.no_grad()
    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor:
        """Return what is remembered before each `every`-th step, (E, ceil(T / every), H).

        That is the hidden state of the model's encoder and of each member's; a failure model looks at nothing
        but the simulation.
        """
        after = torch.cat([model.encode(windows)[1] for model in (self.model, *self.members)], dim=-1)
        return functional.pad(after[:, :-1], (0, 0, 1, 0))[:, ::every]

    def scatter(self, episodes: PairedEpisodes) -> Tensor:
        """Return the factor (X, X) of the scatter around the correction, as fitted on held-out episodes."""
        return self.model.residual_factor

    def to_file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return weights and sizes."""
        tensors = self.model.state_dict()
        metadata: dict[str, Any] = {"shape": asdict(self.model.shape), "target": self.model.target}
        for part, model in ((_FAILURES, self.failures), (_SCATTER, self.scatter_model)):
            if model is not None:
                tensors |= as_part(model.state_dict(), part)
                metadata[part] = asdict(model.shape)
        if self.clearance_m is not None:
            metadata["clearance_m"] = self.clearance_m
        if self.members:
            metadata[_MEMBERS] = len(self.members)
        for number, member in enumerate(self.members):
            tensors |= as_part(member.state_dict(), f"{_MEMBERS}.{number}")
        return tensors, metadata

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Read what `to_file` returned."""
        prefixes = f"{_FAILURES}.", f"{_MEMBERS}.", f"{_SCATTER}."
        own = {name: one for name, one in tensors.items() if not name.startswith(prefixes)}
        shape, failures, scatter_model = GroundingShape(**_tuples(metadata["shape"])), None, None
        if _FAILURES in metadata:
            failures = FailureModel(FailureShape(**_tuples(metadata[_FAILURES])))
            failures = loaded(failures, part_of(tensors, _FAILURES), device)
        if _SCATTER in metadata:
            scatter_model = ScatterModel(ScatterShape(**_tuples(metadata[_SCATTER])))
            scatter_model = loaded(scatter_model, part_of(tensors, _SCATTER), device)
        others = [part_of(tensors, f"{_MEMBERS}.{number}") for number in range(metadata.get(_MEMBERS, 0))]
        model, *members = (
            loaded(GroundingModel(shape, metadata["target"]), weights, device) for weights in (own, *others)
        )
        return cls(model, failures, tuple(members), metadata.get("clearance_m"), scatter_model)


def _tuples(shape: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sizes of a shape as they were before JSON made lists of tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in shape.items()}
