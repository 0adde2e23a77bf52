import math

import pytest
import torch
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.grounding.failures import (
    AHEAD_S,
    AVERAGED_S,
    FailureModel,
    FailureShape,
)
from astra_data.grounding.paired_episodes import PairedWindows
from astra_data.worlds.plane.mazes import U_MAZE

TIMESTEP_S = 0.05


def model(*, has_maze: bool = False, latent_size: int = 0) -> FailureModel:
    torch.manual_seed(0)
    cells = U_MAZE.fine_walls.shape
    sizes = (cells[0], cells[1]) if has_maze else (0, 0)
    made = FailureModel(
        FailureShape(4, 2, TIMESTEP_S, sizes, U_MAZE.fine_m, members=3, latent_size=latent_size)
    )
    if has_maze:
        made.clearance.copy_(torch.from_numpy(U_MAZE.clearance_field))
        made.half_extent.copy_(torch.from_numpy(U_MAZE.half_extent))
    return made.requires_grad_(False).eval()


def windows(episodes: int = 3, steps: int = 12) -> PairedWindows:
    torch.manual_seed(1)
    state = torch.rand(episodes, steps + 1, 4) * 4 - 2
    landed = state[:, 1:] + torch.randn(episodes, steps, 4)
    action = 2 * torch.rand(episodes, steps, 2) - 1
    return toy_episodes(state[:, :-1], action, next_state=state[:, 1:], simulated_next=landed).windows


def seen(made: FailureModel, of: PairedWindows) -> Tensor:
    """Return the inputs (E, T, I) of all steps, one by one."""
    memory, inputs = made.initial_memory(of.state[:, 0], of.previous_action[:, 0]), []
    nothing = torch.zeros(len(of.state), 0)
    for step in range(of.state.shape[1]):
        now = of.state[:, step], of.action[:, step], of.simulated_next[:, step], nothing
        one, memory = made.inputs(*now, memory)
        inputs.append(one)
    return torch.stack(inputs, dim=1)


def rms(move: Tensor) -> float:
    return float(move.square().mean().sqrt())


def test_the_magnitudes_are_moves_in_their_deviations_and_commands() -> None:
    made, of = model(), windows()
    made.wanted_std.fill_(2.0)
    made.moved_std.fill_(3.0)
    made.missed_std.fill_(4.0)
    inputs = seen(made, of)
    for episode, step in ((0, 0), (1, 5)):
        state, action = of.state[episode], of.action[episode]
        wanted = of.simulated_next[episode, step] - state[step]
        moved = state[step] - state[step - 1] if step else torch.zeros(4)
        missed = state[step] - of.simulated_next[episode, step - 1] if step else torch.zeros(4)
        before = action[step - 1] if step else torch.zeros(2)
        expected = [
            rms(wanted) / 2,
            rms(moved) / 3,
            rms(missed) / 4,
            float((action[step] - before).norm()),
            float(action[step].norm()),
        ]
        assert inputs[episode, step, :5].tolist() == pytest.approx(expected, abs=1e-5)


def test_averages_forget_with_their_time_constants() -> None:
    made, still = model(), torch.zeros(1, 40, 4)
    action = torch.tensor([3.0, 4.0]).expand(1, 40, 2)
    inputs = seen(made, toy_episodes(still, action, next_state=still).windows)
    for number, seconds in enumerate(AVERAGED_S):
        of_the_action = inputs[0, :, 5 * (number + 1) + 4]
        expected = [5 * (1 - math.exp(-(step + 1) * TIMESTEP_S / seconds)) for step in range(40)]
        assert of_the_action.tolist() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("latent_size", [0, 8])
@pytest.mark.parametrize("has_maze", [False, True])
def test_a_step_says_what_its_inputs_are_worth(has_maze: bool, latent_size: int) -> None:
    made, of = model(has_maze=has_maze, latent_size=latent_size), windows()
    memory = made.initial_memory(of.state[:, 0], of.previous_action[:, 0])
    for step in range(12):
        latent = torch.randn(3, 8)
        now = of.state[:, step], of.action[:, step], of.simulated_next[:, step], latent
        inputs, after = made.inputs(*now, memory)
        assert inputs.shape == (3, made.shape.input_size) and after.shape == (3, made.memory_size)
        # The latent comes last: without it, a model sees the same but for that.
        assert made.shape.motion_size == made.shape.input_size - latent_size == (31 if has_maze else 20)
        assert torch.equal(inputs[:, made.shape.motion_size :], latent[:, :latent_size])
        said, memory = made.step(*now, memory)
        torch.testing.assert_close(memory, after)
        torch.testing.assert_close(said, made.probability(inputs))


def test_walls_are_seen_where_the_robot_and_where_the_simulator_goes() -> None:
    made = model(has_maze=True)
    # The upper corridor of the U-Maze: walls 2 m to the north and to the south.
    state = torch.tensor([[0.0, 4.0, 0.0, 0.0]])
    landed = state + torch.tensor([[0.0, 0.05, 0.0, 0.0]])  # 1 m/s to the north
    inputs, _ = made.inputs(
        *(state, torch.zeros(1, 2), landed, torch.zeros(1, 0)), made.initial_memory(state, torch.zeros(1, 2))
    )
    walls = inputs[0, 20:]
    to_wall = [float(U_MAZE.clearance(state[0, :2].double().numpy()))]
    for second in AHEAD_S:
        place = state[0, :2].double() + torch.tensor([0.0, second]).double()
        to_wall.append(float(U_MAZE.clearance(place.numpy())))
    assert walls[:6].tolist() == pytest.approx(to_wall, abs=0.11)
    assert to_wall[5] < 0.2 < to_wall[1] < to_wall[0]
    assert walls[6:].tolist() == pytest.approx([to_wall[0]] * 5, abs=1e-5)
