import math

import pytest
import torch

from astra_data.learning.networks.history import HistoryEncoder, PositionFeatures


@pytest.fixture
def encoder() -> HistoryEncoder:
    torch.manual_seed(0)
    return HistoryEncoder(5, embedding_size=16, latent_size=32)


def test_step_by_step_is_the_whole_sequence(encoder: HistoryEncoder) -> None:
    inputs = torch.randn(3, 20, 5)
    latents, states = encoder(inputs)
    hidden = torch.zeros(3, 32)
    for step in range(20):
        hidden = encoder.step(inputs[:, step], hidden)
        torch.testing.assert_close(hidden, states[:, step])
        torch.testing.assert_close(encoder.latent(hidden), latents[:, step])


def test_a_hidden_state_handed_in_continues_the_sequence(encoder: HistoryEncoder) -> None:
    inputs = torch.randn(3, 20, 5)
    whole, states = encoder(inputs)
    rest, _ = encoder(inputs[:, 8:], states[:, 7])
    torch.testing.assert_close(rest, whole[:, 8:])
    forgotten, _ = encoder(inputs[:, 8:])
    assert (forgotten - rest).abs().max() > 0.01


def test_latents_have_zero_mean_and_unit_variance(encoder: HistoryEncoder) -> None:
    latents, states = encoder(3.0 * torch.randn(4, 10, 5))
    torch.testing.assert_close(latents.mean(-1), torch.zeros(4, 10), atol=1e-5, rtol=0)
    torch.testing.assert_close(latents.var(-1, unbiased=False), torch.ones(4, 10), atol=0.02, rtol=0)
    # The length of the hidden state is gone from the latent, which is what the LayerNorm is for.
    torch.testing.assert_close(encoder.latent(100.0 * states), latents, atol=0.02, rtol=0)


def test_position_features_have_halving_wavelengths() -> None:
    features = PositionFeatures(3, longest_m=16.0)
    values = features(torch.tensor([[1.5, -2.0]]))[0].tolist()
    phases = [2 * math.pi * place / wavelength for place in (1.5, -2.0) for wavelength in (16, 8, 4)]
    assert len(values) == features.size == 12
    assert values == pytest.approx([math.sin(p) for p in phases] + [math.cos(p) for p in phases], abs=1e-6)
