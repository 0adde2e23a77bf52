"""The humanoid's MuJoCo model, spreads of its states, the environment of walking, and φ by forward kinematics."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, wraps
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from astra_data.core.arrays import Bools, Floats, normalized
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, mujoco, torch
from astra_data.worlds.geometry import rotation
from astra_data.worlds.protocols import Step, rows_in
from astra_data.worlds.simulators import BatchedPhysics, PhysicsTarget

JOINTS = (
    *("abdomen_z", "abdomen_y", "abdomen_x"),
    *("right_hip_x", "right_hip_z", "right_hip_y", "right_knee"),
    *("left_hip_x", "left_hip_z", "left_hip_y", "left_knee"),
    *("right_shoulder1", "right_shoulder2", "right_elbow"),
    *("left_shoulder1", "left_shoulder2", "left_elbow"),
)  # in the order of the state
COMMANDED = tuple(JOINTS.index(name) for name in ("left_hip_y", "left_knee", "right_hip_y", "right_knee"))
"""The commanded joints among all, in the order of actions."""
FEET = ("left_foot", "right_foot")  # geoms that are spheres at the ends of the shins
FOOT_RADIUS_M = 0.075

POSITIONS = 24  # qpos: x, y, z, quaternion, 17 joint angles
STATE_SIZE = 47  # qpos, then qvel (23): linear, angular, 17 joint rates
STANDING = (0.0, 0.0, 1.4, 1.0, *[0.0] * 43)  # the state in which the model starts: upright, at rest, joints at zero
CONTROL_SUBSTEPS = 5  # physics steps per control step: 5 x 0.003 s, as in Gymnasium
TIMESTEP_S = 0.015

STIFFNESS = 200.0  # in N m/rad: the paper's proportional gain
DAMPING = 10.0  # in N m s/rad: the paper's derivative gain
MOTOR_RANGE = 0.4  # Gymnasium's motors take controls of ±0.4, times their gear the torque in N m

CONTACT_M = 0.002  # a foot touches the floor when its sole is closer: the sum of both margins in the model

Actuators = Literal["positions", "motors"]


def humanoid_model(actuators: Actuators = "positions") -> "mujoco.MjModel":
    """Load Gymnasium's humanoid; with "positions" MuJoCo holds joint angles in rad, up to the motors' torques."""
    path = Path(str(files("gymnasium.envs.mujoco") / "assets" / "humanoid.xml"))
    model = mujoco.MjModel.from_xml_path(str(path))
    if actuators == "positions":
        torque = MOTOR_RANGE * model.actuator_gear[:, 0]
        model.actuator_gear[:, 0] = 1.0
        model.actuator_gainprm[:, 0] = STIFFNESS
        model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_biasprm[:, 1:3] = -STIFFNESS, -DAMPING
        model.actuator_ctrllimited[:] = False
        model.actuator_forcelimited[:] = True
        model.actuator_forcerange[:] = np.stack([-torque, torque], axis=1)
    return model


HIP_DEG, KNEE_DEG = (-50.0, 20.0), (-70.0, -2.0)
"""Joint angles of the commands -1 and 1; not in the paper. Random ones over the full ranges make it fall soon."""
COMMAND_PARAMETERS = {
    **{"hip_low_deg": HIP_DEG[0], "hip_high_deg": HIP_DEG[1]},
    **{"knee_low_deg": KNEE_DEG[0], "knee_high_deg": KNEE_DEG[1]},
}
"""The ends of the ranges by name, as datasets record them."""


def commanded_angles(action: Tensor) -> Tensor:
    """Return the angles (..., 4) in rad of commands (..., 4), clipped to ±1."""
    ends = torch.tensor([HIP_DEG, KNEE_DEG] * 2, dtype=action.dtype, device=action.device)
    low, high = torch.deg2rad(ends).unbind(-1)
    return low + (high - low) * (action.clamp(-1.0, 1.0) + 1.0) / 2.0


JOINTS_RAD = tuple(0.3 if joint in COMMANDED else 0.025 for joint in range(len(JOINTS)))
JOINT_RATES_RAD_S = tuple(2.5 if joint in COMMANDED else 0.6 for joint in range(len(JOINTS)))
POSITION_M = 0.07
VELOCITY_M_S = 0.3
LEAN_RAD = 0.1
SPIN_RAD_S = 1.0

_QUATERNION_SPREAD = 0.2
_STATE = (*[POSITION_M] * 3, *[_QUATERNION_SPREAD] * 4, *JOINTS_RAD)
_STATE += (*[VELOCITY_M_S] * 3, *[SPIN_RAD_S] * 3, *JOINT_RATES_RAD_S)


def in_spreads(state: Tensor) -> Tensor:
    """Return the deviations of target states (..., 47) from standing, clipped at 5 spreads, (..., 47)."""
    return normalized(state, state.new_tensor(STANDING), state.new_tensor(_STATE))


_QUATERNION = slice(3, 7)


@dataclass(frozen=True)
class Locomotion:
    """Rewards, starts and ends of episodes."""

    forward_reward: float = 1.25  # per m/s of the center of mass along x
    healthy_reward: float = 5.0  # for every step that ends at a healthy height
    healthy_m: tuple[float, float] = (1.0, 2.0)  # heights of the torso, outside of which the episode ends
    effort_cost: float = 0.1  # per unit of the sum of the squared controls
    contact_cost: float = 5e-7  # per unit of the sum of the squared contact forces and torques
    contact_cost_limit: float = 10.0  # of a step
    reset_noise: float = 0.01  # half width of the uniform noise on positions and velocities at the start

    def draw_starts(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw target states (count, 47): almost upright and at rest."""
        noise = rng.uniform(-self.reset_noise, self.reset_noise, (count, len(STANDING)))
        state = np.array(STANDING) + noise
        state[:, _QUATERNION] /= np.linalg.norm(state[:, _QUATERNION], axis=1, keepdims=True)
        return state

    def healthy[Height: (Floats, Tensor)](self, height: Height) -> Any:  # noqa: ANN401 - Bools of Floats
        """Return which torso heights (B,) in m are healthy, (B,) bool."""
        low, high = self.healthy_m
        return (height > low) & (height < high)

    def reward(self, velocity: Floats, healthy: Bools, effort: Floats, contact: Floats) -> Floats:
        """Return the rewards (B,); `effort`, `contact`: sums of squared controls and of squared contact forces."""
        cost = self.effort_cost * effort
        cost = cost + np.minimum(self.contact_cost * contact, self.contact_cost_limit)
        return np.asarray(self.forward_reward * velocity + self.healthy_reward * healthy - cost)


