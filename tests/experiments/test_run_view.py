"""`astra-data view RUN`: what is recorded, against replays that are computed here, one robot at a time."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from recordings_of_rerun import points, read, scalars
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError
from astra_data.core.progress import silent
from astra_data.dataset import Dataset
from astra_data.experiments.experiment import load_experiment
from astra_data.experiments.plan import plan, stage_of
from astra_data.experiments.run_view import SHOWN, view_run
from astra_data.grounding.files import load_grounding, save_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.descent import DescentConfig
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.learning.networks.paired_windows import RISK_STEPS
from astra_data.worlds.registry import task_named

CART = Path(__file__).parents[2] / "recipes/examples/cart"
RECIPE = f"""
task = "{CART}/robot.py:TASK"
methods = ["direct_transfer", "nas", "nas_golemo"]
seeds = [3, 4]
[collect]
episodes = 8
max_steps = 60
start = "task"
hold_s = [0.5, 2.0]
[ground]
updates = 20
batch_windows = 8
window = 10
latent_size = 4
held_out_share = 0.25
members = 2
failure_members = 2
[nas_golemo]
epochs = 1
hidden_size = 4
layers = 1
"""
LIMITS = torch.tensor([[-0.2, -1.5], [1.0, 1.5]])
"""Of v in m/s and w in rad/s."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of the cart up to its groundings, of the first seed alone."""
    folder = tmp_path_factory.mktemp("viewed")
    (folder / "cart.toml").write_text(RECIPE)
    experiment = load_experiment(folder / "cart.toml", folder / "runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("astra_data.grounding.failures._DESCENT", DescentConfig(updates=10))
        for item in plan(experiment.recipe, experiment.path, experiment.folder):
            if stage_of(item) in ("collect", "pair", "ground") and item.key.endswith("seed_3"):
                item.call(progress=silent)
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    return experiment.folder


@pytest.fixture(scope="module")
def recording(run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What `view RUN` records of the episodes that it chooses."""
    file = tmp_path_factory.mktemp("recorded") / "run.rrd"
    result = CliRunner().invoke(app, ["view", str(run), "--save", str(file)])
    assert result.output == (
        "left out: hazard of nas_golemo (no failure model), "
        f"disagreement of nas_golemo (one model with one head)\nwritten: {file}\n"
    )
    return read(file)


def recorded_steps(run: Path) -> Iterator[tuple[int, torch.Tensor, torch.Tensor]]:
    """Yield the uid, φ(s_0) (X,) and the commands (T, 2) of each episode."""
    for episode in Dataset.open(run / "pair/seed_3").episodes():
        columns = {name: torch.from_numpy(values.copy()) for name, values in episode.columns.items()}
        yield episode.uid, columns["abstract.state"][0], columns["action"]


def unicycle(state: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
    """Where a cart that obeys at once is after 0.1 s."""
    x, y, yaw = state[0], state[1], torch.atan2(state[3], state[2])
    v, w = command
    turned = yaw + 0.1 * w
    return torch.stack([x + 0.1 * v * yaw.cos(), y + 0.1 * v * yaw.sin(), turned.cos(), turned.sin()])


@torch.no_grad()
def replayed(
    grounding: HistoryGrounding, start: torch.Tensor, commands: torch.Tensor, by: GroundingModel
) -> tuple[torch.Tensor, list[float], list[float]]:
    """Return states (T + 1, X), hazards, and how far `by`, which corrects, is from the model, by step."""
    model, failures = grounding.model, grounding.failures
    assert failures is not None
    low, high = LIMITS
    actions = 2 * (commands - low) / (high - low) - 1
    goal, before = start[None, :0], torch.zeros(1, 2)
    state, states = start[None], [start]
    hidden = {one: torch.zeros(1, 4) for one in {model, by}}
    memory = failures.initial_memory(state, before)
    hazards, apart = [], []
    for command, action in zip(commands, actions[:, None], strict=True):
        latent = {}
        for one in hidden:
            hidden[one] = one.encoder.step(one.encoder_input(state, goal, before), hidden[one])
        landed = unicycle(state[0], command)[None]
        probability, memory = failures.step(state, action, landed, memory)
        latent = {one: model.encoder.latent(hidden[one]) for one in hidden}
        corrected = {one: one.correct(latent[one], action, landed) for one in hidden}
        between = torch.stack([corrected[model], corrected[by]])
        apart.append(max(0.0, float(by.disagreement(between)) - 1.0))
        hazards.append(float(probability) / RISK_STEPS)
        before, state = action, task_named(f"{CART}/robot.py:TASK").simulator(1).settle(state, corrected[by])
        states.append(state[0])
    return torch.stack(states), hazards, apart


def shown(recording: dict[str, dict[str, Any]]) -> set[int]:
    return {int(entity.split("/")[1].split("_")[1]) for entity in recording if "episode" in entity}


def test_held_out_episodes_are_shown_with_the_paths_of_all_simulators(
    run: Path, recording: dict[str, dict[str, Any]]
) -> None:
    # A grounding of 8 episodes holds out 2; which, metrics do not tell, but the split's seed does.
    assert len(shown(recording)) == 2  # of 8
    # The errors of the grounding are of the same episodes, and have a replay for every 25 steps begun.
    lengths = [len(commands) for uid, _, commands in recorded_steps(run) if uid in shown(recording)]
    gap = json.loads((run / "ground/nas/seed_3/gap.json").read_text())
    assert gap["replays"] == sum(-(-length // 25) for length in lengths)
    for uid, start, commands in recorded_steps(run):
        if uid not in shown(recording):
            continue
        expected = [start]
        for command in commands:
            expected.append(unicycle(expected[-1], command))
        raw = torch.stack(expected).numpy()
        of_raw = recording[f"/episode_{uid}/open_loop/raw"]
        np.testing.assert_allclose(points(of_raw)[:, :2], raw[:, :2], atol=1e-4)
        assert of_raw["step"].to_pylist() == [*range(len(commands) + 1)]
        heading = scalars(recording[f"/episode_{uid}/open_loop/raw/abstract.state/heading_x"])
        np.testing.assert_allclose(heading, raw[:, 2], atol=1e-4)

        grounding = cast(HistoryGrounding, load_grounding(run / "ground/nas/seed_3/grounding.safetensors"))
        states, hazards, _ = replayed(grounding, start, commands, grounding.model)
        of_nas = recording[f"/episode_{uid}/open_loop/nas"]
        np.testing.assert_allclose(points(of_nas)[:, :2], states[:, :2], atol=1e-4)
        assert np.abs(states.numpy() - raw).max() > 1e-3
        found = recording[f"/episode_{uid}/open_loop/nas/hazard"]
        np.testing.assert_allclose(scalars(found), hazards, rtol=1e-3)
        assert found["step"].to_pylist() == [*range(len(commands))]
        assert np.ptp(hazards) > 1e-5

        apart = [replayed(grounding, start, commands, member)[2] for member in grounding.members]
        disagreement = scalars(recording[f"/episode_{uid}/open_loop/nas/disagreement"])
        np.testing.assert_allclose(disagreement, np.mean(apart, axis=0), rtol=1e-2, atol=1e-3)
        assert np.ptp(apart, axis=0).max() > 1e-2

        assert {f"/episode_{uid}/{name}" for name in ("target", "simulator", "action/v")} <= recording.keys()
        assert f"/episode_{uid}/open_loop/nas_golemo" in recording
        assert f"/episode_{uid}/open_loop/nas_golemo/hazard" not in recording
        assert f"/episode_{uid}/open_loop/nas_golemo/disagreement" not in recording


def test_episodes_are_chosen_by_their_uids(run: Path, tmp_path: Path) -> None:
    uid = max(uid for uid, _, _ in recorded_steps(run))
    view_run(run, [uid], save=tmp_path / "one.rrd")
    found = read(tmp_path / "one.rrd")
    assert shown(found) == {uid}
    assert f"/episode_{uid}/open_loop/nas/hazard" in found


def test_what_a_run_has_not_made_yet_is_left_out(run: Path, tmp_path: Path) -> None:
    (tmp_path / "young").mkdir()
    shutil.copy(run / "recipe.json", tmp_path / "young/recipe.json")
    with pytest.raises(BadInputError, match="has no dataset of seed 3 yet: run the recipe until pair first"):
        view_run(tmp_path / "young", save=tmp_path / "x.rrd")
    (tmp_path / "young/collect").symlink_to(run / "collect")
    collected = view_run(tmp_path / "young", save=tmp_path / "collected.rrd")
    assert collected == "all simulators (the dataset is not paired yet)"
    found = read(tmp_path / "collected.rrd")
    assert len(shown(found)) == SHOWN and not [entity for entity in found if "open_loop" in entity]
    (tmp_path / "young/pair").symlink_to(run / "pair")
    assert view_run(tmp_path / "young", save=tmp_path / "p.rrd") == "grounded simulators (none is finished)"
    assert {"open_loop/raw"} == {
        "/".join(entity.split("/")[2:4]) for entity in read(tmp_path / "p.rrd") if "open_loop" in entity
    }
    assert not (tmp_path / "x.rrd").exists()


def test_a_failure_model_and_members_that_a_grounding_lacks_are_left_out(run: Path, tmp_path: Path) -> None:
    plain, grounding = tmp_path / "plain", load_grounding(run / "ground/nas/seed_3/grounding.safetensors")
    (plain / "ground/nas/seed_3").mkdir(parents=True)
    shutil.copy(run / "recipe.json", plain / "recipe.json")
    (plain / "pair").symlink_to(run / "pair")
    save_grounding(
        plain / "ground/nas/seed_3/grounding.safetensors",
        cast(HistoryGrounding, grounding).reduced(members=False, failures=False),
        PairedEpisodes.load(run / "pair/seed_3"),
    )
    lacking = view_run(plain, save=tmp_path / "plain.rrd")
    assert lacking == "hazard of nas (no failure model), disagreement of nas (one model with one head)"
    found = read(tmp_path / "plain.rrd")
    assert [entity for entity in found if entity.endswith("open_loop/nas")]
    assert not [entity for entity in found if entity.endswith(("hazard", "disagreement"))]


def test_what_is_neither_and_what_is_not_there_is_told(run: Path, tmp_path: Path) -> None:
    saved = ["--save", str(tmp_path / "x.rrd")]

    def told(*words: str) -> str:
        with pytest.raises(BadInputError) as error:
            app(["view", *words, *saved], standalone_mode=False)
        return str(error.value)

    assert told(str(tmp_path)).startswith(
        f"{tmp_path}: expected a dataset (a folder with meta/info.json) or the folder of a run (with "
        "recipe.json), got neither"
    )
    assert "has no episode 99" in told(str(run), "--episode", "99")
    assert told(str(run), "--seed", "7") == "the recipe has no seed 7; its seeds: 3, 4"
    assert "no dataset of seed 4 yet" in told(str(run), "--seed", "4")
    assert told(str(run / "pair/seed_3"), "--seed", "3").endswith(
        "--seed is for the folder of a run: leave it out"
    )
    assert not (tmp_path / "x.rrd").exists()
