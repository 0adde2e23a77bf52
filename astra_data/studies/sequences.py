"""Recorded motions in control steps, paired with the abstract simulator; and stretches of them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from astra_data.core.config import Config, Count
from astra_data.core.errors import BadInputError
from astra_data.studies.body import Body
from astra_data.studies.recordings import Piece

_KINDS = {"action": "action", "seen": "seen"}
"""What of `Body.mirror` the columns follow; all others are motions."""


class StepsConfig(Config):
    """How rows become control steps."""

    rows: Count = 10
    """Rows per control step: at 60 Hz a sixth of a second, so that half a second is three steps."""
    history: Count = 20
    """H, the number of past control steps in the models' input."""


@dataclass(frozen=True)
class Stretch:
    """B stretches of a recording: H steps of history, then F steps to predict; sizes as in `Body`.

    Attributes:
        past_motion: of each past step, (B, H, M); the simulator's where it does not count.
        past_action: the command in each, (B, H, G). past_seen: what is seen after each, (B, H, S).
        past_simulated: the simulator's motion in each, (B, H, M).
        action: mean action in each future step, as recorded, (B, F, A).
        simulated: the simulator's motion from each recorded state, (B, F, M).
        motion: the robot's motion, (B, F, M). counts: whether it does, (B, F): see `Body.broken`.
        heading: in the field at the start of the prediction, (B,). body: what moves.
    """

    past_motion: Tensor
    past_action: Tensor
    past_seen: Tensor
    past_simulated: Tensor
    action: Tensor
    simulated: Tensor
    motion: Tensor
    counts: Tensor
    heading: Tensor
    body: Body

    def __len__(self) -> int:
        """Return B."""
        return len(self.heading)

    @property
    def all_count(self) -> Tensor:
        """Whether each future step counts and all before it do, (B, F)."""
        return self.counts.long().cumprod(1).bool()

    def mirrored(self, which: Tensor | None = None) -> "Stretch":
        """Mirror left and right in the stretches in `which` (B,) bool, by default all; joints stay."""
        if not self.body.mirror:
            return self
        changed: dict[str, Any] = {}
        for field in fields(self):
            values = getattr(self, field.name)
            if isinstance(values, Tensor) and values.dim() == 3:
                kind = _KINDS.get(field.name.removeprefix("past_"), "motion")
                flips = values * values.new_tensor(self.body.mirror[kind])
                chosen = flips if which is None else torch.where(which[:, None, None], flips, values)
                changed[field.name] = chosen
        return replace(self, **changed)

    def first(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return what is seen before the first future step, its command and the simulator's motion."""
        seen = self.past_seen[:, -1]
        return seen, *self.body.command(self.action[:, 0], self.simulated[:, 0], seen)


@dataclass(frozen=True)
class Sequences:
    """E sequences of control steps, padded at the end to T.

    A piece gives as many sequences as a control step has rows, each starting one row later, so that a step
    starts at every row.

    Attributes:
        motion: of each step, (E, T, M). simulated: the abstract simulator's, (E, T, M).
        action: mean action of the rows, (E, T, A). seen: what is seen before each step and after the last,
        (E, T + 1, S). heading: before each step, (E, T). counts: whether a step does, (E, T); padding never.
        piece: index of the piece of each sequence, (E,). lengths: steps of each, (E,). body: what moves.
    """

    motion: Tensor
    simulated: Tensor
    action: Tensor
    seen: Tensor
    heading: Tensor
    counts: Tensor
    piece: Tensor
    lengths: Tensor
    body: Body

    @classmethod
    def of_pieces(cls, pieces: Sequence[Piece], fps: int, config: StepsConfig) -> "Sequences":
        """Cut `pieces`, recorded at `fps` rows per second, into steps; replay each in the abstract simulator.

        Raises:
            BadInputError: no piece is long enough for a history and one step.
        """
        body = pieces[0].body.at(config.rows / fps)
        sequences = [
            _steps(body, piece, number, first, fps, config.rows)
            for number, piece in enumerate(pieces)
            for first in range(config.rows)
            if len(piece) - first >= (config.history + 1) * config.rows
        ]
        if not sequences:
            seconds = (config.history + 1) * config.rows / fps
            raise BadInputError(f"expected pieces of more than {seconds:.1f} s without a split, found none")
        columns = {
            name: pad_sequence([sequence[name] for sequence in sequences], batch_first=True)
            for name in ("motion", "simulated", "action", "seen", "heading", "counts")
        }
        return cls(
            **columns,
            piece=torch.tensor([int(sequence["piece"]) for sequence in sequences]),
            lengths=torch.tensor([len(sequence["motion"]) for sequence in sequences]),
            body=body,
        )

    def starts(self, history: int, steps: int) -> tuple[Tensor, Tensor]:
        """Return sequences (N,) and steps (N,) with `history` steps before and `steps` that count after."""
        length = self.counts.shape[1]
        if length < history + steps:
            return torch.empty(0, dtype=torch.long), torch.empty(0, dtype=torch.long)
        ahead = self.counts[:, history:].unfold(1, steps, 1).all(-1)
        sequence, step = ahead.nonzero(as_tuple=True)
        return sequence, step + history

    def stretches(self, sequence: Tensor, step: Tensor, history: int, steps: int) -> Stretch:
        """Return the stretches (B, ...) of `sequence` (B,) whose prediction starts at `step` (B,)."""
        row = sequence[:, None]
        past = step[:, None] + torch.arange(-history, 0)
        simulated, before = self.simulated[row, past], self.seen[row, past]
        ahead = step[:, None] + torch.arange(steps)
        inside = ahead < self.counts.shape[1]
        ahead = ahead.clamp_max(self.counts.shape[1] - 1)
        return Stretch(
            past_motion=torch.where(self.counts[row, past][..., None], self.motion[row, past], simulated),
            past_action=self.body.command(self.action[row, past], simulated, before)[0],
            past_seen=self.seen[row, past + 1],
            past_simulated=simulated,
            action=self.action[row, ahead],
            simulated=self.simulated[row, ahead],
            motion=self.motion[row, ahead],
            counts=self.counts[row, ahead] & inside,
            heading=self.heading[sequence, step],
            body=self.body,
        )


def _steps(body: Body, piece: Piece, number: int, first: int, fps: int, rows: int) -> dict[str, Tensor]:
    """Return the control steps of a piece from row `first` on, each column (T, ...)."""
    count = (len(piece) - first) // rows
    last = first + count * rows
    broken = piece.broken[first:last].reshape(count, rows).any(axis=1)
    columns = body.steps(piece.state[first : last + 1], piece.action[first:last], rows, fps)
    return columns | {"counts": torch.from_numpy(~broken), "piece": torch.tensor(number)}
