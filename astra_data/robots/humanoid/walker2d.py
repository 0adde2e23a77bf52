"""The most abstract simulator of the humanoid: a walker in the plane, with legs under one rigid link.

It is the humanoid reduced to the plane of x and z, with the same physics and position control. What it leaves
out: docs/humanoid.md.
"""

from collections.abc import Mapping
from copy import copy

import numpy as np
import torch
from torch import Tensor

from astra_data.dataset.columns import ABSTRACT_STATE, Column
from astra_data.robots.humanoid.abstraction import humanoid_to_walker2d
from astra_data.robots.humanoid.model import CONTACT_M, CONTROL_SUBSTEPS, STANDING, TIMESTEP_S, CommandRanges
from astra_data.robots.humanoid.walker import sole_clearance, walker_model
from astra_data.worlds.free_states import FreeStates
from astra_data.worlds.mujoco_model import ColdSteps

_JOINTS = ("left_hip", "left_knee", "right_hip", "right_knee")
_POSE = slice(0, 6)
_MOTION = slice(0, 13)
_CONTACTS = slice(13, 15)


class HumanoidWalker2d(FreeStates):
    """B walkers; action: angles of left hip, left knee, right hip, right knee, (B, 4), clipped to ±1.

    Attributes:
        state: (B, 15) float32, as `humanoid_to_walker2d` makes it.
        memory: depth of the floors below 0 in m, (B, 1) float64.
    """

    action_size = 4
    abstract_state = Column(
        ABSTRACT_STATE,
        size=15,
        names=(
            *("z", "pitch", *_JOINTS),
            *("vx", "vz", "pitch_rate", *(f"{name}_rate" for name in _JOINTS)),
            *("left_contact", "right_contact"),
        ),
        meaning="torso, legs and foot contacts of a planar walker",
        astra={
            "unit": ["m", *["rad"] * 5, "m/s", "m/s", *["rad/s"] * 5, "1", "1"],
            "frame": ["heading"] * 2 + ["joint"] * 4 + ["heading"] * 3 + ["joint"] * 4 + ["world"] * 2,
            "role": ["invariant"] * 15,
        },
    )
    abstraction = staticmethod(humanoid_to_walker2d)

    def __init__(
        self,
        num_envs: int,
        *,
        ranges: CommandRanges | None = None,
        num_threads: int | None = None,
        device: str = "cpu",
    ) -> None:
        """Build B standing walkers.

        Args:
            num_envs: B.
            ranges: joint angles of commands.
            num_threads: physics threads, by default one per core.
            device: torch device of states and actions; the physics runs on the CPU.
        """
        standing = humanoid_to_walker2d(torch.tensor(STANDING))
        super().__init__(standing.repeat(num_envs, 1).to(device))
        self.memory = self._sunk(self.state)
        self.ranges = ranges or CommandRanges()
        self._model = walker_model()
        self._models = [self._model]
        self._steps = ColdSteps(self._model, num_envs, num_threads)

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {"timestep_s": TIMESTEP_S, **self.ranges.parameters}

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use other joints and control steps from the next step on.

        Args:
            parameters: (B, 1) each: "friction", a factor on the damping of the joints; "timestep_scale", a
                factor on the control step, which keeps its number of physics steps. At 5/3 the longer physics
                steps put poses off by 0.3 % and rates by 1.2 % of what they change by in a step.
        """
        plain = self._model
        if self._models[0] is plain:
            self._models = [copy(plain) for _ in self.state]
        friction, timestep_scale = (
            parameters[name][:, 0].tolist() for name in ("friction", "timestep_scale")
        )
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
        targets = self.ranges.targets(action.cpu().double()).numpy()
        # Before z comes x, which is 0 at the start of every step.
        placed = np.pad(motion.numpy(), ((0, 0), (1, 0)))
        landed = self._steps(self._models, placed, targets, substeps=CONTROL_SUBSTEPS)
        motion = torch.from_numpy(landed[:, 1:].copy())
        contacts = (sole_clearance(motion[:, _POSE]) < CONTACT_M).to(motion.dtype)
        motion[:, 0] -= sunk
        self.state = torch.cat([motion, contacts], dim=-1).float().to(self.state.device)
        return self.state
