import pytest
import torch
from grounding_models import GOAL, HERE, failure_model, model
from torch import Tensor

from astra_data.grounding.failures import FailureModel
from astra_data.grounding.history import GroundedSimulator, HistoryGrounding
from astra_data.grounding.model import GroundingModel
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass

ROWS = torch.arange(3)


def simulator(used: GroundingModel, failures: FailureModel | None = None) -> GroundedSimulator:
    one = HistoryGrounding(used, failures).corrected(PointMass(U_MAZE, 3, timestep_s=0.05))
    one.start(HERE.expand(3, 4), ROWS, GOAL)
    return one


def actions(count: int) -> list[Tensor]:
    torch.manual_seed(1)
    return [2 * torch.rand(3, 2) - 1 for _ in range(count)]


def test_each_step_is_corrected_given_the_latent_of_the_history_before_it() -> None:
    """Algorithm 2, written out with the model's parts and a point mass of its own."""
    used, raw = model(), PointMass(U_MAZE, 3, timestep_s=0.05)
    one = simulator(used)
    state, hidden, previous = HERE.expand(3, 4), torch.zeros(3, 8), torch.zeros(3, 2)
    for action in actions(6):
        hidden = used.encoder.step(used.encoder_input(state, GOAL, previous), hidden)
        torch.testing.assert_close(one.hidden, hidden)
        torch.testing.assert_close(one.latent, torch.nn.functional.layer_norm(hidden, (8,)))
        raw.reset_to(state)
        landed = raw.step(action)
        corrected = used.correct(used.encoder.latent(hidden), action, landed)
        assert (corrected - landed).abs().max() > 1e-3
        before, state, previous = state, one.step(action), action
        # Nothing is near a wall: the state is where the correction put it.
        torch.testing.assert_close(state, corrected)
        assert torch.equal(one.state, state)
        assert not torch.equal(state, before)


def test_a_start_changes_its_rows_alone() -> None:
    used = model()
    one = simulator(used)
    for action in actions(3):
        one.step(action)
    hidden, goal, state = one.hidden.clone(), one.goal.clone(), one.state.clone()
    known, before, there = torch.randn(1, 8), torch.randn(1, 2), torch.tensor([[4.0, 4.0, 0.1, 0.2]])
    one.start(there, torch.tensor([1]), torch.ones(1, 2), hidden=known, previous_action=before)
    expected = used.encoder.step(used.encoder_input(there, torch.ones(1, 2), before), known)
    torch.testing.assert_close(one.hidden[[1]], expected)
    assert torch.equal(one.goal[[1]], torch.ones(1, 2))
    assert torch.equal(one.state[[1]], there)
    others = torch.tensor([0, 2])
    for ours, theirs in ((one.hidden, hidden), (one.goal, goal), (one.state, state)):
        assert torch.equal(ours[others], theirs[others])


def test_a_saved_state_goes_on_as_it_would_have() -> None:
    first, second = simulator(model()), simulator(model())
    for action in actions(3):
        first.step(action)
    saved = {name: values.clone() for name, values in first.state_dict().items()}
    assert saved.keys() == {"state", "goal", "hidden"}
    second.goal.zero_()
    second.load_state_dict(saved)
    for action in actions(3):
        assert torch.equal(first.step(action), second.step(action))
        assert torch.equal(first.latent, second.latent)
    second.load_state_dict(saved)
    second.start(HERE, ROWS[:1], torch.ones(1, 2))
    assert torch.equal(saved["goal"], GOAL)  # what was saved stays as it was


@pytest.mark.parametrize("latent_size", [0, 8])
def test_a_failure_model_is_asked_before_each_correction_and_prices_failures(latent_size: int) -> None:
    used, failures, raw = model(), failure_model(latent_size), PointMass(U_MAZE, 3, timestep_s=0.05)
    used.failure_cost.fill_(-10.0)
    one, plain = simulator(used, failures), simulator(used)
    memory = failures.initial_memory(one.state, torch.zeros(3, 2))
    for action in actions(5):
        raw.reset_to(one.state)
        latent = one.latent
        seen, memory = failures.inputs(one.state, action, raw.step(action), latent, memory)
        said = failures.probability(seen)
        torch.testing.assert_close(one.step(action), plain.step(action))
        torch.testing.assert_close(one.failure_risk(), said / 2)  # within two steps
        expected = used.predict_reward(latent, action) - 10.0 * said / 2
        torch.testing.assert_close(one.predicted_reward(torch.zeros(3)), expected)


def test_a_failure_models_memory_is_kept_and_forgotten_at_a_start() -> None:
    used, failures = model(), failure_model()
    one, played = simulator(used, failures), actions(6)
    for action in played[:4]:
        one.step(action)
    saved = {name: values.clone() for name, values in one.state_dict().items()}
    one.step(played[4])
    wanted = one.failure_risk()
    resumed = simulator(used, failures)
    resumed.load_state_dict(saved)
    resumed.step(played[4])
    torch.testing.assert_close(resumed.failure_risk(), wanted)

    one.start(HERE.expand(3, 4), ROWS, GOAL)
    one.step(played[0])
    fresh = simulator(used, failures)
    fresh.step(played[0])
    torch.testing.assert_close(one.failure_risk(), fresh.failure_risk())
    risk = fresh.failure_risk()
    assert risk is not None and wanted is not None and not torch.allclose(risk, wanted)
