from dataclasses import replace

import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PlanarStates, PointMass, VariedPlanar
from astra_data.worlds.variation import BallVariation, PlanarVariation

HERE = torch.tensor([[-4.0, 5.85, 0.0, 0.0, 7.0]]).expand(3, 5)


def planar(count: int, size: int) -> PlanarStates:
    class Planar(PlanarStates):
        state_size = size

    return Planar(U_MAZE, count, timestep_s=0.1, radius_m=0.1, speed_m_s=2.0)


class Resting(PlanarStates):
    """Remembers its commands, and stays where it is."""

    def step(self, action: torch.Tensor) -> torch.Tensor:
        self.action = action
        return self.state


def resting(count: int, size: int, variation: PlanarVariation) -> tuple[Resting, VariedPlanar]:
    class Sized(Resting):
        state_size = size

    inner = Sized(U_MAZE, count, timestep_s=0.1, radius_m=0.1, speed_m_s=2.0)
    return inner, VariedPlanar(inner, variation)


def test_rows_are_set_by_themselves_and_states_handed_out_stay() -> None:
    states = planar(3, 5)
    states.reset_to(HERE)
    handed_out = states.state
    states.blocked[:] = True
    states.reset_to(HERE[:1] + 1.0, torch.tensor([1]))
    assert torch.equal(handed_out, HERE) and torch.equal(states.state[1], HERE[0] + 1.0)
    assert states.blocked.tolist() == [True, False, True]
    given = HERE.clone()
    states.reset_to(given)
    given.zero_()
    assert torch.equal(states.state, HERE)


@pytest.mark.parametrize(("fine_m", "radius_m"), [(0.25, 0.1), (0.1, 0.15), (0.1, 0.149), (0.1, 0.16)])
def test_a_radius_between_the_cells_of_the_maze_is_refused(fine_m: float, radius_m: float) -> None:
    expected = f"radius_m: expected a multiple of the maze's fine_m, {fine_m} m, got {radius_m}: take another"
    with pytest.raises(BadInputError, match=expected):
        PlanarStates(replace(U_MAZE, fine_m=fine_m), 1, timestep_s=0.1, radius_m=radius_m)


def test_corrections_keep_as_clear_of_walls_as_they_are_told_and_steps_do_not() -> None:
    """The wall's face is at 6 m; the disc's center comes as close as 0.1 m."""
    states = planar(3, 5)
    states.keep_clear(0.5)
    start = HERE.clone()
    start[:, 1] = 5.4
    landed = start.clone()
    landed[0, 1], landed[1, 1], landed[2, 0] = 5.7, 5.3, -3.5
    states.reset_to(start)
    settled = states.settle(start, landed)
    torch.testing.assert_close(settled[:, 1], torch.tensor([5.5, 5.3, 5.4]), atol=1e-3, rtol=0)
    torch.testing.assert_close(settled[:, 0], torch.tensor([-4.0, -4.0, -3.5]))
    # Who is stopped is as fast as it came on in the 0.1 s.
    torch.testing.assert_close(settled[:, 3], torch.tensor([1.0, 0.0, 0.0]), atol=1e-2, rtol=0)
    assert states.blocked.tolist() == [True, False, False]
    moved, stopped = states.free.slide(start[:, :2], landed[:, :2])
    torch.testing.assert_close(moved, landed[:, :2])
    assert not stopped.any()
    states.keep_clear(0.0)  # its radius is as close as it comes
    assert float(states.settle(start, start + torch.tensor([0.0, 0.58, 0.0, 0.0, 0.0]))[:, 1].max()) < 5.901


def test_corrections_slide_along_walls_and_keep_all_else() -> None:
    states = planar(3, 5)
    landed = HERE.clone()
    landed[0, 1], landed[1, 0], landed[:, 2:] = 5.95, -3.95, 0.5
    states.blocked[2] = True  # in the step before
    settled = states.settle(HERE, landed)
    assert states.blocked.tolist() == [True, False, True]
    # The wall's face is at 6 m, the disc's center stays 0.1 m away.
    assert 5.8 < settled[0, 1] < 5.9001 and torch.equal(settled[1:], landed[1:])
    assert torch.equal(settled[:, 2:], landed[:, 2:]) and settled is states.state


