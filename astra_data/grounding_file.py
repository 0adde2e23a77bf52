"""Grounding models on disk: one safetensors file that carries weights, shape, scales and provenance."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from astra_data.checkpoint import load_tensors, save_tensors
from astra_data.dataset.pairs import PairedEpisodes
from astra_data.models.grounding import GroundingModel, GroundingShape


def save_grounding(path: Path, model: GroundingModel, episodes: PairedEpisodes) -> None:
    """Write `model`, fitted on `episodes`, to `path`."""
    told = {
        "shape": asdict(model.shape),
        "target": model.target,
        "dataset": episodes.reference,
        "hash": episodes.content_hash,
    }
    save_tensors(path, model.state_dict(), told)


def load_grounding(path: Path, device: str = "cpu") -> GroundingModel:
    """Read a grounding model; its parameters are frozen."""
    tensors, told = load_tensors(path)
    shape: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in told["shape"].items()
    }
    model = GroundingModel(GroundingShape(**shape), told["target"])
    model.load_state_dict(tensors)
    return model.to(device).requires_grad_(False).eval()
