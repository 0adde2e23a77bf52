from pathlib import Path

import numpy as np
import pytest
import torch
from failing_disk import small_files
from fake_dataset import COLUMNS, LENGTHS, NAMES, concatenated
from torch.utils.data import DataLoader

from astra_data.core.errors import BadInputError, CorruptDatasetError, DiskError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import INDEX, STATE
from astra_data.dataset.frames import Batch, Batches, Frames, Samples


def everything(samples: Samples) -> Batch:
    return samples.__getitems__(range(len(samples)))


def assert_equal(found: Batch, expected: Batch) -> None:
    assert list(found) == list(expected)
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        assert torch.equal(found[name], values), name


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


def test_faults_are_told_at_once(fake: Dataset, frames: Frames) -> None:
    with pytest.raises(BadInputError, match="length 0, expected at least 1; past 1, expected 0 without padding"):
        frames.windows(0, past=1)
    with pytest.raises(BadInputError, match=r"length 31, expected at most 30, the longest episode's, or padding"):
        frames.windows(31)
    assert len(frames.windows(30)) == 1
    with pytest.raises(BadInputError, match=r"past 6, expected 0 to 5"):
        frames.windows(6, past=6, padding="edge")
    with pytest.raises(BadInputError, match="batches of 0 samples: expected at least 1"):
        frames.windows(6).batches(0)
    with pytest.raises(BadInputError, match=r"padding 'wrap', expected 'valid' or 'edge'"):
        frames.windows(6, padding="wrap")  # type: ignore[arg-type]
    faults = "has no episode -1, expected 0 to 4; has no episode 5, .*; episode 2 is listed twice"
    with pytest.raises(BadInputError, match=faults):
        Frames.load(fake, [STATE], episodes=[2, 5, 2, -1])
    with pytest.raises(BadInputError, match="no episodes are listed"):
        Frames.load(fake, [STATE], episodes=[])
    with pytest.raises(BadInputError, match=r"expected indices of episodes, such as np\.flatnonzero of a mask"):
        Frames.load(fake, [STATE], episodes=[False, True, False, False, False])
    with pytest.raises(BadInputError, match=r"has no column speed; it has observation\.state"):
        Frames.load(fake, ["speed"])


def test_a_data_loader_draws_the_same_batches(frames: Frames) -> None:
    windows = frames.windows(6, padding="edge")
    expected = list(windows.batches(8, shuffle=False))
    loader = DataLoader(windows, 8, collate_fn=lambda batch: batch)
    found = list(loader)
    assert len(found) == len(expected) == len(loader)
    for ours, theirs in zip(expected, found, strict=True):
        assert_equal(theirs, ours)


def test_an_interrupted_epoch_goes_on_where_it_was_left(frames: Frames) -> None:
    transitions = frames.transitions()
    uninterrupted = transitions.batches(10, seed=5)
    expected = [batch for _ in range(3) for batch in uninterrupted]
    first = transitions.batches(10, seed=5)
    found = list(first)
    for batch in first:
        found.append(batch)
        state = first.state_dict()
        if len(found) == 8:
            break
    second = transitions.batches(10, seed=5)
    second.load_state_dict(state)
    found += [*second, *second]
    assert len(found) == len(expected) == 18
    for ours, theirs in zip(found, expected, strict=True):
        assert_equal(ours, theirs)


def epoch(batches: Batches) -> list[int]:
    return torch.cat([batch[INDEX] for batch in batches]).tolist()


def test_an_epoch_holds_every_sample_once_in_an_order_of_its_own(frames: Frames) -> None:
    steps = frames.transitions()
    batches = steps.batches(32, seed=1)
    epochs = [epoch(batches) for _ in range(3)]
    assert all(sorted(indices) == list(range(sum(LENGTHS))) for indices in epochs)
    assert epochs[0] != epochs[1] != epochs[2] != epochs[0]
    assert epoch(steps.batches(7, seed=1)) == epochs[0] and epoch(steps.batches(32, seed=2)) != epochs[0]


