from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import COLUMNS, concatenated, fake_episode, write_fake, writer

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION
from astra_data.worlds.commands import Commands

DRIVE = Commands({"v": (-0.2, 1.0), "w": (-1.5, 1.5)})


def test_the_ends_of_the_bounds_are_one() -> None:
    ends = torch.tensor([[-0.2, -1.5], [1.0, 1.5], [0.4, 0.0]])
    expected = torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]])
    torch.testing.assert_close(DRIVE.normal(ends), expected)
    torch.testing.assert_close(DRIVE.in_units(expected), ends)


def test_only_what_is_given_as_an_action_is_clipped() -> None:
    torch.testing.assert_close(DRIVE.in_units(torch.tensor([7.0, -7.0])), torch.tensor([1.0, -1.5]))
    torch.testing.assert_close(DRIVE.normal(torch.tensor([1.6, -3.0])), torch.tensor([2.0, -2.0]))


def test_commands_of_one_are_left_to_the_bit() -> None:
    unit = Commands({"vx": (-1, 1), "vy": (-1.0, 1.0)})
    action = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (100, 2))).float()
    assert unit.are_normal and not DRIVE.are_normal
    assert torch.equal(unit.in_units(action), action) and unit.normal(action) is action
    assert unit.in_units(torch.tensor([3.0, -3.0])).tolist() == [1.0, -1.0]
    one_of_two = Commands({"vx": (-1.0, 1.0), "w": (-2.0, 2.0)})
    assert not one_of_two.are_normal
    assert one_of_two.in_units(torch.tensor([0.5, 0.5])).tolist() == [0.5, 1.0]


def test_they_are_a_mapping_of_names_to_bounds() -> None:
    assert dict(DRIVE) == {"v": (-0.2, 1.0), "w": (-1.5, 1.5)} and len(DRIVE) == 2
    assert Commands({"v": (0, 1)}) == {"v": (0.0, 1.0)}


@pytest.mark.parametrize(
    ("bounds", "told"),
    [
        ({}, "no axis is named"),
        ({"v": 1.5}, r"v: expected \(least, largest\), got 1.5"),
        ({"v": (1.0, 1.0)}, r"v: expected \(least, largest\), got \(1.0, 1.0\)"),
        ({"v": (0.0, 1.0), "w": (0.0, float("inf")), "u": (2.0, 1.0)}, r"w: expected .*inf\); u: expected"),
        ({"v": (1.0,)}, r"v: expected \(least, largest\)"),
    ],
)
def test_bounds_that_are_none_are_refused(bounds: dict[str, tuple[float, float]], told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        Commands(bounds)


def test_the_bounds_may_be_the_range_of_a_dataset(tmp_path: Path) -> None:
    write_fake(tmp_path / "fake")
    least, largest = concatenated(ACTION).min(0), concatenated(ACTION).max(0)
    found = Commands.recorded(tmp_path / "fake")
    assert dict(found) == {
        name: (float(low), float(high)) for name, low, high in zip("xy", least, largest, strict=True)
    }


def test_a_range_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="nowhere"):
        Commands.recorded(tmp_path / "nowhere")
    with writer(tmp_path / "still") as still:
        episode = fake_episode(1, 5)
        episode.columns[ACTION][:, 1] = 0.5
        still.add(episode)
    with pytest.raises(BadInputError, match=r"commands: y never changes in .*: give the bounds"):
        Commands.recorded(tmp_path / "still")
    without = [column for column in COLUMNS if column.name != ACTION]
    with writer(tmp_path / "none", columns=without) as none:
        columns = {name: values for name, values in fake_episode(1, 5).columns.items() if name != ACTION}
        none.add(replace(fake_episode(1, 5), columns=columns))
    with pytest.raises(BadInputError, match="has no column action: give their bounds"):
        Commands.recorded(tmp_path / "none")
