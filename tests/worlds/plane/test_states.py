from dataclasses import replace

import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PlanarStates, VariedPlanar
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
    assert torch.equal(handed_out, HERE)
    assert torch.equal(states.state[1], HERE[0] + 1.0)
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


@pytest.mark.parametrize(("fine_m", "radius_m"), [(0.1, 0.0), (0.1, 0.3), (0.05, 0.35), (0.25, 0.75)])
def test_a_radius_of_whole_cells_is_kept(fine_m: float, radius_m: float) -> None:
    class Planar(PlanarStates):
        state_size = 4

    free = Planar(replace(U_MAZE, fine_m=fine_m), 1, timestep_s=0.1, radius_m=radius_m).free
    end, _ = free.slide(torch.tensor([[-4.0, 5.99 - radius_m]]), torch.tensor([[-4.0, 7.0]]))
    assert float(end[0, 1]) == pytest.approx(6.0 - radius_m, abs=1e-3)


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
    assert states.blocked.tolist() == [True, False, False]
    moved, stopped = states.free.slide(start[:, :2], landed[:, :2])
    torch.testing.assert_close(moved, landed[:, :2])
    assert not stopped.any()


def test_who_is_kept_clear_of_a_wall_stands_there() -> None:
    """Across the wall the velocity is what is left of the motion; along it, and without a wall, as it was."""
    states = planar(3, 5)
    start = HERE.clone()
    start[:, 1] = 5.45
    landed = start.clone()
    landed[:, 2:4] = torch.tensor([0.3, 0.9])
    landed[:, 0] += 0.02
    landed[:2, 1] += 0.2
    states.keep_clear(0.5)
    settled = states.settle(start, landed)
    period_s = states.parameters["timestep_s"]
    torch.testing.assert_close(settled[:2, 3], torch.full((2,), 0.05 / period_s), atol=0.05, rtol=0)
    torch.testing.assert_close(settled[:, 2], torch.full((3,), 0.3))
    torch.testing.assert_close(settled[2, 3], torch.tensor(0.9))
    free = planar(3, 5)
    landed[:, 1] += 1.0
    torch.testing.assert_close(free.settle(start, landed)[:, 2:4], landed[:, 2:4])


def test_nobody_comes_closer_than_the_disc_itself_does() -> None:
    states = planar(3, 5)
    states.keep_clear(0.0)
    landed = HERE.clone()
    landed[:, 1] = 5.99
    torch.testing.assert_close(states.settle(HERE, landed)[:, 1], torch.full((3,), 5.9), atol=1e-3, rtol=0)


def test_simulators_that_vary_keep_clear_as_well() -> None:
    inner, varied = resting(3, 5, PlanarVariation())
    varied.keep_clear(0.5)
    start = HERE.clone()
    start[:, 1] = 5.4
    landed = start.clone()
    landed[:, 1] = 5.8
    inner.reset_to(start)
    settled = varied.settle(start, landed)
    torch.testing.assert_close(settled[:, 1], torch.full((3,), 5.5), atol=1e-3, rtol=0)


def test_a_wall_that_stopped_a_step_counts_after_its_correction_too() -> None:
    states = planar(3, 5)
    states.blocked[2] = True
    states.settle(HERE, HERE)
    assert states.blocked.tolist() == [False, False, True]


def test_corrections_slide_along_walls_and_keep_all_else() -> None:
    states = planar(3, 5)
    landed = HERE.clone()
    landed[0, 1], landed[1, 0], landed[:, 2:] = 5.95, -3.95, 0.5
    settled = states.settle(HERE, landed)
    assert states.blocked.tolist() == [True, False, False]
    # The wall's face is at 6 m, the disc's center stays 0.1 m away.
    assert 5.8 < settled[0, 1] < 5.9001
    assert torch.equal(settled[1:], landed[1:])
    assert torch.equal(settled[:, 2:], landed[:, 2:])
    assert settled is states.state


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
    noise = BallVariation(
        position_noise_m=(0.1, 0.1),
        velocity_noise_m_s=(0.2, 0.2),
        ball_position_noise_m=(0.3, 0.3),
        ball_velocity_noise_m_s=(0.4, 0.4),
    )
    inner, varied = resting(3, 8, noise)
    here = torch.rand(3, 8)
    varied.reset_to(here)
    assert torch.equal(varied.state, here)
    shown = torch.stack([varied.step(torch.zeros(3, 3)) for _ in range(500)]) - here
    assert torch.equal(varied.true_state, here) and torch.equal(inner.state, here)
    expected = torch.tensor([0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.4, 0.4])
    torch.testing.assert_close(shown.amax((0, 1)), expected, atol=0, rtol=0.03)
    torch.testing.assert_close(shown.amin((0, 1)), -expected, atol=0, rtol=0.03)
    # A row that is set is shown as it is; the others as before.
    before = varied.state
    varied.reset_to(torch.zeros(1, 8), torch.tensor([1]))
    assert torch.equal(varied.state, torch.stack([before[0], torch.zeros(8), before[2]]))
    assert torch.equal(varied.true_state, torch.stack([here[0], torch.zeros(8), here[2]]))


def test_what_is_observed_after_a_reset_is_not_the_callers_tensor() -> None:
    _, varied = resting(3, 5, PlanarVariation())
    given = HERE.clone()
    varied.reset_to(given)
    given.zero_()
    assert torch.equal(varied.state, HERE) and torch.equal(varied.true_state, HERE)


def test_noise_is_for_velocities_and_not_for_the_wish_to_kick() -> None:
    torch.manual_seed(0)
    inner, varied = resting(20_000, 8, BallVariation(action_noise=(0.1, 0.1)))
    varied.step(torch.tensor([[0.5, -0.5, 3.0]]).expand(20_000, 3))
    torch.testing.assert_close(inner.action.mean(0), torch.tensor([0.5, -0.5, 3.0]), atol=0.005, rtol=0)
    torch.testing.assert_close(inner.action.std(0), torch.tensor([0.1, 0.1, 0.0]), atol=0.005, rtol=0)


def test_a_correction_is_of_the_true_state_and_is_shown_as_it_is() -> None:
    _, varied = resting(3, 4, PlanarVariation(position_noise_m=(0.1, 0.1)))
    here = HERE[:, :4]
    varied.reset_to(here)
    varied.step(torch.zeros(3, 2))
    landed = here.clone()
    landed[0, 1] = 5.95
    settled = varied.settle(here, landed)
    assert varied.blocked.tolist() == [True, False, False]
    assert torch.equal(varied.state, settled) and torch.equal(varied.true_state, settled)
    varied.true_state = landed
    assert torch.equal(varied.true_state, landed) and torch.equal(varied.state, settled)
