import torch

from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.plane.varied_point_mass import VariedPointMass
from astra_data.worlds.variation import PlanarVariation

START = torch.tensor([[-4.0, 4.0, 0.0, 0.0]])
ACTION = torch.tensor([[0.6, -0.8]])


def one_step(variation: PlanarVariation, count: int = 1, action: torch.Tensor = ACTION) -> VariedPointMass:
    simulator = VariedPointMass(U_MAZE, count, variation, timestep_s=0.05)
    simulator.reset_to(START.expand(count, 4))
    simulator.step(action.expand(count, 2))
    return simulator


def test_plain_parameters_are_the_plain_point_mass() -> None:
    torch.manual_seed(0)
    varied, plain = (
        VariedPointMass(U_MAZE, 50, PlanarVariation(), timestep_s=0.05),
        PointMass(U_MAZE, 50, timestep_s=0.05),
    )
    for simulator in (varied, plain):
        simulator.reset_to(START.expand(50, 4))
    for _ in range(200):
        action = torch.randn(50, 2)
        torch.testing.assert_close(varied.step(action), plain.step(action))
        assert torch.equal(varied.blocked, plain.blocked)


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
