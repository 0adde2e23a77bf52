from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from constant_policy import Constant
from small_cart import TASK as RAIL_CART
from torch import Tensor
from toy_episodes import no_episodes

from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Array
from astra_data.grounding.alignment import TargetEncoder
from astra_data.grounding.files import save_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.policies.learner import KINDS
from astra_data.policies.networks import ActorCritic, AdaptiveShape, PolicyShape, Student, UserPolicy
from astra_data.policies.running_policy import PolicyFile, RunningPolicy, Shown
from astra_data.policies.simulator_env import Simulation, WorldConfig, policy_observation
from astra_data.robots.registry import TASKS
from astra_data.worlds.variation import PlanarVariation

TASK = TASKS["antmaze-umaze"]
STATE, GOAL = torch.randn(3, 6, 29), torch.randn(3, 2)
GOALS = GOAL[:, None].expand(3, 6, 2)


def run(running: RunningPolicy, *, in_simulator: bool = False) -> Tensor:
    """Return the actions (B, T, A) for the states above, or for φ of them."""
    running.start(3)
    act = running.act_in_simulator if in_simulator else running.act
    states = TASK.abstraction(STATE) if in_simulator else STATE
    return torch.stack([act(states[:, step], GOAL) for step in range(6)], dim=1)


def previous(actions: Tensor) -> Tensor:
    return torch.cat([torch.zeros(3, 1, 2), actions[:, :-1]], dim=1)


@pytest.mark.parametrize(("aligned", "in_simulator"), [(False, False), (True, False), (False, True), (True, True)])
@torch.no_grad()
def test_latents_are_those_of_the_whole_history(aligned: bool, in_simulator: bool) -> None:
    """Only target states are for ψ^t; ψ^s encodes abstract ones, wherever they come from."""
    torch.manual_seed(0)
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    target = TargetEncoder(29, 2, 2, embedding_size=8, latent_size=8)
    policy = ActorCritic(PolicyShape(observation_size=16, action_size=2))
    for layer in policy.actor.parameters():
        layer.mul_(10)  # actions of some size
    running = RunningPolicy(TASK, policy, model, target if aligned else None)
    actions = run(running, in_simulator=in_simulator)
    abstract = STATE[..., [0, 1, 15, 16]]
    if aligned and not in_simulator:
        latent, _ = target.encoder.sequence(target.encoder_input(STATE, GOALS, previous(actions)))
    else:
        latent, _ = model.encoder.sequence(model.encoder_input(abstract, GOALS, previous(actions)))
    observation = policy_observation(TASK.objective, abstract, GOALS, latent)
    torch.testing.assert_close(actions, policy.policy(observation)[0], atol=1e-5, rtol=0)
    assert actions.abs().max() > 0.1
    assert running.observation_size == 16 and RunningPolicy(TASK, policy, observed="full").observation_size == 33


def sensing(**pictures: Any) -> TargetEncoder:
    """An encoder that reads two columns in place of states; its estimates are of some size."""
    read: dict[str, Any] = {"inputs": {"observation.features.front": 3, "observation.joints": 26}, "pictures": pictures}
    read |= {"abstract_size": 4, "unit_vectors": []}
    encoder = TargetEncoder(29, 2, 2, embedding_size=8, latent_size=8, position_octaves=0, sensing=read)
    encoder.abstract_std.fill_(3.0)
    torch.nn.init.normal_(encoder.estimate_now.weight, std=0.1)
    return encoder


@pytest.mark.parametrize("aligned", [True, False])
@torch.no_grad()
def test_with_inputs_the_policy_observes_an_estimate_in_place_of_phi(aligned: bool) -> None:
    torch.manual_seed(0)
    model, eyes = GroundingModel(GroundingShape(4, 2, 2, latent_size=8)), sensing()
    policy = ActorCritic(PolicyShape(observation_size=16, action_size=2))
    for layer in policy.actor.parameters():
        layer.mul_(10)
    running = RunningPolicy(TASK, policy, model, eyes if aligned else None, command_limit=0.2, sensing=eyes)
    running.start(3)
    names = [*eyes.inputs]
    given: list[Shown] = [{names[0]: STATE[:, step, :3], names[1]: STATE[:, step, 3:].numpy()} for step in range(6)]
    actions = TASK.limits.normal(torch.stack([running.command(one, GOAL) for one in given], dim=1))
    read = eyes.encoder_input(STATE, GOALS, previous(actions))
    abstract = eyes.estimates(read, eyes.estimator.sequence(read)[1])
    if aligned:
        latent, _ = eyes.encoder.sequence(read)
    else:
        latent, _ = model.encoder.sequence(model.encoder_input(abstract, GOALS, previous(actions)))
    observation = policy_observation(TASK.objective, abstract, GOALS, latent)
    expected = TASK.objective.limit_command(policy.policy(observation)[0], 0.2)
    torch.testing.assert_close(actions, expected, atol=1e-5, rtol=0)
    running.start(3)  # forgets
    torch.testing.assert_close(running.act(STATE[:, 0], GOAL), actions[:, 0], atol=1e-5, rtol=0)


