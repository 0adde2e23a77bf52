import math

import torch
from torch import Tensor

from astra_data.policies.episodes import EpisodeRecord


def flags(*values: int) -> Tensor:
    return torch.tensor(values, dtype=torch.bool)


def test_what_happens_after_the_end_does_not_count() -> None:
    record = EpisodeRecord(torch.zeros(3, 2))
    none = flags(0, 0, 0)
    for step, (success, failed, contact, reward) in enumerate(
        [
            (none, none, flags(1, 1, 0), [1.0, 2.0, 4.0]),
            (flags(1, 0, 0), none, none, [1.0, 2.0, 4.0]),
            (none, flags(1, 1, 0), flags(1, 1, 1), [math.nan, 2.0, 4.0]),
        ]
    ):
        record.add(torch.full((3, 2), float(step + 1)), torch.tensor(reward), success, failed, contact)
    assert record.active.tolist() == [False, False, True] and record.total_steps == 3 + 3 + 2
    outcome = record.outcome()
    assert outcome.to_json() == {
        "success": [1.0, 0.0, 0.0],
        "failed": [0.0, 1.0, 0.0],
        "wall_contact": torch.tensor([1 / 2, 2 / 3, 1 / 3]).tolist(),
        "steps": [2.0, 3.0, 3.0],
        "return": [2.0, 6.0, 12.0],
    }
    assert outcome.position[:, :, 0].nan_to_num(-1.0).tolist() == [[0, 1, 2, -1], [0, 1, 2, 3], [0, 1, 2, 3]]