class HumanoidEnv(PhysicsTarget):
    """B humanoids, states (B, 47); action: angles of hips and knees, (B, 4), clipped to ±1; falls end episodes."""

    observation_size = STATE_SIZE - 2
    action_size = len(COMMANDED)

    def __init__(
        self,
        locomotion: Locomotion,
        num_envs: int,
        *,
        seed: int,
        start_anywhere: bool = False,
        actuators: Actuators = "positions",
        num_threads: int | None = None,
    ) -> None:
        """Build B humanoids with rewards, ends and starts of `locomotion`; `actuators`: see `humanoid_model`."""
        if start_anywhere:
            raise BadInputError("collect.start: expected 'task' for a humanoid, got 'anywhere'")
        self.locomotion, self.num_envs = locomotion, num_envs
        self._model = humanoid_model(actuators)
        motors = humanoid_model("motors")
        self._torque_per_control = motors.actuator_gear[:, 0] / self._model.actuator_gear[:, 0]
        self._mass_share = motors.body_mass / motors.body_mass.sum()
        self.physics = BatchedPhysics(
            self._model, num_envs, substeps=CONTROL_SUBSTEPS, measure=self._measure, num_threads=num_threads
        )
        self.goal = torch.zeros(num_envs, 0)
        self.failed = torch.zeros(num_envs, dtype=torch.bool)
        self.wall_contact = torch.zeros(num_envs, dtype=torch.bool)  # there are no walls
        self.reseed(seed)

    def _measure(self, data: "mujoco.MjData") -> tuple[float, float, float]:
        """Return x of the center of mass, the sums of squared controls and contact forces, of the last evaluation."""
        mujoco.mj_rnePostConstraint(self._model, data)
        control = data.actuator_force / self._torque_per_control
        contact = data.cfrc_ext.ravel()
        return self._mass_share @ data.xipos[:, 0], control @ control, contact @ contact

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of starts at `seed`."""
        self._rng = np.random.default_rng(seed)

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Set the humanoids in `mask` (B,), by default all, almost upright and at rest."""
        rows = rows_in(mask, self.num_envs)
        self.reset_to(rows, self.locomotion.draw_starts(self._rng, len(rows)))
        return self.state[:, 2:]

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Follow the commands `action` (B, 4) for 0.015 s; rows outside `active` (B,) stay."""
        targets = np.zeros((self.num_envs, len(JOINTS)))
        targets[:, COMMANDED] = commanded_angles(action.double()).numpy()
        return self.drive(targets, active)

    def drive(self, control: Floats, active: Tensor | None = None) -> Step:
        """Apply `control` (B, 17), in the order of the actuators; rows outside `active` stay, unrewarded."""
        before = self.physics.measured[:, 0].copy()
        self.physics.step(control, None if active is None else active.numpy())
        after, effort, contact = self.physics.measured.T
        healthy = self.locomotion.healthy(self.physics.qpos[:, 2])
        reward = self.locomotion.reward((after - before) / TIMESTEP_S, healthy, effort, contact)
        self.failed = torch.from_numpy(~healthy)
        return Step(
            observation=self.state[:, 2:],
            reward=torch.from_numpy(reward if active is None else np.where(active, reward, 0.0)).float(),
            terminated=self.failed.clone(),
            success=torch.zeros(self.num_envs, dtype=torch.bool),
        )


_TORSO = 1


class _Skeleton(NamedTuple):
    """Bodies and joints as the model describes them; bodies are by its numbers, in which parents come first."""

    parents: list[int]
    joints: list[range]  # of each body, among all 17
    offsets: Tensor  # from the parents' origins to the bodies', (14, 3)
    turns: Tensor  # from the bodies' axes to the parents', (14, 3, 3)
    anchors: Tensor  # a point on each joint's axis, (17, 3)
    axes: Tensor  # of the joints in their bodies, (17, 3)
    crosses: Tensor  # matrices K with K v = axis x v, (17, 3, 3)
    centers: Tensor  # of mass in the bodies' own frames, (14, 3)
    shares: Tensor  # of the 13 bodies from the torso on in the total mass, (13,)
    moved: Tensor  # the shares that each joint moves, (17, 13)
    feet: tuple[tuple[int, Tensor], ...]  # body that each foot belongs to, and the foot's center, (3,)


@cache
def _skeleton(dtype: "torch.dtype", device: "torch.device") -> _Skeleton:
    model = humanoid_model()
    bodies = range(_TORSO, model.nbody)

    def tensor(values: object) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=dtype, device=device)

    parents = model.body_parentid.tolist()
    joints = [range(at, at + count) for at, count in zip(model.body_jntadr - 1, model.body_jntnum, strict=True)]
    turns, moved = np.zeros((model.nbody, 9)), np.zeros((len(JOINTS), len(bodies)))
    shares = model.body_mass[bodies] / model.body_mass.sum()
    for body, share in zip(bodies, shares, strict=True):
        mujoco.mju_quat2Mat(turns[body], model.body_quat[body])
        carrier = body
        while carrier != _TORSO:
            moved[joints[carrier], body - _TORSO] = share
            carrier = parents[carrier]
    axes = model.jnt_axis[1:]
    return _Skeleton(
        parents=parents,
        joints=joints,
        offsets=tensor(model.body_pos),
        turns=tensor(turns.reshape(-1, 3, 3)),
        anchors=tensor(model.jnt_pos[1:]),
        axes=tensor(axes),
        crosses=tensor([np.cross(np.eye(3), axis) for axis in axes]),
        centers=tensor(model.body_ipos),
        shares=tensor(shares),
        moved=tensor(moved),
        feet=tuple((int(foot.bodyid[0]), tensor(foot.pos)) for foot in map(model.geom, FEET)),
    )


def _place(joints: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return centers of mass of the bodies (..., 13, 3), feet (..., 2, 3), joints' axes and anchors (..., 17, 3)."""
    skeleton = _skeleton(joints.dtype, joints.device)
    identity = torch.eye(3, dtype=joints.dtype, device=joints.device)
    angle = joints[..., None, None]
    crosses = skeleton.crosses
    turns = identity + torch.sin(angle) * crosses + (1 - torch.cos(angle)) * (crosses @ crosses)
    origin = torch.zeros(*joints.shape[:-1], 3, dtype=joints.dtype, device=joints.device)
    frames = {_TORSO: (origin, identity.expand(*joints.shape[:-1], 3, 3))}
    axes, anchors = [origin] * len(JOINTS), [origin] * len(JOINTS)
    for body in range(_TORSO + 1, len(skeleton.parents)):
        origin, turn = frames[skeleton.parents[body]]
        origin = origin + turn @ skeleton.offsets[body]
        turn = turn @ skeleton.turns[body]
        for joint in skeleton.joints[body]:
            anchor = skeleton.anchors[joint]
            axes[joint], anchors[joint] = turn @ skeleton.axes[joint], origin + turn @ anchor
            turn = turn @ turns[..., joint, :, :]
            origin = anchors[joint] - turn @ anchor
        frames[body] = origin, turn

    def place(body: int, point: Tensor) -> Tensor:
        origin, turn = frames[body]
        return origin + turn @ point

    centers = torch.stack([place(body, skeleton.centers[body]) for body in frames], dim=-2)
    feet = torch.stack([place(body, center) for body, center in skeleton.feet], dim=-2)
    return centers, feet, torch.stack(axes, dim=-2), torch.stack(anchors, dim=-2)


