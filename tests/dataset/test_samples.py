import numpy as np
import pytest
import torch
from fake_frames import assert_equal, everything
from torch.utils.data import DataLoader

from astra_data.core.errors import BadInputError
from astra_data.dataset.frames import Frames, Order, Padding, take


def test_samples_come_one_by_one_too(frames: Frames) -> None:
    windows = frames.windows(6, padding="edge")
    batch = everything(windows)
    assert_equal(windows[8], {name: values[8] for name, values in batch.items()})
    assert_equal(windows[-1], {name: values[-1] for name, values in batch.items()})
    assert_equal(windows[-55], windows[0])
    for beyond in (55, -56):
        with pytest.raises(IndexError, match=f"sample {beyond} of 55"):
            windows[beyond]


@pytest.mark.parametrize(("workers", "padding"), [(0, "valid"), (0, "edge"), (2, "edge")])
def test_a_data_loader_draws_the_same_batches(frames: Frames, workers: int, padding: Padding) -> None:
    windows = frames.windows(6, padding=padding)
    expected = list(windows.batches(8, seed=3))
    order = windows.batches(8, seed=3).order
    loader = DataLoader(windows, batch_sampler=order, collate_fn=windows.collate, num_workers=workers)  # type: ignore[arg-type]
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


def epoch(order: Order) -> list[int]:
    return torch.cat(list(order)).tolist()


def test_an_epoch_holds_every_sample_once_in_an_order_of_its_own() -> None:
    order = Order(1000, 32, seed=1)
    epochs = [epoch(order) for _ in range(3)]
    assert all(sorted(indices) == list(range(1000)) for indices in epochs)
    assert epochs[0] != epochs[1] != epochs[2] != epochs[0]
    same, other = Order(1000, 7, seed=1), Order(1000, 32, seed=2)
    assert epoch(same) == epochs[0]
    assert epoch(other) != epochs[0]
    assert abs(np.corrcoef(epochs[0], epochs[1])[0, 1]) < 0.2


def test_without_shuffling_the_order_is_the_samples() -> None:
    order = Order(10, 4, shuffle=False)
    assert [batch.tolist() for batch in order] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    dropped = Order(10, 4, shuffle=False, drop_last=True)
    assert [batch.tolist() for batch in dropped] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert (len(order), len(dropped)) == (3, 2)


@pytest.mark.parametrize("seen", range(1, 9))
def test_a_state_names_the_next_batch(seen: int) -> None:
    reference = Order(20, 5, seed=4)
    expected = [batch.tolist() for _ in range(3) for batch in reference]
    order = Order(20, 5, seed=4)
    found: list[list[int]] = []
    while len(found) < seen:
        for batch in order:
            found.append(batch.tolist())
            if len(found) == seen:
                break
    resumed = Order(20, 5, seed=4)
    resumed.load_state_dict(order.state_dict())
    while len(found) < len(expected):
        found += [batch.tolist() for batch in resumed]
    assert found == expected


def test_a_state_of_another_order_is_refused() -> None:
    state = Order(20, 5, seed=4).state_dict()
    with pytest.raises(BadInputError, match="count is 20, expected 21; seed is 4, expected 0"):
        Order(21, 5).load_state_dict(state)
    with pytest.raises(BadInputError, match="drop_last is None, expected False; epoch is None, expected 0"):
        Order(20, 5, seed=4).load_state_dict({"count": 20, "batch_size": 5, "seed": 4, "shuffle": True})


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("epoch", -1, "0 or more"),
        ("epoch", 1.5, "0 or more"),
        ("batch", -1, "0 to 3"),
        ("batch", 4, "0 to 3"),
    ],
)
def test_a_batch_that_there_is_not_is_refused(key: str, value: float, expected: str) -> None:
    order = Order(20, 5, seed=4)
    with pytest.raises(BadInputError, match=f"{key} is {value}, expected {expected}"):
        order.load_state_dict(order.state_dict() | {key: value})
    assert (order.epoch, order.batch) == (0, 0)
    order.load_state_dict(order.state_dict() | {"epoch": 7, "batch": 3})
    assert len(list(order)) == 1


@pytest.mark.parametrize(("count", "size", "drop_last"), [(10, 0, False), (0, 5, False), (10, 11, True)])
def test_an_order_without_batches_is_refused(count: int, size: int, drop_last: bool) -> None:
    with pytest.raises(BadInputError, match=f"batches of {size} out of {count} samples"):
        Order(count, size, drop_last=drop_last)


def test_rows_are_taken_on_the_device_where_they_lie() -> None:
    """Not only on CUDA; "meta" stands for another."""
    taken = take(torch.empty(5, 3, device="meta"), torch.empty(2, dtype=torch.long, device="meta"))
    assert taken.device.type == "meta" and taken.shape == (2, 3)