@torch.no_grad()
def test_in_place_of_features_come_pictures_of_their_camera(tmp_path: Path) -> None:
    code, camera = tmp_path / "eyes.py", "observation.images.front"
    code.write_text(
        "import numpy as np\nclass Eyes:\n size = 3\n"
        " def __call__(self, pictures):\n  return pictures[:, 0, 0].astype(np.float32)\n"
    )
    origin = {"camera": camera, "encoder": f"{code}:Eyes", "file_sha256": file_digest(code)}
    eyes = sensing(**{"observation.features.front": origin})
    policy = ActorCritic(PolicyShape(observation_size=8, action_size=2))
    running = RunningPolicy(TASK, policy, sensing=eyes)
    pictures = np.random.default_rng(0).integers(0, 255, (3, 4, 4, 3)).astype(np.uint8)
    features, joints = pictures[:, 0, 0].astype(np.float32), STATE[:, 0, 3:]
    commands = []
    shown: list[Shown] = [{camera: pictures}, {"observation.features.front": features}]
    for seen in shown:
        running.start(3)
        commands.append(running.command({**seen, "observation.joints": joints}, GOAL))
    assert torch.equal(*commands)
    refused: list[tuple[Any, str]] = [
        (STATE[:, 0], "takes a dict in place of states: expected observation.features.front, or pictures of obs"),
        ({camera: pictures}, "expected observation.joints, got observation.images.front"),
        ({camera: pictures[:2], "observation.joints": joints}, r"expected the shape \(3, 3\), got \(2, 3\)"),
        ({camera: pictures / 255.0, "observation.joints": joints}, "of uint8, got float64"),
    ]
    for wrongly, message in refused:
        with pytest.raises(BadInputError, match=message):
            running.command(wrongly, GOAL)
    wrong = sensing(**{"observation.features.front": origin | {"file_sha256": "0" * 64}})
    running = RunningPolicy(TASK, policy, sensing=wrong)
    running.start(3)
    with pytest.raises(BadInputError, match="changed since it made the features"):
        running.command({camera: pictures, "observation.joints": joints}, GOAL)


def test_states_and_inputs_are_not_taken_for_each_other() -> None:
    policy = ActorCritic(PolicyShape(observation_size=8, action_size=2))
    running = RunningPolicy(TASK, policy)
    running.start(1)
    with pytest.raises(BadInputError, match="expected states, got a dict"):
        running.command({"observation.joints": STATE[:1, 0]}, GOAL[:1])
    with pytest.raises(BadInputError, match=r"reads observation[.]features[.]front, observation[.]joints, of which"):
        RunningPolicy(TASK, policy, target_encoder=sensing())
    with pytest.raises(BadInputError, match="the policy observes full states"):
        RunningPolicy(TASK, policy, observed="full", sensing=sensing())


@torch.no_grad()
def test_a_policy_of_the_raw_simulator_remembers_and_forgets_at_the_start() -> None:
    torch.manual_seed(0)
    policy = ActorCritic(PolicyShape(observation_size=8, action_size=2, memory_size=8))
    running = RunningPolicy(TASK, policy)
    actions = run(running)
    observation = policy_observation(TASK.objective, STATE[..., [0, 1, 15, 16]], GOALS, None)
    features = policy.remember_sequence(observation, previous(actions), policy.initial_hidden(3), torch.zeros(3, 6))
    torch.testing.assert_close(actions, policy.policy(features)[0], atol=1e-5, rtol=0)
    assert torch.equal(run(running), actions)
    drawn = []
    for seed in (1, 1, 2):
        running.start(3, torch.Generator().manual_seed(seed))
        begun = running.memory
        drawn.append(running.act(STATE[:, 0], GOAL))
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])
    running.resume(begun)
    assert torch.equal(running.act(STATE[:, 0], GOAL), actions[:, 0])


