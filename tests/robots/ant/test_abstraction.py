import numpy as np
import torch

from astra_data.robots.ant.tasks import ant_beyond_point_mass, ant_to_point_mass


def test_keeps_planar_position_and_velocity() -> None:
    state = np.arange(2 * 3 * 29, dtype=np.float32).reshape(2, 3, 29)
    abstract = ant_to_point_mass(state)
    assert abstract.shape == (2, 3, 4)
    assert abstract.dtype == np.float32
    np.testing.assert_array_equal(abstract[..., :2], state[..., :2])  # x, y open qpos
    np.testing.assert_array_equal(abstract[..., 2:], state[..., 15:17])  # vx, vy open qvel
    assert torch.equal(ant_to_point_mass(torch.from_numpy(state)), torch.from_numpy(abstract))


def test_what_is_dropped_is_the_rest_with_slower_joint_rates() -> None:
    state = torch.arange(29.0).repeat(2, 1)
    rest = ant_beyond_point_mass(state)
    slowed = [0.2 * entry for entry in range(21, 29)]
    expected = [*range(2, 15), *range(17, 21), *slowed]
    torch.testing.assert_close(rest, torch.tensor([expected, expected]))
    assert torch.equal(state, torch.arange(29.0).repeat(2, 1))  # a copy was scaled
