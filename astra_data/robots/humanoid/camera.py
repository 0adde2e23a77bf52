"""Pictures of humanoids, rendered by MuJoCo without a window."""

import os

import mujoco
import numpy as np
from numpy.typing import NDArray

from astra_data.core.errors import BadInputError
from astra_data.robots.humanoid.model import POSITIONS, humanoid_model

_DISTANCE_M = 3.8
_EYE_M = 0.95
"""Height of the point that the camera looks at."""
_SIDE_DEG = 90.0
"""The camera looks along y, so that x goes to the right."""
_DOWN_DEG = -8.0


def photograph(states: NDArray[np.float64], *, height: int = 240, width: int = 200) -> NDArray[np.uint8]:
    """Return a picture of each of the target states (K, 47), seen from its right, (K, height, width, 3).

    Raises:
        BadInputError: no OpenGL without a window is available.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    model = humanoid_model()
    data = mujoco.MjData(model)
    try:
        from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer  # noqa: PLC0415 - slow

        viewer = OffScreenViewer(model, data, width, height)
    except (AttributeError, ImportError, RuntimeError, mujoco.FatalError) as error:
        raise BadInputError(
            f"expected OpenGL that works without a window, found none ({error}): set MUJOCO_GL to egl or "
            "osmesa"
        ) from error
    viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = _DISTANCE_M, _SIDE_DEG, _DOWN_DEG
    pictures = []
    for state in states:
        data.qpos[:] = state[:POSITIONS]
        mujoco.mj_forward(model, data)
        viewer.cam.lookat[:] = (*state[:2], _EYE_M)
        pictures.append(viewer.render("rgb_array"))
    return np.stack(pictures)
