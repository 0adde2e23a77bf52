from pathlib import Path

import numpy as np
import pytest
import torch
from constant_policy import Constant
from toy_episodes import no_episodes

from astra_data.core.errors import BadInputError
from astra_data.grounding.files import save_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.policies.networks import ActorCritic, ActorCriticShape, AdaptiveShape, Student
from astra_data.policies.running_policy import KINDS, PolicyFile, UserPolicy
from astra_data.policies.simulator_env import Simulation, WorldConfig
from astra_data.worlds.variation import PlanarVariation


def test_a_policy_comes_back_frozen_with_its_world(tmp_path: Path) -> None:
    policy = ActorCritic(ActorCriticShape(3, 2, memory_size=8, hidden_sizes=(16, 8)))
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
    assert isinstance(loaded.policy, ActorCritic)
    assert torch.equal(loaded.policy.value(features), policy.value(features))


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

    made = PolicyFile(Mine(ActorCriticShape(3, 2)), None, None, None)
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
