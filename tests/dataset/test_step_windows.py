import numpy as np
import pytest
from fake_dataset import LENGTHS
from fake_frames import NAMES, everything

from astra_data.dataset.columns import INDEX, STATE
from astra_data.dataset.frames import Frames
from astra_data.dataset.reader import Dataset


@pytest.mark.parametrize("stride", [1, 3])
def test_valid_windows_are_all_that_lie_inside_an_episode(fake: Dataset, frames: Frames, stride: int) -> None:
    expected = [
        range(start + first, start + first + 6)
        for start, length in zip(fake.starts.tolist(), LENGTHS, strict=True)
        for first in range(0, length - 5, stride)
    ]
    windows = frames.windows(6, stride=stride)
    batch = everything(windows)
    assert batch[INDEX].tolist() == [list(rows) for rows in expected]
    assert not batch["is_pad"].any()
    for name in NAMES:
        np.testing.assert_array_equal(batch[name].numpy(), fake.columns([name])[name][batch[INDEX].numpy()])


@pytest.mark.parametrize(("length", "stride", "past"), [(6, 1, 0), (6, 4, 5), (40, 1, 20), (1, 2, 0)])
def test_edge_windows_repeat_the_first_and_last_step(
    fake: Dataset, frames: Frames, length: int, stride: int, past: int
) -> None:
    rows, is_pad = [], []
    for start, steps in zip(fake.starts, LENGTHS, strict=True):
        for step in range(0, steps, stride):
            wanted = np.arange(step - past, step - past + length)
            rows.append(start + np.clip(wanted, 0, steps - 1))
            is_pad.append((wanted < 0) | (wanted >= steps))
    batch = everything(frames.windows(length, stride=stride, padding="edge", past=past))
    np.testing.assert_array_equal(batch[INDEX].numpy(), rows)
    np.testing.assert_array_equal(batch["is_pad"].numpy(), is_pad)
    np.testing.assert_array_equal(batch[STATE].numpy(), fake.columns([STATE])[STATE][np.array(rows)])
