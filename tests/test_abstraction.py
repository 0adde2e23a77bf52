import numpy as np
import torch

from astra_data.abstraction import ant_to_point_mass


def test_keeps_planar_position_and_velocity() -> None:
    state = np.arange(2 * 3 * 29, dtype=np.float32).reshape(2, 3, 29)
    abstract = ant_to_point_mass(state)
    assert abstract.shape == (2, 3, 4)
    assert abstract.dtype == np.float32
    np.testing.assert_array_equal(abstract[..., :2], state[..., :2])  # x, y open qpos
    np.testing.assert_array_equal(abstract[..., 2:], state[..., 15:17])  # vx, vy open qvel
    assert torch.equal(ant_to_point_mass(torch.from_numpy(state)), torch.from_numpy(abstract))
