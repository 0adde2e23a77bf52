from pathlib import Path

import torch

from astra_data.models.alignment import TargetEncoder
from astra_data.target_encoder_file import load_target_encoder, save_target_encoder


def test_a_target_encoder_comes_back_frozen(tmp_path: Path) -> None:
    encoder = TargetEncoder(29, 2, 3, embedding_size=16, latent_size=8)
    state, goal, action = torch.randn(5, 29), torch.randn(5, 2), torch.randn(5, 3)
    encoder.set_scales(3 * state, goal)
    save_target_encoder(tmp_path / "encoder.safetensors", encoder)
    loaded = load_target_encoder(tmp_path / "encoder.safetensors")
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    inputs = loaded.encoder_input(state, goal, action)
    assert torch.equal(inputs, encoder.encoder_input(state, goal, action))
    assert torch.equal(loaded.encoder(inputs[None])[0], encoder.encoder(inputs[None])[0])