def mass_and_feet(joints: Tensor) -> tuple[Tensor, Tensor]:
    """Return center of mass (..., 3), left and right foot (..., 2, 3) in the torso's frame, of angles (..., 17)."""
    centers, feet, _, _ = _place(joints)
    return _skeleton(joints.dtype, joints.device).shares @ centers, feet


def mass_velocity(joints: Tensor, rates: Tensor) -> Tensor:
    """Return the center of mass's velocity (..., 3) in m/s relative to the torso, of angles and rates (..., 17)."""
    centers, _, axes, anchors = _place(joints)
    moved = _skeleton(joints.dtype, joints.device).moved
    lever = moved @ centers - moved.sum(-1, keepdim=True) * anchors
    velocity: Tensor = (rates.unsqueeze(-1) * torch.linalg.cross(axes, lever)).sum(-2)
    return velocity


_HEIGHT = 2
_JOINTS = slice(7, POSITIONS)
_VELOCITY = slice(POSITIONS, POSITIONS + 3)
_SPIN = slice(POSITIONS + 3, POSITIONS + 6)
_RATES = slice(POSITIONS + 6, None)


def _of_arrays_too(phi: Callable[[Tensor], Tensor]) -> Callable[[Any], Any]:
    """Let φ of tensors take and return arrays, too."""

    @wraps(phi)
    def either(state: Any) -> Any:  # noqa: ANN401
        return phi(state) if isinstance(state, torch.Tensor) else phi(torch.from_numpy(state)).numpy()

    return either


