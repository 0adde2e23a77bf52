"""Successive episodes taken together."""

from collections.abc import Iterable, Iterator

from astra_data.dataset.columns import Episode


def in_blocks(episodes: Iterable[Episode], rows: int) -> Iterator[list[Episode]]:
    """Yield successive episodes in lists: each ends when it has `rows` steps, or with the last episode."""
    block: list[Episode] = []
    steps = 0
    for episode in episodes:
        block.append(episode)
        steps += len(episode)
        if steps >= rows:
            yield block
            block, steps = [], 0
    if block:
        yield block
