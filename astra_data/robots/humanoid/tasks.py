"""The humanoid's tasks: walking of Gymnasium's humanoid, with three abstract simulators (Section V-B)."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np

from astra_data.core.arrays import Floats, normalized
from astra_data.core.lazy import Tensor, mujoco, torch
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, STATE
from astra_data.robots.humanoid import target as humanoid
from astra_data.worlds.objective import Objective
from astra_data.worlds.simulators import ColdSteps, FreeStates
from astra_data.worlds.task import Task, Varied, column, entries, free_body
from astra_data.worlds.variation import JointVariation, VariedSimulator, noisy_command


def walker_model() -> "mujoco.MjModel":
    """Build the walker; qpos (7): x, z and pitch of the torso, left hip, left knee, right hip, right knee."""
    return mujoco.MjModel.from_xml_path(str(files("astra_data.robots.humanoid") / "walker2d.xml"))


_LEG_M = (
    (-0.00902000647996384, -0.4649974000155199),
    (0.003063963232245122, -0.3829877440980478),
    (0.002959964480236801, -0.3699881600947197),
)  # x and z from torso to hip, hip to knee and knee to foot of a stretched leg of the humanoid


def sole_clearance(pose: Tensor) -> Tensor:
    """Return heights of left and right sole above the floor, (..., 2), of `pose` (..., 6): z, pitch, hips and knees."""
    height, pitch, hip, knee = pose[..., :1], pose[..., 1:2], pose[..., [2, 4]], pose[..., [3, 5]]
    for (x, z), angle in zip(_LEG_M, (pitch, pitch + hip, pitch + hip - knee), strict=True):
        height = height - x * torch.sin(angle) + z * torch.cos(angle)
    return height - humanoid.FOOT_RADIUS_M


_PARAMETERS = {"timestep_s": humanoid.TIMESTEP_S, **humanoid.COMMAND_PARAMETERS}  # as paired datasets record them
_POSE, _MOTION, _CONTACTS = slice(0, 6), slice(0, 13), slice(13, 15)
_HEADED, _OF_JOINTS, _OF_BODY = (("heading", "invariant"), ("joint", "invariant"), ("body", "invariant"))


class HumanoidWalker2d(FreeStates):
    """B walkers, states (B, 15); action: angles of left hip, left knee, right hip, right knee (B, 4), clipped to ±1."""

    abstract_state = column(
        ABSTRACT_STATE,
        [
            *(*entries("z", "m", *_HEADED), *entries("pitch", "rad", *_HEADED)),
            *entries("left_hip left_knee right_hip right_knee", "rad", *_OF_JOINTS),
            *(*entries("vx vz", "m/s", *_HEADED), *entries("pitch_rate", "rad/s", *_HEADED)),
            *entries("left_hip_rate left_knee_rate right_hip_rate right_knee_rate", "rad/s", *_OF_JOINTS),
            *entries("left_contact right_contact", "1", "world", "invariant"),
        ],
        "torso, legs and foot contacts of a planar walker",
    )
    abstraction = staticmethod(humanoid.humanoid_to_walker2d)

    def __init__(self, num_envs: int, *, num_threads: int | None = None, device: str = "cpu") -> None:
        standing = humanoid.humanoid_to_walker2d(torch.tensor(humanoid.STANDING))
        super().__init__(standing.repeat(num_envs, 1).to(device))
        self.parameters = _PARAMETERS
        self.memory = self._sunk(self.state)
        self._model = walker_model()
        self._models = [self._model]
        self._steps = ColdSteps(self._model, num_envs, num_threads)

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use factors (B, 1) on the joints' damping and on the control step, of as many physics steps, from now on."""
        plain = self._model
        if self._models[0] is plain:
            self._models = [copy(plain) for _ in self.state]
        friction, timestep_scale = (parameters[name][:, 0].tolist() for name in ("friction", "timestep_scale"))
        for model, factor, scale in zip(self._models, friction, timestep_scale, strict=True):
            model.dof_damping[:] = factor * plain.dof_damping
            model.opt.timestep = scale * plain.opt.timestep

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, 15), on floors below their feet."""
        super().reset_to(state, rows)
        sunk = self._sunk(state)
        self.memory = sunk if rows is None else self.memory.index_copy(0, rows, sunk)

    @staticmethod
    def _sunk(state: Tensor) -> Tensor:
        """Return the depth of the lower foot in the floor, (B, 1) float64 in m."""
        return (-sole_clearance(state[:, _POSE].double()).amin(-1, keepdim=True)).clamp_min(0.0)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move to `landed` (B, 15), its contacts rounded to 1 or 0; return it."""
        contacts = (landed[:, _CONTACTS] > 0.5).to(landed.dtype)
        return super().settle(before, torch.cat([landed[:, _MOTION], contacts], dim=-1))

    def step(self, action: Tensor) -> Tensor:
        """Follow the commands `action` (B, 4) for one control step; return the new state (B, 15)."""
        motion, sunk = self.state[:, _MOTION].cpu().double(), self.memory[:, 0].cpu()
        motion[:, 0] += sunk
        targets = humanoid.commanded_angles(action.cpu().double()).numpy()
        placed = np.pad(motion.numpy(), ((0, 0), (1, 0)))  # before z comes x, which is 0 at the start of every step
        landed = self._steps(self._models, placed, targets, substeps=humanoid.CONTROL_SUBSTEPS)
        motion = torch.from_numpy(landed[:, 1:].copy())
        contacts = (sole_clearance(motion[:, _POSE]) < humanoid.CONTACT_M).to(motion.dtype)
        motion[:, 0] -= sunk
        self.state = torch.cat([motion, contacts], dim=-1).float().to(self.state.device)
        return self.state