@torch.no_grad()
def test_the_encoder_sees_the_shortened_command_and_the_policy_its_own() -> None:
    torch.manual_seed(0)
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    policy = ActorCritic(PolicyShape(observation_size=16, action_size=2, memory_size=8))
    for layer in policy.actor.parameters():
        layer.mul_(20)  # actions of some size
    running = RunningPolicy(TASK, policy, model, command_limit=0.2)
    actions = run(running)
    assert actions.norm(dim=-1).max() <= 0.2 + 1e-6
    abstract = STATE[..., [0, 1, 15, 16]]
    latent, _ = model.encoder.sequence(model.encoder_input(abstract, GOALS, previous(actions)))
    observation = policy_observation(TASK.objective, abstract, GOALS, latent)
    hidden, own, outputs = policy.initial_hidden(3), torch.zeros(3, 2), []
    for step in range(6):
        features, hidden = policy.remember(observation[:, step], own, hidden)
        own = policy.act(features)
        outputs.append(own)
    expected = TASK.objective.limit_command(torch.stack(outputs, dim=1), 0.2)
    torch.testing.assert_close(actions, expected, atol=1e-4, rtol=0)
    assert torch.stack(outputs).norm(dim=-1).max() > 0.3


def test_states_and_goals_come_as_arrays_too_and_are_looked_at_first() -> None:
    running = RunningPolicy(RAIL_CART, ActorCritic(PolicyShape(observation_size=2, action_size=1)))
    state, goal = np.random.default_rng(0).uniform(size=(4, 2)), np.zeros((4, 1))
    with pytest.raises(BadInputError, match=r"expected start\(count\) before the first command"):
        running.command(state, goal)
    running.start(4)
    expected = running.command(torch.tensor(state, dtype=torch.float32), torch.zeros(4, 1))
    assert torch.equal(running.command(state, goal), expected)
    with pytest.raises(BadInputError, match=r"state: expected the shape \(4, 2\), got \(4, 3\)"):
        running.command(np.zeros((4, 3)), goal)
    with pytest.raises(BadInputError, match=r"state: expected the shape \(4, 2\), got \(2,\)"):
        running.command(state[0], goal)
    with pytest.raises(BadInputError, match=r"goal: expected the shape \(4, 1\), got \(4, 0\)"):
        running.command(state, np.zeros((4, 0)))
    state[2, 1] = np.nan
    with pytest.raises(BadInputError, match="state: expected finite values, got nan in row 2, entry 1"):
        running.command(state, goal)


class Doubling:
    def act(self, observation: Array) -> Array:
        assert observation.dtype == np.float32
        return 2.0 * observation[:, :2].astype(np.float64)


def test_it_acts_in_batches_within_the_bounds_and_remembers_nothing() -> None:
    policy = UserPolicy(Doubling(), observation_size=3, action_size=2)
    observation = torch.tensor([[0.1, -0.2, 9.0], [0.3, 4.0, 9.0]])
    hidden = policy.initial_hidden(2)
    features, after = policy.remember(observation, torch.zeros(2, 2), hidden)
    assert hidden.shape == after.shape == (2, 0)
    action = policy.act(features)
    assert action.dtype == torch.float32
    torch.testing.assert_close(action, torch.tensor([[0.2, -0.4], [0.6, 1.0]]))
    location, scale = policy.policy(features)
    assert torch.equal(location, action) and not scale.any() and policy.name == "Doubling"


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda seen: seen, r"Mine\.act: expected actions of shape \(2, 2\), got \(2, 3\)"),
        (lambda seen: seen[:, :2] * np.nan, r"Mine\.act: expected finite actions, got NaN or infinity"),
        (lambda seen: dict[int, int]()[0], r"Mine\.act fails with KeyError: 0"),
        (lambda seen: "left", r"Mine\.act fails with ValueError"),
        (None, r"Mine is no policy: expected act\(observation\) -> action"),
    ],
)
def test_what_is_no_policy_is_answered_by_a_line(act: Any, message: str) -> None:
    class Mine:
        def __init__(self) -> None:
            self.act = act

    with pytest.raises(BadInputError, match=message):
        UserPolicy(Mine(), 3, 2).act(torch.ones(2, 3))


