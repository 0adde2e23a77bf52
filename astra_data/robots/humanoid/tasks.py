"""The humanoid's tasks: walking of Gymnasium's humanoid, with three abstract simulators (Section V-B)."""

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from astra_data.dataset.columns import ACTION, STATE
from astra_data.robots.humanoid.abstraction import (
    beyond_extended_kinematics,
    beyond_kinematics,
    beyond_walker2d,
)
from astra_data.robots.humanoid.camera import photograph
from astra_data.robots.humanoid.kinematics import HumanoidExtendedKinematics, HumanoidKinematics
from astra_data.robots.humanoid.model import DAMPING, JOINTS, STIFFNESS, TIMESTEP_S, CommandRanges
from astra_data.robots.humanoid.objectives import JointWalking, MassWalking, PlanarWalking, Walking
from astra_data.robots.humanoid.target import HumanoidEnv
from astra_data.robots.humanoid.varied import VariedHumanoid
from astra_data.robots.humanoid.walker2d import HumanoidWalker2d
from astra_data.worlds.column_entries import ColumnEntry, column, free_body
from astra_data.worlds.task import Task, Varied
from astra_data.worlds.variation import JointVariation

_COUNT = len(JOINTS)
_HORIZON = 1000
"""Of Gymnasium's Humanoid-v5: 15 s."""

_COMMANDS = ("left_hip", "left_knee", "right_hip", "right_knee")
_COMMAND = [ColumnEntry(name, "1", "joint", "invariant") for name in _COMMANDS]

RANDOMIZED_ACTIONS = JointVariation(action_noise=(0.05, 0.05), action_scale=(-0.05, 0.05))
"""Of domain randomization, as printed in the paper (Section V-B)."""

WIDE_RANGES = JointVariation(
    friction=(0.8, 1.2),
    action_scale=(-0.05, 0.05),
    action_noise=(0.05, 0.05),
    observation_scale=(0.9, 1.1),
    timestep_scale=(1.0, 0.025 / TIMESTEP_S),
)
"""Of COMPASS, as printed in the paper (Section V-B): "additionally" to domain randomization. A control period
of 0.015 to 0.025 s begins at the simulator's own, so it only gets longer; in navigation, whose simulators
have another one, it is read as factors around theirs."""

Kind = type[HumanoidWalker2d] | type[HumanoidKinematics]
Quantities = Mapping[str, tuple[int, ...]]

_JOINT_QUANTITIES: Quantities = {
    "joints_rad": tuple(range(_COUNT)),
    "joint_rates_rad_s": tuple(range(_COUNT, 2 * _COUNT)),
}
_BODY_QUANTITIES: Quantities = {
    "mass_m": tuple(range(2 * _COUNT, 2 * _COUNT + 3)),
    "mass_velocity_m_s": tuple(range(2 * _COUNT + 3, 2 * _COUNT + 6)),
    "up": tuple(range(2 * _COUNT + 6, 2 * _COUNT + 9)),
    "spin_rad_s": tuple(range(2 * _COUNT + 9, 2 * _COUNT + 12)),
}
_WALKER_QUANTITIES: Quantities = {
    "height_m": (0,),
    "pitch_rad": (1,),
    "joints_rad": (2, 3, 4, 5),
    "velocity_m_s": (6, 7),
    "pitch_rate_rad_s": (8,),
    "joint_rates_rad_s": (9, 10, 11, 12),
}


def _humanoids(objective: Walking, num_envs: int, **options: Any) -> HumanoidEnv:  # noqa: ANN401 - handed on
    return HumanoidEnv(objective.locomotion, num_envs, **options)


def _task(
    name: str, objective: Walking, kind: Kind, beyond: Callable[[Tensor], Tensor], quantities: Quantities
) -> Task:
    return Task(
        name=f"humanoid-{name}",
        instruction="walk forward without falling",
        objective=objective,
        make_target=_humanoids,
        target_id="humanoid",
        make_simulator=kind,
        abstraction=kind.abstraction,
        beyond=beyond,
        state=column(STATE, free_body(JOINTS), "qpos (24) and qvel (23) of the humanoid"),
        action=column(ACTION, _COMMAND, "commanded joint angles, ±1 over their ranges"),
        commands=dict.fromkeys(_COMMANDS, (-1.0, 1.0)),
        abstract_state=kind.abstract_state,
        quantities=quantities,
        timestep_s=TIMESTEP_S,
        simulator_id=f"humanoid_{name}",
        photograph=photograph,
        facts={"stiffness": STIFFNESS, "damping": DAMPING, **CommandRanges().parameters},
        varied=Varied(VariedHumanoid, RANDOMIZED_ACTIONS, WIDE_RANGES),
    )


HUMANOID_TASKS = (
    _task("walker2d", PlanarWalking(horizon=_HORIZON), HumanoidWalker2d, beyond_walker2d, _WALKER_QUANTITIES),
    _task(
        "kinematics", JointWalking(horizon=_HORIZON), HumanoidKinematics, beyond_kinematics, _JOINT_QUANTITIES
    ),
    _task(
        "extended",
        MassWalking(horizon=_HORIZON),
        HumanoidExtendedKinematics,
        beyond_extended_kinematics,
        {**_JOINT_QUANTITIES, **_BODY_QUANTITIES},
    ),
)
