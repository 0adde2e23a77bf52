import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from astra_data.core.arrays import Floats
from astra_data.exchange.logs import Field
from astra_data.experiments.planar_heading import Heading

YAW = np.linspace(-3, 3, 25)


def found(*names: str) -> Heading | None:
    return Heading.of({name: Field(name, "state", name, "1", 1.0, "") for name in names})


@pytest.mark.parametrize(
    ("names", "values", "called"),
    [
        (("pose_yaw",), YAW[:, None], "pose_yaw"),
        (("theta_x", "theta_y"), np.column_stack([np.cos(YAW), np.sin(YAW)]), "theta"),
        (("qz", "qw"), np.column_stack([np.sin(YAW / 2), np.cos(YAW / 2)]), "yaw"),
        (
            ("orientation_x", "orientation_y", "orientation_z", "orientation_w"),
            Rotation.from_euler("ZYX", np.column_stack([YAW, 0.2 * np.sin(YAW), 0.1 * YAW])).as_quat(),
            "yaw",
        ),
    ],
)
def test_a_heading_has_many_forms(names: tuple[str, ...], values: Floats, called: str) -> None:
    heading = found("x", "y", *reversed(names), "speed")
    assert heading is not None and heading.name == called
    assert [field.short for field in heading.fields] == [*names]
    np.testing.assert_allclose(heading.angle(values), YAW, atol=1e-9)


def test_parts_alone_are_no_heading() -> None:
    assert found("x", "y", "qx", "qy", "qz") is None and found("x", "y", "heading_x") is None
    heading = found("qz", "qw", "heading_x", "yaw")
    assert heading is not None and [field.short for field in heading.fields] == ["yaw"]
