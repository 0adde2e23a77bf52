from pathlib import Path

import numpy as np

from astra_data.dataset.columns import NEXT_STATE, REWARD, STATE, SUCCESS, TERMINATED, Column, Episode
from astra_data.dataset.inspection import Endings, endings_of, outcome_of
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter


def test_only_a_terminated_last_step_that_stands_still_was_made_up(tmp_path: Path) -> None:
    moves = np.arange(8, dtype=np.float32).reshape(4, 2)
    stops = np.concatenate([moves[1:], moves[-1:]])
    nearly = stops + np.array([0, 1e-6], np.float32) * np.array([[0], [0], [0], [1]], np.float32)
    over, on = np.array([False, False, False, True]), np.zeros(4, bool)
    columns = [Column(STATE, size=2), Column(NEXT_STATE, size=2), Column(TERMINATED, "bool")]
    kinds = [(stops, over), (nearly, over), (stops, on), (stops, on)]
    description = {"name": "ends", "stage": "import"}
    with DatasetWriter(tmp_path / "d", columns, fps=10, task="end", description=description) as writer:
        for uid, (after, ended) in enumerate(kinds):
            writer.add(Episode(uid, {STATE: moves, NEXT_STATE: after, TERMINATED: ended}))

    found = endings_of(Dataset.open(tmp_path / "d"))
    assert found == Endings(terminated=2, cut_off=2, made_up=1)
    assert str(found).startswith("2 terminated, 2 cut off; 1 next states of terminated episodes were made up")
    assert str(Endings(3, 1)) == "3 terminated, 1 cut off"


def test_an_outcome_is_of_all_steps() -> None:
    reward, never = np.array([0.1, 0.2, -1.0], np.float32), np.zeros(3, bool)
    early, last = np.array([True, False, False]), np.array([False, False, True])
    for success, terminated, expected in (
        (never, never, (False, False)),
        (never, last, (False, True)),
        (last, last, (True, False)),
        (early, last, (True, False)),
        (last, never, (True, False)),
    ):
        outcome = outcome_of({SUCCESS: success, TERMINATED: terminated, REWARD: reward})
        assert (outcome["success"], outcome["failed"]) == expected
        assert outcome["return"] == reward.sum(dtype=np.float64) and isinstance(outcome["return"], float)
