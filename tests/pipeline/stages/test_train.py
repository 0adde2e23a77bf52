import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from small_run import TRAIN
from stopping import Stopped, stop_past
from toy_episodes import no_episodes

from astra_data.core.artifact import read_manifest
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, silent
from astra_data.grounding.files import GROUNDING, save_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import METHODS
from astra_data.methods.rma import RmaConfig
from astra_data.pipeline.stages.align import align
from astra_data.pipeline.stages.ground import ground
from astra_data.pipeline.stages.train import train
from astra_data.policies.networks import ActorCritic, PolicyShape, SoftActor, Student
from astra_data.policies.running_policy import PolicyFile
from astra_data.policies.simulator_env import CHANGE_PENALTY, Simulation, WorldConfig, command_limit
from astra_data.policies.train import PpoTrainConfig, SacTrainConfig, Training
from astra_data.robots.registry import TASKS

RMA = RmaConfig(history_length=40, adaptation_steps=64 * 4)
"""Four iterations after the six of `TRAIN`."""
FILES = {"config.json", "curve.json", "manifest.json", "policy.safetensors"}


def make(
    task: str,
    method: str,
    dataset: Path,
    grounding: Path | None,
    out: Path,
    config: PpoTrainConfig | SacTrainConfig = TRAIN,
    progress: Progress = silent,
) -> bytes:
    inputs = {"dataset": dataset, "grounding": grounding, "settings": RMA if method == "rma" else None}
    train(task, method, config, **inputs, out=out, progress=progress)  # type: ignore[arg-type]
    return (out / "policy.safetensors").read_bytes()


def test_the_artifact_is_complete(task: str, grounded: Path, trained: Path) -> None:
    assert {file.name for file in trained.iterdir()} == FILES
    told = json.loads((trained / "config.json").read_text())
    manifest = read_manifest(trained)
    assert manifest and manifest.faults(trained, verify=True) == []
    assert manifest.made_from == {"dataset": told["hash"], "grounding": told["grounding_sha256"]}
    assert len(told.pop("hash")) == 64
    assert told == {
        **{"task": task, "method": "astra", "dataset": "antmaze-short-random-seed0@data-2.0.0", "seed": 0},
        **{"grounding_sha256": file_digest(grounded / "grounding.safetensors"), "initial_sha256": None},
        "train": json.loads(TRAIN.model_dump_json()),
        "settings": None,
    }
    curve = json.loads((trained / "curve.json").read_text())
    assert {"git_commit", "packages", "machine"} <= curve.keys()
    assert [point["steps"] for point in curve["points"]] == [64 * (index + 1) for index in range(6)]
    assert [point["share"] for point in curve["points"]] == pytest.approx([n / 6 for n in range(1, 7)])
    figures = {"steps", "share", "success", "episode_steps", "episodes", "reward", "std"}
    assert curve["points"][0].keys() == figures
    policy = PolicyFile.load(trained / "policy.safetensors")
    assert policy.dataset == "antmaze-short-random-seed0@data-2.0.0" and policy.policy.memory is None
    assert policy.simulation == Simulation(WorldConfig(reward="predicted", data_start_share=0.5))


