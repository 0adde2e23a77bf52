import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from fake_dataset import write_fake
from small_run import TRAIN
from torch import Tensor

from astra_data.core.artifact import read_manifest, write_manifest
from astra_data.core.checkpoint import load_tensors
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, Column, Episode
from astra_data.grounding.files import load_target_encoder, save_target_encoder
from astra_data.grounding.model import GroundingModel
from astra_data.methods.rma import RmaConfig
from astra_data.pipeline.stages.evaluate import EvaluateConfig, evaluate
from astra_data.pipeline.stages.train import train
from astra_data.policies.networks import ActorCritic, PolicyShape
from astra_data.policies.running_policy import PolicyFile
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.navigation import Navigation

CONFIG = EvaluateConfig(episodes=3)
HORIZON = 25
Result = tuple[dict[str, Any], dict[str, Tensor]]


def make(
    task: str,
    method: str,
    out: Path,
    inputs: dict[str, Path] | None = None,
    config: EvaluateConfig = CONFIG,
    num_threads: int | None = None,
) -> Result:
    evaluate(task, method, config, **(inputs or {}), out=out, num_threads=num_threads)  # type: ignore[arg-type]
    tensors, _ = load_tensors(out / "trajectories.safetensors")
    return json.loads((out / "evaluation.json").read_text()), tensors


def aligned_as(aligned: Path, out: Path, latent_r2: float) -> Path:
    """Return the folder of the encoder as if it explained so much of the latents."""
    shutil.copytree(aligned, out)
    encoder = load_target_encoder(out / "target_encoder.safetensors")
    encoder.latent_r2.fill_(latent_r2)
    save_target_encoder(out / "target_encoder.safetensors", encoder)
    write_manifest(out, {})
    return out


@pytest.fixture
def good(aligned: Path, tmp_path: Path) -> Path:
    """An encoder that is deployed."""
    return aligned_as(aligned, tmp_path / "good", 0.95)


@pytest.mark.parametrize(
    ("latent_r2", "asked", "headline"),
    [(0.95, None, "target"), (0.8, None, "source"), (0.95, "source", "source"), (0.8, "target", "target")],
)
def test_robots_run_with_the_encoder_that_is_asked_for_or_that_its_agreement_decides(
    latent_r2: float,
    asked: Literal["source", "target"] | None,
    headline: str,
    task: str,
    trained: Path,
    grounded: Path,
    aligned: Path,
    tmp_path: Path,
) -> None:
    encoder = aligned_as(aligned, tmp_path / "aligned", latent_r2)
    inputs = {"policy": trained, "grounding": grounded}
    config = EvaluateConfig(episodes=3, encoder=asked)
    told, paths = make(task, "astra", tmp_path / "out", inputs | {"target_encoder": encoder}, config)
    assert told["encoder"] == headline and told["encoders"].keys() == {"source", "target"}
    _, by_source = make(task, "astra", tmp_path / "source", inputs)
    same = torch.equal(by_source["target.position"][:, 10], paths["target.position"][:, 10])
    assert same == (headline == "source")


def check_outcome(outcome: dict[str, list[float]], position: Tensor) -> None:
    """Check the lists of one world against each other and against the paths."""
    assert outcome.keys() == {"success", "failed", "wall_contact", "steps", "return"}
    assert all(len(values) == CONFIG.episodes for values in outcome.values())
    assert position.shape[0] == CONFIG.episodes and position.shape[2] == 2
    for episode in range(CONFIG.episodes):
        steps = int(outcome["steps"][episode])
        assert 1 <= steps <= HORIZON
        ended = outcome["success"][episode] + outcome["failed"][episode]
        assert ended in ((0, 1) if steps == HORIZON else (1,)) and 0 <= outcome["wall_contact"][episode] <= 1
        assert math.isfinite(outcome["return"][episode]) and torch.isfinite(position[episode, : steps + 1]).all()
        assert position[episode, steps + 1 :].isnan().all()


