"""Paired episodes as tensors: whole episodes side by side, and windows cut from them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import generator
from astra_data.dataset.columns import (
    ABSTRACT_NEXT_STATE,
    ABSTRACT_SIMULATED_NEXT_STATE,
    ABSTRACT_STATE,
    ACTION,
    GOAL,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    Array,
)
from astra_data.dataset.reader import Dataset
from astra_data.learning.networks.paired_windows import RISK_STEPS, PairedWindows
from astra_data.learning.recorded import draw_steps

_COLUMNS = (
    *(STATE, ACTION, REWARD, TERMINATED, SUCCESS),
    *(ABSTRACT_STATE, ABSTRACT_NEXT_STATE, ABSTRACT_SIMULATED_NEXT_STATE),
)


@dataclass(frozen=True)
class PairedEpisodes:
    """E paired episodes, padded at the end to T steps.

    Attributes:
        target_state: s_i, (E, T, S). reward: what the target paid for each step, (E, T).
        terminated: (E, T) bool, the task ended there, well or badly; never by running out of time.
        windows: everything else, (E, T, ...), with the mask of real steps.
        reference: name and version of the dataset. content_hash: its hash.
        held_out: which episodes the dataset itself sets aside, (E,) bool; None where it does not.
        dropped_place: the entries of s_i that tell where the robot is, if φ drops all of them.
    """

    target_state: Tensor
    reward: Tensor
    terminated: Tensor
    windows: PairedWindows
    reference: str
    content_hash: str
    held_out: Tensor | None = None
    dropped_place: tuple[int, ...] = ()

    @property
    def named(self) -> dict[str, str]:
        """What files made from these episodes tell of them: `dataset` and `hash`."""
        return {"dataset": self.reference, "hash": self.content_hash}

    @classmethod
    def load(cls, root: Path, device: str = "cpu") -> "PairedEpisodes":
        """Read the paired dataset at `root`.

        Raises:
            BadInputError: the dataset has not been paired.
            CorruptDatasetError: it is incomplete.
        """
        dataset = Dataset.open(root)
        if ABSTRACT_STATE not in dataset.features:
            raise BadInputError(f"{root} has no column {ABSTRACT_STATE}: expected a dataset that was paired")
        columns = dataset.columns([*_COLUMNS, *({GOAL} & dataset.features.keys())])
        ends = np.cumsum(dataset.lengths)[:-1]

        def padded(values: Array) -> Tensor:
            pieces = [torch.from_numpy(piece).float() for piece in np.split(values, ends)]
            return pad_sequence(pieces, batch_first=True).to(device)

        said = [bool(word) for word in dataset.metadata.get("held_out", ())]
        action = padded(columns[ACTION])
        goal = columns.get(GOAL, np.empty((len(columns[ACTION]), 0)))
        ended = columns[TERMINATED]
        return cls(
            target_state=padded(columns[STATE]),
            reward=padded(columns[REWARD]),
            terminated=padded(ended).bool(),
            windows=PairedWindows(
                state=padded(columns[ABSTRACT_STATE]),
                action=action,
                previous_action=torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], dim=1),
                goal=padded(goal),
                simulated_next=padded(columns[ABSTRACT_SIMULATED_NEXT_STATE]),
                next_state=padded(columns[ABSTRACT_NEXT_STATE]),
                reward=padded(
                    np.stack(
                        [columns[REWARD] * ~ended, columns[REWARD] * (ended & ~columns[SUCCESS])], axis=-1
                    )
                ),
                topples_soon=padded(_soon(ended & ~columns[SUCCESS], dataset.lengths)),
                mask=padded(np.ones(len(columns[ACTION]))),
            ),
            reference=dataset.reference,
            content_hash=dataset.content_hash,
            held_out=torch.tensor(said, dtype=torch.bool, device=device) if any(said) else None,
            dropped_place=_dropped_place(dataset),
        )

    def __len__(self) -> int:
        """Return the number of episodes E."""
        return len(self.target_state)

    @property
    def lengths(self) -> Tensor:
        """The number of real steps of each episode, (E,)."""
        return self.windows.mask.sum(1).long()

    def select(self, episodes: Tensor) -> "PairedEpisodes":
        """Return the episodes `episodes` (n,)."""
        return replace(
            self,
            target_state=self.target_state[episodes],
            reward=self.reward[episodes],
            terminated=self.terminated[episodes],
            windows=_gather(self.windows, episodes),
            held_out=None if self.held_out is None else self.held_out[episodes],
        )

    def split(self, held_out_share: float, seed: int) -> tuple["PairedEpisodes", "PairedEpisodes"]:
        """Split by episodes into training and held-out ones: as the dataset says, else at random.

        In an augmented dataset a random episode would leave copies of itself behind in the training ones.
        """
        if self.held_out is not None:
            return self.select((~self.held_out).nonzero()[:, 0]), self.select(self.held_out.nonzero()[:, 0])
        order = torch.from_numpy(generator(seed, "held-out episodes").permutation(len(self)))
        order = order.to(self.target_state.device)
        count = max(1, round(held_out_share * len(self)))
        if count >= len(self):
            raise BadInputError(
                f"{self.reference} has {len(self)} episodes: expected more, to hold {count} of them out"
            )
        return self.select(order[count:]), self.select(order[:count])

    def steps(self, values: Tensor) -> Tensor:
        """Return the real steps of `values` (E, T, ...), one after another, (N, ...)."""
        return values[self.windows.mask.bool()]

    def draw_windows(self, count: int, length: int) -> tuple[PairedWindows, Tensor]:
        """Draw windows of `length` steps as `draw_steps` does; the mask marks only the steps that were drawn.

        Returns:
            the windows (count, length, ...), and the target states in them (count, length, S).
        """
        episodes, steps, is_drawn = draw_steps(self.lengths, count, length)
        windows = _gather(self.windows, (episodes, steps))
        return replace(windows, mask=windows.mask * is_drawn), self.target_state[episodes, steps]


def _dropped_place(dataset: Dataset) -> tuple[int, ...]:
    columns = {column.name: column for column in dataset.schema}
    roles = columns[ABSTRACT_STATE].roles
    if not roles or "position" in dict(roles):
        return ()
    groups = [group for role, group in columns[STATE].roles if role == "position"]
    return tuple(index for group in groups for index in range(group.start, group.stop))


def _soon(toppled: NDArray[np.bool_], lengths: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark the last `RISK_STEPS` steps (N,) of each episode that ends in a topple."""
    ends = np.cumsum(lengths)
    steps_left = np.repeat(ends, lengths) - np.arange(len(toppled))
    return np.repeat(toppled[ends - 1], lengths) & (steps_left <= RISK_STEPS)


def _gather(windows: PairedWindows, rows: Tensor | tuple[Tensor, Tensor]) -> PairedWindows:
    return PairedWindows(**{name: values[rows] for name, values in vars(windows).items()})
