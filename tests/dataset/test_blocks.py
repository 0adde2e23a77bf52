"""Successive episodes taken together."""

import numpy as np

from astra_data.dataset.columns import Episode, in_blocks


def _episodes(*lengths: int) -> list[Episode]:
    return [Episode(uid, {"action": np.zeros(length, np.float32)}) for uid, length in enumerate(lengths)]


def test_a_block_ends_with_the_episode_that_fills_it() -> None:
    """None is left out or split, and the last is there though it isn't full."""
    blocks = in_blocks(_episodes(3, 2, 9, 1, 4, 1), rows=5)
    assert [[episode.uid for episode in block] for block in blocks] == [[0, 1], [2], [3, 4], [5]]


def test_nothing_makes_no_block() -> None:
    """Nor is there an empty one after a full one."""
    assert list(in_blocks([], rows=5)) == []
    assert [len(block) for block in in_blocks(_episodes(5), rows=5)] == [1]
