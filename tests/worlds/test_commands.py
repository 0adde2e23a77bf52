from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_dataset import COLUMNS, concatenated, fake_episode, write_fake
from small_cart import TASK, Rail

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION
from astra_data.worlds.commands import Commands, DrivenSimulator, VariedCommands, innermost
from astra_data.worlds.variation import CommandVariation

DRIVE = Commands({"v": (-0.2, 1.0), "w": (-1.5, 1.5)})


def test_the_ends_of_the_bounds_are_one() -> None:
    ends = torch.tensor([[-0.2, -1.5], [1.0, 1.5], [0.4, 0.0]])
    expected = torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]])
    torch.testing.assert_close(DRIVE.normal(ends), expected)
    torch.testing.assert_close(DRIVE.in_units(expected), ends)


def test_only_what_is_given_as_an_action_is_clipped() -> None:
    torch.testing.assert_close(DRIVE.in_units(torch.tensor([7.0, -7.0])), torch.tensor([1.0, -1.5]))
    torch.testing.assert_close(DRIVE.normal(torch.tensor([1.6, -3.0])), torch.tensor([2.0, -2.0]))
    assert driven().step(torch.full((2, 1), 2.0)).tolist() == [[pytest.approx(0.65)]] * 2  # as it was recorded


def test_commands_of_one_are_left_to_the_bit() -> None:
    unit = Commands({"vx": (-1, 1), "vy": (-1.0, 1.0)})
    action = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (100, 2))).float()
    assert unit.are_normal and not DRIVE.are_normal
    assert torch.equal(unit.in_units(action), action) and unit.normal(action) is action
    assert unit.in_units(torch.tensor([3.0, -3.0])).tolist() == [1.0, -1.0]
    one_of_two = Commands({"vx": (-1.0, 1.0), "w": (-2.0, 2.0)})
    assert not one_of_two.are_normal and one_of_two.in_units(torch.tensor([0.5, 0.5])).tolist() == [0.5, 1.0]


@pytest.mark.parametrize(
    ("bounds", "told"),
    [
        ({}, "no axis is named"),
        ({"v": 1.5}, r"v: expected \(least, largest\), got 1.5"),
        ({"v": (1.0, 1.0)}, r"v: expected \(least, largest\), got \(1.0, 1.0\)"),
        ({"v": (1.0, 1.0 + 1e-9)}, r"v: expected \(least, largest\), got \(1.0, 1.000000001\)"),
        ({"v": (-3e38, 3e38)}, r"v: expected \(least, largest\), got"),
        ({"v": ("slow", "fast")}, r"v: expected \(least, largest\), got \('slow', 'fast'\)"),
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
    episode = fake_episode(1, 5)
    episode.columns[ACTION][:, 1] = 0.5
    write_fake(tmp_path / "still", [episode])
    with pytest.raises(BadInputError, match=r"commands: y never changes in .*: give the bounds"):
        Commands.recorded(tmp_path / "still")
    columns = {name: values for name, values in episode.columns.items() if name != ACTION}
    without = [column for column in COLUMNS if column.name != ACTION]
    write_fake(tmp_path / "none", [replace(episode, columns=columns)], columns=without)
    with pytest.raises(BadInputError, match="has no column action: give their bounds"):
        Commands.recorded(tmp_path / "none")


DRIVE_DRIVEN = Commands({"v": (-1.0, 4.0)})


def driven() -> DrivenSimulator:
    return DrivenSimulator(Rail(2), DRIVE_DRIVEN, "cpu")


def test_there_are_no_walls_where_the_simulator_has_none() -> None:
    simulator = driven()
    simulator.reset_to(torch.tensor([[1.0]]), torch.tensor([1]))
    assert simulator.state.tolist() == [[0.0], [1.0]]
    settled = simulator.settle(simulator.state, torch.tensor([[7.0], [8.0]]))
    assert settled.tolist() == simulator.state.tolist() == [[7.0], [8.0]]
    assert simulator.blocked.tolist() == [False, False]
    simulator.vary({"friction": torch.ones(2, 1)})
    assert simulator.parameters == {"timestep_s": 0.1}


class Walled(Rail):
    """A rail with an end at 1."""

    blocked = torch.tensor([True, False])
    varied, simulator = 0, object()  # an engine of its own

    def settle(self, before: torch.Tensor, landed: torch.Tensor) -> torch.Tensor:
        self.reset_to(landed.clamp_max(1.0))
        return self.state

    def vary(self, parameters: dict[str, torch.Tensor]) -> None:
        self.varied += len(parameters)


def test_walls_and_parameters_of_the_simulator_are_its_own() -> None:
    walled = Walled(2)
    simulator = DrivenSimulator(walled, DRIVE_DRIVEN, "cpu")
    assert simulator.settle(simulator.state, torch.tensor([[0.5], [3.0]])).tolist() == [[0.5], [1.0]]
    assert simulator.blocked.tolist() == [True, False]
    simulator.vary({"friction": torch.ones(2, 1)})
    assert walled.varied == 1
    varied = VariedCommands(simulator, CommandVariation())
    assert [innermost(one) for one in (varied, simulator, walled)] == [walled] * 3


def test_commands_vary_from_episode_to_episode() -> None:
    longer = CommandVariation(action_scale=(0.5, 0.5))
    simulator = TASK.varied_simulator(2, longer)
    assert isinstance(simulator, VariedCommands)
    # 0.4 of ±1 becomes 0.6: 1.5 + 2.5 * 0.6 = 3 m/s for a tenth of a second.
    torch.testing.assert_close(simulator.step(torch.full((2, 1), 0.4)), torch.full((2, 1), 0.3))
    # What is beyond ±1 is clipped before it is made shorter: 1.5 + 2.5 * 0.5 = 2.75 m/s.
    shorter = TASK.varied_simulator(2, CommandVariation(action_scale=(-0.5, -0.5)))
    torch.testing.assert_close(shorter.step(torch.full((2, 1), 4.0)), torch.full((2, 1), 0.275))
    torch.manual_seed(0)
    noisy = TASK.varied_simulator(500, CommandVariation(action_noise=(0.05, 0.05)))
    landed = noisy.step(torch.zeros(500, 1))
    assert abs(float(landed.std()) / (0.05 * 2.5 * 0.1) - 1.0) < 0.1 and abs(float(landed.mean()) - 0.15) < 0.002


class InPlace:
    """A simulator that has one tensor of states, and writes into it."""

    def __init__(self) -> None:
        self.state, self.parameters = torch.zeros(2, 1), dict[str, float]()

    def reset_to(self, state: torch.Tensor, rows: torch.Tensor | None = None) -> None:
        self.state[slice(None) if rows is None else rows] = state

    def step(self, command: torch.Tensor) -> torch.Tensor:
        self.state += command
        return self.state

    def settle(self, before: torch.Tensor, landed: torch.Tensor) -> torch.Tensor:
        self.state[:] = landed
        return self.state


def test_states_that_were_handed_out_stay_as_they_were() -> None:
    simulator = DrivenSimulator(InPlace(), DRIVE_DRIVEN, "cpu")
    state, landed = simulator.state, simulator.step(torch.ones(2, 1))
    kept = landed.clone()
    settled = simulator.settle(state, torch.full((2, 1), 7.0))
    simulator.reset_to(torch.full((1, 1), 9.0), torch.tensor([0]))
    assert state.tolist() == [[0.0], [0.0]] and torch.equal(landed, kept)
    assert settled.tolist() == [[7.0], [7.0]] and simulator.state.tolist() == [[9.0], [7.0]]
