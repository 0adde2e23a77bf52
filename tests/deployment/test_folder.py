import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from small_run import small_run

from astra_data.core.artifact import read_manifest
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.dataset.reader import Dataset
from astra_data.deployment.folder import deploy, describe, page
from astra_data.deployment.graph import load_onnx
from astra_data.grounding.alignment import TargetEncoder
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.pipeline.trained_policy import load_policy
from astra_data.policies.networks import ActorCritic, PolicyShape, SoftActor
from astra_data.policies.running_policy import PolicyFile, RunningPolicy
from astra_data.robots.registry import TASKS


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run with a policy of ASTRA, which has the source encoder."""
    run = Path(shutil.copytree(small_run(tmp_path_factory), tmp_path_factory.mktemp("runs") / "small"))
    (run / "recipe.json").write_text(json.dumps({"task": "antmaze-umaze", "evaluate": {"encoder": "source"}}))
    return run


@pytest.fixture(scope="module")
def folder(run: Path) -> Path:
    return deploy(run, "astra", run.with_name("policy"))


def test_the_folder_tells_all_that_is_needed_to_run_it(folder: Path, run: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    of_lerobot = {"config.json", "policy_preprocessor.json", "policy_postprocessor.json"}
    assert names == of_lerobot | {"policy.onnx", "policy.json", "README.md", "run_policy.py", "manifest.json"}
    about = json.loads((folder / "policy.json").read_text())
    task = TASKS["antmaze-umaze"]
    assert about["rate_hz"] == 20 and about["row"] == "astra" and about["encoder"] == "source"
    assert tuple(about["state"]["names"]) == task.state.names and len(about["state"]["units"]) == 29
    assert len(about["goal"]["names"]) == 2
    assert about["command"]["least"] == [-1, -1] and about["command"]["largest"] == [1, 1]
    assert about["hidden"]["size"] == sum(about["hidden"]["parts"].values()) == 2 + 2 + 16
    assert len(about["trained_on"]["hash"]) == 64 and about["largest_difference"] < 1e-6
    manifest = read_manifest(folder)
    assert manifest is not None and manifest.faults(folder, verify=True) == []
    assert manifest.made_from == about["made_from"] and set(about["made_from"]) == {"train", "ground"}
    states = recorded(run)
    ends = [about["state"][f"recorded_{end}"] for end in ("least", "largest")]
    np.testing.assert_array_equal(ends, [states.min(0), states.max(0)])
    page = " ".join((folder / "README.md").read_text().split())
    assert "20 times a second" in page and "{" not in page and str(run.parent) not in page + json.dumps(about)


def test_its_page_runs(folder: Path) -> None:
    code = (folder / "README.md").read_text().partition("```python\n")[2].partition("```")[0]
    start = json.loads((folder / "policy.json").read_text())["state"]["recorded_least"]
    given = f"measure, send, goal = lambda: {start}, print, [1.0, 2.0]\n"
    code = code.replace("steps=1200", "steps=2")
    shown = alone(folder, given + code)
    assert len(shown.splitlines()) == 3 and shown.endswith("[0. 0.]\n")


def test_it_runs_without_this_package_and_without_torch(folder: Path, run: Path, tmp_path: Path) -> None:
    moved = shutil.copytree(folder, tmp_path / "robot")
    noise, goal = np.random.default_rng(0).standard_normal((20, 29)).astype("float32"), [1.0, -2.0]
    states = recorded(run)[:20] + 0.1 * noise
    np.save(tmp_path / "states.npy", states)
    shown = alone(
        moved,
        "import json, numpy\nfrom run_policy import RobotPolicy\nabout = json.load(open('policy.json'))\n"
        "policy = RobotPolicy(rate_hz=20, state=about['state']['names'], goal=about['goal']['names'])\n"
        "states = numpy.load('../states.npy')\npolicy.act(states[3], [0, 0])\npolicy.start()\n"
        f"print(json.dumps([policy.act(state, {goal}).tolist() for state in states]))\n",
    )
    here = load_policy(run, "astra")
    here.start(1)
    expected = [here.act(torch.from_numpy(state[None]), torch.tensor([goal]))[0] for state in states]
    np.testing.assert_allclose(json.loads(shown), torch.stack(expected), atol=1e-5, rtol=0)
    assert len(alone(moved, "import runpy\nrunpy.run_path('run_policy.py', run_name='__main__')").split("\n")) > 9


def alone(folder: Path, code: str) -> str:
    """Run code in a folder, where neither this package nor torch can be imported."""
    without = "import sys\nsys.path.insert(0, '.')\nfor name in ('astra_data', 'torch'): sys.modules[name] = None\n"
    command = [sys.executable, "-I", "-c", without + code]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def recorded(run: Path) -> NDArray[np.float32]:
    """Return the states (N, S) of the dataset of seed 0."""
    return Dataset.open(run / "pair/seed_0").columns(["observation.state"])["observation.state"]


def test_what_is_no_policy_and_a_folder_that_exists_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="follower has no trained policy"):
        deploy(run, "follower", tmp_path / "a/policy")
    with pytest.raises(BadInputError, match=r"astra, seed 1: expected .*\(astra-data train\).*run the recipe"):
        deploy(run, "astra", tmp_path / "a/policy", seed=1)
    assert not (tmp_path / "a").exists()
    with pytest.raises(BadInputError, match=r"exists already; delete it or choose another folder"):
        deploy(run, "astra", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_of_a_policy_that_cannot_be_written_nothing_is_left(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: RunningPolicy, folder: Path) -> None:
        (folder / "policy.onnx").touch()
        raise BadInputError("code that cannot be traced")

    monkeypatch.setattr("astra_data.deployment.graph.write_graph", fail)
    with pytest.raises(BadInputError, match="cannot be traced"):
        deploy(run, "astra", tmp_path / "policy")
    assert list(tmp_path.iterdir()) == []


def test_the_policy_is_that_of_the_seed_and_size_that_are_asked_for(tmp_path: Path) -> None:
    run, code = tmp_path / "rail", Path(__file__).parents[1] / "small_cart.py"
    torch.manual_seed(0)
    for where in ("050/seed_0", "050/seed_1", "100/seed_1"):
        out = run / f"train/direct_transfer/percent_{where}"
        out.mkdir(parents=True)
        policy = ActorCritic(PolicyShape(2, 1, hidden_sizes=(8,), memory_size=4))
        PolicyFile(policy, None, f"drives {where}", "0" * 64).save(out / "policy.safetensors")
    (run / "recipe.json").write_text(json.dumps({"task": f"{code}:TASK", "sweep": {"percent": [50, 100]}}))
    folder = deploy(run, "direct_transfer", tmp_path / "policy", seed=1, percent=50)
    about = json.loads((folder / "policy.json").read_text())
    assert (about["seed"], about["percent"], about["trained_on"]["dataset"]) == (1, 50, "drives 050/seed_1")
    file = run / "train/direct_transfer/percent_050/seed_1/policy.safetensors"
    assert about["made_from"] == {"train": file_digest(file), "file_sha256": file_digest(code)}
    state, goal = torch.tensor([[0.3, -0.2]]), torch.tensor([[1.0]])
    here = load_policy(run, "direct_transfer", seed=1, percent=50)
    here.start(1)
    hidden = torch.zeros(1, about["hidden"]["size"])
    command, _ = load_onnx(folder / "policy.onnx")(state, goal, hidden)
    torch.testing.assert_close(command, here.command(state, goal), atol=1e-5, rtol=0)
    assert about["command_limit"] is None  # of velocities in a maze alone


def test_its_page_tells_sizes_and_what_stops_the_robot() -> None:
    sizes = {"state": ["x", "v", "w"], "goal": [], "command": ["left", "right"]}
    about = {"task": "cart", "row": "nas", "seed": 3, "rate_hz": 10.0}
    about |= {column: {"names": names} for column, names in sizes.items()}
    about |= {"hidden": {"size": 5, "parts": {"memory": 5}}, "trained_on": {"dataset": "a", "hash": "b"}}
    text = " ".join(page(about).split())
    assert "goal=[], ) run(policy, measure, send, goal, steps=600, stop=[0.0, 0.0])" in text
    assert "## Goal None: all episodes have the same." in text
    assert "`state` (1, 3), `goal` (1, 0) and `hidden` (1, 5) in, `command` (1, 2) and" in text
    for units, stop in ((["m/s", "rad/s"], "[0.0, 0.0]"), (["deg", "deg"], "None"), (["m/s", "rad"], "None")):
        command = {"names": sizes["command"], "units": units}
        assert f"steps=600, stop={stop})" in page(about | {"command": command})


def test_a_description_names_encoder_limit_and_frames() -> None:
    task = TASKS["antmaze-umaze"]
    latent = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    aligned = TargetEncoder(29, 2, 2, embedding_size=8, latent_size=8)
    policy = ActorCritic(PolicyShape(16, 2))
    about = describe(RunningPolicy(task, policy, latent, aligned, command_limit=0.4), {"memory": 2})
    assert (about["encoder"], about["command_limit"]) == ("target", 0.4)
    whole = SoftActor(PolicyShape(33, 2, hidden_sizes=(8,)))
    assert describe(RunningPolicy(task, whole, observed="full"), {})["observed"] == "full"
    assert about["state"]["frames"] == (task.state.astra or {})["frame"]
