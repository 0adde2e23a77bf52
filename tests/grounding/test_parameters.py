import torch

from astra_data.grounding.parameters import IdentifiedParameters
from astra_data.worlds.registry import TASKS
from astra_data.worlds.variation import PlanarVariation

TASK = TASKS["antmaze-umaze"]
FOUND = PlanarVariation(friction=(0.8, 0.8), position_noise_m=(0.1, 0.1), heading_bias_deg=(90.0, 90.0))
START = torch.tensor([[-4.0, 4.0, 0.0, 0.0]]).expand(200, 4)


def step(grounding: IdentifiedParameters, variation: PlanarVariation | None = None) -> torch.Tensor:
    torch.manual_seed(0)
    simulator = grounding.simulator(TASK, 200, variation=variation)
    simulator.start(START, torch.arange(200), torch.zeros(200, 2))
    return simulator.step(torch.tensor([[1.0, 0.0]]).expand(200, 2)) - START


def test_simulators_have_the_identified_parameters_and_no_others() -> None:
    moved = step(IdentifiedParameters(FOUND), variation=PlanarVariation(friction=(0.1, 0.1)))
    torch.testing.assert_close(moved[:, 2:].mean(0), torch.tensor([0.0, 0.8]), atol=1e-4, rtol=0)
    # Uniform noise of half width w has a deviation of w / sqrt(3).
    torch.testing.assert_close(moved[:, :2].std(0), torch.full((2,), 0.1 / 3**0.5), rtol=0.15, atol=0)


def test_replays_are_without_noise() -> None:
    quiet = IdentifiedParameters(FOUND).for_replay()
    assert quiet == IdentifiedParameters(replace_noise(FOUND))
    torch.testing.assert_close(
        step(quiet), torch.tensor([[0.0, 0.04, 0.0, 0.8]]).expand(200, 4), atol=1e-4, rtol=0
    )


def replace_noise(variation: PlanarVariation) -> PlanarVariation:
    return variation.model_copy(update={"position_noise_m": (0.0, 0.0)})


def test_there_is_nothing_to_remember_and_no_latent() -> None:
    grounding = IdentifiedParameters(FOUND)
    assert grounding.encoder is None
