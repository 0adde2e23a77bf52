"""What methods learned about a simulator, on disk: one safetensors file with its provenance."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from astra_data.core.checkpoint import save_tensors, understood
from astra_data.core.errors import BadInputError
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.learning.networks.residual import ResidualModel, ResidualShape
from astra_data.worlds.variation import Variation

Grounding = GroundingModel | ResidualModel | Variation
"""A model that corrects each step, with latents or without, or identified parameters of the simulator."""


def save_grounding(path: Path, grounding: Grounding, episodes: PairedEpisodes) -> None:
    """Write `grounding`, fitted on `episodes`, to `path`."""
    told: dict[str, Any] = dict(episodes.named)
    if isinstance(grounding, Variation):
        told |= {"kind": "variation", "variation": grounding.model_dump()}
        save_tensors(path, {"ranges": grounding.ranges()}, told)
    elif isinstance(grounding, ResidualModel):
        told |= {"kind": "residual", "shape": asdict(grounding.shape)}
        save_tensors(path, grounding.state_dict(), told)
    else:
        told |= {"kind": "history", "shape": asdict(grounding.shape), "target": grounding.target}
        save_tensors(path, grounding.state_dict(), told)


def load_grounding(path: Path, device: str = "cpu") -> Grounding:
    """Read a grounding; the parameters of its networks are frozen.

    Raises:
        BadInputError: it is something else, or from an older version.
    """
    with understood(path, "a grounding", ("history", "residual", "variation"), device) as (tensors, told):
        if told["kind"] == "variation":
            return Variation.of_json(told["variation"])
        shape: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in told["shape"].items()
        }
        model: GroundingModel | ResidualModel
        if told["kind"] == "residual":
            model = ResidualModel(ResidualShape(**shape))
        else:
            model = GroundingModel(GroundingShape(**shape), told["target"])
        model.load_state_dict(tensors)
    return model.to(device).requires_grad_(False).eval()


def load_history_model(path: Path, device: str | torch.device = "cpu") -> GroundingModel:
    """Read a grounding that must be a history model.

    Raises:
        BadInputError: it is something else.
    """
    grounding = load_grounding(path, str(device))
    if not isinstance(grounding, GroundingModel):
        raise BadInputError(f"{path}: expected a history model, got a grounding without latents")
    return grounding
