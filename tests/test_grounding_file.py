from pathlib import Path

import torch

from astra_data.checkpoint import load_tensors
from astra_data.dataset.pairs import PairedEpisodes
from astra_data.grounding_file import load_grounding, load_history_model, save_grounding
from astra_data.models.grounding import GroundingModel, GroundingShape, Windows
from astra_data.models.residual import ResidualModel, ResidualShape


def no_episodes() -> PairedEpisodes:
    empty = torch.zeros(1, 1)
    return PairedEpisodes(empty, empty, empty.bool(), Windows(*[empty] * 9), "toy@data-1.0.0", "abc")


def test_a_grounding_comes_back_frozen(tmp_path: Path) -> None:
    shape = GroundingShape(4, 2, 2, latent_size=8, head_sizes=(16, 8), position_octaves=2)
    model = GroundingModel(shape, "detach")
    model.set_scales({"state": torch.randn(50, 4), "reward": torch.randn(50, 1)})
    episodes = no_episodes()
    path = tmp_path / "grounding.safetensors"
    save_grounding(path, model, episodes)
    loaded = load_history_model(path)
    assert (loaded.shape, loaded.target) == (shape, "detach")
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    latent, action, state = torch.randn(3, 8), torch.randn(3, 2), torch.randn(3, 4)
    assert torch.equal(loaded.correct(latent, action, state), model.correct(latent, action, state))
    assert torch.equal(loaded.predict_reward(latent, action), model.predict_reward(latent, action))
    _, told = load_tensors(path)
    assert (told["dataset"], told["hash"]) == ("toy@data-1.0.0", "abc")


def test_a_residual_model_comes_back_frozen(tmp_path: Path) -> None:
    model = ResidualModel(ResidualShape(4, 2, hidden_size=8, layers=2))
    model.set_scales(torch.randn(50, 4), torch.randn(50, 4))
    episodes = no_episodes()
    path = tmp_path / "grounding.safetensors"
    save_grounding(path, model, episodes)
    loaded = load_grounding(path)
    assert isinstance(loaded, ResidualModel)
    assert loaded.shape == model.shape
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    given = torch.randn(3, 5, 4), torch.randn(3, 5, 2), torch.randn(3, 5, 4), model.initial_memory(3)
    # Not to the bit: torch's LSTM rounds differently in training.
    for ours, theirs in zip(model.correct(*given), loaded.correct(*given), strict=True):
        torch.testing.assert_close(ours, theirs)
