import pytest
import torch
from pydantic import create_model

from astra_data.core.config import Config, validated
from astra_data.core.errors import RecipeError
from astra_data.worlds import variation as of
from astra_data.worlds.variation import BallVariation, CommandVariation, JointVariation, PlanarVariation, Variation


def test_parameters_are_drawn_uniformly_from_their_ranges() -> None:
    torch.manual_seed(0)
    variation = PlanarVariation(friction=(0.8, 1.2), heading_bias_deg=(-5.0, 5.0))
    drawn = dict(zip(variation.names, variation.draw(20_000).unbind(-1), strict=True))
    assert (drawn["timestep_scale"] == 1.0).all() and (drawn["action_noise"] == 0.0).all()
    for name, (low, high) in {"friction": (0.8, 1.2), "heading_bias_deg": (-5.0, 5.0)}.items():
        assert low <= float(drawn[name].min()) and float(drawn[name].max()) <= high
        quarters = torch.quantile(drawn[name], torch.tensor([0.25, 0.5, 0.75]))
        width = high - low
        expected = torch.tensor([low + width / 4, low + width / 2, low + 3 * width / 4])
        torch.testing.assert_close(quarters, expected, atol=0.02 * width, rtol=0)


def test_normal_parameters_are_between_minus_one_and_one() -> None:
    variation = PlanarVariation(friction=(0.8, 1.2), action_scale=(0.1, 0.1))
    ends = variation.ranges().T
    torch.testing.assert_close(variation.normal(ends)[:, 0], torch.tensor([-1.0, 1.0]))
    assert variation.normal(ends)[:, 1:].abs().max() == 0.0
    assert variation.normal(ends + 0.1)[:, 1:].abs().max() == 0.0  # however it was set


KINDS = (PlanarVariation, BallVariation, JointVariation, CommandVariation)


@pytest.mark.parametrize("kind", KINDS)
def test_it_survives_json_and_knows_its_parameters(kind: type[Variation]) -> None:
    variation = kind(**{name: (0.8, 1.2) for name in kind.model_fields})
    assert Variation.of_json({name: list(ends) for name, ends in variation.model_dump().items()}) == variation
    assert variation.names == tuple(kind.model_fields)


def test_noise_carries_no_command_beyond_one() -> None:
    torch.manual_seed(0)
    noisy = of.noisy_command(torch.tensor([[1.0, -1.0, 0.0]]).expand(1000, 3), torch.full((1000, 1), 0.1))
    assert noisy.max() == 1.0 and noisy.min() == -1.0 and float(noisy[:, 2].std()) == pytest.approx(0.1, rel=0.1)


NOT_NEGATIVE = "greater than or equal to 0"


@pytest.mark.parametrize("model", [PlanarVariation, BallVariation])
@pytest.mark.parametrize(
    ("name", "least", "expected"),
    [
        *(("friction", 0.0, "greater than 0"), ("timestep_scale", -0.5, "greater than 0")),
        *((name, -0.1, NOT_NEGATIVE) for name in ("action_noise", "position_noise_m", "velocity_noise_m_s")),
    ],
)
def test_ranges_that_cannot_be_are_refused(model: type[Config], name: str, least: float, expected: str) -> None:
    with pytest.raises(RecipeError) as caught:
        validated({"row": {name: [least, 1.0]}}, create_model("Rows", row=(model, ...)), "r.toml")
    assert str(caught.value) == f"r.toml: row.{name}.0: expected {expected}, got {least}"
