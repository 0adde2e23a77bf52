import pytest
import torch

from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.scattered import RandomizedSimulator


def simulators(num_envs: int, factor: torch.Tensor) -> tuple[PointMass, RandomizedSimulator]:
    inner = PointMass(U_MAZE, num_envs, timestep_s=0.05)
    return inner, RandomizedSimulator(inner, factor)


def test_no_noise_is_the_simulator_itself() -> None:
    _, randomized = simulators(1, torch.zeros(4, 4))
    raw = PointMass(U_MAZE, 1, timestep_s=0.05)
    for sim in (raw, randomized):
        sim.reset_to(torch.tensor([[-4.0, 4.0, 0.0, 0.0]]))
    for _ in range(10):
        action = torch.tensor([[0.3, 0.9]])
        assert torch.equal(randomized.step(action), raw.step(action))


def test_noise_has_the_given_shape() -> None:
    torch.manual_seed(0)
    factor = torch.tensor([[0.02, 0, 0, 0], [0.01, 0.02, 0, 0], [0.1, 0, 0.3, 0], [0, 0, 0, 0.2]])
    _, randomized = simulators(20_000, factor)
    randomized.reset_to(torch.tensor([[-4.0, 4.0, 0.0, 0.0]]).expand(20_000, 4))
    state = randomized.step(torch.full((20_000, 2), 0.5))
    assert state.mean(0).tolist() == pytest.approx([-3.975, 4.025, 0.5, 0.5], abs=0.01)
    torch.testing.assert_close(torch.cov(state.T), factor @ factor.T, atol=2e-3, rtol=0.05)


def test_positions_stay_free() -> None:
    torch.manual_seed(0)
    inner, randomized = simulators(200, torch.diag(torch.tensor([0.05, 0.05, 0.0, 0.0])))
    randomized.reset_to(torch.tensor([[-4.0, 5.7, 0.0, 0.0]]).expand(200, 4))
    seen = torch.zeros(200, dtype=torch.bool)
    for _ in range(20):
        state = randomized.step(torch.tensor([[0.0, 1.0]]).expand(200, 2))
        assert not inner.free.blocked[inner.free.cells(state[:, :2])].any()
        seen |= randomized.blocked
    assert bool(seen.all())