_COUNT = len(humanoid.JOINTS)
_CENTER, _VELOCITY, _UP, _SPIN = (slice(first, first + 3) for first in range(2 * _COUNT, 2 * _COUNT + 12, 3))
_JOINTS = [
    *entries(" ".join(humanoid.JOINTS), "rad", *_OF_JOINTS),
    *entries(" ".join(f"{name}_rate" for name in humanoid.JOINTS), "rad/s", *_OF_JOINTS),
]


class HumanoidKinematics(FreeStates):
    """B humanoids' joints, (B, 34); action: angles of left hip and knee, right hip and knee, (B, 4), clipped to ±1."""

    abstract_state = column(ABSTRACT_STATE, _JOINTS, "angles and rates of all joints")
    abstraction = staticmethod(humanoid.humanoid_to_kinematics)

    def __init__(self, num_envs: int, *, device: str = "cpu") -> None:
        standing = type(self).abstraction(torch.tensor(humanoid.STANDING))
        super().__init__(standing.repeat(num_envs, 1).to(device))
        self.parameters = _PARAMETERS
        self._damping = torch.from_numpy(humanoid.humanoid_model().dof_damping[-_COUNT:]).float().to(device)
        self._approach = humanoid.STIFFNESS / (humanoid.DAMPING + self._damping)
        self._timestep_s = torch.tensor(humanoid.TIMESTEP_S, device=device)

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use factors (B, 1) on the joints' damping and on the control step from the next step on."""
        self._approach = humanoid.STIFFNESS / (humanoid.DAMPING + parameters["friction"] * self._damping)
        self._timestep_s = humanoid.TIMESTEP_S * parameters["timestep_scale"]

    def step(self, action: Tensor) -> Tensor:
        """Follow the commands `action` (B, 4) for one control step; return the new state (B, X)."""
        self.state = self._moved(action)
        return self.state

    def _moved(self, action: Tensor) -> Tensor:
        """Return angles and rates (B, 34) of all joints after the step."""
        angles = self.state[:, :_COUNT]
        target = torch.zeros_like(angles)
        target[:, humanoid.COMMANDED] = humanoid.commanded_angles(action)
        left = (target - angles) * torch.exp(-self._approach * self._timestep_s)
        return torch.cat([target - left, self._approach * left], dim=-1)


class HumanoidExtendedKinematics(HumanoidKinematics):
    """The same, with the center of mass and its velocity, and lean and angular velocity of the torso, (B, 46)."""

    abstract_state = column(
        ABSTRACT_STATE,
        [
            *(*_JOINTS, *entries("mass_x mass_y mass_z", "m", *_HEADED)),
            *entries("mass_vx mass_vy mass_vz", "m/s", *_HEADED),
            *(*entries("up_x up_y up_z", "1", *_OF_BODY), *entries("wx wy wz", "rad/s", *_OF_BODY)),
        ],
        "angles and rates of all joints; along the heading, centre of mass, from between the feet, "
        "and its velocity; which way is up from the torso, and how fast it turns",
    )
    abstraction = staticmethod(humanoid.humanoid_to_extended_kinematics)

    def __init__(self, num_envs: int, *, follow_s: float = 0.3, device: str = "cpu") -> None:
        """Build B standing humanoids; `follow_s` is the time constant of the body's velocity and angular velocity."""
        super().__init__(num_envs, device=device)
        self.parameters = {**self.parameters, "follow_s": follow_s}

    def _moved(self, action: Tensor) -> Tensor:
        """Return joints, center of mass and its velocity, lean and spin (B, 46) after the step."""
        joints = super()._moved(action)
        mass, feet = humanoid.mass_and_feet(self.state[:, :_COUNT])
        later_mass, later_feet = humanoid.mass_and_feet(joints[:, :_COUNT])
        aside = (later_mass - later_feet.mean(1)) - (mass - feet.mean(1))
        stance = feet[..., 2].argmin(dim=-1)
        rows = torch.arange(len(feet), device=feet.device)
        driven = ((later_mass - later_feet[rows, stance]) - (mass - feet[rows, stance])) / self._timestep_s
        share = -torch.expm1(-self._timestep_s / self.parameters["follow_s"])
        velocity = torch.lerp(self.state[:, _VELOCITY], driven, share)
        shift = torch.cat([aside[:, :2], velocity[:, 2:] * self._timestep_s], dim=-1)
        spin = (1.0 - share) * self.state[:, _SPIN]
        up = self.state[:, _UP]
        up = torch.nn.functional.normalize(up - self._timestep_s * torch.linalg.cross(spin, up), dim=-1)
        return torch.cat([joints, self.state[:, _CENTER] + shift, velocity, up, spin], dim=-1)


