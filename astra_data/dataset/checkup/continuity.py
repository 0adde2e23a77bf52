"""Next states that are not the states of the rows after them."""

from astra_data.core.numbers import as_rows
from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.columns import NEXT_STATE, STATE, Episode


class Continuity:
    """Compares each step's next state with the state of the row after it, to the bit."""

    def __init__(self) -> None:
        self._steps = self._broken = 0
        self._uids: list[int] = []

    def add(self, episode: Episode) -> None:
        """Compare the steps of the next episode."""
        if NEXT_STATE not in episode.columns or STATE not in episode.columns:
            return
        state, arrived = as_rows(episode.columns[STATE]), as_rows(episode.columns[NEXT_STATE])
        broken = int((arrived[:-1] != state[1:]).any(axis=1).sum())
        self._steps += len(state) - 1
        self._broken += broken
        if broken:
            self._uids.append(episode.uid)

    def findings(self) -> list[Finding]:
        """Tell how many steps do not lead to the row after them."""
        if not self._broken:
            return []
        what = f"steps whose {NEXT_STATE} is not the state of the next row: {self._broken} of {self._steps}"
        advice = (
            "rows are missing, or the columns come from different logs: import again, without "
            f"{NEXT_STATE} in the mapping if each row is the state after the one before"
        )
        return [Finding("warning", what, advice, tuple(self._uids))]
