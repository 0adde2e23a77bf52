import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from small_run import ALIGN, TASK

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import STATE
from astra_data.deployment.folder import deploy
from astra_data.grounding.files import load_grounding, load_target_encoder
from astra_data.pipeline.stages.align import align
from astra_data.pipeline.stages.evaluate import EvaluateConfig, evaluate
from astra_data.pipeline.trained_policy import load_policy, settings_of, trained_policy
from astra_data.policies.running_policy import PolicyFile, running
from astra_data.robots.registry import TASKS
from astra_data.worlds.user_code import code_digest


@pytest.fixture
def run(small: Path) -> Path:
    return small


def test_the_encoder_is_that_of_the_tests(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    settings = {"task": "antmaze-umaze", "evaluate": {"encoder": "source"}}
    (folder / "recipe.json").write_text(json.dumps(settings))
    shutil.rmtree(folder / "align")  # which it does not need
    trained = trained_policy(folder, "astra_plus")
    assert sorted(trained.files) == ["ground", "train"]
    policy = trained.running()
    assert policy.source_encoder is not None and policy.target_encoder is None


@pytest.mark.parametrize("row", ["astra", "astra_plus"])
def test_it_acts_as_the_artifacts_put_together_by_hand(row: str, run: Path) -> None:
    by_hand = running(
        TASKS["antmaze-umaze"],
        PolicyFile.load(run / "train" / row / "seed_0/policy.safetensors"),
        load_grounding(run / "ground/astra/seed_0/grounding.safetensors"),
        load_target_encoder(run / "align/astra/seed_0/target_encoder.safetensors"),
    )
    loaded = load_policy(str(run), row)
    torch.manual_seed(0)
    by_hand.start(2)
    loaded.start(2)
    for _ in range(3):
        state, goal = torch.randn(2, 29), torch.randn(2, 2)
        action = loaded.act(state, goal)
        assert action.shape == (2, 2) and torch.equal(action, by_hand.act(state, goal))


def test_files_of_the_users_are_found_from_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "runs/cart"
    run.mkdir(parents=True)
    own = {"damped": {"method": "damped.py:METHOD", "gain": 2.0}}
    (run / "recipe.json").write_text(json.dumps({"task": "cart.py:TASK", "user_methods": own}))
    for name in ("cart.py", "damped.py"):
        (tmp_path / name).touch()
    monkeypatch.chdir(run)
    found = settings_of(run)
    assert found["task"] == f"{tmp_path}/cart.py:TASK"
    assert found["user_methods"] == {"damped": {"method": f"{tmp_path}/damped.py:METHOD", "gain": 2.0}}


def test_a_file_of_the_same_name_here_is_not_that_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, elsewhere = tmp_path / "cart/runs/cart", tmp_path / "elsewhere"
    for folder in (run, elsewhere):
        folder.mkdir(parents=True)
    settings = {"task": "cart.py:TASK", "user_methods": {"damped": {"method": "damped.py:METHOD"}}}
    (run / "recipe.json").write_text(json.dumps(settings))
    for folder in (tmp_path / "cart", elsewhere):
        for name in ("cart.py", "damped.py"):
            (folder / name).write_text(f"TASK = METHOD = '{folder.name}'")
    (run / "code.json").write_text(json.dumps({"task": code_digest(f"{tmp_path}/cart/cart.py:TASK")}))
    monkeypatch.chdir(elsewhere)
    found = settings_of("../cart/runs/cart")
    assert found["task"] == f"{tmp_path}/cart/cart.py:TASK"
    assert found["user_methods"]["damped"]["method"] == f"{tmp_path}/cart/damped.py:METHOD"
    (tmp_path / "cart/cart.py").unlink()  # with none but the wrong one, that is told by its place
    with pytest.raises(BadInputError, match=r"^cart\.py changed since \.\./cart/runs/cart was made"):
        settings_of("../cart/runs/cart")


def test_what_is_missing_is_listed_with_the_stage_that_makes_it(run: Path) -> None:
    missing = r"astra_plus, seed 1: expected .*policy.safetensors \(astra-data train\), .*\(astra-data align\)"
    with pytest.raises(BadInputError, match=missing):
        load_policy(run, "astra_plus", seed=1)


@pytest.mark.parametrize(
    ("part", "told"),
    [
        ("train/astra_plus", "{} was altered"),
        ("ground/astra", "astra_plus/seed_0 was made from another grounding"),
        ("align/astra", "{} was altered"),
    ],
)
def test_no_policy_is_made_of_an_altered_file(part: str, told: str, run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    [file] = (folder / part / "seed_0").glob("*.safetensors")
    whole = bytearray(file.read_bytes())
    whole[-1] ^= 1
    file.write_bytes(whole)
    with pytest.raises(BadInputError, match=told.format(re.escape(str(file)))):
        load_policy(folder, "astra_plus")


@pytest.mark.parametrize(
    ("row", "seed", "told"),
    [
        ("astra", 7, "the run has no seed 7; its seeds: 0, 1"),
        ("astr", 0, "the run has no row 'astr': did you mean 'astra'?"),
        ("iql", 0, "the run has no row 'iql'; known: astra, follower"),
        ("follower", 0, "follower has no trained policy: it is written by hand"),
    ],
)
def test_a_row_or_seed_that_the_recipe_lacks_is_told(row: str, seed: int, told: str, tmp_path: Path) -> None:
    settings = {"task": "antmaze-umaze", "methods": ["astra", "follower"], "seeds": [0, 1]}
    (tmp_path / "recipe.json").write_text(json.dumps(settings))
    with pytest.raises(BadInputError, match=f"^{re.escape(told)}$"):
        load_policy(tmp_path, row, seed=seed)


def test_a_policy_that_is_there_is_loaded_whatever_the_recipe_has_now(run: Path, tmp_path: Path) -> None:
    (tmp_path / "recipe.json").write_text(json.dumps({"task": "antmaze-umaze", "methods": ["nas"], "seeds": [1]}))
    for stage in ("train", "ground", "align"):
        (tmp_path / stage).symlink_to(run / stage)
    assert load_policy(tmp_path, "astra_plus")


def test_a_run_of_several_sizes_is_asked_for_one(run: Path, tmp_path: Path) -> None:
    (tmp_path / "recipe.json").write_text(json.dumps({"task": "antmaze-umaze", "sweep": {"percent": [25, 100]}}))
    for percent, got in ((None, "none"), (50, "50")):
        with pytest.raises(BadInputError, match=rf"percent: expected one of 25, 100, got {got}"):
            load_policy(tmp_path, "astra", percent=percent)
    with pytest.raises(BadInputError, match=r"train/astra/percent_025/seed_0/policy.safetensors"):
        load_policy(tmp_path, "astra", percent=25)
    with pytest.raises(BadInputError, match=r"percent: expected none, as the recipe has one size, got 25"):
        load_policy(run, "astra_plus", percent=25)


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"expected the folder of a run \(with recipe\.json"):
        load_policy(tmp_path, "astra")
    (tmp_path / "recipe.json").write_text("{")
    with pytest.raises(BadInputError, match=r"recipe\.json is not what a run writes"):
        load_policy(tmp_path, "astra")


def test_a_policy_aligned_with_inputs_runs_by_them_and_is_not_deployed_as_a_folder(
    run: Path, task: str, paired: Path, grounded: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(run, tmp_path / "run"))
    shutil.rmtree(folder / "align")
    config = ALIGN.model_copy(update={"updates": 3, "inputs": (STATE,)})
    align(config, dataset=paired, grounding=grounded, out=folder / "align/astra/seed_0")
    state, goal = torch.randn(1, 29), torch.randn(1, 2)
    commands = {}
    for encoder in ("target", "source", None):
        settings = {"task": "antmaze-umaze", "evaluate": {"encoder": encoder} if encoder else {}}
        (folder / "recipe.json").write_text(json.dumps(settings | {"align": {"inputs": [STATE]}}))
        policy = load_policy(folder, "astra")
        assert policy.sensing is not None and (policy.target_encoder is None) == (encoder != "target")
        policy.start(1)
        commands[encoder] = policy.command({STATE: state}, goal)
    assert torch.equal(commands["source"], commands[None]) and not torch.equal(commands["source"], commands["target"])
    with pytest.raises(
        BadInputError, match=r"astra acts on observation[.]state in place of states, which a folder does not"
    ):
        deploy(folder, "astra", tmp_path / "deployed")
    with pytest.raises(
        BadInputError, match=r"the target encoder reads observation[.]state, of which a task's target shows none"
    ):
        evaluate_with(folder, "target", tmp_path / "evaluation")
    evaluate_with(folder, None, tmp_path / "evaluation")
    found = json.loads((tmp_path / "evaluation/evaluation.json").read_text())
    assert found["encoder"] == "source" and "encoders" not in found


def evaluate_with(run: Path, encoder: Any, out: Path) -> None:
    config = EvaluateConfig(episodes=1, encoder=encoder)
    parts = {"policy": "train", "grounding": "ground", "target_encoder": "align"}
    folders: dict[str, Any] = {name: run / stage / "astra/seed_0" for name, stage in parts.items()}
    evaluate(TASK, "astra", config, **folders, out=out)
