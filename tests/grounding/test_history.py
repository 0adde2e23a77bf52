import json

import torch
from grounding_models import HERE, TASK, divided, failure_model, members, model
from toy_episodes import toy_episodes

from astra_data.grounding.grounded_simulator import GroundedSimulator
from astra_data.grounding.history import HistoryGrounding
from astra_data.learning.networks.failure import FailureModel, FailureShape


def test_members_go_on_from_recorded_histories_by_their_own_memories() -> None:
    torch.manual_seed(3)
    states, acts = torch.randn(1, 6, 4) * 0.1 + HERE, torch.rand(1, 6, 2)
    episodes = toy_episodes(states, acts, next_state=states)
    windows, others = episodes.windows, members()
    grounding = HistoryGrounding(model(), None, others)
    before = grounding.hidden_before(windows)
    assert before.shape == (1, 6, 3 * 8)
    rows = torch.arange(4)
    one = grounding.simulator(TASK, 4)
    assert isinstance(one, GroundedSimulator)
    at = 4
    goal = windows.goal[0, at].expand(4, 2)
    one.start(
        states[0, at].expand(4, 4),
        rows,
        goal,
        hidden=before[0, at].expand(4, -1),
        previous_action=acts[0, at - 1].expand(4, 2),
    )
    latents = [other.encode(windows)[0][0, at] for other in (grounding.model, *others)]
    torch.testing.assert_close(one.latent, latents[0].expand(4, 8))
    raw = TASK.simulator(4)
    raw.reset_to(states[0, at].expand(4, 4))
    action = torch.full((4, 2), 0.3)
    landed = raw.step(action)
    expected = [
        other.correct(latent.expand(2, 8), action[:2], landed[:2])
        for other, latent in zip(others, latents[1:], strict=True)
    ]
    torch.testing.assert_close(one.step(action), torch.cat(expected))


def test_what_is_not_asked_for_is_left_out() -> None:
    failures = FailureModel(FailureShape(4, 2, 0.05, members=1))
    whole = HistoryGrounding(model(), failures, members())
    assert whole.reduced(members=True, failures=True) == whole
    assert whole.reduced(members=False, failures=True) == HistoryGrounding(whole.model, failures)
    assert whole.reduced(members=True, failures=False) == HistoryGrounding(whole.model, None, whole.members)
    assert whole.for_replay() == HistoryGrounding(whole.model)


def test_members_are_part_of_files_and_of_the_state() -> None:
    whole = HistoryGrounding(model(), None, members())
    tensors, metadata = whole.to_file()
    read = HistoryGrounding.from_file(tensors, json.loads(json.dumps(metadata)), "cpu")
    assert len(read.members) == 2
    for one, other in zip(read.members, whole.members, strict=True):
        assert all(map(torch.equal, one.state_dict().values(), other.state_dict().values()))
    first, second = divided(read.model, read.members), divided(read.model, read.members)
    action = torch.full((5, 2), 0.4)
    first.step(action)
    saved = {name: values.clone() for name, values in first.state_dict().items()}
    assert saved.keys() == {"state", "goal", "hidden", "own_hidden"}
    second.load_state_dict(saved)
    for _ in range(3):
        assert torch.equal(first.step(action), second.step(action))


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
