import numpy as np
import torch

from astra_data.core.arrays import as_column, as_rows, normalized


def test_states_are_in_standard_deviations_and_clipped() -> None:
    mean, std = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 4.0])
    state = torch.tensor([[1.5, -6.0], [3.5, 18.0], [3.6, -30.0]])
    assert torch.allclose(normalized(state, mean, std), torch.tensor([[1.0, -1.0], [5.0, 5.0], [5.0, -5.0]]))


def test_columns_of_one_value_a_step_have_no_second_axis() -> None:
    one, two = np.arange(3.0), np.arange(6.0).reshape(3, 2)
    assert np.array_equal(as_rows(one), [[0.0], [1.0], [2.0]]) and np.array_equal(as_rows(two), two)
    assert np.array_equal(as_column(as_rows(one)), one) and np.array_equal(as_column(two), two)
    assert as_column(one) is one