@pytest.mark.parametrize("method", ["direct_transfer", "astra_plus"])
def test_after_an_interruption_it_goes_on(
    method: str, task: str, paired: Path, grounded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.core.checkpoint.CHECKPOINT_SECONDS", 0.0)
    grounding = grounded if method == "astra_plus" else None
    expected = make(task, method, paired, grounding, tmp_path / "whole")
    out = tmp_path / "interrupted"
    with pytest.raises(Stopped):
        make(task, method, paired, grounding, out, progress=stop_past(0.7))
    assert not out.exists()
    seen: list[float] = []
    resumed = make(task, method, paired, grounding, out, progress=lambda done, note: seen.append(done))
    assert seen == pytest.approx([5 / 6, 1.0]) and resumed == expected
    policy = PolicyFile.load(out / "policy.safetensors")
    limit = command_limit(TASKS[task], PairedEpisodes.load(paired))
    plus = {"reward": "priced", "change_penalty": CHANGE_PENALTY, "command_limit": limit}
    world = WorldConfig(data_start_share=0.5).model_copy(update=plus if method == "astra_plus" else {})
    assert policy.simulation == Simulation(world)


def test_sac_trains_a_soft_actor(task: str, paired: Path, grounded: Path, tmp_path: Path) -> None:
    config = SacTrainConfig(
        learner="sac", num_envs=8, rollout_steps=8, total_steps=8 * 8 * 6, updates_per_step=1, batch_size=16
    )
    make(task, "astra", paired, grounded, tmp_path / "train", config)
    assert isinstance(PolicyFile.load(tmp_path / "train/policy.safetensors").policy, SoftActor)


def test_what_was_begun_with_another_grounding_is_left_alone(
    task: str, paired: Path, grounded: Path, grounded_anew: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.core.checkpoint.CHECKPOINT_SECONDS", 0.0)
    out = tmp_path / "out"
    with pytest.raises(Stopped):
        make(task, "nas", paired, grounded, out, TRAIN, stop_past(0.7))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    with pytest.raises(BadInputError, match=r"partial was started with other settings .*: remove it"):
        make(task, "nas", paired, grounded_anew, out)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()} == before
    make(task, "nas", paired, grounded, out)


def test_rma_deploys_a_student_that_is_told_no_parameters(task: str, paired: Path, tmp_path: Path) -> None:
    make(task, "rma", paired, None, tmp_path / "train")
    assert {file.name for file in (tmp_path / "train").iterdir()} == FILES
    told = json.loads((tmp_path / "train" / "config.json").read_text())
    assert (told["method"], told["settings"]) == ("rma", RMA.model_dump())
    assert told["train"] == json.loads(TRAIN.model_dump_json())
    curve = json.loads((tmp_path / "train" / "curve.json").read_text())
    assert [point["steps"] for point in curve["points"]] == [64 * (index + 1) for index in range(6)]
    adaptation = curve["adaptation"]["points"]
    assert curve["finished_at"] >= curve["adaptation"]["finished_at"]
    assert [point["steps"] for point in adaptation] == [64 * (index + 1) for index in range(4)]
    figures = {"steps", "share", "success", "episode_steps", "episodes", "reward", "r2_extrinsics"}
    assert adaptation[0].keys() == figures
    file = PolicyFile.load(tmp_path / "train" / "policy.safetensors")
    assert isinstance(file.policy, Student)
    assert file.policy.shape.observation_size == 8  # position, velocity, goal, relative goal
    assert file.policy.shape.history_length == 40
    assert file.simulation is not None and file.simulation.variation == TASKS[task].varied.wide


@pytest.mark.parametrize("share", [0.45, 0.85], ids=["teacher", "student"])
def test_rma_goes_on_after_an_interruption_in_either_phase(
    share: float, task: str, paired: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.core.checkpoint.CHECKPOINT_SECONDS", 0.0)
    expected = make(task, "rma", paired, None, tmp_path / "whole")
    out = tmp_path / "interrupted"
    with pytest.raises(Stopped):
        make(task, "rma", paired, None, out, progress=stop_past(share))
    seen: list[float] = []
    resumed = make(task, "rma", paired, None, out, progress=lambda done, note: seen.append(done))
    assert seen == pytest.approx([tenth / 10 for tenth in range(5 if share < 0.6 else 9, 11)]) and resumed == expected


def test_methods_that_do_not_fit_are_refused(task: str, paired: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="'follower' has no policy to train"):
        make(task, "follower", paired, None, tmp_path / "out")
    with pytest.raises(BadInputError, match="run the stage `ground` first"):
        make(task, "astra", paired, None, tmp_path / "out")
    with pytest.raises(BadInputError, match="starts from the policy of direct_transfer: train that first"):
        make(task, "direct_transfer_iql", paired, None, tmp_path / "out")
    with pytest.raises(BadInputError, match="pair it again, with the simulator of this task"):
        make("humanoid-walker2d", "direct_transfer", paired, None, tmp_path / "out")
    with pytest.raises(BadInputError, match=r"grounding.safetensors does not exist") as caught:
        make(task, "astra", paired, tmp_path, tmp_path / "out")
    assert "\n" not in str(caught.value)
    other = HistoryGrounding(GroundingModel(GroundingShape(5, 2, 2, latent_size=8)))
    save_grounding(tmp_path / GROUNDING, other, no_episodes())
    with pytest.raises(BadInputError, match=r"fitted to values \{'state': 5.* has \{'state': 4.*: run the stage `gr"):
        make(task, "nas", paired, tmp_path, tmp_path / "out")
    with pytest.raises(BadInputError, match=r"fitted to values \{'state': 5"):
        align(dataset=paired, grounding=tmp_path, out=tmp_path / "out")


def test_data_without_goals_are_refused_where_policies_meet_them(
    task: str, paired: Path, grounded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = PairedEpisodes.load

    def without_goals(root: Path, device: str) -> PairedEpisodes:
        episodes = loaded(root, device)
        return replace(episodes, windows=replace(episodes.windows, goal=episodes.windows.goal[..., :0]))

    monkeypatch.setattr(PairedEpisodes, "load", without_goals)
    from_data, from_the_start = (TRAIN.model_copy(update={"data_start_share": share}) for share in (0.5, 0.0))
    for method, grounding, config in (
        ("iql", None, from_the_start),
        ("nas", grounded, from_the_start),
        ("direct_transfer", None, from_data),
    ):
        with pytest.raises(BadInputError, match=r"lacks the goals of .*: run `astra-data label` first"):
            make(task, method, paired, grounding, tmp_path / "out", config)
    with pytest.raises(BadInputError, match="lacks the goals"):
        ground(task, "astra", dataset=paired, out=tmp_path / "out")
    assert make(task, "direct_transfer", paired, None, tmp_path / "out", from_the_start)


def test_a_simulator_that_is_not_mastered_is_trained_in_again(
    task: str, paired: Path, grounded: Path, tmp_path: Path
) -> None:
    """No policy masters it in six iterations, so both tries are made, and the first is as without tries."""
    config = TRAIN.model_copy(update={"tries": 2})
    make(task, "nas", paired, grounded, tmp_path / "twice", config)
    curve = json.loads((tmp_path / "twice/curve.json").read_text())
    assert [one["success"] for one in curve["tries"]] == [0.0, 0.0]
    assert {file.name for file in (tmp_path / "twice").iterdir()} >= {"policy.safetensors", "curve.json"}
    assert not list((tmp_path / "twice").glob("try_*"))
    assert (
        make(task, "nas", paired, grounded, tmp_path / "once") == (tmp_path / "twice/policy.safetensors").read_bytes()
    )


def test_trainings_without_a_simulator_are_made_once(
    task: str, paired: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever they learned, there is no simulator of theirs to test it in."""
    policy = PolicyFile(ActorCritic(PolicyShape(6, 2)), None, "toy@data-1.0.0", "abc")
    given = list[Training]()

    def learn(training: Training) -> tuple[PolicyFile, dict[str, Any]]:
        given.append(training)
        return policy, {"points": []}

    monkeypatch.setitem(METHODS, "behavior_cloning", replace(METHODS["behavior_cloning"], learn=learn))
    config, out = TRAIN.model_copy(update={"tries": 2}), tmp_path / "cloned"
    train(task, "behavior_cloning", config, dataset=paired, seed=4, out=out, num_threads=3)
    assert "tries" not in json.loads((out / "curve.json").read_text())
    assert [(one.seed, one.num_threads) for one in given] == [(4, 3)]


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (ActorCritic(PolicyShape(6, 2)), "ActorCritic"),
        ((ActorCritic(PolicyShape(6, 2)), {"points": []}), "ActorCritic and dict"),
        ((), "nothing"),
        ((PolicyFile(ActorCritic(PolicyShape(6, 2)), None, None, None), []), "PolicyFile and list"),
    ],
)
def test_what_a_function_of_the_user_s_learns_is_a_policy_file_and_a_curve(
    task: str, paired: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, returned: Any, told: str
) -> None:
    method = "direct_transfer"
    monkeypatch.setitem(METHODS, method, replace(METHODS[method], learn=lambda training: returned))
    config = TRAIN.model_copy(update={"tries": 2})
    with pytest.raises(BadInputError, match=f"^learn returned {told}: expected a PolicyFile and a dict"):
        train(task, method, config, dataset=paired, out=tmp_path / "learned")


def test_a_policy_of_short_commands_is_no_start_of_fine_tuning(
    task: str, paired: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.policies.train.command_limit", lambda task, episodes: 0.5)
    make(task, "direct_transfer_plus", paired, None, tmp_path / "limited")
    with pytest.raises(BadInputError, match="command_limit, which has no effect on 'direct_transfer_iql'"):
        train(task, "direct_transfer_iql", TRAIN, dataset=paired, initial=tmp_path / "limited", out=tmp_path / "tuned")
    assert not (tmp_path / "tuned").exists()