def test_a_policy_comes_back_frozen_with_its_world(tmp_path: Path) -> None:
    policy = ActorCritic(PolicyShape(3, 2, memory_size=8, hidden_sizes=(16, 8)))
    world = WorldConfig(reward="priced", change_penalty=0.02, command_limit=0.7, data_start_share=0.5)
    variation = PlanarVariation(friction=(0.8, 1.2))
    simulation = Simulation(world, variation)
    saved = PolicyFile(policy, simulation, "toy@data-1.0.0", "abc")
    saved.save(tmp_path / "policy.safetensors")
    loaded = PolicyFile.load(tmp_path / "policy.safetensors")
    assert (loaded.dataset, loaded.content_hash) == ("toy@data-1.0.0", "abc")
    assert loaded.simulation == simulation and loaded.policy.shape == policy.shape
    assert not any(parameter.requires_grad for parameter in loaded.policy.parameters())
    step = torch.randn(4, 3), torch.randn(4, 2), torch.randn(4, 8)
    for one, other in zip(loaded.policy.remember(*step), policy.remember(*step), strict=True):
        assert torch.equal(one, other)
    features = torch.randn(4, 11)
    assert torch.equal(loaded.policy.policy(features)[0], policy.policy(features)[0])
    assert isinstance(loaded.policy, ActorCritic) and torch.equal(loaded.policy.value(features), policy.value(features))


def test_a_student_comes_back_as_one(tmp_path: Path) -> None:
    student = Student(AdaptiveShape(3, 2, hidden_sizes=(16, 8), extrinsics_size=4, history_length=44))
    PolicyFile(student, None, "toy@data-1.0.0", "abc").save(tmp_path / "policy.safetensors")
    loaded = PolicyFile.load(tmp_path / "policy.safetensors").policy
    assert isinstance(loaded, Student) and loaded.shape == student.shape
    step = torch.randn(4, 3), torch.randn(4, 2), torch.randn_like(student.initial_hidden(4))
    for one, other in zip(loaded.remember(*step), student.remember(*step), strict=True):
        assert torch.equal(one, other)


def test_a_grounding_is_no_policy(tmp_path: Path) -> None:
    grounding = HistoryGrounding(GroundingModel(GroundingShape(4, 2, 2, latent_size=8)))
    path = tmp_path / "policy.safetensors"
    save_grounding(path, grounding, no_episodes())
    with pytest.raises(
        BadInputError,
        match=r"policy.safetensors: expected a policy \(kind actor_critic or adaptive or soft_actor\), "
        "found kind history: run that stage again$",
    ):
        PolicyFile.load(path)


def test_networks_that_could_not_be_read_again_are_not_written(tmp_path: Path) -> None:
    class Mine(ActorCritic):
        pass

    made = PolicyFile(Mine(PolicyShape(3, 2)), None, None, None)
    with pytest.raises(BadInputError, match=r"^a Mine cannot be read again: expected a .*SoftActor, or what"):
        made.save(tmp_path / "policy.safetensors")
    assert not [*tmp_path.iterdir()]


def test_what_a_policy_of_another_learner_saves_and_asks_for_is_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, made = (tmp_path / "policy.safetensors", PolicyFile(UserPolicy(Constant(0.5), 3, 1), None, None, None))
    monkeypatch.setitem(KINDS, Constant.kind, Constant)
    monkeypatch.setattr(Constant, "to_file", lambda self: ({"command": np.ones(1)}, {"unit": "none"}))
    with pytest.raises(BadInputError, match=r"^Constant.to_file: 'command' is a ndarray, expected a torch"):
        made.save(path)
    assert not path.exists()
    monkeypatch.setattr(Constant, "to_file", lambda self: ({"speed": torch.ones(1)}, {"unit": "none"}))
    made.save(path)
    told = r"^Constant.from_file, given the tensors speed and the values unit, fails with KeyError: 'command'"
    with pytest.raises(BadInputError, match=told):
        PolicyFile.load(path)
