"""What a training remembers beside what it trains: its points and its time, kept in a checkpoint with it."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from astra_data.core.checkpoint import flatten, resumed, save_tensors
from astra_data.core.stopwatch import Alarm, Stopwatch

CHECKPOINT_SECONDS = 60.0
"""After so long, a checkpoint is due."""


class Logbook:
    """The log of a training that can be interrupted.

    Attributes:
        points: what was measured on the way, of JSON values.
        stopwatch: runs from the beginning, on top of what was spent before an interruption.
    """

    def __init__(self, checkpoint: Path | None, go_on: Callable[[dict[str, Any]], object]) -> None:
        """Begin, or go on from the `checkpoint` if it is there.

        Args:
            checkpoint: the file that `keep` writes; None to write none.
            go_on: sets the training back to a state that was given to `keep`.

        Raises:
            BadInputError: the checkpoint cannot be read, or `go_on` does not find in it what it needs.
        """
        self._checkpoint = checkpoint
        self.points, spent = list[dict[str, Any]](), None
        if checkpoint and checkpoint.exists():
            with resumed(checkpoint) as (state, told):
                go_on(state)
                self.points, spent = told["points"], told["spent"]
        self.stopwatch, self._alarm = Stopwatch(spent), Alarm(CHECKPOINT_SECONDS)

    @property
    def is_due(self) -> bool:
        """Whether the last checkpoint is so old that another is due."""
        return self._alarm.rings

    def keep(self, state: Mapping[str, Any]) -> None:
        """Write a checkpoint: `state`, which `flatten` can take, the points and the time spent."""
        if self._checkpoint is not None:
            told = {"points": self.points, "spent": self.stopwatch.spent()}
            save_tensors(self._checkpoint, flatten(state), told)
        self._alarm.reset()
