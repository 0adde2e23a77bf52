from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import output_of
from fake_dataset import write_fake
from recordings import MAPPING, rows, write_table
from shared_files import contents
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError, SharingError
from astra_data.dataset.edit import subset
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
    assert "3 episodes, 18 frames from 20 rows" in result.output and "split points: field 2" in result.output
    assert dataset.info["fps"] == 5 and dataset.description["stage"] == "import"
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


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Dataset:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("astra_data.reports.figures.style.png", lambda figure: b"\x89PNG")
    monkeypatch.chdir(tmp_path)
    return write_fake(tmp_path / "fake")


def test_a_version_goes_to_a_folder_and_back(fake: Dataset, tmp_path: Path) -> None:
    place = f"file://{tmp_path}/shared"
    assert output_of("push", str(fake.root), "./shared") == f"shared: {place}/fake@data-1.0.0\n"
    home = tmp_path / "home/fake/data-1.0.0"
    assert output_of("pull", f"{place}/fake", "--version", "1.0.0") == f"fake@data-1.0.0: {home}\n"
    assert contents(home) == contents(fake.root)
    out = tmp_path / "out"
    assert output_of("pull", f"{place}/fake", "--out", str(out)) == f"fake@data-1.0.0: {out}\n"
    with pytest.raises(BadInputError, match=r"no version data-2\.0\.0"):
        output_of("pull", f"{place}/fake", "--version", "2.0.0")
    with pytest.raises(SharingError, match=r"bytes, of which at most 10 are taken"):
        output_of("pull", f"{place}/fake", "--out", str(tmp_path / "large"), "--max-bytes", "10")


def test_a_version_that_is_a_subset_of_another_is_told(fake: Dataset, tmp_path: Path) -> None:
    subset(fake, percent=40, out=tmp_path / "part")
    place, note = f"file://{tmp_path}/shared", "note: it was made by subset from fake@data-1.0.0; "
    output_of("push", str(fake.root), "./shared")
    newest = "who pulls without a version gets the newest that is there"
    assert output_of("push", "part", "./shared") == f"shared: {place}/fake@data-1.1.0\n{note}{newest}\n"
    home = tmp_path / "home/fake/data-1.1.0"
    shown = f"fake@data-1.1.0: {home}\n{note}--version takes another\n"
    assert output_of("pull", f"{place}/fake") == shown


def test_a_card_is_written_with_its_notes(fake: Dataset, tmp_path: Path) -> None:
    (tmp_path / "notes.toml").write_text('license = "mit"\n')
    assert (
        output_of("export", str(fake.root), "--format", "card", "--out", "fake.md")
        == "written: fake.md\nwritten: fake-coverage.png\n"
    )
    assert "license: unknown" in (tmp_path / "fake.md").read_text()
    out = tmp_path / "it.md"
    output_of("export", str(fake.root), "--format", "card", "--out", str(out), "--notes", "notes.toml")
    assert "license: mit" in out.read_text()


def test_private_is_for_the_hub(fake: Dataset) -> None:
    with pytest.raises(BadInputError, match="private is for the Hugging Face Hub"):
        output_of("push", str(fake.root), "./shared", "--private")
