import json
from collections.abc import Callable
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_run import GROUND
from stopping import Stopped, stop_past

from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, silent
from astra_data.core.seeding import generator
from astra_data.grounding import fit as stage
from astra_data.grounding.files import load_history_model
from astra_data.grounding.open_loop import _starts
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.methods import add_method
from astra_data.pipeline.stages.ground import ground

pytestmark = pytest.mark.usefixtures("quick_fits")


def test_of_a_reward_that_abstract_states_tell_whole_nothing_is_left_to_correct(
    task: str, paired: Path, tmp_path: Path
) -> None:
    """The ant's rewards are of its true places, which its abstract states hold."""
    scales = {}
    for row in ("astra_printed", "astra"):
        config, out = GROUND.model_copy(update={"updates": 1}), tmp_path / row
        ground(task, row, config, dataset=paired, out=out)
        model = load_history_model(out / "grounding.safetensors")
        assert model.shape.corrects_reward == (row == "astra")
        scales[row] = float(model.reward_std[-1])
    assert scales["astra_printed"] > 0.01 and scales["astra"] == pytest.approx(1e-3)


def make(task: str, dataset: Path, out: Path, method: str = "astra", progress: Progress = silent) -> bytes:
    ground(task, method, GROUND, dataset=dataset, out=out, progress=progress)
    return (out / "grounding.safetensors").read_bytes()


def test_the_artifact_is_complete(task: str, grounded: Path) -> None:
    files = {"config.json", "gap.json", "grounding.safetensors", "manifest.json", "metrics.json"}
    assert {file.name for file in grounded.iterdir()} == files
    told = json.loads((grounded / "config.json").read_text())
    assert len(told.pop("hash")) == 64
    assert told == {
        **{"task": task, "method": "astra", "dataset": "antmaze-short-random-seed0@data-2.0.0", "seed": 0},
        "ground": json.loads(GROUND.model_dump_json()),
        "settings": None,
    }
    metrics = json.loads((grounded / "metrics.json").read_text())
    assert {"git_commit", "packages", "machine"} <= metrics.keys()
    (epoch,) = metrics["epochs"]
    heads = {f"{figure}_{head}" for figure in ("loss", "r2") for head in ("latent", "reward", "state")}
    assert epoch.keys() == {"step", "held_out_error"} | heads
    assert epoch["step"] == GROUND.updates
    gap = json.loads((grounded / "gap.json").read_text())
    assert gap["horizons"] == [1, 10, 50]
    for kind in ("raw", "grounded"):
        for quantity in ("position_m", "velocity_m_s"):
            assert {figure: len(values) for figure, values in gap[kind][quantity].items()} == {
                "mean": 3,
                "low": 3,
                "high": 3,
            }


@pytest.mark.parametrize("seed", [0, 1])
def test_the_gap_is_measured_on_held_out_episodes(seed: int, task: str, paired: Path, tmp_path: Path) -> None:
    """One step after a reset, the raw simulator is where pairing saw it land."""
    grounded = tmp_path / "grounded"
    ground(task, "nas", GROUND.model_copy(update={"updates": 2}), dataset=paired, seed=seed, out=grounded)
    _, held_out = PairedEpisodes.load(paired).split(GROUND.held_out_share, seed)
    missed = (held_out.windows.simulated_next - held_out.windows.next_state).numpy()
    starts = _starts(held_out.lengths.numpy(), 1, generator(seed, "gap starts"))
    wrong = missed[starts]
    gap = json.loads((grounded / "gap.json").read_text())
    assert gap["replays"] == len(wrong)
    for quantity, entries in (("position_m", [0, 1]), ("velocity_m_s", [2, 3])):
        expected = np.linalg.norm(wrong[:, entries], axis=1).mean()
        assert gap["raw"][quantity]["mean"][0] == pytest.approx(expected, rel=1e-4)


