"""B humanoids under joint controls, with the rewards and ends of Gymnasium's Humanoid-v5."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.robots.humanoid.locomotion import Locomotion
from astra_data.robots.humanoid.model import (
    CONTROL_SUBSTEPS,
    POSITIONS,
    TIMESTEP_S,
    Actuators,
    humanoid_model,
)
from astra_data.worlds.batched_mujoco import BatchedPhysics


class Humanoids:
    """B humanoids, each on a floor of its own.

    The reward's control cost is that of Gymnasium's motors: position actuators count by the torques that they
    apply, each divided by the gear of the motor in its place. Otherwise targets would cost, not effort.

    Attributes:
        physics: their bodies.
        reward: of the last step, (B,) float64; 0 for humanoids that were not active.
    """

    def __init__(
        self,
        locomotion: Locomotion,
        num_envs: int,
        *,
        actuators: Actuators = "positions",
        num_threads: int | None = None,
    ) -> None:
        """Build B humanoids in the model's initial pose.

        Args:
            locomotion: the task.
            num_envs: B.
            actuators: meaning of the controls, see `humanoid_model`.
            num_threads: physics threads, by default one per core.
        """
        self.locomotion = locomotion
        model, motors = humanoid_model(actuators), humanoid_model("motors")
        self._model = model
        self._torque_per_control = motors.actuator_gear[:, 0] / model.actuator_gear[:, 0]
        self._mass_share = model.body_mass / model.body_mass.sum()
        self.physics = BatchedPhysics(
            model, num_envs, substeps=CONTROL_SUBSTEPS, measure=self._measure, num_threads=num_threads
        )
        self.reward: Floats = np.zeros(num_envs)

    @property
    def state(self) -> Floats:
        """Positions and velocities, (B, 47)."""
        return np.concatenate([self.physics.qpos, self.physics.qvel], axis=1)

    @property
    def healthy(self) -> Bools:
        """Which are at a healthy height, (B,)."""
        return self.locomotion.healthy(self.physics.qpos[:, 2])

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Set the humanoids `rows` (n,) to `state` (n, 47)."""
        self.physics.set_state(rows, state[:, :POSITIONS], state[:, POSITIONS:])
        self.reward[rows] = 0.0

    def step(self, control: Floats, active: Bools | None = None) -> None:
        """Apply `control` (B, 17), in the order of the actuators, for 0.015 s to the `active` rows (B,)."""
        before = self.physics.measured[:, 0].copy()
        self.physics.step(control, active)
        after, effort, contact = self.physics.measured.T
        reward = self.locomotion.reward((after - before) / TIMESTEP_S, self.healthy, effort, contact)
        self.reward = reward if active is None else np.where(active, reward, 0.0)

    def _measure(self, data: mujoco.MjData) -> tuple[float, float, float]:
        """Return x of the center of mass, and the sums of squared controls and contact forces.

        As in Gymnasium, they are of the last evaluation of the dynamics, not of the state after it.
        """
        mujoco.mj_rnePostConstraint(self._model, data)
        control = data.actuator_force / self._torque_per_control
        contact = data.cfrc_ext.ravel()
        return self._mass_share @ data.xipos[:, 0], control @ control, contact @ contact
