from pathlib import Path

import pytest
import torch
from toy_episodes import no_episodes

from astra_data.core.checkpoint import load_tensors, save_tensors
from astra_data.core.errors import BadInputError
from astra_data.grounding.grounding_file import load_grounding, load_history_model, save_grounding
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.learning.networks.residual import ResidualModel, ResidualShape
from astra_data.training.policy_file import PolicyFile


def test_a_grounding_comes_back_frozen(tmp_path: Path) -> None:
    shape = GroundingShape(4, 2, 2, latent_size=8, head_sizes=(16, 8), position_octaves=2)
    model = GroundingModel(shape, "detach")
    model.set_scales({"state": torch.randn(50, 4)})
    model.set_reward_scales(torch.stack([torch.randn(50), -10.0 * (torch.arange(50) == 7)], dim=-1))
    assert torch.isfinite(model.failure_weight)
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


def test_what_is_no_grounding_is_told(tmp_path: Path) -> None:
    path = tmp_path / "grounding.safetensors"
    policy = ActorCritic(ActorCriticShape(3, 2, memory_size=8))
    PolicyFile(policy, None, "toy@data-1.0.0", "abc").save(path)
    with pytest.raises(
        BadInputError,
        match=r"grounding.safetensors: expected a grounding \(kind history or residual or variation\), "
        r"found kind actor_critic: run that stage again$",
    ):
        load_grounding(path)


@pytest.mark.parametrize(
    ("lacks", "found"),
    [("kind", "a file without a kind"), ("shape", "no 'shape'"), ("target", "no 'target'")],
)
def test_a_grounding_of_an_older_version_is_told(lacks: str, found: str, tmp_path: Path) -> None:
    path = tmp_path / "grounding.safetensors"
    save_grounding(path, GroundingModel(GroundingShape(4, 2, 2, latent_size=8)), no_episodes())
    tensors, told = load_tensors(path)
    save_tensors(path, tensors, {key: value for key, value in told.items() if key != lacks})
    with pytest.raises(BadInputError, match=f"expected a grounding .*found {found}: run that stage again$"):
        load_grounding(path)


def test_a_grounding_with_other_sizes_or_weights_is_told(tmp_path: Path) -> None:
    path = tmp_path / "grounding.safetensors"
    save_grounding(path, ResidualModel(ResidualShape(4, 2, hidden_size=8)), no_episodes())
    tensors, told = load_tensors(path)
    save_tensors(path, tensors, told | {"shape": told["shape"] | {"depth": 2}})
    with pytest.raises(BadInputError, match=r"found .* unexpected keyword argument 'depth': run that stage"):
        load_grounding(path)
    save_tensors(path, {"weight": torch.zeros(1)}, told)
    with pytest.raises(BadInputError, match=r'found .*Unexpected key.*"weight".*: run that stage again$'):
        load_grounding(path)
