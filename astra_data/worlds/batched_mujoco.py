"""Step B copies of one MuJoCo model at once, on every core.

The copies' states, warm starts included, are rows of one array, so that each goes on exactly as a single
Gymnasium environment would (`mujoco.rollout` starts every call cold). Each thread steps its copies in one
`MjData`, which therefore stays in the core's cache; `mj_step` releases the interpreter lock.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.core.provenance import cores
from astra_data.worlds.plane.mazes import Maze

_PHYSICS = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_STATE = int(_PHYSICS | mujoco.mjtState.mjSTATE_WARMSTART | mujoco.mjtState.mjSTATE_CTRL)


def add_walls(world: ElementTree.Element, maze: Maze, height: float, **attributes: str) -> None:
    """Add a box of `height` m for each wall cell of `maze` to the body `world` of a model's XML."""
    half = 0.5 * maze.scale
    for row, column in maze.wall_cells():
        x, y = maze.cell_center(row, column)
        box = {"name": f"block_{row}_{column}", "type": "box", "size": f"{half} {half} {height / 2}"}
        ElementTree.SubElement(world, "geom", {**box, "pos": f"{x} {y} {height / 2}", **attributes})


def wall_geoms(model: mujoco.MjModel) -> tuple[int, int] | None:
    """Return the first and last geom id of the maze walls (ids are contiguous), or None on an open plane."""
    walls = [
        geom
        for geom in range(model.ngeom)
        if mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom).startswith("block_")
    ]
    return (walls[0], walls[-1]) if walls else None


def views(model: mujoco.MjModel, state: Floats) -> tuple[Floats, Floats]:
    """Return views of full states (B, N): positions (B, nq) and velocities (B, nv)."""
    after_time, end = 1 + model.nq, 1 + model.nq + model.nv
    return state[:, 1:after_time], state[:, after_time:end]


def share_out(
    rows: Iterable[int], pool: ThreadPoolExecutor, work: Callable[[int, Iterator[int]], None], threads: int
) -> None:
    """Have `threads`, the caller's and others of `pool`, `work` with their number on some of the `rows`."""
    # All threads take rows from one iterator (its `next` is atomic), so that none waits for a slower one.
    waiting = iter(rows)
    helpers = [pool.submit(work, thread, waiting) for thread in range(1, threads)]
    work(0, waiting)
    for helper in helpers:
        helper.result()


class BatchedPhysics:
    """B independent copies of `model`, stepped `substeps` physics steps per control step.

    Attributes:
        qpos: positions, (B, nq) float64, refreshed by `step` and `set_state`. qvel: velocities, (B, nv)
        float64, likewise. state: the full state of each copy, warm start included, (B, N) float64; a copy of
        it can be written back. touching: whether anything touched a watched geom at the end of the copy's
        last step, (B,) bool. measured: the numbers that `measure` read off each copy when it was last stepped
        or set, (B, M) float64.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        *,
        substeps: int,
        watched_geoms: tuple[int, int] | None = None,
        measure: Callable[[mujoco.MjData], Sequence[float]] | None = None,
        num_threads: int | None = None,
    ) -> None:
        """Allocate B copies in the model's initial state.

        watched_geoms: first and last id of the geoms whose contacts are reported, by default none. measure:
        reads M numbers off a copy that was just stepped or set, without changing its state.
        """
        self.model = model
        self.num_envs = num_envs
        self.substeps = substeps
        self.num_threads = min(num_threads or cores(), num_envs)
        self._watched = frozenset(range(watched_geoms[0], watched_geoms[1] + 1) if watched_geoms else ())
        self._measure = measure
        self.state: Floats = np.zeros((num_envs, mujoco.mj_stateSize(model, _STATE)))
        self.qpos, self.qvel = views(model, self.state)
        self.touching: Bools = np.zeros(num_envs, dtype=bool)
        self._control: Floats = self.state[:, self.state.shape[1] - model.nu :]
        self._rows = list(self.state)
        self._data = [mujoco.MjData(model) for _ in range(self.num_threads)]
        self._pool = ThreadPoolExecutor(self.num_threads)
        size = 0 if measure is None else len(measure(self._data[0]))
        self.measured: Floats = np.zeros((num_envs, size))
        self.set_state(np.arange(num_envs), np.tile(model.qpos0, (num_envs, 1)), np.zeros_like(self.qvel))

    def set_state(self, rows: NDArray[np.intp], qpos: Floats, qvel: Floats) -> None:
        """Reset the copies `rows` (n,) to `qpos` (n, nq) and `qvel` (n, nv), clearing warm starts."""
        data = self._data[0]
        for row, position, velocity in zip(rows, qpos, qvel, strict=True):
            mujoco.mj_resetData(self.model, data)
            data.qpos[:] = position
            data.qvel[:] = velocity
            mujoco.mj_forward(self.model, data)
            mujoco.mj_getState(self.model, data, self._rows[row], _STATE)
            if self._measure is not None:
                self.measured[row] = self._measure(data)
        self.touching[rows] = False

    def step(self, control: Floats, active: Bools | None = None) -> None:
        """Apply `control` (B, nu) for one control step to the copies in `active` (B,), by default to all."""
        self._control[:] = control
        rows = range(self.num_envs) if active is None else np.flatnonzero(active).tolist()
        share_out(rows, self._pool, self._step_rows, self.num_threads)

    def _step_rows(self, thread: int, rows: Iterator[int]) -> None:
        data = self._data[thread]
        model, substeps, watched, measure = self.model, self.substeps, self._watched, self._measure
        get_state, set_state, step = mujoco.mj_getState, mujoco.mj_setState, mujoco.mj_step
        for row in rows:
            state = self._rows[row]
            set_state(model, data, state, _STATE)
            step(model, data, substeps)
            get_state(model, data, state, _STATE)
            if watched:
                # Few geoms touch: a set is a third of the time of numpy's comparisons.
                self.touching[row] = not watched.isdisjoint(data.contact.geom.flat)
            if measure is not None:
                self.measured[row] = measure(data)
