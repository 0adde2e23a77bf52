"""Abstract simulators that are MuJoCo models, reset and stepped in batches by `mujoco.rollout`."""

import copy

import mujoco
import numpy as np
import torch
from mujoco.rollout import Rollout
from torch import Tensor

from astra_data.core.cores import cores
from astra_data.core.errors import BadInputError
from astra_data.worlds.free_states import FreeStates


class MujocoModel(FreeStates):
    """B copies of a MuJoCo model; state: qpos (nq) then qvel (nv), action: the motors' controls (nu).

    Every step starts cold, without the solver's warm start from the last one: pairs need that, for their
    states have just been reset.

    Attributes:
        state: (B, nq + nv) float32.
    """

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, *, substeps: int, num_threads: int | None = None
    ) -> None:
        """Allocate B copies in the model's initial state.

        Args:
            model: the model.
            num_envs: B.
            substeps: physics steps per step.
            num_threads: by default one per core.

        Raises:
            BadInputError: the model's actuators have states of their own, which (qpos, qvel) leaves out.
        """
        if model.na:
            raise BadInputError(
                f"the model has {model.na} actuator states: expected actuators without states"
            )
        # MuJoCo would put a diverging state back to the initial pose, as if the robot had jumped there.
        self.model = copy.deepcopy(model)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.substeps = substeps
        self._data = [mujoco.MjData(self.model) for _ in range(min(num_threads or cores(), num_envs))]
        self._rollout = Rollout(nthread=len(self._data))
        initial = np.concatenate([model.qpos0, np.zeros(model.nv)])
        super().__init__(torch.from_numpy(np.tile(initial, (num_envs, 1))).float())

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {"timestep_s": self.substeps * float(self.model.opt.timestep), "substeps": self.substeps}

    def step(self, action: Tensor) -> Tensor:
        """Apply controls `action` (B, nu), clipped by the motors; return the new state (B, nq + nv)."""
        model, count = self.model, len(self.state)
        initial = np.zeros((count, mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))))
        initial[:, 1 : 1 + self.state.shape[1]] = self.state.numpy()
        control = np.repeat(action.double().numpy()[:, None], self.substeps, axis=1)
        states, _ = self._rollout.rollout(model, self._data, initial, control)
        self.state = torch.from_numpy(states[:, -1, 1 : 1 + self.state.shape[1]]).float()
        return self.state
