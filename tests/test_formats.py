"""What version 0.1 wrote is read by this one: datasets, groundings, policies, runs; see tests/formats."""

import json
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_report import REPLAY

from astra_data.core.checkpoint import load_tensors, save_tensors
from astra_data.core.errors import BadInputError
from astra_data.dataset.doctor.check import check as check_dataset
from astra_data.dataset.edit import subset
from astra_data.dataset.reader import Dataset
from astra_data.experiments.execution import Item
from astra_data.experiments.run import check, run
from astra_data.experiments.trained_policy import load_policy
from astra_data.grounding.files import load_grounding
from astra_data.grounding.open_loop_error import gap_report
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.reports.files import read_published
from astra_data.reports.schema import Results
from astra_data.stages.pair import pair
from astra_data.training.policy_file import PolicyFile, running
from astra_data.training.running_policy import RunningPolicy
from astra_data.worlds.registry import TASKS

OLD = Path(__file__).parent / "formats/0.1"
TASK = "antmaze-umaze"
ACTIONS = json.loads((OLD / "actions.json").read_text())


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the recipe, with its run in `runs/small`; for tests that only read it."""
    folder = tmp_path_factory.mktemp("0.1")
    shutil.unpack_archive(OLD / "run.tar.xz", folder / "runs", filter="data")
    shutil.copy(OLD / "small.toml", folder)
    return folder


@pytest.fixture(scope="module")
def old(unpacked: Path) -> Path:
    return unpacked / "runs/small"


@pytest.mark.parametrize("stage", ["collect", "pair"])
def test_datasets_are_whole_and_can_be_edited(old: Path, stage: str, tmp_path: Path) -> None:
    folder = old / stage / "seed_0"
    dataset = Dataset.open(folder)
    assert dataset.verify() == check_dataset(folder).faults == []
    smaller = Dataset.open(subset(dataset, percent=50, name="half", out=tmp_path / "half"))
    assert len(dataset) == 4 and len(smaller) == 2
    assert smaller.description["parents"] == [dataset.identity]


def test_episodes_are_paired_as_they_were(old: Path, tmp_path: Path) -> None:
    paired = Dataset.open(pair(TASK, dataset=old / "collect/seed_0", out=tmp_path / "pair"))
    before = Dataset.open(old / "pair/seed_0")
    names = list(before.features)
    now, then = paired.columns(names), before.columns(names)
    assert list(paired.features) == names
    for name in names:
        np.testing.assert_allclose(now[name], then[name], rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("method", ["compass", "nas_golemo", "astra"])
def test_groundings_correct_as_they_did(old: Path, method: str) -> None:
    folder = old / "ground" / method / "seed_0"
    _, held_out = PairedEpisodes.load(old / "pair/seed_0").split(0.25, 0)
    gap = gap_report(TASKS[TASK], load_grounding(folder / "grounding.safetensors"), held_out, seed=0)
    before = json.loads((folder / "gap.json").read_text())
    assert (gap["horizons"], gap["replays"]) == (before["horizons"], before["replays"])
    for kind in ("raw", "grounded"):
        assert gap[kind].keys() == before[kind].keys()
        for quantity, band in before[kind].items():
            # One episode is held out, so that the interval that was there had no width.
            assert band["low"] == band["mean"] == band["high"]
            assert gap[kind][quantity]["mean"] == pytest.approx(band["mean"], rel=1e-3, abs=1e-5, nan_ok=True)


@pytest.mark.parametrize("row", ACTIONS)
def test_policies_act_as_they_did(old: Path, row: str) -> None:
    dataset = Dataset.open(old / "collect/seed_0")
    columns = dataset.columns(["observation.state", "observation.environment_state"])
    steps = [dataset.starts[:2] + step for step in range(4)]
    inputs = [tuple(torch.from_numpy(values[at]) for values in columns.values()) for at in steps]
    assert_acts(load_policy(old, row), inputs, torch.tensor(ACTIONS[row]))


def test_a_policy_learned_by_sac_acts_as_it_did() -> None:
    known = json.loads((OLD / "sac_actions.json").read_text())
    policy = running(TASKS["humanoid-kinematics"], PolicyFile.load(OLD / "sac_policy.safetensors"))
    inputs = [(torch.tensor(known["state"]), torch.zeros(4, 0))]
    assert_acts(policy, inputs, torch.tensor([known["action"]]))


def assert_acts(
    policy: RunningPolicy, inputs: Iterable[tuple[torch.Tensor, ...]], expected: torch.Tensor
) -> None:
    policy.start(expected.shape[1])
    for (state, goal), actions in zip(inputs, expected, strict=True):
        torch.testing.assert_close(policy.act(state, goal), actions, rtol=1e-4, atol=1e-5)


def test_a_run_is_finished_without_manifests(unpacked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = check(unpacked / "small.toml", root=unpacked / "runs", verify=True)
    assert {key: of.state for key, of in found.items()} == dict.fromkeys(found, "finished")
    remarks = {key.partition("/")[0]: of.why for key, of in found.items()}
    datasets = dict.fromkeys(("collect", "pair"), "")
    made = dict.fromkeys(("ground", "train", "align", "evaluate", "report"), "no manifest (made by 0.1)")
    assert remarks == datasets | made
    assert len(found) == 22
    assert "doubt_penalty is now called disagreement_penalty" in capsys.readouterr().err


def test_weights_of_a_run_without_manifests_are_read_on_request(unpacked: Path, tmp_path: Path) -> None:
    shutil.copytree(unpacked, tmp_path, dirs_exist_ok=True)
    recipe, root = tmp_path / "small.toml", tmp_path / "runs"
    policy = root / "small/train/iql/seed_0/policy.safetensors"
    tensors, metadata = load_tensors(policy)
    save_tensors(policy, {name: value * float("nan") for name, value in tensors.items()}, metadata)
    assert check(recipe, root=root)["train/iql/seed_0"].is_finished
    found = check(recipe, root=root, verify=True)
    assert [key for key, of in found.items() if not of.is_finished] == ["train/iql/seed_0"]
    assert "expected finite weights" in found["train/iql/seed_0"].why
    with pytest.raises(BadInputError, match="expected finite weights"):
        load_policy(root / "small", "iql")


def test_a_run_goes_on_with_its_report(
    unpacked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(unpacked, tmp_path, dirs_exist_ok=True)
    recipe, root, made = tmp_path / "small.toml", tmp_path / "runs", list[str]()

    def execute(items: Iterable[Item], **_: object) -> None:
        for item in items:
            made.append(item.key)
            item.call(progress=lambda *_: None)

    monkeypatch.setattr("astra_data.experiments.run.execute", execute)
    # Figures take seconds, and are tested elsewhere.
    monkeypatch.setattr("astra_data.reports.drawing.figures_of", lambda *_, **__: {})
    monkeypatch.setattr("astra_data.reports.figures.dynamics_mismatch", lambda *_: None)
    monkeypatch.setattr("astra_data.reports.figures.png", lambda _: b"")
    monkeypatch.setattr("astra_data.stages.report.replay_commands", lambda _: REPLAY)
    before = read_published(root / "small/report/results.json")
    run(recipe, root=root)
    now = read_published(root / "small/report/results.json")
    assert made == ["report"] and not (root / "small/set_aside").exists()
    assert isinstance(before, Results) and isinstance(now, Results)
    # As text, for NaN stands where there is nothing.
    assert str(now.methods) == str(before.methods)
    assert check(recipe, root=root)["report"].why == ""