def test_a_policy_is_tested_in_both_worlds_and_with_both_encoders(
    task: str, trained: Path, grounded: Path, good: Path, tmp_path: Path
) -> None:
    inputs = {"policy": trained, "grounding": grounded, "target_encoder": good}
    told, paths = make(task, "astra", tmp_path / "astra", inputs)
    keys = {"task", "method", "seed", "episodes", "dataset_version", "dataset_hash", "wall_seconds"}
    keys |= {"cpu_seconds", "encoder", "target", "simulated", "encoders", "raw"}
    keys |= {"git_commit", "packages", "machine", "leg_scale", "finished_at"}
    assert told.keys() == keys
    assert (told["method"], told["seed"], told["episodes"], told["encoder"]) == ("astra", 0, 3, "target")
    assert told["encoders"].keys() == {"source", "target"}
    assert told["dataset_version"] == "antmaze-short-random-seed0@data-2.0.0"
    check_outcome(told["target"], paths["target.position"])
    check_outcome(told["simulated"], paths["simulated.position"])
    assert json.loads((tmp_path / "astra/config.json").read_text()) == CONFIG.model_dump(mode="json")
    manifest = read_manifest(tmp_path / "astra")
    assert manifest and manifest.made_from == {
        name: file_digest(next(folder.glob("*.safetensors"))) for name, folder in inputs.items()
    }
    # Starts and goals are every method's, whatever it is.
    follower, followed = make(task, "follower", tmp_path / "follower")
    assert follower.keys() == keys - {"encoder", "simulated", "encoders", "dataset_version", "dataset_hash"}
    assert follower["raw"].keys() == follower["target"].keys()
    check_outcome(follower["target"], followed["target.position"])
    for name in ("start", "goal"):
        assert torch.equal(followed[name], paths[name]) and len(paths[name].unique(dim=0)) == CONFIG.episodes
    assert torch.equal(followed["start"], followed["target.position"][:, 0])
    assert torch.equal(paths["start"], paths["target.position"][:, 0])


@pytest.mark.parametrize("foreign", ["policy", "target_encoder"])
def test_artifacts_of_another_grounding_are_refused(
    foreign: str, task: str, trained: Path, grounded: Path, grounded_anew: Path, aligned: Path, tmp_path: Path
) -> None:
    inputs = {"policy": trained, "grounding": grounded_anew, "target_encoder": aligned}
    (fits,) = {"policy", "target_encoder"} - {foreign}
    inputs[fits] = Path(shutil.copytree(inputs[fits], tmp_path / fits))
    write_manifest(inputs[fits], {"grounding": file_digest(grounded_anew / "grounding.safetensors")})
    with pytest.raises(BadInputError, match=f"{inputs[foreign]} was made from another grounding than"):
        make(task, "astra", tmp_path / "out", inputs)
    assert not (tmp_path / "out").exists()


def test_simulators_that_all_rows_share_begin_and_reward_alike(
    task: str,
    paired: Path,
    trained: Path,
    grounded: Path,
    aligned: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(GroundingModel, "target_reward", lambda model, latent, action, own, *risk: own + 1.0)
    inputs = {"policy": trained, "grounding": grounded, "target_encoder": aligned, "reference": grounded}
    astra, _ = make(task, "astra", tmp_path / "astra", inputs)
    # Its own world is the reference here, but for the reward that it predicts.
    assert astra["grounded"] == astra["simulated"] | {"return": astra["grounded"]["return"]}
    assert astra["grounded"]["return"] != astra["simulated"]["return"] != astra["raw"]["return"]
    train(task, "direct_transfer", TRAIN, dataset=paired, out=tmp_path / "train")
    inputs = {"policy": tmp_path / "train", "reference": grounded}
    transferred, _ = make(task, "direct_transfer", tmp_path / "direct_transfer", inputs)
    assert transferred["raw"] == transferred["simulated"] != transferred["grounded"]
    follower, _ = make(task, "follower", tmp_path / "follower", {"reference": grounded})
    assert "simulated" not in follower and min(follower["raw"]["return"]) > max(transferred["raw"]["return"])


def test_longer_legs_change_the_target_alone(task: str, tmp_path: Path) -> None:
    usual, paths = make(task, "follower", tmp_path / "usual")
    longer, others = make(task, "follower", tmp_path / "longer", config=CONFIG.model_copy(update={"leg_scale": 1.25}))
    assert (usual["leg_scale"], longer["leg_scale"]) == (1.0, 1.25) and longer["raw"] == usual["raw"]
    assert torch.equal(others["goal"], paths["goal"])
    assert not torch.equal(others["target.position"][:, 10], paths["target.position"][:, 10])


def test_a_policy_that_was_in_no_simulator_is_tested_in_the_target_alone(
    task: str, trained: Path, tmp_path: Path
) -> None:
    grounded_policy = PolicyFile.load(trained / "policy.safetensors")
    policy = ActorCritic(PolicyShape(observation_size=8, action_size=2, memory_size=4))
    replace(grounded_policy, policy=policy, simulation=None).save(tmp_path / "policy.safetensors")
    told, paths = make(task, "iql", tmp_path / "out", {"policy": tmp_path})
    assert "simulated" not in told and "simulated.position" not in paths and "encoders" not in told
    check_outcome(told["target"], paths["target.position"])


@pytest.mark.parametrize(("narrower", "expected"), [(1.0, 0.0), (0.0, 1.0)])
def test_commands_beyond_those_of_the_dataset_are_counted(
    task: str, trained: Path, grounded: Path, tmp_path: Path, narrower: float, expected: float
) -> None:
    columns = [Column(name, size=2) for name in (STATE, NEXT_STATE, ACTION)]
    actions = narrower * np.array([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]], np.float32)
    values = dict.fromkeys((STATE, NEXT_STATE, ACTION), actions)
    write_fake(tmp_path / "set", [Episode(0, values, {})], columns=columns)
    policy = {"policy": trained, "grounding": grounded}
    told, _ = make(task, "astra", tmp_path / "out", policy | {"recorded": tmp_path / "set"})
    assert told["beyond_recorded"] == expected
    without, _ = make(task, "astra", tmp_path / "without", policy)
    assert "beyond_recorded" not in without and without["target"] == told["target"]