def test_the_gap_is_that_of_the_grounding(task: str, paired: Path, tmp_path: Path, forgotten_methods: None) -> None:
    add_method("mine", "shifted_method:METHOD")
    ground(task, "mine", GROUND, dataset=paired, out=tmp_path / "grounded")
    gap = json.loads((tmp_path / "grounded/gap.json").read_text())
    raw, grounded = (gap[name]["position_m"]["mean"][0] for name in ("raw", "grounded"))
    assert grounded != pytest.approx(raw, rel=1e-4)


def test_the_time_is_that_of_the_whole_stage(
    task: str, paired: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes after the joint fit, and after the fit, takes an hour each by this clock."""
    late, ticks = [0.0], count()
    for module, name in (("grounding.history", "fit_scatter"), ("pipeline.stages.ground", "gap_report")):
        place, usual = f"astra_data.{module}.{name}", getattr(import_module(f"astra_data.{module}"), name)

        def slow(*args: Any, usual: Callable[..., Any] = usual, **kwargs: Any) -> Any:
            late[0] += 3600.0
            return usual(*args, **kwargs)

        monkeypatch.setattr(place, slow)
    monkeypatch.setattr("astra_data.core.progress.time.perf_counter", lambda: late[0] + 1e-6 * next(ticks))
    monkeypatch.setattr("astra_data.core.progress.time.time", lambda: late[0])
    make(task, paired, tmp_path / "grounded")
    told = json.loads((tmp_path / "grounded/metrics.json").read_text())
    assert told["wall_seconds"] == pytest.approx(7200.0, abs=1) and told["finished_at"] == 7200.0


@pytest.mark.parametrize(
    ("method", "told"),
    [
        ("LOSSY", r"^Lossy\.from_file: read again, steps end up to"),
        ("CLASHING", "^the figures of fit: machine: .*; failures: .*: expected .* other names than those of reports"),
        (
            "UNWRITABLE",
            "figures of fit: loss: .* JSON value; r2.list.1.float: .* finite number; 2: Keys .*: expected JSON",
        ),
    ],
)
def test_a_grounding_that_no_policy_could_be_trained_in_or_no_report_be_made_of_is_not_written(
    method: str, told: str, task: str, paired: Path, tmp_path: Path, forgotten_methods: None
) -> None:
    add_method("mine", f"shifted_method:{method}")
    with pytest.raises(BadInputError, match=told):
        ground(task, "mine", GROUND, dataset=paired, out=tmp_path / "grounded")
    assert not (tmp_path / "grounded").exists()


def test_after_an_interruption_it_goes_on(
    task: str, paired: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage, "_MEASURED_EVERY", 10)
    out = tmp_path / "ground"
    expected = make(task, paired, tmp_path / "whole")
    with pytest.raises(Stopped):
        make(task, paired, out, progress=stop_past(0.6))
    assert not out.exists()
    seen: list[tuple[float, str]] = []
    assert make(task, paired, out, progress=lambda *noted: seen.append(noted)) == expected
    assert seen[0][0] == 0.95 and [share for share, _ in seen].count(1.0) == 1  # the last ten updates only
    told, whole = (json.loads((folder / "metrics.json").read_text()) for folder in (out, tmp_path / "whole"))
    assert told["epochs"] == whole["epochs"] and told["epochs"][0]["step"] == 10
    least = min(told["epochs"], key=lambda epoch: float(epoch["held_out_error"]))
    assert told["updates"] == least["step"]
    assert seen[-1][1].startswith(f"updates {least['step']}, window 20, ")


def test_methods_without_a_grounding_and_raw_datasets_are_refused(
    task: str, paired: Path, collected: Path, tmp_path: Path
) -> None:
    with pytest.raises(BadInputError, match="'direct_transfer' does not ground its simulator"):
        make(task, paired, tmp_path / "out", method="direct_transfer")
    with pytest.raises(BadInputError, match="expected a dataset that was paired") as caught:
        make(task, collected, tmp_path / "out")
    assert "\n" not in str(caught.value)
    with pytest.raises(BadInputError, match="no such folder; expected a folder, name or name@data-"):
        make(task, tmp_path / "nowhere", tmp_path / "out")
