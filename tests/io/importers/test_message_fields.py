from typing import Any

import numpy as np
import pytest
from google.protobuf.timestamp_pb2 import Timestamp

from astra_data.core.errors import BadInputError
from astra_data.io.importers.mcap import MessageField


def joints(names: list[str], velocity: list[float]) -> dict[str, Any]:
    return {"name": names, "velocity": velocity}


TWIST = {"linear": {"x": 0.5, "y": 0.0, "z": 0.0}}
STAMPED = {"header": {"stamp": {"sec": 1_764_000_000, "nanosec": 123_456_789}}}


@pytest.mark.parametrize(
    ("field", "content", "expected"),
    [
        ("/cmd_vel:linear.x", TWIST, 0.5),
        ("/joints:velocity", joints(["a", "b"], [1.0, 2.0]), [1.0, 2.0]),
        ("/joints:velocity.1", joints(["a", "b"], [1.0, 2.0]), 2.0),
        ("/joints:velocity[b]", joints(["a", "b"], [1.0, 2.0]), 2.0),
        ("/joints:velocity[arm/b.1]", joints(["arm/b.1", "b"], [1.0, 2.0]), 1.0),
        ("/joints:arms.0.velocity[b]", {"arms": [joints(["a", "b"], [1.0, 2.0])]}, 2.0),
        ("/odom:header.stamp.sec", STAMPED, 1_764_000_000),
        ("/mode:name", {"name": "walk"}, "walk"),
    ],
)
def test_a_path_leads_to_a_value(field: str, content: Any, expected: Any) -> None:  # noqa: ANN401
    np.testing.assert_array_equal(MessageField(field).value(content), expected)


@pytest.mark.parametrize(
    ("field", "content", "fault"),
    [
        (
            "/cmd_vel:linear.xx",
            TWIST,
            "no part 'xx' in /cmd_vel:linear, which has x, y, z: did you mean 'x'?",
        ),
        ("/cmd_vel:linear.w", TWIST, "no part 'w' in /cmd_vel:linear, which has x, y, z"),
        ("/cmd_vel:speed.x", TWIST, "no part 'speed' in /cmd_vel, which has linear"),
        ("/cmd_vel:linear.x.y", TWIST, "no part 'y' in /cmd_vel:linear.x"),
        (
            "/clock:secs",
            Timestamp(seconds=1),
            "no part 'secs' in /clock, which has seconds, nanos: did you mean 'seconds'?",
        ),
        (
            "/joints:velocity.2",
            joints(["a"], [1.0]),
            "no part '2' in /joints:velocity, which has 1 values, counted from 0",
        ),
        (
            "/joints:velocity[left_weel]",
            joints(["left_wheel"], [1.0]),
            "no 'left_weel' in /joints:velocity: did you mean 'left_wheel'?",
        ),
        ("/joints:velocity[b]", joints(["a", "b"], []), "/joints:velocity has 0 values for 2 names"),
        (
            "/pose:velocity[b]",
            {"velocity": [1.0]},
            "'/pose:velocity[b]': /pose:velocity is no list with a list 'name' beside it",
        ),
        ("/cmd_vel:linear", TWIST, "'/cmd_vel:linear' is neither a number nor a list of numbers"),
        ("/odom:x", {"x": None}, "'/odom:x' is neither a number nor a list of numbers"),
    ],
)
def test_what_a_message_lacks_is_told_with_what_it_has(field: str, content: Any, fault: str) -> None:  # noqa: ANN401
    with pytest.raises(BadInputError) as error:
        MessageField(field).value(content)
    assert str(error.value) == fault


@pytest.mark.parametrize(
    ("field", "left"), [("velocity[left]", 1.0), ("velocity", None), ("velocity.0", None)]
)
def test_joints_in_another_order_are_told_apart_by_name_alone(field: str, left: float | None) -> None:
    of_joint = MessageField(f"/joints:{field}")
    of_joint.value(joints(["left", "right"], [1.0, 2.0]))
    of_joint.value(joints(["left", "right"], [3.0, 4.0]))
    swapped = joints(["right", "left"], [2.0, 1.0])
    if left is not None:
        assert float(of_joint.value(swapped)) == left
        return
    with pytest.raises(BadInputError) as error:
        of_joint.value(swapped)
    assert str(error.value) == (
        f"'/joints:{field}' is in another order than before: its names are right, left, and were left, "
        "right; take each value by its name, '/joints:velocity[left]'"
    )
