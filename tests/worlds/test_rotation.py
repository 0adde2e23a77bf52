import mujoco
import numpy as np
import torch

from astra_data.worlds.geometry import rotation, rotation_matrix


def test_rotation_matrix_is_mujocos() -> None:
    quaternions = np.random.default_rng(0).normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    for quaternion, matrix in zip(quaternions, rotation_matrix(quaternions), strict=True):
        theirs = np.zeros(9)
        mujoco.mju_quat2Mat(theirs, quaternion)
        np.testing.assert_allclose(matrix.ravel(), theirs, atol=1e-14)


def test_rotation_of_tensors_is_mujocos() -> None:
    drawn = torch.randn(10, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    quaternions = drawn / drawn.norm(dim=1, keepdim=True)
    for quaternion, ours in zip(quaternions, rotation(quaternions), strict=True):
        theirs = np.zeros(9)
        mujoco.mju_quat2Mat(theirs, quaternion.numpy())
        np.testing.assert_allclose(ours.reshape(9), theirs, atol=1e-14)
