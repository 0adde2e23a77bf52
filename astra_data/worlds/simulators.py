"""Abstract simulators of states without walls: of a NumPy function, or of a MuJoCo model."""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.rollout import Rollout
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.core.provenance import cores


class FreeStates:
    """B states (B, X) in a space without obstacles.

    Attributes:
        state: (B, X) float32.
    """

    def __init__(self, state: Tensor) -> None:
        """Begin at `state` (B, X)."""
        self.state = state

    @property
    def blocked(self) -> Tensor:
        """Which states were stopped by an obstacle: none, (B,) bool."""
        return torch.zeros(len(self.state), dtype=torch.bool, device=self.state.device)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X)."""
        # New tensors, so that callers can keep earlier ones.
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` to `landed`, both (B, X); return `landed`."""
        self.reset_to(landed)
        return self.state


class NumpySimulator(FreeStates):
    """B abstract states that a NumPy function steps; `partial` makes of it what builds B of them.

    Attributes:
        state: (B, X) float32.
        parameters: what a dataset paired with it records about it.

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from astra_data.worlds.simulators import NumpySimulator
        >>> def drive(state, command):
        ...     return state + 0.1 * command
        >>> make_simulator = partial(NumpySimulator, function=drive, size=2)
        >>> make_simulator(3).step(torch.ones(3, 2)).shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        num_envs: int,
        *,
        function: Callable[[Floats, Floats], NDArray[np.floating[Any]]],
        size: int,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        """Begin with B states of zeros.

        function: maps states (B, X) and commands (B, A), both float64, to the next states (B, X). size: of a
        state, X. parameters: numbers or texts about it, by default none.
        """
        super().__init__(torch.zeros(num_envs, size))
        self._function = function
        self.parameters: dict[str, float] = dict(parameters or {})

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, A); return the new states (B, X)."""
        landed = self._function(self.state.double().numpy(), action.double().numpy())
        self.state = torch.from_numpy(np.array(landed, dtype=np.float32))
        return self.state


class ColdSteps:
    """Steps of B copies of a MuJoCo model without actuator states, by several threads.

    Every step starts cold, without the solver's warm start from the last one: pairs need that, for their
    states have just been reset.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, num_threads: int | None = None) -> None:
        """Prepare steps of `num_envs` copies of `model`; there is by default one thread per core."""
        self._data = [mujoco.MjData(model) for _ in range(min(num_threads or cores(), num_envs))]
        self._rollout = Rollout(nthread=len(self._data))

    def __call__(
        self,
        model: mujoco.MjModel | Sequence[mujoco.MjModel],
        motion: Floats,
        control: Floats,
        *,
        substeps: int,
    ) -> Floats:
        """Return where `substeps` physics steps from `motion`, qpos then qvel (B, nq + nv), lead.

        `model` is one for all, or one for each of the B copies, which differ in numbers alone; the `control`
        of the actuators (B, nu) is constant.
        """
        one = model if isinstance(model, mujoco.MjModel) else model[0]
        after_time = slice(1, 1 + one.nq + one.nv)
        initial = np.zeros((len(motion), mujoco.mj_stateSize(one, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))))
        initial[:, after_time] = motion
        states, _ = self._rollout.rollout(
            model, self._data, initial, np.repeat(control[:, None], substeps, axis=1)
        )
        return np.asarray(states[:, -1, after_time])


class MujocoModel(FreeStates):
    """B copies of a MuJoCo model; state: qpos (nq) then qvel (nv), action: the motors' controls (nu).

    Every step starts cold.

    Attributes:
        state: (B, nq + nv) float32.
    """

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, *, substeps: int, num_threads: int | None = None
    ) -> None:
        """Allocate B copies in the model's initial state.

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
        self._steps = ColdSteps(self.model, num_envs, num_threads)
        initial = np.concatenate([model.qpos0, np.zeros(model.nv)])
        super().__init__(torch.from_numpy(np.tile(initial, (num_envs, 1))).float())

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {"timestep_s": self.substeps * float(self.model.opt.timestep), "substeps": self.substeps}

    def step(self, action: Tensor) -> Tensor:
        """Apply controls `action` (B, nu), clipped by the motors; return the new state (B, nq + nv)."""
        motion, control = self.state.double().numpy(), action.double().numpy()
        landed = self._steps(self.model, motion, control, substeps=self.substeps)
        self.state = torch.from_numpy(landed).float()
        return self.state
