"""The tasks and methods of recorded walks and joints, in recipes/examples/recorded."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from toy_joints import FPS, positions, targets

from astra_data.core.progress import silent
from astra_data.dataset import Dataset
from astra_data.grounding.fit import Fitting, GroundConfig
from astra_data.grounding.open_loop import gap_report
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.io.importing import import_dataset
from astra_data.pipeline.stages.label import label
from astra_data.pipeline.stages.pair import pair

RECIPES = Path(__file__).parents[2] / "recipes"
RECORDED = RECIPES / "examples/recorded"


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(RECORDED))
    return {name: importlib.import_module(name) for name in ("joints", "walker", "windows")}


def test_a_walk_leads_back_to_its_poses(recorded: dict[str, Any]) -> None:
    walker = recorded["walker"]
    rng = np.random.default_rng(0)
    pose = np.column_stack([rng.normal(size=(9, 2)).cumsum(0), 3.0 + rng.normal(0, 0.4, 9).cumsum()])
    states = torch.from_numpy(walker.states(pose)).float()
    simulator = walker.PlanarWalker(len(states) - 1)
    simulator.reset_to(states[:-1])
    after = simulator.step(torch.zeros(len(states) - 1, 4))
    # Where the last motion leads does not depend on the command; the motion is all the command's.
    torch.testing.assert_close(after[:, :4], states[1:, :4])
    torch.testing.assert_close(after[:, 4:], walker.PlanarWalker.motion(torch.zeros(8 - 1, 4)))
    turned = pose[1:, 2] - pose[0, 2]
    np.testing.assert_allclose(states[1:, 2], np.cos(turned[:-1]), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        states[:, 4:6].norm(dim=1), np.linalg.norm(np.diff(pose[:, :2], axis=0), axis=1), rtol=1e-5
    )


def test_ridge_learns_what_recorded_joints_do(
    recorded: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    joints, windows = recorded["joints"], recorded["windows"]
    rows = 4000
    parts = [targets(rows, seed) for seed in range(4)]
    log = {
        "time": torch.arange(rows) / FPS,
        "dof_pos": torch.from_numpy(np.concatenate([positions(part)[:-1] for part in parts], axis=1)).float(),
        "des_dof_pos": torch.from_numpy(np.concatenate(parts, axis=1)).float(),
    }
    torch.save(log, tmp_path / "chirp_data.pt")
    source = import_dataset([tmp_path / "chirp_data.pt"], RECIPES / "imports/pace_anymal.toml").root
    joints.write_steps(joints.ANYMAL, source, states=joints.states, stretches=joints.stretches, rows=4)
    steps = Dataset.open(tmp_path / "home/pace-joints-steps/data-1.0.0")
    assert steps.info["fps"] == 100
    # Shifted copies of a stretch follow each other in every subset, and what is held out has none.
    recordings = steps.recordings[steps.subset(len(steps))]
    assert (np.diff(recordings) != 0).sum() == len(set(recordings)) - 1
    assert 4 * (~np.array(steps.metadata["held_out"])).sum() >= len(steps) > len(set(recordings))
    assert {1, 4} == {int(one) for one in np.bincount(recordings)}
    first = next(iter(steps.episodes())).columns
    np.testing.assert_allclose(first["observation.state"][1:], first["next.observation.state"][:-1])
    # The first state is that after the first step of four rows, its action the mean of the next four.
    begin = int(np.abs(log["dof_pos"].numpy() - first["observation.state"][0, :12]).sum(1).argmin())
    np.testing.assert_allclose(first["action"][0], log["des_dof_pos"][begin : begin + 4].mean(0), atol=1e-6)
    task = f"{RECORDED / 'joints.py'}:ANYMAL"
    labeled = label(task, data=steps.root, out=tmp_path / "labeled")
    paired = pair(task, dataset=labeled, out=tmp_path / "pairs")
    episodes = PairedEpisodes.load(paired)
    training, held_out = episodes.split(0.25, 0)
    fitting = Fitting(joints.ANYMAL, GroundConfig(updates=50), None, training, held_out, 0, "cpu", tmp_path, silent)
    for method in (windows.RIDGE, windows.NETWORK):
        grounding, _ = method.fit(fitting)
        written = windows.WindowGrounding.from_file(*grounding.to_file(), "cpu")
        report = gap_report(joints.ANYMAL, written, held_out, seed=0)
        raw, grounded = (report[name]["joints_rad"]["mean"][:2] for name in ("raw", "grounded"))
        assert max(np.divide(grounded, raw)) < 0.5


def test_a_window_remembers_as_it_does_step_by_step(recorded: dict[str, Any]) -> None:
    windows = recorded["windows"]
    window = windows.Window([0, 1], 1, 3, is_network=False)
    state, action = torch.randn(2, 7, 3), torch.randn(2, 7, 1)
    of = type("Windows", (), {"state": state, "action": action})
    before = windows.WindowGrounding(window).hidden_before(of)
    assert not before[:, 0].any()
    last = torch.cat([state[:, 1:6, :2], action[:, 1:6]], dim=-1).flatten(1)
    torch.testing.assert_close(before[:, 6], last)


def test_seconds_in_which_joints_stand_still_are_left_out(recorded: dict[str, Any]) -> None:
    state = np.zeros((41, 12))
    state[13:17, 3], state[25, 7] = 0.06, 0.04
    assert list(recorded["joints"].stretches(state, 10)) == [(10, 20)]
