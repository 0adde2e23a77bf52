"""Episodes that are another one again."""

from astra_data.dataset.checkup.finding import Finding, deletion
from astra_data.dataset.columns import ACTION, STATE, Episode
from astra_data.dataset.digests import digest_of


class Duplicates:
    """Episodes of the same states and actions, to the bit, by their digests."""

    def __init__(self) -> None:
        self._first: dict[tuple[int, ...], int] = {}
        self._copies: dict[int, int] = {}

    def add(self, episode: Episode) -> None:
        """Compare the next episode with those before."""
        names = (name for name in (STATE, ACTION) if name in episode.columns)
        key = tuple(digest_of(episode.columns[name]) for name in names)
        if not key:
            return
        first = self._first.setdefault(key, episode.uid)
        if first != episode.uid:
            self._copies[episode.uid] = first

    def findings(self, called: str) -> list[Finding]:
        """Tell which episodes are copies."""
        if not self._copies:
            return []
        uids = tuple(self._copies)
        first = self._copies[uids[0]]
        what = f"copies of other episodes: {len(uids)}; {uids[0]} has the states and actions of {first}"
        advice = f"they count twice, and may be both in training and held out: {deletion(called, uids)}"
        return [Finding("warning", what, advice, uids)]
