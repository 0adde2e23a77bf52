import torch
from torch import nn

from astra_data.grounding.encoder import add_scales, take_scales


def test_scales_are_those_of_the_values_and_plain_without_any() -> None:
    network, values = nn.Module(), torch.tensor([[1.0, 5.0], [3.0, 5.0]])
    add_scales(network, {"state": 2, "goal": 0, "unseen": 1})
    take_scales(network, {"state": values, "goal": torch.zeros(2, 0)})
    found = {name: buffer.tolist() for name, buffer in network.state_dict().items()}
    assert found == {
        "state_mean": [2.0, 5.0],
        "state_std": [torch.tensor(2.0).sqrt().item(), torch.tensor(1e-3).item()],
        "goal_mean": [],
        "goal_std": [],
        "unseen_mean": [0.0],
        "unseen_std": [1.0],
    }
