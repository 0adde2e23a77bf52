"""Abstract simulators of states without walls: of a NumPy function, or a MuJoCo model; batches of MuJoCo."""

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, mujoco, torch
from astra_data.core.provenance import cores
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.user_code import explained


def shaped(what: str, found: object, shape: tuple[int, ...], advice: str) -> Floats:
    """Return what the user's code `found` as an array; refuse what is none of `shape`."""
    with explained(what):
        array = np.asarray(found, dtype=np.float64)
    if array.shape != shape:
        got = "None" if found is None else array.shape
        raise BadInputError(f"{what}: expected an array of shape {shape}, got {got}: {advice}")
    return array


class FreeStates:
    """B states (B, X) float32 in a space without obstacles; where a subclass has some, `blocked` (B,) bool says so."""

    def __init__(self, state: Tensor) -> None:
        self.state = state
        self.blocked = torch.zeros(len(state), dtype=torch.bool, device=state.device)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X)."""
        # New tensors, so that callers can keep earlier ones.
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` to `landed`, both (B, X); return `landed`."""
        self.reset_to(landed)
        return self.state


class NumpySimulator(FreeStates):
    """B abstract states (B, X) that a NumPy function steps; `partial` makes of it what builds B of them."""

    def __init__(
        self,
        num_envs: int,
        *,
        function: Callable[[Floats, Floats], NDArray[np.floating[Any]]],
        size: int,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        """Begin with B states of zeros; `function` maps states (B, X) and commands (B, A), float64, to the next."""
        super().__init__(torch.zeros(num_envs, size))
        self._function = function
        self.parameters: dict[str, float] = dict(parameters or {})

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, A); return the new states (B, X)."""
        landed = self._function(self.state.double().numpy(), action.double().numpy())
        expected, advice = tuple(self.state.shape), "return the next state of every row"
        landed = shaped("the simulator's function of states and commands", landed, expected, advice)
        self.state = torch.from_numpy(landed.astype(np.float32))
        return self.state


class ColdSteps:
    """Steps of B copies of a MuJoCo model without actuator states, nor the solver's warm start, as pairs need it."""

    def __init__(self, model: "mujoco.MjModel", num_envs: int, num_threads: int | None = None) -> None:
        from mujoco.rollout import Rollout  # noqa: PLC0415 - slow

        self._data = [mujoco.MjData(model) for _ in range(min(num_threads or cores(), num_envs))]
        self._rollout = Rollout(nthread=len(self._data))

    def __call__(
        self, model: "mujoco.MjModel | Sequence[mujoco.MjModel]", motion: Floats, control: Floats, *, substeps: int
    ) -> Floats:
        """Return where `substeps` physics steps lead from `motion`, qpos then qvel (B, N); `control` (B, nu) stays."""
        one = model if isinstance(model, mujoco.MjModel) else model[0]
        after_time = slice(1, 1 + one.nq + one.nv)
        initial = np.zeros((len(motion), mujoco.mj_stateSize(one, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))))
        initial[:, after_time] = motion
        states, _ = self._rollout.rollout(model, self._data, initial, np.repeat(control[:, None], substeps, axis=1))
        return np.asarray(states[:, -1, after_time])


class MujocoModel(FreeStates):
    """B copies of a MuJoCo model, stepped cold; state: qpos (nq) then qvel (nv), action: the motors' controls (nu)."""

    def __init__(
        self, model: "mujoco.MjModel", num_envs: int, *, substeps: int, num_threads: int | None = None
    ) -> None:
        if not isinstance(model, mujoco.MjModel):
            raise BadInputError(f"expected a model, such as mujoco.MjModel.from_xml_path(FILE), got {model!r}")
        if int(substeps) != substeps or substeps < 1:
            raise BadInputError(f"substeps: expected a whole number of 1 or more, got {substeps!r}")
        if model.na:
            raise BadInputError(f"the model has {model.na} actuator states: expected actuators without states")
        # MuJoCo would put a diverging state back to the initial pose, as if the robot had jumped there.
        self.model = copy.deepcopy(model)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.substeps = int(substeps)
        self.parameters = {"timestep_s": substeps * float(model.opt.timestep), "substeps": self.substeps}
        self._steps = ColdSteps(self.model, num_envs, num_threads)
        initial = np.concatenate([model.qpos0, np.zeros(model.nv)])
        super().__init__(torch.from_numpy(np.tile(initial, (num_envs, 1))).float())

    def step(self, action: Tensor) -> Tensor:
        """Apply controls `action` (B, nu), clipped by the motors; return the new state (B, nq + nv)."""
        if action.shape[1] != self.model.nu:
            raise BadInputError(f"expected as many commands as motors, {self.model.nu}: got {action.shape[1]}")
        motion, control = self.state.double().numpy(), action.double().numpy()
        landed = self._steps(self.model, motion, control, substeps=self.substeps)
        self.state = torch.from_numpy(landed).float()
        return self.state


