import numpy as np
import pytest

from astra_data.robots.nao.kinematics import IDENTICAL, JOINTS, Traits, TraitSpread


def test_robots_without_a_spread_are_identical() -> None:
    traits = Traits.draw(IDENTICAL, 3, np.random.default_rng(0))
    assert traits.joint_offset_rad.shape == (3, len(JOINTS))
    assert not traits.joint_offset_rad.any()
    assert traits.stiffness.tolist() == traits.quality.tolist() == [1.0] * 3
    assert traits.friction.tolist() == [0.6] * 3
    assert traits.delay_ticks.tolist() == [2] * 3


def test_each_trait_has_its_own_range() -> None:
    spread = TraitSpread(
        joint_offset_deg=2.0, stiffness_loss=0.4, delay_ticks=(1, 4), friction=(0.2, 0.3), quality=(0.5, 0.6)
    )
    traits = Traits.draw(spread, 4000, np.random.default_rng(0))
    assert np.degrees(traits.joint_offset_rad).std() == pytest.approx(2.0, rel=0.02)
    assert np.degrees(traits.joint_offset_rad).mean() == pytest.approx(0.0, abs=0.05)
    for values, low, high in (
        (traits.stiffness, 0.6, 1.0),
        (traits.friction, 0.2, 0.3),
        (traits.quality, 0.5, 0.6),
    ):
        assert low <= values.min() and values.max() <= high
        # Uniform: mean and standard deviation of a uniform distribution.
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
        assert values.std() == pytest.approx((high - low) / 12**0.5, rel=0.03)
    assert np.unique(traits.delay_ticks).tolist() == [1, 2, 3, 4]


def test_seeds_repeat_them() -> None:
    first, again, other = (Traits.draw(TraitSpread(), 2, np.random.default_rng(seed)) for seed in (0, 0, 1))
    for name, values in vars(first).items():
        np.testing.assert_array_equal(values, getattr(again, name))
    assert (first.joint_offset_rad != other.joint_offset_rad).all()
