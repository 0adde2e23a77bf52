"""How episodes end, and whether enough of them fail for a failure model."""

from collections.abc import Sequence

import numpy as np

from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.columns import TERMINATED, Episode
from astra_data.dataset.endings import is_terminated

FEW_FAILURES = 10
"""Fewer failures are little for a failure model (docs/failures.md)."""


class EpisodeEnds:
    """How each episode of a dataset ends."""

    def __init__(self, successes: Sequence[bool | None] | None) -> None:
        """Take whether each episode succeeds, in their order; None where or if it is unknown."""
        self._successes = successes
        self._lengths: list[int] = []
        self._terminated: list[bool] = []
        self._uids: list[int] = []
        self._marked = False

    def add(self, episode: Episode) -> None:
        """Count the next episode."""
        self._marked |= TERMINATED in episode.columns
        self._terminated.append(is_terminated(episode.columns))
        self._lengths.append(len(episode))
        self._uids.append(episode.uid)

    @property
    def failures(self) -> list[int]:
        """Uids of the episodes that are terminated without success, as far as that is known."""
        known = self._successes or [None] * len(self._uids)
        ends = zip(self._uids, self._terminated, known, strict=True)
        return [uid for uid, terminated, success in ends if terminated and success is False]

    def __str__(self) -> str:
        """Count the ways in which episodes end."""
        if not self._marked and self._successes is None:
            return "unknown: neither success nor next.terminated was recorded"
        known = np.array([success is True for success in self._successes or [False] * len(self._uids)])
        terminated, lengths = np.array(self._terminated), np.array(self._lengths)
        others = ~known & ~terminated
        limit = lengths.max()
        # One alone that is longer than all others need not have met a limit.
        timed = others & (lengths == limit) & ((lengths == limit).sum() > 1)
        failed, unknown = len(self.failures), int((terminated & ~known).sum()) - len(self.failures)
        counts = (
            (int(known.sum()), "in success"),
            (failed, "in failure"),
            (unknown, "terminated, success unknown"),
            (int(timed.sum()), f"after {limit} steps, the longest (a time limit)"),
            (int((others & ~timed).sum()), "cut"),
        )
        return ", ".join(f"{count} {way}" for count, way in counts if count)

    def findings(self) -> list[Finding]:
        """Tell whether no episode goes on after its first step, and of few failures, where there are any."""
        failures, found = self.failures, []
        if max(self._lengths, default=0) == 1:
            found.append(
                Finding(
                    "warning",
                    "every episode ends after its first step",
                    "check what ends them: failed of the robot or log, reached and missed of the objective, "
                    "or how a mapping splits episodes",
                )
            )
        if not 0 < len(failures) < FEW_FAILURES:
            return found
        count = "1 failure" if len(failures) == 1 else f"{len(failures)} failures"
        return [
            *found,
            Finding(
                "note",
                f"{count}, which is little for a failure model to learn from",
                f"record {FEW_FAILURES} or more failures (astra-data collect TASK --behavior stress), or "
                "no failure can be predicted from it",
                tuple(failures),
            ),
        ]
