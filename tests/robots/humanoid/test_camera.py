import numpy as np
import pytest
from numpy.typing import NDArray

from astra_data.core.errors import BadInputError
from astra_data.robots.humanoid.model import STANDING
from astra_data.robots.humanoid.tasks import photograph


def skin(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell where a picture (height, width, 3) shows the body: it is reddish, floor and sky are not."""
    red, _, blue = picture.astype(int).transpose(2, 0, 1)
    return np.asarray(red > blue + 30)


def test_the_camera_follows_who_walks_and_sees_who_lies() -> None:
    states = np.tile(np.array(STANDING), (3, 1))
    states[1, 0] = 5.0
    states[2, [2, *range(3, 7)]] = 0.1, *(0.5**0.5 * np.array([1.0, 0.0, 1.0, 0.0]))
    try:
        pictures = photograph(states, height=120, width=120)
    except BadInputError as error:
        pytest.skip(str(error))
    assert pictures.shape == (3, 120, 120, 3)
    standing, away, lying = map(skin, pictures)
    assert (standing != away).mean() < 0.01
    rows, columns = (np.flatnonzero(standing.any(axis=axis)) for axis in (1, 0))
    assert np.ptp(rows) > 1.5 * np.ptp(columns)
    rows, columns = (np.flatnonzero(lying.any(axis=axis)) for axis in (1, 0))
    assert np.ptp(columns) > 1.5 * np.ptp(rows)


def test_who_walks_along_x_goes_to_the_right() -> None:
    fallen = np.array(STANDING)
    fallen[[2, *range(3, 7)]] = 0.1, *(0.5**0.5 * np.array([1.0, 0.0, 1.0, 0.0]))  # with its head along x
    try:
        (lying,) = map(skin, photograph(fallen[None], height=120, width=160))
    except BadInputError as error:
        pytest.skip(str(error))
    assert lying.shape == (120, 160)
    columns = np.flatnonzero(lying.any(axis=0))
    # Legs reach farther from the torso, in the middle of the picture, than the head does.
    assert 80 - columns.min() > 1.3 * (columns.max() - 80) > 0


def test_without_opengl_there_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise ImportError("no libEGL")

    monkeypatch.setattr("gymnasium.envs.mujoco.mujoco_rendering.OffScreenViewer", none)
    with pytest.raises(BadInputError, match=r"OpenGL that works without a window.*no libEGL.*MUJOCO_GL"):
        photograph(np.array([STANDING]))
