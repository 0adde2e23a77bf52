import torch

from astra_data.core.numbers import normalised


def test_states_are_in_standard_deviations_and_clipped() -> None:
    mean, std = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 4.0])
    state = torch.tensor([[1.5, -6.0], [3.5, 18.0], [3.6, -30.0]])
    assert torch.allclose(normalised(state, mean, std), torch.tensor([[1.0, -1.0], [5.0, 5.0], [5.0, -5.0]]))
