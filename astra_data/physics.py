"""Step B copies of one MuJoCo model at once, on every core.

Each copy keeps its own `MjData`, so warm starts carry over between control steps exactly as in a single
Gymnasium environment (`mujoco.rollout` starts every call cold), and contacts stay readable.
`mj_step` releases the interpreter lock, so plain threads use all cores.
"""

from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from numpy.typing import NDArray

from astra_data.cores import cores

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class BatchedPhysics:
    """B independent copies of `model`, stepped `substeps` physics steps per control step.

    Attributes:
        qpos: positions, (B, nq) float64, refreshed by `step` and `set_state`.
        qvel: velocities, (B, nv) float64, likewise.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        *,
        substeps: int,
        num_threads: int | None = None,
    ) -> None:
        self.model = model
        self.num_envs = num_envs
        self.substeps = substeps
        self.qpos: Floats = np.zeros((num_envs, model.nq))
        self.qvel: Floats = np.zeros((num_envs, model.nv))
        self._data = [mujoco.MjData(model) for _ in range(num_envs)]
        self._views = [(data, data.ctrl, data.qpos, data.qvel) for data in self._data]
        self.num_threads = min(num_threads or cores(), num_envs)
        self._pool = ThreadPoolExecutor(self.num_threads)

    def set_state(self, rows: NDArray[np.intp], qpos: Floats, qvel: Floats) -> None:
        """Reset the copies `rows` (n,) to `qpos` (n, nq) and `qvel` (n, nv), clearing warm starts."""
        for row, position, velocity in zip(rows, qpos, qvel, strict=True):
            data = self._data[row]
            mujoco.mj_resetData(self.model, data)
            data.qpos[:] = position
            data.qvel[:] = velocity
            mujoco.mj_forward(self.model, data)
        self.qpos[rows] = qpos
        self.qvel[rows] = qvel

    def step(self, control: Floats, active: Bools | None = None) -> None:
        """Apply `control` (B, nu) for one control step to the copies in `active` (B,), by default to all."""
        rows = np.arange(self.num_envs) if active is None else np.flatnonzero(active)
        # Several small shares per thread, so that no core waits for a slow share at the end.
        shares = np.array_split(rows, min(4 * self.num_threads, max(len(rows), 1)))
        if self.num_threads == 1:
            self._step_rows(rows, control)
        else:
            list(self._pool.map(self._step_rows, shares, [control] * len(shares)))

    def _step_rows(self, rows: NDArray[np.intp], control: Floats) -> None:
        model, substeps, step = self.model, self.substeps, mujoco.mj_step
        for row in rows.tolist():
            data, ctrl, qpos, qvel = self._views[row]
            ctrl[:] = control[row]
            step(model, data, substeps)
            self.qpos[row] = qpos
            self.qvel[row] = qvel

    def touches(self, rows: NDArray[np.intp], first_geom: int, last_geom: int) -> Bools:
        """Tell for each copy in `rows` (n,) whether anything touches a geom with id in [first, last]."""
        touching = np.zeros(len(rows), dtype=bool)
        for index, row in enumerate(rows.tolist()):
            geoms = self._data[row].contact.geom
            touching[index] = bool(((geoms >= first_geom) & (geoms <= last_geom)).any())
        return touching
