"""Gymnasium's humanoid, driven by position commands for hips and knees; rewards and ends of Humanoid-v5."""

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.robots.humanoid.model import (
    COMMANDED,
    CONTROL_SUBSTEPS,
    JOINTS,
    POSITIONS,
    STATE_SIZE,
    TIMESTEP_S,
    Actuators,
    CommandRanges,
    Locomotion,
    humanoid_model,
)
from astra_data.worlds.batched_mujoco import BatchedPhysics
from astra_data.worlds.protocols import Step, rows_in


class HumanoidEnv:
    """B humanoids; action: angles of left hip, left knee, right hip, right knee, (B, 4), clipped to ±1.

    State (B, 47): qpos (24) then qvel (23), as in Gymnasium. Observation (B, 45): the state without x and y,
    as Humanoid-v5's begins. Only falling ends an episode. The reward's control cost is that of Gymnasium's
    motors: position actuators count by the torques that they apply, each divided by the gear of the motor in
    its place. Otherwise targets would cost, not effort.

    Attributes:
        physics: their bodies. goal: (B, 0), there is none.
        failed: (B,) bool, at an unhealthy height after the last step.
    """

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
        """Build B humanoids.

        locomotion: reward, ends and starts. actuators: meaning of the controls, see `humanoid_model`.

        Raises:
            BadInputError: `start_anywhere` is true.
        """
        if start_anywhere:
            raise BadInputError("collect.start: expected 'task' for a humanoid, got 'anywhere'")
        self.locomotion, self.num_envs = locomotion, num_envs
        self.ranges = CommandRanges()
        self._model = humanoid_model(actuators)
        motors = humanoid_model("motors")
        self._torque_per_control = motors.actuator_gear[:, 0] / self._model.actuator_gear[:, 0]
        self._mass_share = motors.body_mass / motors.body_mass.sum()
        self.physics = BatchedPhysics(
            self._model, num_envs, substeps=CONTROL_SUBSTEPS, measure=self._measure, num_threads=num_threads
        )
        self.goal = torch.zeros(num_envs, 0)
        self.failed = torch.zeros(num_envs, dtype=torch.bool)
        self.reseed(seed)

    def _measure(self, data: mujoco.MjData) -> tuple[float, float, float]:
        """Return x of the center of mass, and the sums of squared controls and contact forces.

        As in Gymnasium, they are of the last evaluation of the dynamics, not of the state after it.
        """
        mujoco.mj_rnePostConstraint(self._model, data)
        control = data.actuator_force / self._torque_per_control
        contact = data.cfrc_ext.ravel()
        return self._mass_share @ data.xipos[:, 0], control @ control, contact @ contact

    @property
    def state(self) -> Tensor:
        """The full target states, (B, 47) float32."""
        return torch.from_numpy(np.concatenate([self.physics.qpos, self.physics.qvel], axis=1)).float()

    @property
    def position(self) -> Tensor:
        """Positions of the humanoids, (B, 2) float32 in m."""
        return self.state[:, :2]

    @property
    def wall_contact(self) -> Tensor:
        """All false, for there are no walls: (B,) bool."""
        return torch.zeros(self.num_envs, dtype=torch.bool)

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of starts at `seed`."""
        self._rng = np.random.default_rng(seed)

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Set the humanoids in `mask` (B,), by default all, almost upright and at rest."""
        rows = rows_in(mask, self.num_envs)
        self.reset_to(rows, self.locomotion.draw_starts(self._rng, len(rows)))
        return self.state[:, 2:]

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Set the humanoids `rows` (n,) to `state` (n, 47)."""
        self.physics.set_state(rows, state[:, :POSITIONS], state[:, POSITIONS:])
        self.failed[rows] = False

    def state_dict(self) -> dict[str, Tensor]:
        """Return what `load_state_dict` needs to continue from here; later random draws may differ."""
        arrays = {"physics": self.physics.state, "measured": self.physics.measured}
        return {name: torch.from_numpy(values.copy()) for name, values in arrays.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        self.physics.state[:] = state["physics"].numpy()
        self.physics.measured[:] = state["measured"].numpy()

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Follow the commands `action` (B, 4) for 0.015 s; rows outside `active` (B,) stay."""
        targets = np.zeros((self.num_envs, len(JOINTS)))
        targets[:, COMMANDED] = self.ranges.targets(action.double()).numpy()
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
