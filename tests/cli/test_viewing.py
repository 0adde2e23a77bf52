from pathlib import Path

import pytest
from command_line import call, output_of
from fake_dataset import write_fake

from astra_data.core.errors import BadInputError


def test_a_name_is_that_of_a_dataset_beside_a_folder_of_that_name(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_fake(home / "walks/data-1.0.0")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walks").mkdir()  # as `astra-data new walks` makes it
    assert output_of("view", "walks", "--save", "walks.rrd") == "written: walks.rrd\n"
    assert (tmp_path / "walks.rrd").stat().st_size > 0


def test_what_is_neither_dataset_nor_run_is_told(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "logs").mkdir()
    for place, fault in (("logs", "got neither: name the folder"), ("walk", "no dataset 'walk'")):
        result = call("view", place, "--save", "logs.rrd")
        assert isinstance(result.exception, BadInputError) and fault in str(result.exception)
    root = write_fake(tmp_path / "set").root
    result = call("view", str(root), "--seed", "1")
    assert "--seed is for the folder of a run" in str(result.exception)
