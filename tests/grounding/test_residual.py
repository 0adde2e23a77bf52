import pytest
import torch

from astra_data.grounding.residual import ResidualSimulator
from astra_data.learning.networks.residual import ResidualModel, ResidualShape
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass

HERE = (-4.0, 4.0)


def simulator(count: int, scatter: torch.Tensor | None = None) -> ResidualSimulator:
    torch.manual_seed(0)
    model = ResidualModel(ResidualShape(4, 2, hidden_size=8, layers=2))
    inner = PointMass(U_MAZE, count, timestep_s=0.05)
    one = ResidualSimulator(inner, model, scatter=scatter)
    start(one, torch.tensor([[*HERE, 0.0, 0.0]]).expand(count, 4), torch.arange(count))
    return one


def start(
    one: ResidualSimulator, state: torch.Tensor, rows: torch.Tensor, hidden: torch.Tensor | None = None
) -> None:
    one.start(state, rows, torch.zeros(len(rows), 2), hidden=hidden)


def correct_by(one: ResidualSimulator, offset: tuple[float, ...]) -> None:
    """Let the model add the same offset to every step."""
    with torch.no_grad():
        one.model.output.weight.zero_()
        one.model.output.bias.copy_(torch.tensor(offset))


def test_each_step_goes_on_from_the_corrected_state() -> None:
    one = simulator(1)
    correct_by(one, (0.01, -0.02, 0.3, 0.0))
    for step in range(1, 4):
        state = one.step(torch.tensor([[1.0, 0.0]]))
        expected = (HERE[0] + 0.06 * step, HERE[1] - 0.02 * step, 1.3, 0.0)
        assert state[0].tolist() == pytest.approx(expected, abs=1e-5)
        assert torch.equal(one.simulator.state, state)
    assert not one.blocked.any()


def test_corrections_stop_at_walls() -> None:
    one = simulator(1)
    correct_by(one, (0.0, 30.0, 0.0, 0.0))
    state = one.step(torch.tensor([[1.0, 0.0]]))
    assert one.blocked.all()
    free = PointMass(U_MAZE, 1, timestep_s=0.05).free
    assert bool(free.blocked[free.cells(state[:, :2])].logical_not().all())
    assert float(state[0, 0]) == pytest.approx(HERE[0] + 0.05, abs=1e-5)


def test_leaning_on_a_wall_is_a_touch_though_the_correction_draws_away_from_it() -> None:
    one = simulator(2)
    correct_by(one, (0.0, -0.2, 0.0, 0.0))
    near_and_far = torch.tensor([[-4.0, 5.89, 0.0, 0.0], [-4.0, 5.0, 0.0, 0.0]])
    start(one, near_and_far, torch.arange(2))
    state = one.step(torch.tensor([[0.0, 1.0]]).expand(2, 2))
    assert float(state[0, 1]) < 5.75
    assert one.blocked.tolist() == [True, False]
    one.step(torch.tensor([[1.0, 0.0]]).expand(2, 2))
    assert one.blocked.tolist() == [False, False]


def test_a_reset_empties_the_memory_of_its_rows_alone() -> None:
    one, fresh = simulator(3), simulator(3)
    for _ in range(5):
        one.step(torch.randn(3, 2))
    kept = one.hidden.clone()
    rows, here = torch.tensor([1]), torch.tensor([[*HERE, 0.0, 0.0]])
    start(one, here, rows)
    assert not one.hidden[1].any()
    assert torch.equal(one.hidden[[0, 2]], kept[[0, 2]])
    action = torch.tensor([[0.3, -0.4]]).expand(3, 2)
    torch.testing.assert_close(one.step(action)[1], fresh.step(action)[1])
    known = torch.randn(1, one.model.shape.memory_size)
    start(one, here, rows, known)
    assert torch.equal(one.hidden[rows], known)


def test_from_what_was_saved_it_goes_on_as_it_went() -> None:
    first, second = simulator(3), simulator(3)
    for _ in range(3):
        first.step(torch.randn(3, 2))
    saved = {name: values.clone() for name, values in first.state_dict().items()}
    second.load_state_dict(saved)
    action = torch.tensor([[0.3, -0.4]]).expand(3, 2)
    for _ in range(2):
        assert torch.equal(first.step(action), second.step(action))
    second.load_state_dict(saved)
    start(second, torch.tensor([[*HERE, 0.0, 0.0]]), torch.tensor([1]))
    assert saved["hidden"][1].any()  # a second load finds what the first one did


def test_scatter_has_the_asked_covariance() -> None:
    factor = torch.diag(torch.tensor([0.01, 0.02, 0.1, 0.3]))
    one = simulator(20_000, scatter=factor)
    correct_by(one, (0.0, 0.0, 0.0, 0.0))
    state = one.step(torch.zeros(20_000, 2))
    torch.testing.assert_close(state.std(0), factor.diagonal(), rtol=0.03, atol=0)
