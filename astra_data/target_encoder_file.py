"""Target encoders on disk."""

from pathlib import Path

from astra_data.checkpoint import load_tensors, save_tensors
from astra_data.models.alignment import TargetEncoder


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
    save_tensors(path, encoder.state_dict(), sizes)


def load_target_encoder(path: Path, device: str = "cpu") -> TargetEncoder:
    """Read a target encoder; its parameters are frozen."""
    tensors, sizes = load_tensors(path)
    encoder = TargetEncoder(**sizes)
    encoder.load_state_dict(tensors)
    return encoder.to(device).requires_grad_(False).eval()
