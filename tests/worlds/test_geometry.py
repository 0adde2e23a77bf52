import mujoco
import numpy as np

from astra_data.worlds.geometry import rotation_matrix


def test_rotation_matrix_is_mujocos() -> None:
    quaternions = np.random.default_rng(0).normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    for quaternion, matrix in zip(quaternions, rotation_matrix(quaternions), strict=True):
        theirs = np.zeros(9)
        mujoco.mju_quat2Mat(theirs, quaternion)
        np.testing.assert_allclose(matrix.ravel(), theirs, atol=1e-14)
