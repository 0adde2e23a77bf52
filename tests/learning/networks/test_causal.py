import pytest
import torch
from torch import Tensor

from astra_data.learning.networks.causal import CausalConfig, CausalModel, descend, fit_causes

CONFIG = CausalConfig(updates=500)


def law(cause: Tensor) -> Tensor:
    """Two effects (N, 2) of five causes: of the first and the last; of the second. The others have none."""
    first = (cause[:, 0] - 0.4).square() + 0.3 * cause[:, 4]
    return torch.stack([first, (cause[:, 1] + 0.2).square()], dim=-1)


@pytest.fixture(scope="module")
def fitted() -> CausalModel:
    torch.manual_seed(0)
    cause = torch.rand(4000, 5) * 2.0 - 1.0
    effect = law(cause)
    effect = (effect - effect.mean(0)) / effect.std(0) + 0.1 * torch.randn(4000, 2)
    return fit_causes(cause, effect, CONFIG, penalized=4)


def test_the_mask_tells_what_causes_what(fitted: CausalModel) -> None:
    reaches = fitted.probability > CONFIG.mask_threshold
    assert reaches[:4].tolist() == [[True, False], [False, True], [False, False], [False, False]]
    assert fitted.probability[4, 0] > 0.9


def test_it_predicts_the_effects(fitted: CausalModel) -> None:
    torch.manual_seed(1)
    cause = torch.rand(500, 5) * 2.0 - 1.0
    effect = law(cause)
    wrong = fitted(cause, (fitted.probability > 0.3).float()) - (effect - effect.mean(0)) / effect.std(0)
    assert wrong.square().mean() < 0.05


def test_descent_moves_what_it_may_to_the_smallest_effects(fitted: CausalModel) -> None:
    mask = (fitted.probability > 0.3).float()
    start, moves = torch.tensor([-0.5, -0.5, 0.5, 0.5]), torch.tensor([True, True, False, False])
    others = torch.linspace(-1.0, 1.0, 50).unsqueeze(-1)
    moved = descend(fitted, mask, start, moves, others)
    torch.testing.assert_close(moved, torch.tensor([0.4, -0.2, 0.5, 0.5]), atol=0.1, rtol=0)
    kept = descend(fitted, mask, start, ~moves, others)
    torch.testing.assert_close(kept, start)


def test_masks_are_drawn_with_their_probability_and_pass_gradients() -> None:
    torch.manual_seed(0)
    model = CausalModel(2, 2)
    with torch.no_grad():
        model.logits.copy_(torch.tensor([[0.0, 2.0], [-2.0, -1.0]]))
    drawn = model.draw_mask(20_000)
    assert set(drawn.detach().unique().tolist()) == {0.0, 1.0}
    torch.testing.assert_close(drawn.mean(0), model.probability, atol=0.01, rtol=0)
    (gradient,) = torch.autograd.grad(drawn.mean(0).sum(), model.logits)
    # With temperature 1, the mean derivative of the relaxed draw is that of E[sigmoid(l + logistic noise)].
    step = 1e-3
    noise = torch.rand(2_000_000, dtype=torch.float64).logit()
    for logit, slope in zip(model.logits.flatten().tolist(), gradient.flatten().tolist(), strict=True):
        rise = ((logit + step + noise).sigmoid() - (logit - step + noise).sigmoid()).mean() / (2 * step)
        assert slope == pytest.approx(float(rise), abs=0.005)