@_of_arrays_too
def humanoid_to_walker2d(state: Tensor) -> Tensor:
    """Keep a planar walker: height, pitch, hips and knees, their rates, contacts of feet: (..., 47) to (..., 15)."""
    height, spin = state[..., _HEIGHT], state[..., _SPIN]
    joints, turn = state[..., _JOINTS], rotation(state[..., _QUATERNION])
    velocity = _headed(turn, state[..., _VELOCITY])
    forward, left, up = turn[..., 2, :].unbind(-1)  # the vertical components of the torso's axes
    level = torch.hypot(left, up).clamp_min(1e-6)
    pitch = torch.atan2(-forward, level)
    pitch_rate = (up * spin[..., 1] - left * spin[..., 2]) / level
    _, feet = mass_and_feet(joints)
    axes = torch.stack([forward, left, up], dim=-1).unsqueeze(-2)
    clearance = height.unsqueeze(-1) + (axes * feet).sum(-1) - FOOT_RADIUS_M
    pose = [torch.stack([height, pitch], dim=-1), joints[..., COMMANDED]]
    rates = [velocity[..., [0, 2]], pitch_rate.unsqueeze(-1), state[..., _RATES][..., COMMANDED]]
    return torch.cat([*pose, *rates, (clearance < CONTACT_M).to(state.dtype)], dim=-1)


