import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.robots.humanoid.abstraction import mass_and_feet, mass_velocity
from astra_data.robots.humanoid.model import FEET, humanoid_model


def posed(joints: Floats, rates: Floats) -> mujoco.MjData:
    """Return MuJoCo's humanoid with its torso at the origin, level and at rest."""
    model = humanoid_model()
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:], data.qvel[6:] = joints, rates
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return data


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_center_of_mass_and_feet_are_mujocos(dtype: torch.dtype, atol: float) -> None:
    rng = np.random.default_rng(0)
    joints, rates = rng.uniform(-1.5, 1.5, (20, 17)), rng.uniform(-3, 3, (20, 17))
    shaped = torch.from_numpy(joints).to(dtype).reshape(4, 5, 17)
    mass, feet = mass_and_feet(shaped)
    velocity = mass_velocity(shaped, torch.from_numpy(rates).to(dtype).reshape(4, 5, 17))
    assert mass.shape == velocity.shape == (4, 5, 3)
    assert feet.shape == (4, 5, 2, 3)
    for row in range(20):
        data = posed(joints[row], rates[row])
        np.testing.assert_allclose(mass.reshape(20, 3)[row], data.subtree_com[1], atol=atol)
        theirs = [data.geom(name).xpos for name in FEET]
        np.testing.assert_allclose(feet.reshape(20, 2, 3)[row], theirs, atol=atol)
        np.testing.assert_allclose(velocity.reshape(20, 3)[row], data.subtree_linvel[1], atol=atol)
