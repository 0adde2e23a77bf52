import torch

from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.states import PlanarStates, VariedStates
from astra_data.worlds.variation import PlanarVariation

HERE = torch.tensor([[-4.0, 5.85, 0.0, 0.0, 7.0]]).expand(3, 5)


class Resting(VariedStates):
    def step(self, action: torch.Tensor) -> torch.Tensor:
        return self.show([torch.full((3,), 0.1), torch.full((3,), 0.2)])


def test_rows_are_set_by_themselves_and_states_handed_out_stay() -> None:
    states = PlanarStates(U_MAZE, 3, 5, radius_m=0.1, device="cpu")
    states.reset_to(HERE)
    handed_out = states.state
    states.blocked[:] = True
    states.reset_to(HERE[:1] + 1.0, torch.tensor([1]))
    assert torch.equal(handed_out, HERE)
    assert torch.equal(states.state[1], HERE[0] + 1.0)
    assert states.blocked.tolist() == [True, False, True]


def test_corrections_slide_along_walls_and_keep_all_else() -> None:
    states = PlanarStates(U_MAZE, 3, 5, radius_m=0.1, device="cpu")
    landed = HERE.clone()
    landed[0, 1], landed[1, 0], landed[:, 2:] = 5.95, -3.95, 0.5
    settled = states.settle(HERE, landed)
    assert states.blocked.tolist() == [True, False, False]
    # The wall's face is at 6 m, the disc's centre stays 0.1 m away.
    assert 5.8 < settled[0, 1] < 5.9001
    assert torch.equal(settled[1:], landed[1:])
    assert torch.equal(settled[:, 2:], landed[:, 2:])
    assert settled is states.state


def test_sensors_show_what_is_not_so() -> None:
    torch.manual_seed(0)
    states = Resting(U_MAZE, 3, 4, PlanarVariation(friction=(0.5, 1.5)), radius_m=0.1, device="cpu")
    states.reset_to(HERE[:, :4])
    shown = torch.stack([states.step(torch.zeros(3, 2)) for _ in range(500)]) - states.true_state
    assert torch.equal(states.true_state, HERE[:, :4])
    largest = shown.abs().amax((0, 1))
    torch.testing.assert_close(largest, torch.tensor([0.1, 0.1, 0.2, 0.2]), atol=0, rtol=0.02)
