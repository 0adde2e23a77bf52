"""Recorded walks in control steps, paired with the abstract simulator; and stretches of them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from astra_data.core.config import Config, Count
from astra_data.core.errors import BadInputError
from astra_data.studies.motion import MIRROR, between
from astra_data.studies.planar_walker import PlanarWalker
from astra_data.studies.recordings import Piece
from astra_data.worlds.plane.geometry import turned

MIRRORED_ACTION = (-1.0, 1.0, -1.0, 1.0)
MIRRORED_POINT = (1.0, -1.0)


class StepsConfig(Config):
    """How rows become control steps."""

    rows: Count = 10
    """Rows per control step: at 60 Hz a sixth of a second, so that half a second is three steps."""
    history: Count = 20
    """H, the past control steps in the models' input."""


@dataclass(frozen=True)
class Stretch:
    """B stretches of a walk: H steps of history, then F steps to predict, all in the body's frame.

    Attributes:
        past_motion: of each past step, (B, H, 3); the simulator's where the robot did not walk.
        past_action: mean action in each, (B, H, 4). past_ball: the ball after each, in m, (B, H, 2).
        past_simulated: the simulator's motion in each, (B, H, 3).
        action: mean action in each future step, (B, F, 4). simulated: the simulator's motion, (B, F, 3).
        motion: the robot's motion, (B, F, 3). is_walking: (B, F) bool.
        heading: in the field at the start of the prediction, (B,).
    """

    past_motion: Tensor
    past_action: Tensor
    past_ball: Tensor
    past_simulated: Tensor
    action: Tensor
    simulated: Tensor
    motion: Tensor
    is_walking: Tensor
    heading: Tensor

    def __len__(self) -> int:
        """Return B."""
        return len(self.heading)

    def mirrored(self, which: Tensor | None = None) -> "Stretch":
        """Mirror left and right in the stretches in `which` (B,) bool, by default all."""
        signs = {3: MIRROR, 4: MIRRORED_ACTION, 2: MIRRORED_POINT}
        changed = {}
        for field in fields(self):
            values = getattr(self, field.name)
            if values.dim() == 3:
                sign = values.new_tensor(signs[values.shape[-1]])
                flips = values * sign
                values = flips if which is None else torch.where(which[:, None, None], flips, values)
            changed[field.name] = values
        return Stretch(**changed)


@dataclass(frozen=True)
class Walks:
    """E sequences of control steps, padded at the end to T.

    A piece gives as many sequences as a control step has rows, each starting one row later, so that a step
    starts at every row.

    Attributes:
        motion: of each step, in the body's frame, (E, T, 3). simulated: the abstract simulator's, (E, T, 3).
        action: mean action of the rows, (E, T, 4). ball: in the body's frame before each step and after the
        last, (E, T + 1, 2). heading: before each step, (E, T). is_walking: (E, T) bool, False in the padding.
        piece: index of the piece of each sequence, (E,). lengths: steps of each, (E,).
    """

    motion: Tensor
    simulated: Tensor
    action: Tensor
    ball: Tensor
    heading: Tensor
    is_walking: Tensor
    piece: Tensor
    lengths: Tensor

    @classmethod
    def of_pieces(cls, pieces: Sequence[Piece], fps: int, config: StepsConfig) -> "Walks":
        """Cut `pieces`, recorded at `fps` rows per second, into steps; replay each in the abstract simulator.

        Raises:
            BadInputError: no piece is long enough for a history and one step.
        """
        sequences = [
            _steps(piece, number, first, fps, config.rows)
            for number, piece in enumerate(pieces)
            for first in range(config.rows)
            if len(piece) - first >= (config.history + 1) * config.rows
        ]
        if not sequences:
            seconds = (config.history + 1) * config.rows / fps
            raise BadInputError(f"expected pieces of more than {seconds:.1f} s without a split, found none")
        columns = {
            name: pad_sequence([sequence[name] for sequence in sequences], batch_first=True)
            for name in ("motion", "simulated", "action", "ball", "heading", "is_walking")
        }
        return cls(
            **columns,
            piece=torch.tensor([int(sequence["piece"]) for sequence in sequences]),
            lengths=torch.tensor([len(sequence["motion"]) for sequence in sequences]),
        )

    def starts(self, history: int, steps: int) -> tuple[Tensor, Tensor]:
        """Return sequences (N,) and steps (N,) with `history` steps before and `steps` of walking after."""
        length = self.is_walking.shape[1]
        if length < history + steps:
            return torch.empty(0, dtype=torch.long), torch.empty(0, dtype=torch.long)
        ahead = self.is_walking[:, history:].unfold(1, steps, 1).all(-1)
        sequence, step = ahead.nonzero(as_tuple=True)
        return sequence, step + history

    def stretches(self, sequence: Tensor, step: Tensor, history: int, steps: int) -> Stretch:
        """Return the stretches (B, ...) of `sequence` (B,) whose prediction starts at `step` (B,)."""
        row = sequence[:, None]
        past = step[:, None] + torch.arange(-history, 0)
        simulated = self.simulated[row, past]
        ahead = step[:, None] + torch.arange(steps)
        inside = ahead < self.is_walking.shape[1]
        ahead = ahead.clamp_max(self.is_walking.shape[1] - 1)
        return Stretch(
            past_motion=torch.where(self.is_walking[row, past][..., None], self.motion[row, past], simulated),
            past_action=self.action[row, past],
            past_ball=self.ball[row, past + 1],
            past_simulated=simulated,
            action=self.action[row, ahead],
            simulated=self.simulated[row, ahead],
            motion=self.motion[row, ahead],
            is_walking=self.is_walking[row, ahead] & inside,
            heading=self.heading[sequence, step],
        )


def _steps(piece: Piece, number: int, first: int, fps: int, rows: int) -> dict[str, Tensor]:
    """Return the control steps of a piece from row `first` on, each column (T, ...)."""
    count = (len(piece) - first) // rows
    state = torch.from_numpy(piece.state[first : first + count * rows + 1 : rows])
    action = torch.from_numpy(piece.action[first : first + count * rows]).reshape(count, rows, 4)
    broken = piece.broken[first : first + count * rows].reshape(count, rows).any(axis=1)
    pose = state[:, :3]
    return {
        "motion": between(pose[:-1], pose[1:]).float(),
        "simulated": _replayed(state[:-1], action, fps).float(),
        "action": action.mean(1).float(),
        "ball": turned(state[:, 3:] - pose[:, :2], -pose[:, 2]).float(),
        "heading": pose[:-1, 2].float(),
        "is_walking": torch.from_numpy(~broken),
        "piece": torch.tensor(number),
    }


def _replayed(state: Tensor, action: Tensor, fps: int) -> Tensor:
    """Return the abstract simulator's motions (T, 3) from `state` (T, 5) under actions (T, rows, 4)."""
    simulator = PlanarWalker(len(state), timestep_s=1 / fps)
    # The velocity before does not matter: the body follows commands at once.
    standing = torch.zeros(len(state), 3, dtype=state.dtype)
    simulator.reset_to(torch.cat([state[:, :3], standing, state[:, 3:]], dim=-1))
    for row in action.unbind(1):
        simulator.step(row)
    return between(state[:, :3], simulator.state[:, :3])
