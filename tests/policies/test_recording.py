from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_cart import TASK, Last

from astra_data.core.progress import silent
from astra_data.dataset.columns import ACTION, DONE, SUCCESS, TERMINATED, TRUNCATED, Episode
from astra_data.policies.collecting import _step, record


def test_where_it_is_to_last_an_episode_succeeds_in_its_last_step() -> None:
    task, recorded = replace(TASK, objective=Last(horizon=4)), list[Episode]()
    env, still = task.target(2, seed=0), torch.full((2, 1), -0.6)  # 0 m/s
    env.reset()
    behavior: Any = SimpleNamespace(act=lambda state, goal: still)
    writer: Any = SimpleNamespace(staged=set(), add=lambda episode, number: recorded.append(episode))
    assert record(task, env, behavior, range(2), writer, max_steps=4, seed=0, progress=silent) == 8
    for episode in recorded:
        assert episode.columns[SUCCESS].tolist() == [False, False, False, True]
        assert episode.columns[ACTION].tolist() == pytest.approx([0.0] * 4, abs=1e-6)  # in m/s
        assert (episode.metadata["success"], episode.metadata["failed"]) == (True, False)
    assert len(recorded) == 2


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
        assert torch.equal(row[TERMINATED], ends) and torch.equal(row[TRUNCATED], truncated)
        assert torch.equal(row[DONE], ends | truncated)