def test_commands_are_clipped_then_turned_then_scaled() -> None:
    states = planar(2, 4)
    command = torch.tensor([[3.0, 0.0], [0.5, -0.25]])
    torch.testing.assert_close(states.commanded_velocity(command), torch.tensor([[2.0, 0.0], [1.0, -0.5]]))
    plain = {"friction": 1.0, "action_scale": 0.0, "heading_bias_deg": 0.0, "timestep_scale": 1.0}
    columns = {name: torch.full((2, 1), value) for name, value in plain.items()}
    columns["friction"][1], columns["action_scale"][1], columns["heading_bias_deg"][0] = 0.5, 0.2, 90.0
    columns["timestep_scale"][1] = 3.0
    states.vary(columns)
    torch.testing.assert_close(
        states.commanded_velocity(command), torch.tensor([[0.0, 2.0], [0.6, -0.3]]), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(states.period_s, torch.tensor([[0.1], [0.3]]))


def test_sensors_show_other_states_than_the_true_ones() -> None:
    torch.manual_seed(0)
    names = ("position_noise_m", "velocity_noise_m_s", "ball_position_noise_m", "ball_velocity_noise_m_s")
    widths = {name: (width / 10, width / 10) for width, name in enumerate(names, start=1)}
    inner, varied = resting(3, 8, BallVariation(**widths))
    here = torch.rand(3, 8)
    varied.reset_to(here)
    assert torch.equal(varied.state, here)
    shown = torch.stack([varied.step(torch.zeros(3, 3)) for _ in range(500)]) - here
    assert torch.equal(varied.simulator.state, here) and torch.equal(inner.state, here)
    expected = torch.tensor([0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.4, 0.4])
    torch.testing.assert_close(shown.amax((0, 1)), expected, atol=0, rtol=0.03)
    torch.testing.assert_close(shown.amin((0, 1)), -expected, atol=0, rtol=0.03)
    # A row that is set is shown as it is; the others as before.
    before = varied.state
    varied.reset_to(torch.zeros(1, 8), torch.tensor([1]))
    assert torch.equal(varied.state, torch.stack([before[0], torch.zeros(8), before[2]]))
    assert torch.equal(varied.simulator.state, torch.stack([here[0], torch.zeros(8), here[2]]))


START = torch.tensor([[-4.0, 4.0, 0.0, 0.0]])
ACTION = torch.tensor([[0.6, -0.8]])


def point_mass(num_envs: int) -> PointMass:
    return PointMass(U_MAZE, num_envs, timestep_s=0.05)


def one_step(variation: PlanarVariation, count: int = 1, action: torch.Tensor = ACTION) -> VariedPlanar:
    simulator = VariedPlanar(point_mass(count), variation)
    simulator.reset_to(START.expand(count, 4))
    simulator.step(action.expand(count, 2))
    return simulator


def test_the_plain_point_mass_does_these_operations_in_this_order() -> None:
    """Recorded datasets hold its float32 states: no rounding may change."""
    torch.manual_seed(1)
    simulator = PointMass(U_MAZE, 100, timestep_s=0.192, speed_m_s=0.25)
    position = torch.tensor(U_MAZE.cell_center(*U_MAZE.start)).expand(100, 2)
    simulator.reset_to(torch.cat([position, torch.zeros(100, 2)], dim=-1))
    for _ in range(50):
        action = 2 * torch.randn(100, 2)
        state = simulator.step(action)
        moved, _ = simulator.free.slide(position, position + action.clamp(-1.0, 1.0) * 0.25 * 0.192)
        assert torch.equal(state, torch.cat([moved, (moved - position) / 0.192], dim=-1))
        position = moved


def test_each_parameter_does_what_its_name_says() -> None:
    plain = one_step(PlanarVariation())
    assert torch.equal(plain.state[0, 2:], plain.simulator.state[0, 2:])
    for variation, velocity, moved in (
        (PlanarVariation(friction=(0.5, 0.5)), [0.3, -0.4], [0.015, -0.02]),
        (PlanarVariation(action_scale=(0.5, 0.5)), [0.9, -1.2], [0.045, -0.06]),
        (PlanarVariation(heading_bias_deg=(90.0, 90.0)), [0.8, 0.6], [0.04, 0.03]),
        (PlanarVariation(timestep_scale=(2.0, 2.0)), [0.6, -0.8], [0.06, -0.08]),
    ):
        state = one_step(variation).state[0]
        torch.testing.assert_close(state[2:], torch.tensor(velocity), atol=1e-4, rtol=0)
        torch.testing.assert_close(state[:2] - START[0, :2], torch.tensor(moved), atol=1e-5, rtol=0)


def test_noise_on_commands_moves() -> None:
    torch.manual_seed(0)
    noisy = one_step(PlanarVariation(action_noise=(0.1, 0.1)), 20_000, 0.5 * ACTION)
    assert torch.equal(noisy.state, noisy.simulator.state)
    torch.testing.assert_close(noisy.state[:, 2:].std(0), torch.full((2,), 0.1), atol=0.005, rtol=0)
