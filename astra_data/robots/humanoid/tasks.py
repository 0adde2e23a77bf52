"""The humanoid's tasks: walking of Gymnasium's humanoid, with three abstract simulators (Section V-B)."""

import os
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import normalized
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, STATE
from astra_data.robots.humanoid import abstraction
from astra_data.robots.humanoid import target as humanoid
from astra_data.robots.humanoid.simulators import HumanoidExtendedKinematics, HumanoidKinematics, HumanoidWalker2d
from astra_data.worlds.objective import Objective
from astra_data.worlds.task import Task, Varied, column, entries, free_body
from astra_data.worlds.variation import JointVariation, VariedSimulator, noisy_command

_COUNT = len(humanoid.JOINTS)
_LEGS_RAD = tuple(humanoid.JOINTS_RAD[joint] for joint in humanoid.COMMANDED)
_LEG_RATES_RAD_S = tuple(humanoid.JOINT_RATES_RAD_S[joint] for joint in humanoid.COMMANDED)


@dataclass(frozen=True)
class Walking(Objective):
    """Walk along x and do not fall; there is no goal."""

    action_size = len(humanoid.COMMANDED)
    is_lasting = True
    spread: ClassVar[tuple[float, ...]]  # typical deviation of each entry of a state from standing, (X,)
    phi: ClassVar[abstraction.Phi]  # φ of target states (count, 47), (count, X)

    locomotion: humanoid.Locomotion = field(default_factory=humanoid.Locomotion)  # rewards and starts of the target
    failure_reward: float = field(default=-5.0, kw_only=True)
    """Minus the reward for staying up, which a step that ends in a fall does not get."""

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return the deviations of states (..., X) from standing, in spreads and clipped to ±5, (..., X)."""
        return normalized(state, state.new_tensor(self._standing), state.new_tensor(self.spread))

    @cached_property
    def _standing(self) -> NDArray[np.float64]:
        return self.phi(np.array(humanoid.STANDING))

    @abstractmethod
    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the body's forward velocity in a step between states (B, X), (B,) in m/s."""

    def draw_starts(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw states (count, X) as the target does: almost upright and at rest."""
        return self.phi(self.locomotion.draw_starts(rng, count))

    def reached(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return False for all states (B, X), (B,): there is no goal to reach."""
        return torch.zeros(len(state), dtype=torch.bool, device=state.device)

    def reward(self, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
        """Return the reward (B,) of a step between states (B, X), a fall where `failed` (B,)."""
        task = self.locomotion
        return task.forward_reward * self.velocity(before, after) + task.healthy_reward + self.failure_reward * failed


@dataclass(frozen=True)
class PlanarWalking(Walking):
    """Walking of the planar walker, states (..., 15); outside of the healthy heights it has fallen."""

    spread = (
        *(humanoid.POSITION_M, humanoid.LEAN_RAD, *_LEGS_RAD),
        *(humanoid.VELOCITY_M_S, humanoid.VELOCITY_M_S, humanoid.SPIN_RAD_S, *_LEG_RATES_RAD_S),
        *(1.0, 1.0),
    )
    phi = abstraction.humanoid_to_walker2d

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which torsos of states (B, 15) are outside of the healthy heights, (B,) bool."""
        low, high = self.locomotion.healthy_m
        return ~((state[:, 0] > low) & (state[:, 0] < high))

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the forward velocity of the center of mass after the step, with stiff arms, (B,) in m/s."""
        joints = after.new_zeros(2, len(after), _COUNT)
        joints[..., humanoid.COMMANDED] = torch.stack([after[:, 2:6], after[:, 9:13]])
        mass, _ = abstraction.mass_and_feet(joints[0])
        swept = abstraction.mass_velocity(*joints)
        pitch, pitch_rate = after[:, 1], after[:, 8]
        forward, up = swept[:, 0] + pitch_rate * mass[:, 2], swept[:, 2] - pitch_rate * mass[:, 0]
        return after[:, 6] + torch.cos(pitch) * forward + torch.sin(pitch) * up


@dataclass(frozen=True)
class JointWalking(Walking):
    """Walking of the joints alone, states (..., 34); they show no falls, so every episode succeeds."""

    spread = (*humanoid.JOINTS_RAD, *humanoid.JOINT_RATES_RAD_S)
    phi = abstraction.humanoid_to_kinematics

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the velocity of a level torso over its lower foot, which does not slip, (B,) in m/s."""
        feet, later = (abstraction.mass_and_feet(state[:, :_COUNT])[1] for state in (before, after))
        rows = torch.arange(len(feet), device=feet.device)
        lower = feet[..., 2].argmin(dim=-1)
        return (feet[rows, lower, 0] - later[rows, lower, 0]) / humanoid.TIMESTEP_S


@dataclass(frozen=True)
class MassWalking(Walking):
    """Walking of joints, center of mass and the torso's lean, states (..., 46)."""

    spread = (
        *(*JointWalking.spread, *[humanoid.POSITION_M] * 3, *[humanoid.VELOCITY_M_S] * 3),
        *(*[humanoid.LEAN_RAD] * 3, *[humanoid.SPIN_RAD_S] * 3),
    )
    phi = abstraction.humanoid_to_extended_kinematics

    lowest_mass_m: float = 0.65
    """A humanoid whose center of mass is lower has fallen, on average two steps before the target's episode
    ends; standing it is 0.9 m high."""

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which centers of mass of states (B, 46) are too low, (B,) bool."""
        return ~(state[:, 2 * _COUNT + 2] >= self.lowest_mass_m)

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the velocity of the center of mass along the heading after the step, (B,) in m/s."""
        return after[:, 2 * _COUNT + 3]


class VariedHumanoid(VariedSimulator):
    """B of the humanoid's simulators, each with a `JointVariation`; rewards and falls are of the observed state."""

    @property
    def _scale(self) -> Tensor:
        return self.by_name()["observation_scale"]

    @property
    def state(self) -> Tensor:
        """The observed states, (B, X) float32."""
        return self._scale * self.true_state

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` to where `landed` is observed, both (B, X); return the observed states."""
        self.simulator.settle(before / self._scale, landed / self._scale)
        return self.state

    def step(self, action: Tensor) -> Tensor:
        """Follow the commands `action` (B, A); return the observed states (B, X)."""
        parameters = self.by_name()
        self.simulator.vary(parameters)
        command = noisy_command(action, parameters["action_noise"])
        self.simulator.step((1.0 + parameters["action_scale"]) * command)
        return self.state


def photograph(states: NDArray[np.float64], *, height: int = 240, width: int = 200) -> NDArray[np.uint8]:
    """Return a picture of each of the target states (K, 47), seen from its right, (K, height, width, 3)."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    model = humanoid.humanoid_model()
    data = mujoco.MjData(model)
    try:
        from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer  # noqa: PLC0415 - slow

        viewer = OffScreenViewer(model, data, width, height)
    except (AttributeError, ImportError, RuntimeError, mujoco.FatalError) as error:
        raise BadInputError(
            f"expected OpenGL that works without a window, found none ({error}): set MUJOCO_GL to egl or osmesa"
        ) from error
    # Along y, so that x goes to the right.
    viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = 3.8, 90.0, -8.0
    pictures = []
    for state in states:
        data.qpos[:] = state[: humanoid.POSITIONS]
        mujoco.mj_forward(model, data)
        viewer.cam.lookat[:] = (*state[:2], 0.95)
        pictures.append(viewer.render("rgb_array"))
    return np.stack(pictures)


_HORIZON = 1000  # of Gymnasium's Humanoid-v5: 15 s

_COMMANDS = ("left_hip", "left_knee", "right_hip", "right_knee")
_COMMAND = entries(" ".join(_COMMANDS), "1", "joint", "invariant")

RANDOMIZED_ACTIONS = JointVariation(action_noise=(0.05, 0.05), action_scale=(-0.05, 0.05))
"""Of domain randomization, as printed in the paper (Section V-B)."""

WIDE_RANGES = JointVariation(
    friction=(0.8, 1.2),
    action_scale=(-0.05, 0.05),
    action_noise=(0.05, 0.05),
    observation_scale=(0.9, 1.1),
    timestep_scale=(1.0, 0.025 / humanoid.TIMESTEP_S),
)
"""Of COMPASS, as printed in the paper (Section V-B): "additionally" to domain randomization. A control period
of 0.015 to 0.025 s begins at the simulator's own, so it only gets longer; in navigation, whose simulators
have another one, it is read as factors around theirs."""

Kind = type[HumanoidWalker2d] | type[HumanoidKinematics]
Quantities = dict[str, tuple[int, ...]]

_JOINT_QUANTITIES = {"joints_rad": (*range(_COUNT),), "joint_rates_rad_s": (*range(_COUNT, 2 * _COUNT),)}
_BODY_QUANTITIES = {
    name: (*range(2 * _COUNT + first, 2 * _COUNT + first + 3),)
    for name, first in {"mass_m": 0, "mass_velocity_m_s": 3, "up": 6, "spin_rad_s": 9}.items()
}
_WALKER_QUANTITIES: Quantities = {
    "height_m": (0,),
    "pitch_rad": (1,),
    "joints_rad": (2, 3, 4, 5),
    "velocity_m_s": (6, 7),
    "pitch_rate_rad_s": (8,),
    "joint_rates_rad_s": (9, 10, 11, 12),
}


def _humanoids(objective: Walking, num_envs: int, **options: Any) -> humanoid.HumanoidEnv:
    return humanoid.HumanoidEnv(objective.locomotion, num_envs, **options)


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
        state=column(STATE, free_body(humanoid.JOINTS), "qpos (24) and qvel (23) of the humanoid"),
        action=column(ACTION, _COMMAND, "commanded joint angles, ±1 over their ranges"),
        commands=dict.fromkeys(_COMMANDS, (-1.0, 1.0)),
        abstract_state=kind.abstract_state,
        quantities=quantities,
        timestep_s=humanoid.TIMESTEP_S,
        simulator_id=f"humanoid_{name}",
        photograph=photograph,
        facts={"stiffness": humanoid.STIFFNESS, "damping": humanoid.DAMPING, **humanoid.CommandRanges().parameters},
        varied=Varied(VariedHumanoid, RANDOMIZED_ACTIONS, WIDE_RANGES),
    )


WALKER2D = _task(
    "walker2d", PlanarWalking(horizon=_HORIZON), HumanoidWalker2d, abstraction.beyond_walker2d, _WALKER_QUANTITIES
)
KINEMATICS = _task(
    "kinematics", JointWalking(horizon=_HORIZON), HumanoidKinematics, abstraction.beyond_kinematics, _JOINT_QUANTITIES
)
EXTENDED = _task(
    "extended",
    MassWalking(horizon=_HORIZON),
    HumanoidExtendedKinematics,
    abstraction.beyond_extended_kinematics,
    _JOINT_QUANTITIES | _BODY_QUANTITIES,
)
