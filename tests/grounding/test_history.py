import json

import torch
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.grounding.history import GroundedSimulator, HistoryGrounding
from astra_data.learning.networks.failure import FailureModel, FailureShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.registry import TASKS

TASK = TASKS["antmaze-umaze"]
GOAL = torch.tensor([[-4.0, -4.0], [4.0, 4.0], [0.0, 4.0]])
HERE = torch.tensor([[-4.0, 4.0, 0.0, 0.0]])
ROWS = torch.arange(3)


def model(heads: int = 1, corrects_reward: bool = False) -> GroundingModel:
    torch.manual_seed(0)
    made = GroundingModel(
        GroundingShape(4, 2, 2, latent_size=8, correction_heads=heads, corrects_reward=corrects_reward)
    )
    with torch.no_grad():
        for head in made.corrections:
            list(head.parameters())[-2].normal_(std=0.05)
    return made.requires_grad_(False)


def simulator(used: GroundingModel, scatter: Tensor | None = None) -> GroundedSimulator:
    one = GroundedSimulator(PointMass(U_MAZE, 3, timestep_s=0.05), used, scatter=scatter)
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


def test_corrections_stop_at_walls() -> None:
    used = model()
    with torch.no_grad():
        list(used.corrections.parameters())[-1].copy_(torch.tensor([0.0, 30.0, 0.0, 0.0]))
    one = simulator(used)
    state = one.step(torch.zeros(3, 2))
    free = PointMass(U_MAZE, 1, timestep_s=0.05).free
    assert one.blocked.all()
    assert not free.blocked[free.cells(state[:, :2])].any()


def test_scatter_is_added_to_the_correction() -> None:
    factor = torch.tensor([[0.02, 0, 0, 0], [0.1, 0.02, 0, 0], [0, 0, 0.3, 0], [0, 0, 0, 0.2]])
    plain, scattered = simulator(model()), simulator(model(), factor)
    action = actions(1)[0]
    torch.manual_seed(5)
    noisy = scattered.step(action)
    torch.manual_seed(5)
    torch.testing.assert_close(noisy, plain.step(action) + torch.randn(3, 4) @ factor.T)


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


def test_risk_and_reward_are_of_the_last_step() -> None:
    used = model()
    one = simulator(used)
    first, second = actions(2)
    one.step(first)
    latent = one.latent.clone()
    after = one.step(second)
    assert not torch.allclose(latent, one.latent)
    torch.testing.assert_close(one.topple_risk(), used.topple_risk(latent, second, after))
    own = torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(one.predicted_reward(own), used.predict_reward(latent, second))


def test_residual_rewards_are_added_to_the_tasks_own() -> None:
    own, (action,) = torch.tensor([1.0, 2.0, 3.0]), actions(1)
    rewards = []
    for corrects in (False, True):
        one = simulator(model(corrects_reward=corrects))
        one.step(action)
        rewards.append(one.predicted_reward(own))
    torch.testing.assert_close(rewards[1], rewards[0] + own)


def test_disagreement_is_what_the_heads_differ_beyond_the_usual() -> None:
    used = model(heads=3)
    one = simulator(used)
    used.correction_std.copy_(torch.tensor([1.0, 2.0, 4.0, 8.0]))
    action, latent = actions(1)[0], one.latent
    landed = PointMass(U_MAZE, 3, timestep_s=0.05)
    landed.reset_to(HERE.expand(3, 4))
    apart = used.ensemble_predictions(latent, action, landed.step(action)) / used.correction_std
    spread = apart.var(0, correction=1).mean(-1).sqrt()
    used.usual_disagreement.copy_(spread.median())
    one.step(action)
    torch.testing.assert_close(one.disagreement, (spread / spread.median() - 1.0).clamp_min(0.0))
    assert (one.disagreement == 0).sum() == 2


def test_each_row_may_keep_one_head_until_it_starts_anew() -> None:
    used = model(heads=3)
    one = simulator(used)
    one.keep_heads()
    one.start(HERE.expand(3, 4), ROWS, GOAL)
    kept: list[list[int]] = []
    for number, action in enumerate(actions(40)):
        latent, before = one.latent, one.state.clone()
        raw = PointMass(U_MAZE, 3, timestep_s=0.05)
        raw.reset_to(before)
        expected = used.ensemble_predictions(latent, action, raw.step(action))
        apart = (expected - one.step(action)).abs().amax(-1)
        heads = apart.argmin(0)
        # Corrections that are stopped at a wall tell nothing.
        told = apart.min(0).values < 1e-5
        kept.append([int(head) if known else -1 for head, known in zip(heads, told, strict=True)])
        if number % 4 == 3:
            one.start(HERE.expand(2, 4), ROWS[1:], GOAL[1:])
    first = {row[0] for row in kept} - {-1}
    stretches = [{row[1] for row in kept[begin : begin + 4]} - {-1} for begin in range(0, 40, 4)]
    assert len(first) == 1 and all(len(heads) == 1 for heads in stretches)
    assert set.union(*stretches) == {0, 1, 2}


