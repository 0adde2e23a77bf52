"""Fit a model by gradient descent, with a decaying learning rate; an interrupted fit is resumed."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from astra_data.core.config import Config, Count, Positive
from astra_data.core.logbook import Logbook
from astra_data.learning.divergence import refuse_divergence


class DescentConfig(Config):
    """How a model is fitted by gradient descent. The paper gives none of these settings."""

    updates: Count = 1500
    """Number of gradient updates."""
    learning_rate: Positive = 1e-3
    """Learning rate at the start; decays to zero along a half cosine."""
    gradient_norm: Positive = 1.0
    """Gradients are clipped to this norm."""


class Descent:
    """A fit in progress, with AdamW.

    Attributes:
        parameters: the fitted ones.
        done: updates so far.
        points: measurements during the fit.
        stopwatch: measures from the start, including the time before an interruption.
    """

    def __init__(
        self,
        model: nn.Module,
        config: DescentConfig,
        *,
        checkpoint: Path | None = None,
        weight_decay: float = 0.0,
    ) -> None:
        """Start, or resume from `checkpoint` if it exists.

        Args:
            model: its parameters that require gradients are fitted.
            config: settings.
            checkpoint: the file that `keep` writes; None for none.
            weight_decay: of AdamW.

        Raises:
            BadInputError: the checkpoint is of another model, or from an older version.
        """
        self.done = 0
        self._model, self._config = model, config
        self.parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
        self._optimizer = torch.optim.AdamW(self.parameters, config.learning_rate, weight_decay=weight_decay)
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self._optimizer, config.updates)
        self._logbook = Logbook(checkpoint, self._go_on)
        self.points, self.stopwatch = self._logbook.points, self._logbook.stopwatch

    def _go_on(self, state: dict[str, Any]) -> None:
        self._model.load_state_dict(state["model"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        self.done = state["done"]

    @property
    def is_over(self) -> bool:
        """Whether all updates are done."""
        return self.done >= self._config.updates

    @property
    def share(self) -> float:
        """Share of the updates that are done."""
        return self.done / self._config.updates

    def update(self, loss: Tensor) -> None:
        """Take one step down the gradient of `loss`.

        Raises:
            BadInputError: the fit diverged.
        """
        self._optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self._config.gradient_norm)
        refuse_divergence(f"in update {self.done + 1}", {"gradient": float(norm)})
        self._optimizer.step()
        self._schedule.step()
        self.done += 1

    def keep(self, **measured: float | None) -> None:
        """Add the figures `measured` now to the points, and write the checkpoint.

        Raises:
            BadInputError: the fit diverged.
        """
        refuse_divergence(f"by update {self.done}", measured)
        self.points.append({"step": self.done, **measured})
        self._logbook.keep(
            {
                "model": self._model.state_dict(),
                "optimizer": self._optimizer.state_dict(),
                "schedule": self._schedule.state_dict(),
                "done": self.done,
            }
        )
