from types import SimpleNamespace
from typing import Any

import torch

from astra_data.dataset.columns import DONE, TERMINATED, TRUNCATED
from astra_data.training.recording import _step


def test_an_episode_that_ends_in_its_last_step_is_terminated_and_not_truncated() -> None:
    ends = torch.tensor([True, False])
    env: Any = SimpleNamespace(
        state=torch.zeros(2, 3),
        goal=torch.zeros(2, 2),
        step=lambda action, active: SimpleNamespace(
            reward=torch.zeros(2), terminated=ends, success=torch.zeros(2, dtype=torch.bool)
        ),
    )
    behavior: Any = SimpleNamespace(act=lambda state, goal: torch.zeros(2, 2))
    for last, truncated in ((True, ~ends), (False, torch.zeros(2, dtype=torch.bool))):
        row = _step(env, behavior, ends, last=last)
        assert torch.equal(row[TERMINATED], ends)
        assert torch.equal(row[TRUNCATED], truncated)
        assert torch.equal(row[DONE], ends | truncated)
