import torch
from grounding_models import GOAL, HERE, divided, failure_model, members, model
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.grounding.grounded_simulator import GroundedSimulator
from astra_data.grounding.history import HistoryGrounding
from astra_data.learning.networks.failure import FailureModel
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass

ROWS = torch.arange(3)


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
    torch.testing.assert_close(one.failure_risk(), used.topple_risk(latent, second, after))
    own = torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(one.predicted_reward(own), used.predict_reward(latent, second))
    used.failure_cost.fill_(-10.0)
    going_on, failing = used.predict_reward_parts(latent, second).unbind(-1)
    assert (failing < -1).all()
    torch.testing.assert_close(one.predicted_reward(own, with_failures=False), going_on)


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


def test_members_correct_and_reward_their_shares_and_policies_see_the_models_latents() -> None:
    used, others = model(), members()
    one, action = divided(used, others), torch.full((5, 2), 0.4)
    apart = [simulator(other) for other in (used, *others)]  # each alone, in three rows
    for alone in apart:
        alone.start(HERE.expand(3, 4), ROWS, GOAL[0].expand(3, 2))
    for _ in range(4):
        assert torch.equal(one.latent, used.encoder.latent(one.hidden))
        state = one.step(action)
        first, second = (alone.step(action[:3]) for alone in apart[1:])
        torch.testing.assert_close(state, torch.cat([first[:2], second]))
        nothing = torch.zeros(5)
        rewards = [alone.predicted_reward(nothing[:3]) for alone in apart]
        torch.testing.assert_close(one.predicted_reward(nothing), torch.cat([rewards[1][:2], rewards[2]]))
        risks = [alone.failure_risk() for alone in apart]
        torch.testing.assert_close(one.failure_risk(), torch.cat([risks[1][:2], risks[2]]))
        assert not torch.allclose(rewards[1], rewards[2]) and not torch.allclose(first, second)
    follows = torch.zeros(5, 8)
    state, previous = HERE.expand(5, 4), torch.zeros(5, 2)
    again = divided(used, others)
    for _ in range(4):
        follows = used.encoder.step(used.encoder_input(state, GOAL[0].expand(5, 2), previous), follows)
        torch.testing.assert_close(again.hidden, follows)
        state, previous = again.step(action), action


def test_members_that_start_again_forget_and_the_others_do_not() -> None:
    one, other = (divided(model(), members()) for _ in range(2))
    action = torch.full((5, 2), 0.4)
    for made in (one, other):
        for _ in range(3):
            made.step(action)
    rows = torch.tensor([4, 1])
    one.start(HERE.expand(2, 4), rows, GOAL[:1].expand(2, 2))
    fresh, after, before = divided(model(), members()).step(action), one.step(action), other.step(action)
    torch.testing.assert_close(after[rows], fresh[rows])
    kept = torch.tensor([0, 2, 3])
    torch.testing.assert_close(after[kept], before[kept])
    assert not torch.allclose(before[rows], fresh[rows])


def test_disagreement_is_that_of_a_rows_member_with_the_model() -> None:
    used, others = model(), members()
    one, action = divided(used, others), torch.full((5, 2), 0.4)
    for number, other in enumerate(others):
        other.correction_std.fill_(0.2 + 0.1 * number)
        other.usual_disagreement.fill_(1e-3)
    assert not one.disagreement.any()
    latent = one.latent
    raw = PointMass(U_MAZE, 5, timestep_s=0.05)
    raw.reset_to(HERE.expand(5, 4))
    landed = raw.step(action)
    own = one.step(action)
    # The deviation of two numbers is their distance by the root of two.
    spread = (own - used.correct(latent, action, landed)).square().mean(-1).div(2).sqrt()
    scale = torch.tensor([0.2, 0.2, 0.3, 0.3, 0.3])
    torch.testing.assert_close(one.disagreement, (spread / scale / 1e-3 - 1).clamp_min(0.0))
    assert one.disagreement.max() > 0


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
        torch.testing.assert_close(one.failure_risk(), failures.hazard(said))
        going_on, _ = used.predict_reward_parts(latent, action).unbind(-1)
        expected = going_on - 10.0 * failures.hazard(said)
        torch.testing.assert_close(one.predicted_reward(torch.zeros(3)), expected)
    assert not torch.allclose(one.failure_risk(), plain.failure_risk())


def test_a_failure_models_memory_is_kept_and_forgotten_at_a_start() -> None:
    used, failures = model(), failure_model()
    one, played = foreseeing(used, failures), actions(6)
    for action in played[:4]:
        one.step(action)
    saved = {name: values.clone() for name, values in one.state_dict().items()}
    one.step(played[4])
    wanted = one.failure_risk()
    resumed = foreseeing(used, failures)
    resumed.load_state_dict(saved)
    resumed.step(played[4])
    torch.testing.assert_close(resumed.failure_risk(), wanted)

    one.start(HERE.expand(3, 4), ROWS, GOAL)
    one.step(played[0])
    fresh = foreseeing(used, failures)
    fresh.step(played[0])
    torch.testing.assert_close(one.failure_risk(), fresh.failure_risk())
    assert not torch.allclose(fresh.failure_risk(), wanted)


def test_within_a_history_a_failure_model_knows_the_action_before_and_what_it_is_told() -> None:
    used, failures = model(), failure_model()
    hidden, before, action = torch.randn(3, 8), torch.rand(3, 2), actions(1)[0]
    middle = foreseeing(used, failures)
    middle.start(HERE.expand(3, 4), ROWS, GOAL, hidden=hidden, previous_action=before)
    middle.step(action)
    raw = PointMass(U_MAZE, 3, timestep_s=0.05)
    raw.reset_to(HERE.expand(3, 4))
    memory = failures.initial_memory(HERE.expand(3, 4), before)
    said, _ = failures.step(HERE.expand(3, 4), action, raw.step(action), memory)
    torch.testing.assert_close(middle.failure_risk(), failures.hazard(said))
    averages = torch.rand(3, 15)
    middle.start(
        HERE.expand(3, 4), ROWS, GOAL, hidden=torch.cat([hidden, averages], 1), previous_action=before
    )
    middle.step(action)
    known = failures.initial_memory(HERE.expand(3, 4), before, averages)
    warm, _ = failures.step(HERE.expand(3, 4), action, raw.state, known)
    torch.testing.assert_close(middle.failure_risk(), failures.hazard(warm))
    assert not torch.allclose(warm, said)
    states = torch.zeros(1, 5, 4)
    of = toy_episodes(states, torch.zeros(1, 5, 2), next_state=states).windows
    assert HistoryGrounding(used, failures).hidden_before(of).shape == (1, 5, 8)


def test_what_was_saved_stays_as_it_was() -> None:
    one = simulator(model())
    one.step(actions(1)[0])
    saved = {name: values.clone() for name, values in one.state_dict().items()}
    kept = {name: values.clone() for name, values in saved.items()}
    one.load_state_dict(saved)
    one.start(HERE, ROWS[:1], torch.ones(1, 2))
    assert not torch.equal(one.goal, kept["goal"])
    assert all(torch.equal(saved[name], values) for name, values in kept.items())
