"""A dataset with everything that the exporters write."""

from pathlib import Path

import numpy as np
from fake_dataset import COLUMNS, fake_episodes, writer

from astra_data.dataset.columns import GOAL, NEXT_STATE, STATE, Array, Column, Episode
from astra_data.dataset.reader import Dataset

NEXT = Column(NEXT_STATE, size=3)


def write_transitions(root: Path, *, has_goal: bool = True) -> Dataset:
    """Five episodes in which every next state is the state of the next step."""
    extra = (NEXT, Column(GOAL, size=2)) if has_goal else (NEXT,)
    with writer(root, columns=[*COLUMNS, *extra]) as open_writer:
        for number, episode in enumerate(fake_episodes()):
            state = episode.columns[STATE]
            added: dict[str, Array] = {NEXT_STATE: np.concatenate([state[1:], state[:1] + 1])}
            if has_goal:
                added[GOAL] = np.full((len(episode), 2), number, np.float32)
            metadata = dict(episode.metadata) | ({"seed": 3} if number == 1 else {})
            open_writer.add(Episode(episode.uid, {**episode.columns, **added}, metadata))
    return Dataset.open(root)
