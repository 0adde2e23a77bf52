import math

import numpy as np
import pytest
from nao_values import TOTAL_MASS_KG

from astra_data.robots.nao.kinematics import (
    ARM,
    FOOT_M,
    HEAD,
    LEG,
    SOLE_POINTS_M,
    TORSO,
    Link,
    box_inertia,
)

LINKS = (TORSO, *HEAD, *ARM, *LEG)


def test_a_box_resists_turning_as_an_integral_over_it_says() -> None:
    size = np.array([0.2, 0.3, 0.5])
    rng = np.random.default_rng(0)
    points = rng.uniform(-size / 2, size / 2, (400_000, 3))
    expected = [2.0 * (points[:, [j, k]] ** 2).sum(axis=1).mean() for j, k in ((1, 2), (0, 2), (0, 1))]
    assert box_inertia(2.0, (0.2, 0.3, 0.5)) == pytest.approx(expected, rel=0.01)


def test_limbs_weigh_what_the_robot_weighs() -> None:
    once = sum(link.mass_kg for link in (TORSO, *HEAD))
    twice = sum(link.mass_kg for link in (*ARM, *LEG))
    assert once + 2 * twice == pytest.approx(TOTAL_MASS_KG, abs=0.005)


@pytest.mark.parametrize("link", LINKS, ids=lambda link: link.name)
def test_links_are_of_matter(link: Link) -> None:
    x, y, z = link.inertia
    # Moments of inertia of any body satisfy the triangle inequality.
    assert min(x, y, z) > 0 and 2 * max(x, y, z) <= x + y + z + 1e-12
    # A radius of gyration, and a center of mass, within the link.
    assert math.sqrt(max(link.inertia) / link.mass_kg) < 0.1
    assert np.linalg.norm(link.center_m) < 0.07
    assert link.limits_deg[0] <= link.limits_deg[1]


def test_the_legs_joints_are_those_of_the_documentation() -> None:
    assert [link.name for link in LEG] == [
        *("HipYawPitch", "HipRoll", "HipPitch"),
        *("KneePitch", "AnklePitch", "AnkleRoll"),
    ]
    axes = {link.name: link.axis for link in LEG}
    assert all(axes[name] == (1, 0, 0) for name in axes if name.endswith("Roll"))
    assert all(axes[name] == (0, 1, 0) for name in ("HipPitch", "KneePitch", "AnklePitch"))
    assert axes["HipYawPitch"] == pytest.approx((0.0, math.sqrt(0.5), -math.sqrt(0.5)))
    # Hip to ankle, standing: 100 mm and 102.9 mm down.
    assert np.sum([link.offset_m for link in LEG[1:]], axis=0) == pytest.approx([0.0, 0.0, -0.2029])
    assert all(link.axis is None for link in (TORSO, *HEAD, *ARM))


def test_soles_touch_the_floor_inside_the_feet() -> None:
    (back, front), (inner, outer) = FOOT_M
    for x, y in SOLE_POINTS_M:
        assert back <= x <= front and inner <= y <= outer
    xs, ys = np.array(SOLE_POINTS_M).T
    assert xs[0] == xs[1] > 0 > xs[2] == xs[3]
    assert ys[0] == ys[2] > 0 > ys[1] == ys[3]
