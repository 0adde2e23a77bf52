"""Columns of the fake dataset that tests draw from, and how batches are compared."""

import torch

from astra_data.dataset.columns import ACTION, INDEX, REWARD, STATE, TERMINATED
from astra_data.dataset.frames import Batch, Samples

NAMES = (STATE, ACTION, REWARD, TERMINATED, "mode", INDEX)


def everything(samples: Samples) -> Batch:
    return samples.__getitems__(range(len(samples)))


def assert_equal(found: Batch, expected: Batch) -> None:
    assert list(found) == list(expected)
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        assert torch.equal(found[name], values), name
