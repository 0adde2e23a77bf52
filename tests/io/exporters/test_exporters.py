"""What all exporters have in common."""

import json
import os
import subprocess
import sys
from pathlib import Path

import full_disk
import h5py
import numpy as np
import pytest
from fake_dataset import COLUMNS, fake_columns, write_fake, writer
from fake_transitions import NEXT, write_transitions
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, Array, Column, Episode
from astra_data.dataset.description import ContentHash
from astra_data.dataset.reader import Dataset
from astra_data.io import export_record
from astra_data.io.exporters import EXPORTERS, export
from astra_data.io.importing import import_dataset
from astra_data.io.layouts import RECORD

REWARDS = """
name = "a"
task = "a"
fps = 1
columns.a.fields = ["rewards"]
"""
FILES = {"d3rlpy": "set.h5", "d4rl": "set.hdf5", "minari": "set-v0", "robomimic": "set.hdf5"}


@pytest.mark.parametrize("format", sorted(EXPORTERS))
@pytest.mark.parametrize("has_goal", [True, False])
def test_all_that_went_in_comes_back(tmp_path: Path, format: str, has_goal: bool) -> None:
    dataset = write_transitions(tmp_path / "set", has_goal=has_goal)
    export(dataset, tmp_path / FILES[format], format=format)
    report = import_dataset([tmp_path / FILES[format]], out=tmp_path / "back")
    back = Dataset.open(report.root)
    assert (report.episodes, report.frames) == (len(dataset), int(dataset.lengths.sum()))
    assert back.schema == dataset.schema
    assert back.uids.tolist() == dataset.uids.tolist()
    assert back.metadata == dataset.metadata
    assert (back.task, back.info["fps"], back.order) == (dataset.task, dataset.info["fps"], dataset.order)
    for found, expected in zip(back.episodes(), dataset.episodes(), strict=True):
        for name, values in expected.columns.items():
            np.testing.assert_array_equal(found.columns[name], values, err_msg=name)
    # The hash is of every value, LeRobot's own columns included.
    assert back.content_hash == dataset.content_hash
    assert back.reference == "fake@data-1.0.1"
    assert back.description["parents"] == [dataset.identity]
    assert back.description["environment"] == dataset.description["environment"]


