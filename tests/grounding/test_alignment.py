import pytest
import torch
from torch import Tensor

from astra_data.grounding.alignment import TargetEncoder, gaussian_mmd
from astra_data.grounding.encoder import PositionFeatures


def mean_kernel(x: Tensor, y: Tensor, bandwidths: Tensor) -> tuple[float, float]:
    """Return the mean of the kernel over pairs of samples (N, Z), and its standard error."""
    squared = (x - y).square().sum(-1, keepdim=True)
    values = (-squared / (2 * bandwidths.square())).exp().mean(-1)
    return float(values.mean()), float(values.std()) / len(x) ** 0.5


def test_closed_form_agrees_with_sampling() -> None:
    torch.manual_seed(0)
    bandwidths = torch.tensor([0.8, 2.5])
    means, variances = torch.randn(2, 6), 0.2 + torch.rand(2, 6)

    def samples(which: int) -> Tensor:
        return means[which] + variances[which].sqrt() * torch.randn(200_000, 6)

    terms = [(1, 0, 0), (1, 1, 1), (-2, 0, 1)]
    parts = [(sign, *mean_kernel(samples(i), samples(j), bandwidths)) for sign, i, j in terms]
    sampled = sum(sign * mean for sign, mean, _ in parts)
    error = sum((sign * error) ** 2 for sign, _, error in parts) ** 0.5
    exact = float(gaussian_mmd(means[0], variances[0], means[1], variances[1], bandwidths))
    assert abs(exact - sampled) < 4 * error
    assert exact > 20 * error  # the comparison above can tell something


def gradient(bandwidths: Tensor) -> float:
    """Return the gradient's norm between unrelated latents of size 64."""
    torch.manual_seed(0)
    source, target = torch.randn(2, 32, 64)
    target.requires_grad_()
    variance = torch.full((32, 64), 0.1)
    gaussian_mmd(source, variance, target, variance, bandwidths).sum().backward()
    assert target.grad is not None
    return float(target.grad.norm(dim=-1).min())


def test_target_encoder_clips_normalized_states() -> None:
    encoder = TargetEncoder(3, 2, 1, embedding_size=4, latent_size=4, position_octaves=2)
    state, goal = 2.0 + 3.0 * torch.randn(5000, 3), torch.randn(5000, 2)
    encoder.set_scales(state, goal)
    inputs = encoder.encoder_input(state, goal, torch.zeros(5000, 1))
    assert inputs.shape == (5000, 6 + 8)
    torch.testing.assert_close(inputs[:, 3:11], PositionFeatures(2)(state[:, :2]))
    torch.testing.assert_close(inputs[:, :3].std(0), torch.ones(3), atol=0.01, rtol=0)
    far = encoder.encoder_input(torch.full((1, 3), 1e6), goal[:1] - 1e6, torch.zeros(1, 1))
    assert far[0, :3].tolist() == pytest.approx([5.0] * 3) and far[0, 11:13].tolist() == [-5.0] * 2


def test_target_encoder_does_not_see_what_it_shall_not() -> None:
    encoder = TargetEncoder(3, 0, 1, embedding_size=4, latent_size=4, position_octaves=0)
    state, nothing = torch.randn(50, 3), torch.zeros(50, 0)
    encoder.set_scales(state, nothing, unseen=[0, 2])
    inputs = encoder.encoder_input(1e6 * state, nothing, torch.zeros(50, 1))
    assert not inputs[:, [0, 2]].any() and inputs[:, 1].all()


@pytest.mark.parametrize(("r2", "deployed"), [(0.0, False), (0.89, False), (0.91, True)])
def test_only_a_close_target_encoder_is_deployed(r2: float, deployed: bool) -> None:
    encoder = TargetEncoder(3, 2, 1, embedding_size=4, latent_size=4)
    assert not encoder.is_deployed
    encoder.latent_r2.fill_(r2)
    again = TargetEncoder(**encoder.sizes)
    again.load_state_dict(encoder.state_dict())
    assert encoder.is_deployed is again.is_deployed is deployed
