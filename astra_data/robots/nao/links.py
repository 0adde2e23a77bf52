"""The NAO's links and joints in numbers: lengths, masses, centers of mass, inertias, limits, torques.

Sources: Aldebaran's documentation of the NAO H25 (links, joints, masses); B-Human's published calibration of
the V6 (masses, limits, soles; centers of mass from its calibration of the V4, whose links are the same).
Frames are Aldebaran's: in the zero posture all are parallel, x forward, y to the left, z up. Only left limbs
are listed; right ones are their mirror images.
"""

from dataclasses import dataclass

Triple = tuple[float, float, float]

HIP_OFFSET_Y_M = 0.050
HIP_OFFSET_Z_M = 0.085
THIGH_M = 0.100
TIBIA_M = 0.1029
FOOT_HEIGHT_M = 0.04519
SHOULDER_M: Triple = (0.0, 0.098, 0.100)
NECK_M: Triple = (0.0, 0.0, 0.1265)

SOLE_POINTS_M = ((0.100, 0.048), (0.100, -0.038), (-0.048, 0.048), (-0.048, -0.038))
"""Contact points of the left sole, from the ankle: the corners of its outline; in front, where the toes are
round, as far ahead as the pressure sensors. In the order of the sensors: front left, front right, back left,
back right."""
FOOT_M = ((-0.048, 0.114), (-0.038, 0.048))
"""Outline of the left foot, from the ankle: back and front, inner and outer."""
FOOT_TOP_M = 0.040
"""Height of the foot's shell over the sole, ours: about that of its bumper."""


@dataclass(frozen=True)
class Link:
    """A rigid link with its joint to the parent, if it has one.

    Attributes:
        name: its joint's name in Aldebaran's documentation, without the side.
        offset_m: its frame's origin in the parent's frame.
        mass_kg: its mass.
        center_m: its center of mass.
        inertia: about the center of mass along the frame's axes, in kg m².
        axis: the joint's axis; None for a fixed link.
        limits_deg: the joint's range.
    """

    name: str
    offset_m: Triple
    mass_kg: float
    center_m: Triple
    inertia: Triple
    axis: Triple | None = None
    limits_deg: tuple[float, float] = (0.0, 0.0)


def box_inertia(mass_kg: float, size_m: Triple) -> Triple:
    """Return the moments of inertia in kg m² of a solid box, for links whose own are not listed here."""
    x, y, z = size_m
    share = mass_kg / 12
    return share * (y * y + z * z), share * (x * x + z * z), share * (x * x + y * y)


# Torso and thigh: the published tensors about the joint, moved to the center of mass. All others: boxes of
# about the links' outer size, ours.
TORSO = Link("Torso", (0, 0, 0), 1.0496, (-0.00413, 0, 0.04342), (3.08e-3, 2.88e-3, 1.59e-3))
HEAD = (
    Link("HeadYaw", NECK_M, 0.0784, (0, 0, -0.02742), box_inertia(0.0784, (0.04, 0.04, 0.08))),
    Link("HeadPitch", NECK_M, 0.6594, (-0.00112, 0, 0.05258), box_inertia(0.6594, (0.11, 0.13, 0.12))),
)
# Offsets from the shoulder, the arm stretched forward; the center of mass of forearm and hand is ours.
ARM = (
    Link("ShoulderPitch", (0, 0, 0), 0.0930, (-0.00165, -0.02663, 0.00014), (8.4e-5, 8.4e-5, 8.4e-5)),
    Link(
        "ShoulderRoll", (0, 0, 0), 0.1578, (0.02455, 0.00563, 0.0033), box_inertia(0.1578, (0.11, 0.05, 0.06))
    ),
    Link(
        "ElbowYaw",
        (0.105, 0.015, 0),
        0.0648,
        (-0.02744, 0, -0.00014),
        box_inertia(0.0648, (0.06, 0.04, 0.04)),
    ),
    Link("ElbowRoll", (0.105, 0.015, 0), 0.0776, (0.028, 0, 0), box_inertia(0.0776, (0.056, 0.05, 0.05))),
    Link("WristYaw", (0.16095, 0.015, 0), 0.1853, (0.034, 0, 0.003), box_inertia(0.1853, (0.1, 0.06, 0.05))),
)
_DIAGONAL = 0.5**0.5
LEG = (
    Link(
        "HipYawPitch",
        (0, HIP_OFFSET_Y_M, -HIP_OFFSET_Z_M),
        0.0698,
        (-0.00781, -0.01114, 0.02661),
        box_inertia(0.0698, (0.05, 0.05, 0.06)),
        (0, _DIAGONAL, -_DIAGONAL),
        (-65.62, 42.44),
    ),
    Link(
        "HipRoll",
        (0, 0, 0),
        0.1405,
        (-0.01549, 0.00029, -0.00515),
        box_inertia(0.1405, (0.07, 0.05, 0.05)),
        (1, 0, 0),
        (-21.74, 45.29),
    ),
    Link(
        "HipPitch",
        (0, 0, 0),
        0.3897,
        (0.00138, 0.00221, -0.05373),
        (5.1e-4, 4.7e-4, 3.0e-4),
        (0, 1, 0),
        (-88.0, 27.73),
    ),
    Link(
        "KneePitch",
        (0, 0, -THIGH_M),
        0.3014,
        (0.00453, 0.00225, -0.04936),
        box_inertia(0.3014, (0.08, 0.07, 0.13)),
        (0, 1, 0),
        (-5.29, 121.04),
    ),
    Link(
        "AnklePitch",
        (0, 0, -TIBIA_M),
        0.1342,
        (0.00045, 0.00029, 0.00685),
        box_inertia(0.1342, (0.06, 0.05, 0.05)),
        (0, 1, 0),
        (-68.15, 52.86),
    ),
    Link(
        "AnkleRoll",
        (0, 0, 0),
        0.1718,
        (0.02542, 0.0033, -0.03239),
        box_inertia(0.1718, (0.16, 0.08, 0.04)),
        (1, 0, 0),
        (-22.79, 44.06),
    ),
)
LEG_JOINTS = tuple(link.name for link in LEG)