@cache
def physics_state() -> int:
    """Return what of MuJoCo's state an episode goes on from."""
    kinds = mujoco.mjtState
    return int(kinds.mjSTATE_FULLPHYSICS | kinds.mjSTATE_WARMSTART | kinds.mjSTATE_CTRL)


def add_walls(world: ElementTree.Element, maze: Maze, height: float, **attributes: str) -> None:
    """Add a box of `height` m for each wall cell of `maze` to the body `world` of a model's XML."""
    half = 0.5 * maze.scale
    for row, column in maze.cells(walls=True):
        x, y = maze.cell_center(row, column)
        box = {"name": f"block_{row}_{column}", "type": "box", "size": f"{half} {half} {height / 2}"}
        ElementTree.SubElement(world, "geom", {**box, "pos": f"{x} {y} {height / 2}", **attributes})


def wall_geoms(model: "mujoco.MjModel") -> tuple[int, int] | None:
    """Return the first and last geom id of the maze walls (ids are contiguous), or None on an open plane."""
    walls = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("block_")]
    return (walls[0], walls[-1]) if walls else None


class BatchedPhysics:
    """B independent copies of `model`, stepped `substeps` physics steps per control step."""

    def __init__(
        self,
        model: "mujoco.MjModel",
        num_envs: int,
        *,
        substeps: int,
        watched_geoms: tuple[int, int] | None = None,
        measure: "Callable[[mujoco.MjData], Sequence[float]] | None" = None,
        num_threads: int | None = None,
    ) -> None:
        """Allocate B copies in the initial state; watch contacts of geoms, first to last; `measure` M numbers each."""
        self.model, self.num_envs, self.substeps = model, num_envs, substeps
        self.num_threads = min(num_threads or cores(), num_envs)
        self._watched = frozenset(range(watched_geoms[0], watched_geoms[1] + 1) if watched_geoms else ())
        self._measure = measure
        self.state: Floats = np.zeros((num_envs, mujoco.mj_stateSize(model, physics_state())))  # warm start included
        self.qpos, self.qvel, _ = np.split(self.state[:, 1:], [model.nq, model.nq + model.nv], axis=1)  # views
        self.touching: Bools = np.zeros(num_envs, dtype=bool)  # a watched geom, at the end of the last step
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
            mujoco.mj_getState(self.model, data, self._rows[row], physics_state())
            if self._measure is not None:
                self.measured[row] = self._measure(data)
        self.touching[rows] = False

    def step(self, control: Floats, active: Bools | None = None) -> None:
        """Apply `control` (B, nu) for one control step to the copies in `active` (B,), by default to all."""
        self._control[:] = control
        self._share_out(range(self.num_envs) if active is None else np.flatnonzero(active).tolist(), self._step_rows)

    def _share_out(self, rows: Iterable[int], work: Callable[[int, Iterator[int]], None]) -> None:
        """Have this thread and others `work` with their number on some of the `rows`."""
        # All threads take rows from one iterator (its `next` is atomic), so that none waits for a slower one.
        waiting = iter(rows)
        helpers = [self._pool.submit(work, thread, waiting) for thread in range(1, self.num_threads)]
        work(0, waiting)
        for helper in helpers:
            helper.result()

    def _step_rows(self, thread: int, rows: Iterator[int]) -> None:
        data = self._data[thread]
        model, substeps, watched, measure = self.model, self.substeps, self._watched, self._measure
        get_state, set_state, step = mujoco.mj_getState, mujoco.mj_setState, mujoco.mj_step
        for row in rows:
            state = self._rows[row]
            set_state(model, data, state, physics_state())
            step(model, data, substeps)
            get_state(model, data, state, physics_state())
            if watched:
                # Few geoms touch: a set is a third of the time of numpy's comparisons.
                self.touching[row] = not watched.isdisjoint(data.contact.geom.flat)
            if measure is not None:
                self.measured[row] = measure(data)


class PhysicsTarget:
    """What target environments share whose state is that of their `physics`."""

    physics: BatchedPhysics
    goal: Tensor
    failed: Tensor

    @property
    def state(self) -> Tensor:
        """The full target states: qpos, then qvel, (B, S) float32."""
        return torch.from_numpy(np.concatenate([self.physics.qpos, self.physics.qvel], axis=1)).float()

    @property
    def position(self) -> Tensor:
        """Positions of the robots, (B, 2) float32 in m."""
        return torch.from_numpy(self.physics.qpos[:, :2]).float()

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Set the robots `rows` (n,) to `state` (n, S)."""
        self.physics.set_state(rows, *np.split(state, [self.physics.model.nq], axis=1))
        self.failed[rows] = False

    def state_dict(self) -> dict[str, Tensor]:
        """Return what `load_state_dict` needs to continue from here; later random draws may differ."""
        arrays = {"physics": self.physics.state, "measured": self.physics.measured, "goal": self.goal.numpy()}
        return {name: torch.from_numpy(values.copy()) for name, values in arrays.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        self.physics.state[:], self.physics.measured[:] = state["physics"].numpy(), state["measured"].numpy()
        self.goal = state["goal"].clone()
