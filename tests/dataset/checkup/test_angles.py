import numpy as np
import pytest

from astra_data.dataset.checkup.angles import Angles, is_angle
from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.columns import STATE, Column, Episode

UNITS = {"unit": ["m", "rad", "rad/s", "rad"]}
COLUMN = Column(STATE, size=4, names=("x", "heading", "rate", "arm"), astra=UNITS)


def findings(*largest: float) -> list[Finding]:
    angles = Angles(COLUMN)
    for uid, share in enumerate((0.5, -1.0, 0.25)):
        angles.add(Episode(uid, {STATE: np.outer([0.0, share], largest).astype(np.float32)}))
    return angles.findings()


def test_an_angle_of_many_turns_is_taken_for_degrees() -> None:
    (found,) = findings(500.0, 179.9, 500.0, 3.0)
    assert found.severity == "warning"
    assert found.what == f"heading of {STATE}: up to 179.9 rad, which is more than two full turns"
    assert "degrees, set `scale` to 0.0174533" in found.advice
    (both,) = findings(0.0, 179.9, 0.0, 90.0)
    assert both.what.startswith("heading, arm of")


def test_two_turns_and_other_units_are_nothing_odd() -> None:
    assert findings(500.0, 12.5, 500.0, 3.0) == []
    plain = Angles(Column(STATE, size=2))
    plain.add(Episode(0, {STATE: np.full((3, 2), 180.0, np.float32)}))
    assert plain.findings() == []


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("theta", True),
        ("Base.Yaw", True),
        ("heading_deg", True),
        ("joint1.pos", True),
        ("y", False),
        ("theta.vel", False),
        ("yaw_rate", False),
        ("cos_yaw_dot", False),
    ],
)
def test_angles_are_known_by_their_names(name: str, known: bool) -> None:
    assert is_angle(name) is known