def test_without_shuffling_the_order_is_the_samples(frames: Frames) -> None:
    batches = frames.transitions().batches(20, shuffle=False)
    assert [batch[INDEX].tolist() for batch in batches] == [[*range(20)], [*range(20, 40)], [*range(40, 55)]]
    assert len(batches) == 3


def test_a_state_of_another_order_is_refused(frames: Frames) -> None:
    batches = frames.transitions().batches(20, seed=4)
    state = batches.state_dict()
    for other in (state | {"count": 21}, state | {"seed": 0}, state | {"batch": 3}, state | {"epoch": -1}, {}):
        with pytest.raises(BadInputError, match="the state is of another order of samples: expected"):
            batches.load_state_dict(other)


def test_valid_windows_are_all_that_lie_inside_an_episode(fake: Dataset, frames: Frames) -> None:
    expected = [
        range(start + first, start + first + 6)
        for start, length in zip(fake.starts.tolist(), LENGTHS, strict=True)
        for first in range(length - 5)
    ]
    batch = everything(frames.windows(6))
    assert batch[INDEX].tolist() == [list(rows) for rows in expected] and not batch["is_pad"].any()
    for name in NAMES:
        np.testing.assert_array_equal(batch[name].numpy(), fake.columns([name])[name][batch[INDEX].numpy()])


@pytest.mark.parametrize(("length", "past"), [(6, 0), (6, 5), (40, 20), (1, 0)])
def test_edge_windows_repeat_the_first_and_last_step(fake: Dataset, frames: Frames, length: int, past: int) -> None:
    rows, is_pad = [], []
    for start, steps in zip(fake.starts, LENGTHS, strict=True):
        for step in range(steps):
            wanted = np.arange(step - past, step - past + length)
            rows.append(start + np.clip(wanted, 0, steps - 1))
            is_pad.append((wanted < 0) | (wanted >= steps))
    batch = everything(frames.windows(length, padding="edge", past=past))
    np.testing.assert_array_equal(batch[INDEX].numpy(), rows)
    np.testing.assert_array_equal(batch["is_pad"].numpy(), is_pad)
    np.testing.assert_array_equal(batch[STATE].numpy(), fake.columns([STATE])[STATE][np.array(rows)])


def test_mapped_columns_equal_loaded_ones(
    fake: Dataset, frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASTRA_DATA_CACHE", str(tmp_path))
    mapped = Frames.load(fake, NAMES, memory_share=0.0)
    assert_equal(everything(mapped.windows(5)), everything(frames.windows(5)))
    files = sorted(path.relative_to(tmp_path).parts for path in tmp_path.rglob("*") if path.is_file())
    assert files == [(fake.content_hash, name, "values.npy") for name in sorted(NAMES)]
    # The second time the raw files serve, and what is written to the tensors stays out of them.
    monkeypatch.setattr(Dataset, "blocks", None)
    mapped.columns[STATE].zero_()
    assert torch.equal(Frames.load(fake, NAMES, memory_share=0.0).columns[STATE], frames.columns[STATE])


def test_another_value_in_a_raw_file_is_told(fake: Dataset, tmp_path: Path) -> None:
    Frames.load(fake, NAMES, memory_share=0.0, cache=tmp_path)
    path = tmp_path / fake.content_hash / STATE / "values.npy"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(CorruptDatasetError, match=f"was altered .{STATE}: other values .*; delete"):
        Frames.load(fake, NAMES, memory_share=0.0, cache=tmp_path)


def test_a_full_disk_ends_with_an_error_and_no_raw_file(fake: Dataset, tmp_path: Path) -> None:
    with small_files(200), pytest.raises(DiskError, match=f"{STATE} cannot be written: a file would be"):
        Frames.load(fake, [STATE], memory_share=0.0, cache=tmp_path)
    assert not list(tmp_path.rglob("*.npy"))