@_of_arrays_too
def humanoid_to_kinematics(state: Tensor) -> Tensor:
    """Keep the angles in rad and rates in rad/s of all joints: (..., 47) to (..., 34)."""
    return torch.cat([state[..., _JOINTS], state[..., _RATES]], dim=-1)


@_of_arrays_too
def humanoid_to_extended_kinematics(state: Tensor) -> Tensor:
    """Keep joints, center of mass along the heading, its velocity, the torso's up and spin: (..., 47) to (..., 46)."""
    joints, rates = state[..., _JOINTS], state[..., _RATES]
    turn = rotation(state[..., _QUATERNION])

    def turned(vector: Tensor) -> Tensor:
        return (turn @ vector.unsqueeze(-1)).squeeze(-1)

    mass, feet = mass_and_feet(joints)
    aside = _headed(turn, turned(mass - feet.mean(-2)))[..., :2]
    height = state[..., _HEIGHT, None] + turned(mass)[..., 2:]
    spin = state[..., _SPIN]
    swept = torch.linalg.cross(spin, mass) + mass_velocity(joints, rates)
    velocity = _headed(turn, state[..., _VELOCITY] + turned(swept))
    return torch.cat([joints, rates, aside, height, velocity, turn[..., 2, :], spin], dim=-1)


def beyond_walker2d(state: Tensor) -> Tensor:
    """Return what `humanoid_to_walker2d` drops except x and y: (..., 47) to (..., 34), in spreads."""
    seen = in_spreads(state)
    velocity = _headed(rotation(state[..., _QUATERNION]), state[..., _VELOCITY])
    rest = [joint for joint in range(len(JOINTS)) if joint not in COMMANDED]
    joints, rates = seen[..., _JOINTS][..., rest], seen[..., _RATES][..., rest]
    left = normalized(velocity[..., 1:2], 0.0, VELOCITY_M_S)
    return torch.cat([seen[..., _QUATERNION], joints, left, seen[..., _SPIN], rates], dim=-1)


def beyond_kinematics(state: Tensor) -> Tensor:
    """Return what `humanoid_to_kinematics` drops except x and y: (..., 47) to (..., 11), in spreads."""
    seen = in_spreads(state)
    height, quaternion = seen[..., [_HEIGHT]], seen[..., _QUATERNION]
    return torch.cat([height, quaternion, seen[..., _VELOCITY], seen[..., _SPIN]], dim=-1)


def beyond_extended_kinematics(state: Tensor) -> Tensor:
    """Return the heading, which `humanoid_to_extended_kinematics` drops, as cosine and sine: (..., 47) to (..., 2)."""
    return _heading(rotation(state[..., _QUATERNION]))


def _heading(turn: Tensor) -> Tensor:
    """Return the headings of torsos with rotations (..., 3, 3), as cosine and sine (..., 2)."""
    return torch.nn.functional.normalize(turn[..., :2, 0], dim=-1)


def _headed(turn: Tensor, vector: Tensor) -> Tensor:
    """Return vectors (..., 3) in the level frames along the headings of torsos with rotations (..., 3, 3)."""
    cosine, sine = _heading(turn).unbind(-1)
    x, y, z = vector.unbind(-1)
    return torch.stack([cosine * x + sine * y, cosine * y - sine * x, z], dim=-1)
