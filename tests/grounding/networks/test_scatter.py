import math

import torch
from torch.distributions import Normal

from astra_data.grounding.scatter import ScatterModel, ScatterShape

INPUTS = torch.tensor([[0.3, -1.2], [2.0, 0.5], [-0.4, 0.1]])


def scatter_model(forms: int = 4) -> ScatterModel:
    torch.manual_seed(1)
    made = ScatterModel(ScatterShape(2, 3, forms)).requires_grad_(False).eval()
    made.usual.copy_(torch.tensor([0.1, 1.0, 10.0]))
    made.forms.normal_()
    return made


def told(made: ScatterModel) -> ScatterModel:
    """Let each moment have its own scale."""
    list(made.network.parameters())[-2].normal_()
    return made


def test_the_likelihood_is_that_of_a_gaussian_but_for_a_constant() -> None:
    made = told(scatter_model())
    residual = torch.randn(3, 3) * made.usual
    gaussian = Normal(0.0, made.log_scale(INPUTS).exp()).log_prob(residual / made.usual)
    apart = made.nll(INPUTS, residual) + gaussian
    torch.testing.assert_close(apart, torch.full((3, 3), -0.5 * math.log(2 * math.pi)))


def test_what_is_drawn_are_forms_at_the_scale_of_the_moment() -> None:
    made = told(scatter_model())
    assert made.log_scale(INPUTS).std() > 0.1
    torch.manual_seed(0)
    drawn = made.draw(INPUTS.repeat(100, 1))
    in_units = made.in_units(INPUTS.repeat(100, 1), drawn)
    nearest = (in_units[:, None] - made.forms).abs().amax(-1)
    assert float(nearest.amin(1).max()) < 1e-5  # all entries are of one form
    assert set(nearest.argmin(1).tolist()) == {0, 1, 2, 3}
