import pytest
import torch

from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass


def point_mass(num_envs: int) -> PointMass:
    return PointMass(U_MAZE, num_envs, timestep_s=0.05)


def test_free_motion_integrates_the_command() -> None:
    sim = point_mass(1)
    sim.reset_to(torch.tensor([[-4.0, 4.0, 0.0, 0.0]]))
    for _ in range(20):
        state = sim.step(torch.tensor([[0.6, -0.8]]))
    assert state[0].tolist() == pytest.approx([-4.0 + 0.6, 4.0 - 0.8, 0.6, -0.8], abs=1e-4)


def test_commands_are_clipped() -> None:
    sim = point_mass(1)
    sim.reset_to(torch.tensor([[-4.0, 4.0, 0.0, 0.0]]))
    assert sim.step(torch.tensor([[5.0, -5.0]]))[0].tolist() == pytest.approx([-3.95, 3.95, 1, -1], abs=1e-4)


def test_a_wall_stops_one_axis_and_its_velocity() -> None:
    sim = point_mass(1)
    sim.reset_to(torch.tensor([[-4.0, 4.0, 0.0, 0.0]]))
    for _ in range(60):
        state = sim.step(torch.tensor([[0.5, 1.0]]))
    # The wall's face is at y = 6, its centre may come to 0.1 m of it.
    assert state[0].tolist() == pytest.approx([-4.0 + 60 * 0.025, 5.9, 0.5, 0.0], abs=1e-3)
    assert bool(sim.blocked)


def test_reset_to_round_trip() -> None:
    sim = point_mass(3)
    state = torch.rand(3, 4)
    sim.reset_to(state)
    assert torch.equal(sim.state, state)
    sim.reset_to(torch.zeros(1, 4), torch.tensor([1]))
    assert torch.equal(sim.state, torch.stack([state[0], torch.zeros(4), state[2]]))


def test_states_handed_out_stay_as_they_were() -> None:
    sim = point_mass(2)
    state = sim.step(torch.ones(2, 2))
    kept = state.clone()
    sim.reset_to(torch.full((1, 4), 7.0), torch.tensor([0]))
    sim.step(torch.ones(2, 2))
    assert torch.equal(state, kept)


def test_a_batch_steps_as_its_rows_do() -> None:
    generator = torch.Generator().manual_seed(0)
    centres = torch.tensor(U_MAZE.free_centres(), dtype=torch.float32)
    position = centres[torch.randint(len(centres), (64,), generator=generator)]
    # Most of them close to a wall.
    position = position + 1.89 * torch.tanh(3 * torch.randn(64, 2, generator=generator))
    state = torch.cat([position, torch.zeros(64, 2)], dim=-1)
    action = 2 * torch.rand(64, 2, generator=generator) - 1
    together, single = point_mass(64), point_mass(1)
    together.reset_to(state)
    after = together.step(action)
    for row in range(64):
        single.reset_to(state[row : row + 1])
        assert torch.equal(single.step(action[row : row + 1])[0], after[row])
        assert bool(single.blocked[0]) == bool(together.blocked[row])
    assert 0 < int(together.blocked.sum()) < 64
