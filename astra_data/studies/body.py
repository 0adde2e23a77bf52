"""What a study predicts of a robot: its motions, what models see of it, and its abstract simulator."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.dataset.reader import Dataset


@dataclass(frozen=True)
class Body(ABC):
    """The part of a robot whose recorded motion is predicted.

    Attributes:
        motion_size: M, of the motion in a control step. given_size: G, of the command as models are given it.
        seen_size: S, of what models see besides motions and commands.
        axes: names of the errors, E. judged: those whose mean stands for all.
        mirror: signs of each kind of column in the mirror image: "motion", "action", "seen"; empty where
            there is no mirror image.
        usual_motion: 1 for each entry of a motion whose mean is its own, 0 where a mean is an accident of the
            recordings, (M,). usual_seen: the same of what is seen, (S,).
        is_scaled: whether commands and what is seen are taken in units of their spread.
        noise: deviations of noise on motions (M,) and on what is seen (S,) while models are fitted.
    """

    motion_size: int
    given_size: int
    seen_size: int
    axes: tuple[str, ...]
    judged: tuple[str, ...]
    mirror: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    usual_motion: tuple[float, ...] = ()
    usual_seen: tuple[float, ...] = ()
    is_scaled: bool = False
    noise: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())

    def at(self, step_s: float) -> Self:
        """Return the body whose control step takes `step_s`."""
        return self

    @abstractmethod
    def steps(self, state: Floats, action: Floats, rows: int, fps: int) -> dict[str, Tensor]:
        """Return the control steps of `rows` rows each.

        Args:
            state: before each row and after the last, (T * rows + 1, state's size).
            action: in each row, (T * rows, A).
            rows: of a control step.
            fps: rows per second.

        Returns:
            motion (T, M), the simulator's `simulated` (T, M), action (T, A), seen (T + 1, S), heading (T,).
        """

    @abstractmethod
    def chained(self, motions: Tensor) -> Tensor:
        """Return the cumulative motions (B, T, M) after 1, 2, ... T of `motions` (B, T, M)."""

    @abstractmethod
    def composed(self, first: Tensor, then: Tensor) -> Tensor:
        """Return the motion (..., M) of `first` followed by `then`."""

    @abstractmethod
    def seen_after(self, seen: Tensor, motion: Tensor) -> Tensor:
        """Return what is seen (..., S) after `motion` (..., M)."""

    @abstractmethod
    def features(self, seen: Tensor) -> Tensor:
        """Return what is seen, (..., S), as models are given it, (..., S)."""

    @abstractmethod
    def command(self, action: Tensor, simulated: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return the command (..., G) and the simulator's motion (..., M) of a step.

        Args:
            action: as recorded, (..., A).
            simulated: the simulator's motion from the recorded state, (..., M).
            seen: before the step, recorded or predicted, (..., S).
        """

    @abstractmethod
    def nearer(self, seen: Tensor, given: Tensor, motion: Tensor) -> Tensor:
        """Return what stands for the reward of each step but the first, (B, T - 1).

        Args:
            seen: after each step, (B, T, S).
            given: the command in each, (B, T, G).
            motion: in each, (B, T, M).
        """

    @abstractmethod
    def wrong(self, predicted: Tensor, true: Tensor, heading: Tensor) -> Tensor:
        """Return errors (N, K, E) of cumulative motions (N, K, M); `heading` (N,) is that at the start."""


class Reading(Protocol):
    """Settings of reading recordings: which body they are of, and which rows count."""

    @property
    def piece_s(self) -> float:
        """Longer episodes are cut into pieces of this length."""

    def body(self, dataset: Dataset) -> Body:
        """Return the body that `dataset` is of; raises `BadInputError` if it is of none."""

    def broken(self, state: Floats, fps: int) -> NDArray[np.bool_]:
        """Return which rows (N,) between states (N + 1, ...) do not count."""
