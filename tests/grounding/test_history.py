import json
from typing import Any

import pytest
import torch
from grounding_models import GOAL, HERE, TASK, failure_model, model
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.grounding.failures import FailureModel
from astra_data.grounding.history import GroundedSimulator, HistoryGrounding
from astra_data.grounding.model import GroundingModel
from astra_data.grounding.simulator import NO_GROUNDING, EpisodeSimulator
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.navigation import PointMass


@pytest.mark.parametrize("latent_size", [None, 0, 8])
def test_a_failure_model_is_saved_with_its_grounding(latent_size: int | None) -> None:
    failures = None if latent_size is None else failure_model(latent_size)
    walls: dict[str, Any] = {"clearance_m": latent_size, "fails_at_walls": latent_size == 0}
    tensors, metadata = HistoryGrounding(model(), failures, **walls).to_file()
    read = HistoryGrounding.from_file(dict(tensors), json.loads(json.dumps(metadata)), "cpu")
    assert ("failures" in metadata) == (read.failures is not None) == (failures is not None)
    assert {name: getattr(read, name) for name in walls} == walls
    if failures is not None and read.failures is not None:
        assert read.failures.shape == failures.shape
        saved = read.failures.state_dict()
        assert all(torch.equal(saved[name], one) for name, one in failures.state_dict().items())


STEPS, COUNT = 11, 3


@pytest.mark.parametrize("every", [1, 4])
@torch.no_grad()
def test_an_episode_taken_up_in_its_midst_goes_on_as_it_went(every: int) -> None:
    torch.manual_seed(0)
    grounding = HistoryGrounding(model())
    goal, action = torch.randn(COUNT, 2), 2 * torch.rand(COUNT, STEPS, 2) - 1
    start = torch.tensor([[*TASK.maze.cell_center(1, 1), 0.0, 0.0]]).float().expand(COUNT, 4)
    rows = torch.arange(COUNT)
    whole = grounding.simulator(TASK, COUNT)
    whole.start(start, rows, goal)
    raw = TASK.simulator(COUNT)
    states, simulated = [start], []
    for step in range(STEPS):
        raw.reset_to(states[-1])
        simulated.append(raw.step(action[:, step]))
        states.append(whole.step(action[:, step]))
    previous = torch.cat([torch.zeros(COUNT, 1, 2), action[:, :-1]], dim=1)
    windows = toy_episodes(
        *(torch.stack(states[:-1], dim=1), action),
        next_state=torch.stack(states[1:], dim=1),
        simulated_next=torch.stack(simulated, dim=1),
        goal=goal.unsqueeze(1).expand(COUNT, STEPS, 2),
    ).windows
    hidden = grounding.hidden_before(windows, every)
    assert hidden is not None and hidden.shape[:2] == (COUNT, -(-STEPS // every))
    for index, first in enumerate(range(0, STEPS, every)):
        late = grounding.simulator(TASK, COUNT)
        late.start(states[first], rows, goal, hidden=hidden[:, index], previous_action=previous[:, first])
        for step in range(first, STEPS):
            torch.testing.assert_close(late.step(action[:, step]), states[step + 1], atol=1e-4, rtol=1e-4)


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
        torch.testing.assert_close(state, corrected)  # nothing is near a wall: the state is where the correction put it
        assert torch.equal(one.state, state) and not torch.equal(state, before)


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
    assert torch.equal(one.goal[[1]], torch.ones(1, 2)) and torch.equal(one.state[[1]], there)
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
        assert torch.equal(first.step(action), second.step(action)) and torch.equal(first.latent, second.latent)
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
        torch.testing.assert_close(one.hazard, said / 2)  # within two steps
        expected = used.target_reward(latent, action, torch.zeros(3)) - 10.0 * said / 2
        torch.testing.assert_close(one.predicted_reward(torch.zeros(3)), expected)


def test_a_failure_models_memory_is_kept_and_forgotten_at_a_start() -> None:
    used, failures = model(), failure_model()
    one, played = simulator(used, failures), actions(6)
    for action in played[:4]:
        one.step(action)
    saved = {name: values.clone() for name, values in one.state_dict().items()}
    one.step(played[4])
    wanted = one.hazard
    resumed = simulator(used, failures)
    resumed.load_state_dict(saved)
    resumed.step(played[4])
    torch.testing.assert_close(resumed.hazard, wanted)

    known = torch.rand(3, 8 + 15)
    one.start(HERE.expand(3, 4), ROWS, GOAL, hidden=known, previous_action=played[0])
    remembered = failures.initial_memory(HERE.expand(3, 4), played[0], known[:, 8:])
    assert torch.equal(one.state_dict()["remembered"], remembered)
    one.start(HERE.expand(3, 4), ROWS, GOAL)
    one.step(played[0])
    fresh = simulator(used, failures)
    fresh.step(played[0])
    torch.testing.assert_close(one.hazard, fresh.hazard)
    risk = fresh.hazard
    assert risk is not None and wanted is not None and not torch.allclose(risk, wanted)


def varied(count: int) -> EpisodeSimulator:
    return NO_GROUNDING.simulator(TASK, count, variation=TASK.varied.wide)


def test_a_start_draws_the_parameters_of_its_rows_anew() -> None:
    torch.manual_seed(0)
    one = varied(4)
    before = one.parameters
    assert before is not None and before.abs().max() <= 1.0
    one.start(HERE, torch.tensor([2]), torch.zeros(1, 2))
    after = one.parameters
    assert after is not None
    names = TASK.varied.wide.names
    drawn = [names.index(name) for name in ("friction", "heading_bias_deg", "timestep_scale")]
    assert (after[2, drawn] != before[2, drawn]).all() and torch.equal(after[[0, 1, 3]], before[[0, 1, 3]])
    friction = after[:, names.index("friction")]  # from -1 at the lower to 1 at the upper end
    low, high = TASK.varied.wide.friction  # type: ignore[attr-defined]
    inner = one.simulator.parameters[:, names.index("friction")]  # type: ignore[index]
    torch.testing.assert_close(friction, (inner - low) / (high - low) * 2 - 1, atol=1e-5, rtol=0)


def test_a_saved_state_goes_on_with_its_parameters() -> None:
    torch.manual_seed(0)
    first, second = varied(3), varied(3)
    first.start(HERE.expand(3, 4), torch.arange(3), torch.zeros(3, 2))
    first.step(torch.ones(3, 2))
    saved = {name: values.clone() for name, values in first.state_dict().items()}
    assert saved.keys() == {"state", "true", "parameters"}
    second.load_state_dict(saved)
    assert first.parameters is not None and second.parameters is not None
    assert torch.equal(second.parameters, first.parameters)
    for _ in range(3):
        states = []
        for one in (first, second):
            torch.manual_seed(1)
            states.append(one.step(torch.tensor([[0.5, -1.0]]).expand(3, 2)))
        assert torch.equal(*states)
    assert torch.equal(saved["parameters"], first.state_dict()["parameters"])


def test_a_saved_state_holds_what_a_simulator_remembers() -> None:
    walker = TASKS["humanoid-walker2d"]
    one, plain = EpisodeSimulator(walker.simulator(2)), EpisodeSimulator(TASK.simulator(1))
    assert plain.state_dict().keys() == {"state"} and one.state_dict().keys() == {"state", "memory"}
    memory = torch.rand_like(one.state_dict()["memory"])
    one.load_state_dict(one.state_dict() | {"memory": memory})
    assert torch.equal(one.state_dict()["memory"], memory)
