"""Target encoders on disk."""

from pathlib import Path

from astra_data.core.checkpoint import save_tensors, understood
from astra_data.learning.networks.alignment import TargetEncoder

_KIND = "target encoder"


def save_target_encoder(path: Path, encoder: TargetEncoder) -> None:
    """Write `encoder` to `path`."""
    embedding = encoder.encoder.embedding
    states, goals = len(encoder.state_mean), len(encoder.goal_mean)
    waves = encoder.position_features.size
    sizes = {
        "state_size": states,
        "goal_size": goals,
        "action_size": embedding.in_features - states - waves - goals,
        "embedding_size": embedding.out_features,
        "latent_size": encoder.encoder.latent_size,
        "position_octaves": waves // 4,
    }
    save_tensors(path, encoder.state_dict(), {"kind": _KIND, "sizes": sizes})


def load_target_encoder(path: Path, device: str = "cpu") -> TargetEncoder:
    """Read a target encoder; its parameters are frozen.

    Raises:
        BadInputError: it is something else, or from an older version.
    """
    with understood(path, "a target encoder", (_KIND,), device) as (tensors, told):
        encoder = TargetEncoder(**told["sizes"])
        encoder.load_state_dict(tensors)
    return encoder.to(device).requires_grad_(False).eval()
