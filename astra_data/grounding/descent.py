"""Fits by gradient descent, which can be resumed; seeds of torch's generators."""

import copy
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from astra_data.core.checkpoint import Logbook
from astra_data.core.config import AtOnce, Config, Count, Positive
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch


def seed_generators(seed: int, device: "torch.device") -> None:
    """Seed torch's generators of the CPU and `device`; `torch.manual_seed` takes ten times as long."""
    torch.default_generator.manual_seed(seed)
    if device.type == "cuda":
        with torch.cuda.device(device):
            torch.cuda.manual_seed(seed)


@contextmanager
def seeded(seed: int, device: "torch.device") -> Iterator[None]:
    """Draw on the CPU and `device` from `seed` in the block; afterwards, draws go on as before it."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        seed_generators(seed, device)
        yield


def refuse_divergence(where: str, figures: Mapping[str, float | None]) -> None:
    """Check that the `figures` of a training, so far measured `where`, are numbers."""
    if wrong := [name for name, value in figures.items() if value is not None and not math.isfinite(value)]:
        figure = f"a {' and a '.join(wrong)} that is not finite"
        raise BadInputError(f"training diverged {where}, with {figure}: make learning_rate smaller")


class DescentConfig(Config):
    """How a model is fitted by gradient descent."""

    updates: Count
    """Maximum number of gradient updates; fewer where the held-out error no longer falls."""
    learning_rate: Positive
    """Learning rate at the start; decays to zero along a half cosine."""


class WindowedConfig(Config):
    """How a model is fitted to windows of recorded steps. The paper gives none of these settings."""

    updates: Count | None = None
    """Maximum number of gradient updates; fewer where the held-out error no longer falls. By default as many
    as see each recorded step 32 times, but 600 to 1200."""
    learning_rate: Positive = 3e-3
    """Learning rate at the start; decays to zero along a half cosine."""
    batch_windows: AtOnce = 48
    """Windows per update."""
    window: AtOnce = 50
    """Steps per window, in backpropagation through time; at most the longest episode."""

    def descent(self, steps: int) -> DescentConfig:
        """Return the settings of a fit to so many recorded `steps`."""
        passes = round(_PASSES * steps / (self.batch_windows * self.window))
        updates = self.updates or min(max(passes, _UPDATES[0]), _UPDATES[1])
        return DescentConfig(updates=updates, learning_rate=self.learning_rate)


_PASSES, _UPDATES = 32, (600, 1200)
_GRADIENT_NORM = 1.0  # gradients are clipped to this norm
_PATIENCE_SHARE = 0.3  # a fit ends once its held-out error has not fallen for this share of the updates


class Descent:
    """A fit by AdamW, after `done` updates; `points` are measurements, `stopwatch` counts earlier sessions too."""

    def __init__(
        self,
        model: "torch.nn.Module",
        config: DescentConfig,
        *,
        checkpoint: Path | None = None,
        weight_decay: float = 0.0,
    ) -> None:
        """Start to fit the parameters of `model` that require gradients, or resume from `checkpoint` if it exists."""
        self.done = 0
        self.best: int | None = None  # the update with the least held-out error
        self._least, self._weights = float("inf"), dict[str, Tensor]()
        self._model, self._config = model, config
        self.parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
        self._optimizer = torch.optim.AdamW(
            self.parameters, config.learning_rate, weight_decay=weight_decay, foreach=True
        )
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self._optimizer, config.updates)
        self._parts: dict[str, Any] = {"model": model, "optimizer": self._optimizer, "schedule": self._schedule}
        self._logbook = Logbook(checkpoint, self._go_on)
        self.points, self.stopwatch = self._logbook.points, self._logbook.stopwatch

    def _go_on(self, state: dict[str, Any]) -> None:
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self.done, self.best, self._least, self._weights = (state[k] for k in ("done", "best", "least", "weights"))

    @property
    def is_over(self) -> bool:
        """Whether all updates are done, or the held-out error no longer falls."""
        # Of a short fit, patience ends before the next measurement.
        is_later = self.best is not None and self.points[-1]["step"] > self.best
        waited = self.done - (self.best or 0) if is_later else 0
        return self.done >= self._config.updates or waited > _PATIENCE_SHARE * self._config.updates

    @property
    def share(self) -> float:
        """Share of the updates that are done."""
        return self.done / self._config.updates

    def update(self, loss: Tensor) -> None:
        """Take one step down the gradient of `loss`."""
        self._optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, _GRADIENT_NORM)
        refuse_divergence(f"in update {self.done + 1}", {"gradient": float(norm)})
        self._optimizer.step()
        self._schedule.step()
        self.done += 1

    def keep(self, held_out_error: float | None = None, **measured: float | None) -> None:
        """Add figures to the points, and write the checkpoint; `finish` returns to the weights of the least error."""
        error = {} if held_out_error is None else {"held_out_error": held_out_error}
        refuse_divergence(f"by update {self.done}", error | measured)
        self.points.append({"step": self.done, **error, **measured})
        if held_out_error is not None and held_out_error < self._least:
            self._least, self.best = held_out_error, self.done
            self._weights = copy.deepcopy(self._model.state_dict())
        parts = {name: part.state_dict() for name, part in self._parts.items()}
        so_far = {"done": self.done, "best": self.best, "least": self._least, "weights": self._weights}
        self._logbook.keep(parts | so_far)

    def finish(self) -> None:
        """Return to the weights with the least held-out error, if it was measured."""
        if self._weights:
            self._model.load_state_dict(self._weights)