def test_without_a_target_starts_and_goals_are_those_of_the_simulator_that_is_reported(
    task: str, trained: Path, grounded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(TASKS, "blind", replace(TASKS[task], name="blind", make_target=None))
    inputs = {"policy": trained, "grounding": grounded, "reference": grounded}
    told, paths = make("blind", "astra", tmp_path / "out", inputs)
    assert told["tested_in"] == "grounded" and "target" not in told
    assert torch.equal(paths["start"], paths["grounded.position"][:, 0])
    assert paths["goal"].shape == (CONFIG.episodes, 2)
    full = ActorCritic(PolicyShape(observation_size=33, action_size=2))
    given = PolicyFile.load(trained / "policy.safetensors")
    replace(given, policy=full, simulation=None, observed="full").save(tmp_path / "policy.safetensors")
    with pytest.raises(BadInputError, match="'iql' observes the full state of a target, and blind has none"):
        make("blind", "iql", tmp_path / "full", {"policy": tmp_path})


def test_the_same_seed_gives_the_same_outcome_on_any_number_of_threads(
    task: str, trained: Path, grounded: Path, tmp_path: Path
) -> None:
    inputs = {"policy": trained, "grounding": grounded}
    first, second = (make(task, "astra", tmp_path / str(threads), inputs, num_threads=threads) for threads in (1, 2))
    assert first[0]["encoder"] == "source"
    for world in ("target", "simulated"):
        assert first[0][world] == second[0][world]


def test_an_episode_ends_with_its_success(
    task: str, trained: Path, grounded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = TASKS[task].objective
    assert isinstance(usual, Navigation)
    objective = replace(usual, success_radius_m=100.0)
    monkeypatch.setitem(TASKS, "antmaze-near", replace(TASKS[task], objective=objective))
    told, paths = make("antmaze-near", "astra", tmp_path / "out", {"policy": trained, "grounding": grounded})
    for world in ("target", "simulated"):
        check_outcome(told[world], paths[f"{world}.position"])
        assert (told[world]["success"], told[world]["steps"]) == ([1.0] * 3, [1.0] * 3)
    assert min(told["target"]["return"]) > 9.0  # the bonus, and a step's progress


def test_a_student_is_tested_in_the_target_and_in_its_varied_simulator(task: str, paired: Path, tmp_path: Path) -> None:
    settings = RmaConfig(history_length=40, adaptation_steps=64)
    train(task, "rma", TRAIN, settings=settings, dataset=paired, out=tmp_path / "policy")
    told, paths = make(task, "rma", tmp_path / "out", {"policy": tmp_path / "policy"})
    for world in ("target", "simulated"):
        check_outcome(told[world], paths[f"{world}.position"])


def test_missing_inputs_are_told(task: str, trained: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="run the stage `train` first"):
        make(task, "astra", tmp_path / "out")
    for method in ("astra", "nas"):
        with pytest.raises(BadInputError, match="run the stage `ground` first"):
            make(task, method, tmp_path / "out", {"policy": trained})
    with pytest.raises(BadInputError, match=r"policy.safetensors does not exist") as caught:
        make(task, "direct_transfer", tmp_path / "out", {"policy": tmp_path})
    assert "\n" not in str(caught.value)
    with pytest.raises(BadInputError, match="'follower' has no policy: leave it out, or name the policy's row"):
        make(task, "follower", tmp_path / "out", {"policy": trained})


def test_what_does_not_fit_is_refused_before_any_episode(
    task: str, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BadInputError, match=r"the policy takes 24 values, .* gives 8: expected a policy of this"):
        make(task, "direct_transfer", tmp_path / "out", {"policy": trained})
    (tmp_path / "out").mkdir()
    monkeypatch.setattr("astra_data.pipeline.stages.evaluate.task_named", lambda name: pytest.fail("work was begun"))
    with pytest.raises(BadInputError, match=r"out is already finished: remove it"):
        make(task, "follower", tmp_path / "out")
