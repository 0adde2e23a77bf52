from pathlib import Path

import h5py
import numpy as np
import pytest
from recordings import MAPPING, rows, write_table
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import FORMATS


def test_options_override_the_mapping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    path = write_table(tmp_path / "log.data.csv", rows()).rename(tmp_path / "log.data")
    (tmp_path / "mapping.toml").write_text(MAPPING)
    arguments = ["import", str(path), "--mapping", str(tmp_path / "mapping.toml"), "--format", "csv"]
    result = CliRunner().invoke(cli.app, [*arguments, "--name", "renamed", "--fps", "5", "--task", "run"])
    assert result.exit_code == 0, result.output
    dataset = Dataset.open(tmp_path / "home/renamed/data-1.0.0")
    assert "3 episodes, 18 frames from 20 rows" in result.output
    assert "split points: field 2" in result.output
    assert dataset.info["fps"] == 5
    assert dataset.description["stage"] == "import"
    assert dataset.description["config"]["recordings"][0]["name"] == "log.data"


def test_the_help_names_every_format() -> None:
    told = CliRunner().invoke(cli.app, ["import", "--help"], env={"COLUMNS": "200"}).output
    assert ", ".join(list(FORMATS)[:-1]) + f" or {list(FORMATS)[-1]}." in told


def test_a_known_layout_needs_no_mapping_but_a_name_and_a_rate(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "set.hdf5", "w") as file:
        file["observations"], file["actions"] = np.zeros((6, 3)), np.zeros((6, 2))
        file["rewards"], file["terminals"] = np.zeros(6), np.arange(6) == 5
    arguments = ["import", str(tmp_path / "set.hdf5"), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(cli.app, arguments)
    assert isinstance(result.exception, BadInputError)
    assert "pass --name and --fps, or --mapping FILE.toml" in str(result.exception)
    result = CliRunner().invoke(cli.app, [*arguments, "--name", "set", "--fps", "20"])
    assert result.output.startswith(f"finished: {tmp_path / 'out'}: 1 episodes, 5 frames from 6 rows in ")
    assert Dataset.open(tmp_path / "out").task == "set"


def test_bad_files_are_left_out_by_an_option(tmp_path: Path) -> None:
    good = write_table(tmp_path / "good.csv", rows())
    bad = write_table(tmp_path / "bad.csv", {"x": rows()["x"]})
    (tmp_path / "mapping.toml").write_text(MAPPING)
    arguments = ["import", str(good), str(bad), "--mapping", str(tmp_path / "mapping.toml"), "--out"]
    refused = CliRunner().invoke(cli.app, [*arguments, str(tmp_path / "refused")])
    assert isinstance(refused.exception, BadInputError) and "bad.csv: no fields" in str(refused.exception)
    result = CliRunner().invoke(cli.app, [*arguments, str(tmp_path / "out"), "--skip-bad"])
    assert result.exit_code == 0 and "left out: 1\n  bad.csv: no fields" in result.output
