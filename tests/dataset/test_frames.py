from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import COLUMNS, LENGTHS, concatenated
from fake_frames import NAMES, assert_equal, everything
from gpu import needs_cuda

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import INDEX, STATE
from astra_data.dataset.frames import Frames
from astra_data.dataset.reader import Dataset


def test_columns_are_the_datasets(fake: Dataset) -> None:
    frames = Frames.load(fake)
    assert list(frames.columns) == [column.name for column in COLUMNS]
    for name, values in frames.columns.items():
        np.testing.assert_array_equal(values.numpy(), concatenated(name))
    assert len(frames) == sum(LENGTHS)
    assert repr(frames).startswith("Frames(5 episodes, 55 steps, observation.state (3,), action (2,), ")


def test_transitions_are_the_steps(fake: Dataset, frames: Frames) -> None:
    batch = frames.transitions().__getitems__([7, 0, 54])
    for name, values in fake.columns(NAMES).items():
        np.testing.assert_array_equal(batch[name].numpy(), values[[7, 0, 54]])
    assert len(frames.transitions()) == sum(LENGTHS)


@pytest.mark.parametrize("memory_share", [0.0, 0.5])
def test_chosen_episodes_only(fake: Dataset, tmp_path: Path, memory_share: float) -> None:
    chosen = Frames.load(fake, [INDEX], episodes=[3, 0], memory_share=memory_share, cache=tmp_path)
    expected = [*range(7), *range(20, 50)]
    assert everything(chosen.transitions())[INDEX].tolist() == expected
    if memory_share:
        assert chosen.columns[INDEX].tolist() == expected
    assert everything(chosen.windows(7))[INDEX][:, 0].tolist() == [0, *range(20, 44)]
    padded = everything(chosen.windows(4, padding="edge", past=2))
    assert padded[INDEX][:2].tolist() == [[0, 0, 0, 1], [0, 0, 1, 2]]
    assert padded[INDEX][7].tolist() == [20, 20, 20, 21]


def test_columns_are_mapped_where_their_share_of_the_memory_is_too_small(
    fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = sum(LENGTHS) * 3 * 4
    for memory, share in ((2 * size, 0.5), (10 * size, 0.1)):
        monkeypatch.setattr("astra_data.dataset.frames.memory_bytes", lambda memory=memory: memory)
        Frames.load(fake, [STATE], memory_share=share, cache=tmp_path)
        assert not list(tmp_path.iterdir())
    monkeypatch.setattr("astra_data.dataset.frames.memory_bytes", lambda: 2 * size - 2)
    Frames.load(fake, [STATE], memory_share=0.5, cache=tmp_path)
    assert list(tmp_path.rglob("values.npy"))


@needs_cuda
@pytest.mark.parametrize("fits", [True, False])
def test_batches_come_to_the_device(
    fake: Dataset, frames: Frames, monkeypatch: pytest.MonkeyPatch, fits: bool
) -> None:
    if not fits:
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (0, 0))
    moved = Frames.load(fake, NAMES, device="cuda")
    assert {values.is_cuda for values in moved.columns.values()} == {fits}
    for padding in ("valid", "edge"):
        batch = everything(moved.windows(6, padding=padding))
        assert all(values.is_cuda for values in batch.values())
        expected = everything(frames.windows(6, padding=padding))
        assert_equal({name: values.cpu() for name, values in batch.items()}, expected)


def test_faults_are_told_at_once(fake: Dataset, frames: Frames) -> None:
    with pytest.raises(BadInputError, match="length 0, expected at least 1; stride -1, expected at least 1"):
        frames.windows(0, stride=-1)
    with pytest.raises(
        BadInputError, match=r"length 31, expected at most 30, the longest episode's, or padding"
    ):
        frames.windows(31)
    assert len(frames.windows(30)) == 1
    with pytest.raises(BadInputError, match=r"past 6, expected 0 to 5"):
        frames.windows(6, past=6, padding="edge")
    with pytest.raises(BadInputError, match=r"past 1, expected 0 without padding"):
        frames.windows(6, past=1)
    with pytest.raises(BadInputError, match=r"padding 'wrap', expected 'valid' or 'edge'"):
        frames.windows(6, padding="wrap")  # type: ignore[arg-type]
    faults = "has no episode -1, expected 0 to 4; has no episode 5, .*; episode 2 is listed twice"
    with pytest.raises(BadInputError, match=faults):
        Frames.load(fake, [STATE], episodes=[2, 5, 2, -1])
    with pytest.raises(BadInputError, match="no episodes are listed"):
        Frames.load(fake, [STATE], episodes=[])
    with pytest.raises(BadInputError, match=r"has no column speed; it has observation\.state"):
        Frames.load(fake, ["speed"])
