import numpy as np

from astra_data.robots.humanoid.model import Locomotion


def test_healthy_heights_lie_between_the_bounds() -> None:
    height = np.array([0.9, 1.0, 1.001, 1.999, 2.0, np.nan])
    assert Locomotion().healthy(height).tolist() == [False, False, True, True, False, False]


def test_rewards_add_up() -> None:
    reward = Locomotion().reward(
        velocity=np.array([0.8, -0.4]),
        healthy=np.array([True, False]),
        effort=np.array([0.5, 0.0]),
        contact=np.array([1e5, 1e9]),
    )
    np.testing.assert_allclose(reward, [1.0 + 5.0 - 0.05 - 0.05, -0.5 - 10.0])
