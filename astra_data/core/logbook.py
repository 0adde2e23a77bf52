"""The log of a training run: measured points and time spent, kept in its checkpoint."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from astra_data.core.checkpoint import resumed, save_state
from astra_data.core.stopwatch import Alarm, Stopwatch

CHECKPOINT_SECONDS = 60.0
"""Time between checkpoints."""


class Logbook:
    """The log of a training run that can be interrupted.

    Attributes:
        points: measurements, of JSON values.
        stopwatch: measures from the start, including the time before an interruption.
    """

    def __init__(self, checkpoint: Path | None, go_on: Callable[[dict[str, Any]], object]) -> None:
        """Start, or resume from `checkpoint` if it exists.

        Args:
            checkpoint: the file that `keep` writes; None to write none.
            go_on: restores a state that was passed to `keep`.

        Raises:
            BadInputError: the checkpoint cannot be read, or lacks something that `go_on` needs.
        """
        self._checkpoint = checkpoint
        self.points, spent = list[dict[str, Any]](), None
        if checkpoint and checkpoint.exists():
            with resumed(checkpoint) as (state, metadata):
                go_on(state)
                self.points, spent = metadata["points"], metadata["spent"]
        self.stopwatch, self._alarm = Stopwatch(spent), Alarm(CHECKPOINT_SECONDS)

    @property
    def is_due(self) -> bool:
        """Whether the next checkpoint is due."""
        return self._alarm.rings

    def keep(self, state: Mapping[str, Any]) -> None:
        """Write a checkpoint: `state` (see `save_state`), the points and the time spent."""
        if self._checkpoint is not None:
            metadata = {"points": self.points, "spent": self.stopwatch.spent()}
            save_state(self._checkpoint, state, metadata)
        self._alarm.reset()
