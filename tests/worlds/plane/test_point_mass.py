import pytest
import torch

from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass, VariedPlanar
from astra_data.worlds.variation import PlanarVariation

START = torch.tensor([[-4.0, 4.0, 0.0, 0.0]])
ACTION = torch.tensor([[0.6, -0.8]])


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
    # The wall's face is at y = 6, its center may come to 0.1 m of it.
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
    centers = torch.tensor(U_MAZE.free_centers(), dtype=torch.float32)
    position = centers[torch.randint(len(centers), (64,), generator=generator)]
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


def one_step(variation: PlanarVariation, count: int = 1, action: torch.Tensor = ACTION) -> VariedPlanar:
    simulator = VariedPlanar(point_mass(count), variation)
    simulator.reset_to(START.expand(count, 4))
    simulator.step(action.expand(count, 2))
    return simulator


def test_plain_parameters_are_the_plain_point_mass_to_the_bit() -> None:
    torch.manual_seed(0)
    varied, plain = VariedPlanar(point_mass(50), PlanarVariation()), point_mass(50)
    for simulator in (varied, plain):
        simulator.reset_to(START.expand(50, 4))
    for _ in range(200):
        action = torch.randn(50, 2)
        assert torch.equal(varied.step(action), plain.step(action))
        assert torch.equal(varied.blocked, plain.blocked)


def test_the_plain_point_mass_does_these_operations_in_this_order() -> None:
    """Recorded datasets hold its float32 states: no rounding may change."""
    torch.manual_seed(1)
    simulator = PointMass(U_MAZE, 100, timestep_s=0.192, speed_m_s=0.25)
    position = torch.tensor(U_MAZE.free_centers()[:1], dtype=torch.float32).expand(100, 2)
    simulator.reset_to(torch.cat([position, torch.zeros(100, 2)], dim=-1))
    for _ in range(50):
        action = 2 * torch.randn(100, 2)
        state = simulator.step(action)
        moved, _ = simulator.free.slide(position, position + action.clamp(-1.0, 1.0) * 0.25 * 0.192)
        assert torch.equal(state, torch.cat([moved, (moved - position) / 0.192], dim=-1))
        position = moved


def test_each_parameter_does_what_its_name_says() -> None:
    plain = one_step(PlanarVariation())
    assert torch.equal(plain.state[0, 2:], plain.true_state[0, 2:])
    for variation, velocity, moved in (
        (PlanarVariation(friction=(0.5, 0.5)), [0.3, -0.4], [0.015, -0.02]),
        (PlanarVariation(action_scale=(0.5, 0.5)), [0.9, -1.2], [0.045, -0.06]),
        (PlanarVariation(heading_bias_deg=(90.0, 90.0)), [0.8, 0.6], [0.04, 0.03]),
        (PlanarVariation(timestep_scale=(2.0, 2.0)), [0.6, -0.8], [0.06, -0.08]),
    ):
        state = one_step(variation).state[0]
        torch.testing.assert_close(state[2:], torch.tensor(velocity), atol=1e-4, rtol=0)
        torch.testing.assert_close(state[:2] - START[0, :2], torch.tensor(moved), atol=1e-5, rtol=0)


def test_commands_are_cut_off_before_they_are_scaled() -> None:
    state = one_step(PlanarVariation(action_scale=(0.1, 0.1)), action=torch.tensor([[3.0, 0.0]])).state
    torch.testing.assert_close(state[0, 2:], torch.tensor([1.1, 0.0]), atol=1e-4, rtol=0)


def test_noise_on_commands_moves_and_noise_of_sensors_only_shows() -> None:
    torch.manual_seed(0)
    noisy = one_step(PlanarVariation(action_noise=(0.1, 0.1)), 20_000, 0.5 * ACTION)
    assert torch.equal(noisy.state, noisy.true_state)
    torch.testing.assert_close(noisy.state[:, 2:].std(0), torch.full((2,), 0.1), atol=0.005, rtol=0)
    shown = one_step(PlanarVariation(position_noise_m=(0.03, 0.03), velocity_noise_m_s=(0.02, 0.02)), 20_000)
    assert (shown.true_state == shown.true_state[:1]).all()
    error = (shown.state - shown.true_state).abs().amax(0)
    torch.testing.assert_close(error, torch.tensor([0.03, 0.03, 0.02, 0.02]), atol=1e-4, rtol=0.01)