_LEGS_RAD = tuple(humanoid.JOINTS_RAD[joint] for joint in humanoid.COMMANDED)
_LEG_RATES_RAD_S = tuple(humanoid.JOINT_RATES_RAD_S[joint] for joint in humanoid.COMMANDED)


@dataclass(frozen=True)
class Walking(Objective):
    """Walk along x and do not fall; there is no goal."""

    action_size = len(humanoid.COMMANDED)
    is_lasting = True
    spread: ClassVar[tuple[float, ...]]  # typical deviation of each entry of a state from standing, (X,)
    phi: ClassVar["staticmethod[[Floats], Floats]"]  # φ of target states (count, 47), (count, X)

    locomotion: humanoid.Locomotion = field(default_factory=humanoid.Locomotion)  # rewards and starts of the target
    failure_reward: float = field(default=-5.0, kw_only=True)  # a step that ends in a fall is not paid for staying up

    def observe(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return the deviations of states (..., X) from standing, in spreads and clipped to ±5, (..., X)."""
        return normalized(state, state.new_tensor(self._standing), state.new_tensor(self.spread))

    @cached_property
    def _standing(self) -> Floats:
        return self.phi(np.array(humanoid.STANDING))

    @abstractmethod
    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the body's forward velocity in a step between states (B, X), (B,) in m/s."""

    def draw_starts(self, rng: np.random.Generator, count: int) -> Floats:
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
    phi = staticmethod(humanoid.humanoid_to_walker2d)

    def missed(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return which torsos of states (B, 15) are outside of the healthy heights, (B,) bool."""
        return torch.as_tensor(~self.locomotion.healthy(state[:, 0]))

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the forward velocity of the center of mass after the step, with stiff arms, (B,) in m/s."""
        joints = after.new_zeros(2, len(after), _COUNT)
        joints[..., humanoid.COMMANDED] = torch.stack([after[:, 2:6], after[:, 9:13]])
        mass, _ = humanoid.mass_and_feet(joints[0])
        swept = humanoid.mass_velocity(*joints)
        pitch, pitch_rate = after[:, 1], after[:, 8]
        forward, up = swept[:, 0] + pitch_rate * mass[:, 2], swept[:, 2] - pitch_rate * mass[:, 0]
        return after[:, 6] + torch.cos(pitch) * forward + torch.sin(pitch) * up


@dataclass(frozen=True)
class JointWalking(Walking):
    """Walking of the joints alone, states (..., 34); they show no falls, so every episode succeeds."""

    spread = (*humanoid.JOINTS_RAD, *humanoid.JOINT_RATES_RAD_S)
    phi = staticmethod(humanoid.humanoid_to_kinematics)

    def velocity(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the velocity of a level torso over its lower foot, which does not slip, (B,) in m/s."""
        feet, later = (humanoid.mass_and_feet(state[:, :_COUNT])[1] for state in (before, after))
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
    phi = staticmethod(humanoid.humanoid_to_extended_kinematics)

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
        return self._scale * self.simulator.state

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
_BODY_QUANTITIES = _JOINT_QUANTITIES | {
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
    name: str, walking: type[Walking], kind: Kind, beyond: Callable[[Tensor], Tensor], quantities: Quantities
) -> Task:
    return Task(
        name=f"humanoid-{name}",
        instruction="walk forward without falling",
        objective=walking(horizon=_HORIZON),
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
        facts={"stiffness": humanoid.STIFFNESS, "damping": humanoid.DAMPING, **humanoid.COMMAND_PARAMETERS},
        varied=Varied(VariedHumanoid, RANDOMIZED_ACTIONS, WIDE_RANGES),
    )


WALKER2D = _task("walker2d", PlanarWalking, HumanoidWalker2d, humanoid.beyond_walker2d, _WALKER_QUANTITIES)
KINEMATICS = _task("kinematics", JointWalking, HumanoidKinematics, humanoid.beyond_kinematics, _JOINT_QUANTITIES)
EXTENDED = _task(
    "extended", MassWalking, HumanoidExtendedKinematics, humanoid.beyond_extended_kinematics, _BODY_QUANTITIES
)