VECTORS_OF = {
    "d3rlpy": ("observations_1", "actions_1"),
    "d4rl": ("observations", "actions", "next_observations", "infos/goal"),
    "minari": (
        *("episode_1/observations/observation", "episode_1/observations/desired_goal"),
        "episode_1/actions",
    ),
    "robomimic": tuple(
        f"data/demo_1/{field}"
        for field in ("obs/state", "next_obs/state", "obs/goal", "next_obs/goal", "actions")
    ),
}


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_one_value_a_step_is_a_vector_of_one(tmp_path: Path, format: str) -> None:
    """As the other libraries expect states, goals and actions; also where the robot has a single command."""
    single = [Column(name) for name in (STATE, NEXT_STATE, GOAL, ACTION)]
    rest = [column for column in COLUMNS if column.name not in (STATE, ACTION)]
    with writer(tmp_path / "set", columns=[*single, *rest]) as open_writer:
        for number in range(2):
            values = np.arange(6, dtype=np.float32)
            mine = {STATE: values[:-1], NEXT_STATE: values[1:], GOAL: values[:-1], ACTION: values[:-1]}
            open_writer.add(Episode(number, fake_columns(5, seed=1) | mine))
    dataset, out = Dataset.open(tmp_path / "set"), tmp_path / FILES[format]
    export(dataset, out, format=format)
    with h5py.File(out / "data/main_data.hdf5" if format == "minari" else out) as file:
        shapes = {field: file[field].shape for field in VECTORS_OF[format]}
        rewards = {"d4rl": "rewards", "minari": "episode_1/rewards", "robomimic": "data/demo_1/rewards"}
        assert format not in rewards or len(file[rewards[format]].shape) == 1
    width = 2 if format == "d3rlpy" else 1
    assert {shape[1:] for field, shape in shapes.items() if "actions" not in field} == {(width,)}
    assert {shape[1:] for field, shape in shapes.items() if "actions" in field} == {(1,)}
    import_dataset([out], out=tmp_path / "back")
    assert Dataset.open(tmp_path / "back").content_hash == dataset.content_hash


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_a_value_that_differs_is_never_shown(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str
) -> None:
    class Altering(ContentHash):
        def update(self, name: str, values: Array) -> None:
            super().update(name, values)
            if name == REWARD and values.any():
                values[0] = 0.25

    monkeypatch.setattr(export_record, "ContentHash", Altering)
    with pytest.raises(CorruptDatasetError, match=r"was not written: .*next\.reward differs from what"):
        export(dataset, tmp_path / FILES[format], format=format)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "mapping", [None, 'name = "a"\ntask = "a"\nfps = 1\n[columns.a]\nfields = ["rewards"]']
)
def test_an_altered_export_is_not_imported(dataset: Dataset, tmp_path: Path, mapping: str | None) -> None:
    file = None
    if mapping:
        file = tmp_path / "mapping.toml"
        file.write_text(mapping)
    export(dataset, tmp_path / "set.hdf5", format="d4rl")
    with h5py.File(tmp_path / "set.hdf5", "r+") as opened:
        opened["next_observations"][20] = 0
    with pytest.raises(CorruptDatasetError, match=r"incomplete: next\.observation\.state differs"):
        import_dataset([tmp_path / "set.hdf5"], file, out=tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_an_altered_record_is_told(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.hdf5", format="d4rl")
    with h5py.File(tmp_path / "set.hdf5", "r+") as opened:
        record = json.loads(opened[RECORD][()])
        del opened[RECORD]
        opened[RECORD] = json.dumps(record | {"lengths": [7, -1], "uids": "none"})
    with pytest.raises(CorruptDatasetError, match=r"record of the export is malformed \(uids: .*; lengths"):
        import_dataset([tmp_path / "set.hdf5"], out=tmp_path / "back")


def test_rows_that_are_missing_are_told(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.hdf5", format="robomimic")
    with h5py.File(tmp_path / "set.hdf5", "r+") as opened:
        del opened["data/demo_4"]
    with pytest.raises(CorruptDatasetError, match="altered or is incomplete: "):
        import_dataset([tmp_path / "set.hdf5"], out=tmp_path / "back")


def test_exports_are_imported_one_by_one(dataset: Dataset, tmp_path: Path) -> None:
    paths = [tmp_path / "one.hdf5", tmp_path / "two.hdf5"]
    for path in paths:
        export(dataset, path, format="d4rl")
    with pytest.raises(BadInputError, match="import each export separately, then merge"):
        import_dataset(paths, out=tmp_path / "back")
    (tmp_path / "a").mkdir()
    foreign = tmp_path / "a" / "foreign.hdf5"
    with h5py.File(foreign, "w") as file:
        file["rewards"] = np.zeros(3)
    with pytest.raises(BadInputError, match=r"two\.hdf5 is an export of astra-data: import each"):
        import_dataset([foreign, paths[1]], out=tmp_path / "back")


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_a_column_called_as_a_field_of_the_format_has_one_of_its_own(tmp_path: Path, format: str) -> None:
    columns = [*COLUMNS, Column(GOAL, size=2), Column("goal"), NEXT]
    with writer(tmp_path / "set", columns=columns) as open_writer:
        values = fake_columns(4, seed=1)
        values |= {NEXT_STATE: np.roll(values[STATE], -1, axis=0), GOAL: np.ones((4, 2), np.float32)}
        open_writer.add(Episode(1, values | {"goal": np.full(4, 2, np.float32)}))
    export(Dataset.open(tmp_path / "set"), tmp_path / FILES[format], format=format)
    back = Dataset.open(import_dataset([tmp_path / FILES[format]], out=tmp_path / "back").root)
    episode = next(back.episodes())
    assert (episode.columns["goal"] == 2).all() and (episode.columns[GOAL] == 1).all()


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_without_rewards_zeros_are_written_aloud_and_do_not_come_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, format: str
) -> None:
    columns = [column for column in COLUMNS if column.name != REWARD]
    with writer(tmp_path / "set", columns=[*columns, NEXT]) as open_writer:
        values = fake_columns(4, seed=1)
        del values[REWARD]
        state = values[STATE]
        open_writer.add(Episode(1, values | {NEXT_STATE: np.concatenate([state[1:], state[:1]])}))
    dataset = Dataset.open(tmp_path / "set")
    export(dataset, tmp_path / FILES[format], format=format)
    assert caplog.messages == ["fake@data-1.0.0 has no next.reward: rewards are written as 0"]
    import_dataset([tmp_path / FILES[format]], out=tmp_path / "back")
    assert Dataset.open(tmp_path / "back").content_hash == dataset.content_hash


def test_a_full_disk_leaves_one_line_and_nothing_else(dataset: Dataset, tmp_path: Path) -> None:
    cases = []
    for format, name in FILES.items():
        whole = tmp_path / "whole" / format / name
        export(dataset, whole, format=format)
        size = (whole / "data/main_data.hdf5" if whole.is_dir() else whole).stat().st_size
        cases += [(format, name, int(size * share)) for share in (0, 0.5, 0.97)]
    command = [sys.executable, full_disk.__file__, str(dataset.root), str(tmp_path), json.dumps(cases)]
    settings = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # it forks
    done = subprocess.run(command, env=settings, capture_output=True, text=True, check=True)
    results = json.loads(done.stdout)
    assert len(results) == len(cases) == 12
    for number, (status, line) in enumerate(results):
        assert (status, line.count("\n")) == (1, 1), (cases[number], line)
        assert "cannot be written: a file would be larger than is allowed" in line
        assert not (tmp_path / str(number)).exists()


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_nothing_is_overwritten_and_nothing_half_is_left(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str
) -> None:
    out = tmp_path / "random-v0"
    with monkeypatch.context() as patch:
        patch.setattr(Dataset, "episodes", lambda *_: iter([1]))
        with pytest.raises((AttributeError, TypeError)):
            export(dataset, out, format=format)
    assert list(tmp_path.iterdir()) == []
    out.write_text("mine")
    with pytest.raises(BadInputError, match="exists already"):
        export(dataset, out, format=format)
    assert out.read_text() == "mine"


def test_what_is_missing_is_told(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadInputError, match=r"format 'd4lr': unknown: did you mean 'd4rl'\?"):
        export(dataset, tmp_path / "a", format="d4lr")
    with pytest.raises(BadInputError, match=r"it lacks next\.observation\.state"):
        export(write_fake(tmp_path / "bare"), tmp_path / "a", format="d4rl")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(BadInputError, match=r"h5py is needed but not installed: uv sync --extra hdf5$"):
        export(dataset, tmp_path / "a", format="d4rl")
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(BadInputError, match="uv sync --extra minari"):
        export(dataset, tmp_path / "a", format="minari")


def test_the_command_exports(dataset: Dataset, tmp_path: Path) -> None:
    arguments = ["export", str(dataset.root), "--format", "d4rl", "--out", str(tmp_path / "set.hdf5")]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.output == f"finished: {tmp_path / 'set.hdf5'}\n"
