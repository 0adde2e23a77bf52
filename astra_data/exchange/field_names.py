"""What the names of fields in logs say: roles and units."""

import math
import re
from typing import Literal

Role = Literal["time", "episode", "state", "command", "goal", "failure", "success", "reward", "left out"]

COMMANDED = "cmd|command|action|act|ctrl|control|setpoint|desired|des|target|ref"
WEAK_FAILURE = re.compile(r"bump(ed|er)?|e_?stop")
"""A failure where it ever comes, and where there is no other."""
NAMES: tuple[tuple[Role, str], ...] = (
    ("time", r"t|(.+_)?(time|stamp|timestamp|secs?|seconds)"),
    (
        "episode",
        r"(ep(isode)?|trial|drive|run|rollout|traj(ectory)?|flight|lap|session|bag)"
        r"(_?(id|index|nr))?",
    ),
    ("left out", r"(frame|row|step|seq|sample)(_?(id|index|nr))?|index|idx|id|(.+_)?n(ano)?secs?"),
    (
        "failure",
        r"fail(ed|ure)?|fell|fall(en)?|tipped|toppled|crash(ed)?|colli(sion|ded)|fault|terminated|"
        + WEAK_FAILURE.pattern,
    ),
    ("success", r"success|succeeded|(goal_)?reached|at_goal|delivered|solved"),
    ("reward", r"reward"),
    (
        "command",
        r"(.+_)?(cmd|command|action|act|ctrl|control|setpoint|desired|des|target|ref)(_.+|\d+)?|u(_.+|\d+)?",
    ),
)
"""Roles by the whole of a field's name, without its unit; all other fields are states."""
GOAL = re.compile(
    r"(?!.*(dist|bearing|_to_|_from_))(.+_)?(goal|destination|waypoint)(?P<axis>_(x|y|z|yaw|heading|theta|psi))?"
)
PLACE_TO_GO = re.compile(r"(target|ref|desired|des)_[xyz]")
"""A goal where it stays the same in each episode and something else is commanded, and otherwise a command."""
UNCLEAR = "done|truncated|timeout"
"""Ends of which the name does not say whether they are successes, failures or neither."""
FORCE = re.compile(r"(.+_)?(tau|torque|effort)(_.+|\d+)?")
"""A command where there is no other."""
PEDAL = re.compile(r"throttle|brake|steer(ing)?(_angle)?")
"""Likewise, in a car."""
UNITS: tuple[tuple[str, str, float], ...] = (
    ("mm_s", "m/s", 1e-3),
    ("cm_s", "m/s", 1e-2),
    ("m_s", "m/s", 1.0),
    ("m_per_s", "m/s", 1.0),
    ("mps", "m/s", 1.0),
    ("km_h", "m/s", 1 / 3.6),
    ("kmh", "m/s", 1 / 3.6),
    ("kph", "m/s", 1 / 3.6),
    ("m_s2", "m/s²", 1.0),
    ("mps2", "m/s²", 1.0),
    ("deg_s", "rad/s", math.pi / 180),
    ("deg_per_s", "rad/s", math.pi / 180),
    ("dps", "rad/s", math.pi / 180),
    ("rad_s", "rad/s", 1.0),
    ("rad_per_s", "rad/s", 1.0),
    ("rpm", "rad/s", math.pi / 30),
    ("deg_s2", "rad/s²", math.pi / 180),
    ("rad_s2", "rad/s²", 1.0),
    ("mm", "m", 1e-3),
    ("cm", "m", 1e-2),
    ("m", "m", 1.0),
    ("deg", "rad", math.pi / 180),
    ("rad", "rad", 1.0),
    ("nm", "N m", 1.0),
    ("n", "N", 1.0),
    ("v", "V", 1.0),
    ("a", "A", 1.0),
)
"""Endings of names, the unit that values are stored in, and the factor to it."""
ENDINGS = [ending for ending, _, _ in UNITS]
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
HEADING = re.compile(r"(.+_)?(heading|yaw|theta|psi)")
TURN_RATE = re.compile(
    r"w_?z?|omega(_?z)?|(.+_)?(turn|angular(_vel(ocity)?)?(_z)?|ang_vel(_z)?|"
    r"(v|d|vel_|velocity_)(heading|yaw|theta|psi|th|rot|ang)|"
    r"(heading|yaw|theta|psi|turn(ing)?|rot(ation)?)_?(rate|vel|velocity|speed|dot))"
)
LENGTH = re.compile(
    r"(?!.*(heading|yaw|theta|psi|quat|orient|vel|twist|linear|angular|speed|acc|rate|force|torque))(.+_)?(p|pos)?[xyz]"
)
QUATERNION = re.compile(r"(.+_)?(q|quat(ernion)?|orient(ation)?|rot(ation)?)_?[wxyz]")
"""A part of one, where all four are there."""
EPISODE = re.compile(dict(NAMES)["episode"])
COMMAND = re.compile(rf"(^|_)({COMMANDED}|u)(_|(?=\d)|$)")