def test_kept_heads_are_part_of_the_state() -> None:
    used = model(heads=3)
    one, other = simulator(used), simulator(used)
    for made in (one, other):
        made.keep_heads()
    saved = {name: values.clone() for name, values in one.state_dict().items()}
    other.load_state_dict(saved)
    for action in actions(5):
        assert torch.equal(one.step(action), other.step(action))
    single = simulator(model())
    single.keep_heads()  # of one head, which is their mean
    plain = simulator(model())
    for action in actions(5):
        assert torch.equal(single.step(action), plain.step(action))


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


def test_scatter_is_the_models_own() -> None:
    used = model()
    used.residual_factor.copy_(torch.eye(4))
    nothing = torch.zeros(1, 3, 4)
    episodes = toy_episodes(nothing, torch.zeros(1, 3, 2), next_state=nothing)
    grounding = HistoryGrounding(used)
    assert torch.equal(grounding.scatter(episodes), torch.eye(4))
    assert grounding.encoder is used
    one = grounding.simulator(TASK, 2, scatter=torch.eye(4))
    assert isinstance(one, GroundedSimulator)
    assert (one.model, one.latent_size, one.latent.shape) == (used, 8, (2, 8))
    assert one.scatter is not None


def failure_model() -> FailureModel:
    torch.manual_seed(3)
    return FailureModel(FailureShape(4, 2, 0.05, members=2)).requires_grad_(False).eval()


def foreseeing(used: GroundingModel, failures: FailureModel) -> GroundedSimulator:
    one = GroundedSimulator(PointMass(U_MAZE, 3, timestep_s=0.05), used, failures=failures)
    one.start(HERE.expand(3, 4), ROWS, GOAL)
    return one


def test_a_failure_model_is_asked_before_each_correction_and_replaces_the_other_heads() -> None:
    used, failures, raw = model(), failure_model(), PointMass(U_MAZE, 3, timestep_s=0.05)
    used.failure_cost.fill_(-10.0)
    one, plain = foreseeing(used, failures), simulator(used)
    memory = failures.initial_memory(one.state, torch.zeros(3, 2))
    for action in actions(5):
        raw.reset_to(one.state)
        said, memory = failures.step(one.state, action, raw.step(action), memory)
        latent = one.latent
        torch.testing.assert_close(one.step(action), plain.step(action))
        torch.testing.assert_close(one.topple_risk(), failures.hazard(said))
        going_on, _ = used.predict_reward_parts(latent, action).unbind(-1)
        expected = going_on - 10.0 * failures.hazard(said)
        torch.testing.assert_close(one.predicted_reward(torch.zeros(3)), expected)
    assert not torch.allclose(one.topple_risk(), plain.topple_risk())


def test_a_failure_models_memory_is_kept_forgotten_at_a_start_and_taken_from_histories() -> None:
    used, failures = model(), failure_model()
    one, played = foreseeing(used, failures), actions(6)
    states, landed, raw = [one.state], [], PointMass(U_MAZE, 3, timestep_s=0.05)
    for action in played[:4]:
        raw.reset_to(one.state)
        landed.append(raw.step(action))
        states.append(one.step(action))
    saved = {name: values.clone() for name, values in one.state_dict().items()}
    one.step(played[4])
    wanted = one.topple_risk()
    resumed = foreseeing(used, failures)
    resumed.load_state_dict(saved)
    resumed.step(played[4])
    torch.testing.assert_close(resumed.topple_risk(), wanted)

    episodes = toy_episodes(
        torch.stack([*states[:-1], states[-1]], dim=1),
        torch.stack([*played[:4], played[4]], dim=1),
        next_state=torch.stack([*states[1:], states[-1]], dim=1),
        simulated_next=torch.stack([*landed, landed[-1]], dim=1),
        goal=GOAL[:, None].expand(3, 5, 2),
    )
    grounding = HistoryGrounding(used, failures)
    hidden = grounding.hidden_before(episodes.windows)[:, 4]
    middle = grounding.corrected(PointMass(U_MAZE, 3, timestep_s=0.05), None)
    middle.start(states[-1], ROWS, GOAL, hidden=hidden, previous_action=played[3])
    middle.step(played[4])
    torch.testing.assert_close(middle.topple_risk(), wanted)

    one.start(HERE.expand(3, 4), ROWS, GOAL)
    one.step(played[0])
    fresh = foreseeing(used, failures)
    fresh.step(played[0])
    torch.testing.assert_close(one.topple_risk(), fresh.topple_risk())


def test_a_failure_model_is_saved_with_its_grounding() -> None:
    made = HistoryGrounding(model(), failure_model())
    tensors, metadata = made.to_file()
    read = HistoryGrounding.from_file(dict(tensors), json.loads(json.dumps(metadata)), "cpu")
    assert read.failures is not None and read.failures.shape == failure_model().shape
    assert all(
        torch.equal(read.failures.state_dict()[name], one)
        for name, one in failure_model().state_dict().items()
    )
    assert "failures" not in HistoryGrounding(model()).to_file()[1]
