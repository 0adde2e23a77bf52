"""A grounding by a history model: each step is corrected given a latent of the history (Algorithm 2)."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn import functional

from astra_data.core.checkpoint import as_part, loaded, part_of
from astra_data.grounding.grounded_simulator import GroundedSimulator
from astra_data.grounding.networks.failure import FailureModel, FailureShape
from astra_data.grounding.networks.grounding import GroundingModel, GroundingShape
from astra_data.grounding.networks.paired_windows import PairedWindows
from astra_data.grounding.networks.scatter import ScatterModel, ScatterShape
from astra_data.grounding.protocols import FittedGrounding
from astra_data.worlds.protocols import PlacedSimulator

_FAILURES, _SCATTER = "failures", "scatter"
"""Prefixes of the tensors and sizes of a failure model and of a scatter model in files."""


@dataclass(frozen=True)
class HistoryGrounding(FittedGrounding):
    """Correct each step by a history model, whose latents policies observe.

    Attributes:
        model: fitted to all training episodes. failures: the failure model, if there is one.
        clearance_m: how close to walls corrections may end; None for as close as the simulator itself.
        fails_at_walls: whether touching a wall is a failure. Then the correction touches it, not the scatter,
            which holds the errors of where the robot was believed to be.
        scatter_model: the model of the target's scatter around the correction, if one was fitted.
    """

    kind: ClassVar[str] = "history"

    model: GroundingModel
    failures: FailureModel | None = None
    clearance_m: float | None = None
    scatter_model: ScatterModel | None = None
    fails_at_walls: bool = False

    @property
    def encoder(self) -> GroundingModel:
        """The model, whose encoder is ψ^s."""
        return self.model

    def for_replay(self) -> "HistoryGrounding":
        """Return the model alone."""
        return replace(self, failures=None, scatter_model=None)

    def corrected(self, simulator: PlacedSimulator) -> GroundedSimulator:
        """Wrap `simulator`; see `Grounding.corrected`."""
        return GroundedSimulator(
            simulator,
            self.model,
            self.failures,
            self.scatter_model,
            clearance_m=self.clearance_m,
            fails_at_walls=self.fails_at_walls,
        )

    @torch.no_grad()
    def hidden_before(self, windows: PairedWindows, every: int = 1) -> Tensor:
        """Return the encoder's hidden state before each `every`-th step, (E, ceil(T / every), H)."""
        _, after = self.model.encode(windows)
        return functional.pad(after[:, :-1], (0, 0, 1, 0))[:, ::every]

    def to_file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return weights and sizes."""
        tensors = self.model.state_dict()
        metadata: dict[str, Any] = {
            "shape": asdict(self.model.shape),
            "fails_at_walls": self.fails_at_walls,
        }
        for part, model in ((_FAILURES, self.failures), (_SCATTER, self.scatter_model)):
            if model is not None:
                tensors |= as_part(model.state_dict(), part)
                metadata[part] = asdict(model.shape)
        if self.clearance_m is not None:
            metadata["clearance_m"] = self.clearance_m
        return tensors, metadata

    @classmethod
    def from_file(cls, tensors: dict[str, Tensor], metadata: Mapping[str, Any], device: str) -> Self:
        """Read what `to_file` returned."""
        prefixes = f"{_FAILURES}.", f"{_SCATTER}."
        own = {name: one for name, one in tensors.items() if not name.startswith(prefixes)}
        shape, failures, scatter_model = GroundingShape(**_tuples(metadata["shape"])), None, None
        if _FAILURES in metadata:
            failures = FailureModel(FailureShape(**_tuples(metadata[_FAILURES])))
            failures = loaded(failures, part_of(tensors, _FAILURES), device)
        if _SCATTER in metadata:
            scatter_model = ScatterModel(ScatterShape(**_tuples(metadata[_SCATTER])))
            scatter_model = loaded(scatter_model, part_of(tensors, _SCATTER), device)
        model = loaded(GroundingModel(shape), own, device)
        clearance_m, fails_at_walls = metadata.get("clearance_m"), metadata["fails_at_walls"]
        return cls(model, failures, clearance_m, scatter_model, fails_at_walls)


def _tuples(shape: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sizes of a shape as they were before JSON made lists of tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in shape.items()}
