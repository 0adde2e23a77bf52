from typing import Any

import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.policies.running_policy import Array, UserPolicy


class Doubling:
    def act(self, observation: Array) -> Array:
        assert observation.dtype == np.float32
        return 2.0 * observation[:, :2].astype(np.float64)


def test_it_acts_in_batches_within_the_bounds_and_remembers_nothing() -> None:
    policy = UserPolicy(Doubling(), observation_size=3, action_size=2)
    observation = torch.tensor([[0.1, -0.2, 9.0], [0.3, 4.0, 9.0]])
    hidden = policy.initial_hidden(2)
    features, after = policy.remember(observation, torch.zeros(2, 2), hidden)
    assert hidden.shape == after.shape == (2, 0)
    action = policy.act(features)
    assert action.dtype == torch.float32
    torch.testing.assert_close(action, torch.tensor([[0.2, -0.4], [0.6, 1.0]]))
    location, scale = policy.policy(features)
    assert torch.equal(location, action) and not scale.any() and policy.name == "Doubling"


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda seen: seen, r"Mine\.act: expected actions of shape \(2, 2\), got \(2, 3\)"),
        (lambda seen: seen[:, :2] * np.nan, r"Mine\.act: expected finite actions, got NaN or infinity"),
        (lambda seen: dict[int, int]()[0], r"Mine\.act fails with KeyError: 0"),
        (lambda seen: "left", r"Mine\.act fails with ValueError"),
        (None, r"Mine is no policy: expected act\(observation\) -> action"),
    ],
)
def test_what_is_no_policy_is_answered_by_a_line(act: Any, message: str) -> None:
    class Mine:
        def __init__(self) -> None:
            self.act = act

    with pytest.raises(BadInputError, match=message):
        UserPolicy(Mine(), 3, 2).act(torch.ones(2, 3))
