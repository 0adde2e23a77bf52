"""`astra-data view RUN`: what is recorded, against replays that are computed here, one robot at a time."""

import json
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from command_line import call
from quick_runs import fit_quickly, run_here
from rail_run import rail_run

from astra_data.core.errors import BadInputError
from astra_data.dataset.reader import Dataset
from astra_data.grounding.files import load_grounding
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel
from astra_data.pipeline.run_view import view_run
from astra_data.pipeline.trained_policy import settings_of
from astra_data.robots.registry import task_named

RrdReader = import_module("rerun.chunk" if find_spec("rerun.chunk") else "rerun.experimental").RrdReader
CART = Path(__file__).parents[2] / "recipes/examples/cart"
RECIPE = f"""
task = "{CART}/robot.py:TASK"
methods = ["direct_transfer", "nas"]
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
"""
LIMITS = torch.tensor([[-0.2, -1.5], [1.0, 1.5]])  # of v in m/s and w in rad/s


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Return what a recording holds: entity to component, "step" and "time" (in ns) to its rows."""
    found: dict[str, dict[str, Any]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            found.setdefault(str(chunk.entity_path), {})[name] = column
    return found


def scalars(table: dict[str, Any]) -> np.ndarray[Any, Any]:
    return np.array(table["Scalars:scalars"].to_pylist())[:, 0]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of the cart up to its groundings, of the first seed alone."""
    folder = tmp_path_factory.mktemp("viewed")
    (folder / "cart.toml").write_text(RECIPE)
    with pytest.MonkeyPatch.context() as patch:
        fit_quickly(patch)
        return run_here(folder / "cart.toml", until="ground", seeds=[3])


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
def replayed(model: GroundingModel, start: torch.Tensor, commands: torch.Tensor) -> torch.Tensor:
    """Return the states (T + 1, X) of a replay that `model` corrects."""
    low, high = LIMITS
    actions = 2 * (commands - low) / (high - low) - 1
    state, states, hidden, before = start[None], [start], torch.zeros(1, 4), torch.zeros(1, 2)
    for command, action in zip(commands, actions[:, None], strict=True):
        hidden = model.encoder.step(model.encoder_input(state, start[None, :0], before), hidden)
        landed = unicycle(state[0], command)[None]
        corrected = model.correct(model.encoder.latent(hidden), action, landed)
        before, state = action, task_named(f"{CART}/robot.py:TASK").simulator(1).settle(state, corrected)
        states.append(state[0])
    return torch.stack(states)


def test_held_out_episodes_are_shown_with_the_paths_of_all_simulators(run: Path, tmp_path: Path) -> None:
    assert call("view", str(run), "--save", str(tmp_path / "run.rrd")).output == f"written: {tmp_path / 'run.rrd'}\n"
    recording = read(tmp_path / "run.rrd")
    # The error of the grounding is of the same episodes: a replay for every 25 steps begun.
    lengths = [len(commands) for uid, _, commands in recorded_steps(run) if uid in shown(recording)]
    gap = json.loads((run / "ground/nas/seed_3/gap.json").read_text())
    assert len(lengths) == 2 and gap["replays"] == sum(-(-length // 25) for length in lengths)
    grounding = load_grounding(run / "ground/nas/seed_3/grounding.safetensors")
    assert isinstance(grounding, HistoryGrounding)
    for uid, start, commands in recorded_steps(run):
        if uid not in shown(recording):
            continue
        raw = [start]
        for command in commands:
            raw.append(unicycle(raw[-1], command))
        corrected = replayed(grounding.model, start, commands)
        assert (torch.stack(raw) - corrected).abs().max() > 1e-3
        for name, states in (("raw", torch.stack(raw)), ("nas", corrected)):
            entity = f"/episode_{uid}/open_loop/{name}"
            for number, entry in enumerate(("x", "y", "heading_x", "heading_y")):
                found = recording[f"{entity}/{entry}"]
                np.testing.assert_allclose(scalars(found), states[:, number], atol=1e-4)
                assert found["step"].to_pylist() == [*range(len(commands) + 1)]
        assert {f"/episode_{uid}/target", f"/episode_{uid}/target/v"} <= recording.keys()


def shown(recording: dict[str, dict[str, Any]]) -> set[int]:
    return {int(entity.split("/")[1].split("_")[1]) for entity in recording if "episode" in entity}


@pytest.mark.usefixtures("quick_fits")
def test_those_held_out_of_a_share_of_the_recordings_are_shown(run: Path, tmp_path: Path) -> None:
    head, _, tables = RECIPE.partition("[collect]")
    data = f'data = "{run / "collect/seed_3"}"\n[sweep]\npercent = [50]\n'
    (tmp_path / "half.toml").write_text(head + data + tables[tables.index("[ground]") :])
    view_run(run_here(tmp_path / "half.toml", until="ground", seeds=[3]), save=tmp_path / "half.rrd")
    assert len(shown(read(tmp_path / "half.rrd"))) == 1


def test_episodes_are_chosen_by_their_uids(run: Path, tmp_path: Path) -> None:
    uid = max(uid for uid, _, _ in recorded_steps(run))
    view_run(run, [uid], save=tmp_path / "one.rrd")
    assert shown(read(tmp_path / "one.rrd")) == {uid}


def test_states_of_one_value_are_shown(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> None:
    rail = rail_run(tmp_path_factory, seeds=[0], methods=["nas"])
    [label] = task_named(settings_of(rail)["task"]).abstract_state.labels
    view_run(rail, save=tmp_path / "rail.rrd")
    recording = read(tmp_path / "rail.rrd")
    uids = Dataset.open(rail / "pair/seed_0").uids.tolist()
    for row, episode in enumerate(Dataset.open(rail / "pair/seed_0").episodes()):
        if uids[row] in shown(recording):
            found = scalars(recording[f"/episode_{uids[row]}/target/{label}"])
            np.testing.assert_allclose(found[:-1], episode.columns["abstract.state"].ravel(), atol=1e-6)
    assert shown(recording)


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["RUN", "--episode", "99"], "has no episode 99"),
        (["RUN", "--seed", "4"], "has no pairs of seed 4 yet: run the recipe until pair"),
        (["RUN", "--save", "x.txt"], "--save x.txt: expected a file that ends in .rrd"),
    ],
)
def test_what_cannot_be_shown_is_refused(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], fault: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = call("view", *(str(run) if word == "RUN" else word for word in ["--save", "x.rrd", *words]))
    assert isinstance(result.exception, BadInputError) and fault in str(result.exception)
    assert not [*tmp_path.iterdir()]


def test_a_viewer_that_does_not_open_is_told(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    missing = Mock(side_effect=RuntimeError("no viewer"))
    monkeypatch.setattr("rerun.RecordingStream.flush", missing)
    for spawn in (missing, Mock()):  # the viewer is not installed, or ends without a display
        monkeypatch.setattr("rerun.RecordingStream.spawn", spawn)
        with pytest.raises(BadInputError, match=r"^the viewer does not open \(no viewer\): .* --save FILE\.rrd"):
            view_run(run)
