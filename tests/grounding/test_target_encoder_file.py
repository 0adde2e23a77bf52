from pathlib import Path

import pytest
import torch

from astra_data.core.checkpoint import load_tensors, save_tensors
from astra_data.core.errors import BadInputError
from astra_data.grounding.target_encoder_file import load_target_encoder, save_target_encoder
from astra_data.learning.networks.alignment import TargetEncoder


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


@pytest.mark.parametrize(
    ("missing", "message"),
    [("kind", r"\(kind target encoder\), found a file without a kind"), ("sizes", "found no 'sizes'")],
)
def test_what_is_no_target_encoder_is_refused(missing: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "encoder.safetensors"
    save_target_encoder(path, TargetEncoder(29, 2, 3, embedding_size=16, latent_size=8))
    tensors, told = load_tensors(path)
    del told[missing]
    save_tensors(path, tensors, told)
    with pytest.raises(BadInputError, match=f"expected a target encoder .*{message}"):
        load_target_encoder(path)
