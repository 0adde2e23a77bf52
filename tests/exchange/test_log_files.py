from pathlib import Path

import pytest
from fake_dataset import write_fake

from astra_data.core.errors import BadInputError
from astra_data.core.naming import RECORD
from astra_data.exchange.log_files import csv_files


def test_a_folder_stands_for_its_logs(tmp_path: Path) -> None:
    for name in ("b.csv", "a.TSV", "bag.mcap", "notes.txt"):
        (tmp_path / name).touch()
    assert csv_files(tmp_path) == [tmp_path / "a.TSV", tmp_path / "b.csv"]
    assert csv_files(tmp_path / "b.csv") == [tmp_path / "b.csv"]


@pytest.mark.parametrize("name", ["drive_0.mcap", "drive/drive_0.mcap", "drive/drive_0.db3", "drive.MCAP"])
def test_bags_are_to_be_imported_first(tmp_path: Path, name: str) -> None:
    bags = tmp_path / "my bags"
    (bags / name).parent.mkdir(parents=True)
    (bags / name).touch()
    for place in {bags, (bags / name).parent, bags / name}:
        told = f"got a ROS recording, {Path(name).name}: "
        expected = rf"{told}.*import '{place}' --mapping recipes/imports/ros2_base\.toml"
        with pytest.raises(BadInputError, match=expected) as raised:
            csv_files(place)
        assert "recipes copy ros2_base" in str(raised.value) and "--from NAME" in str(raised.value)


def test_what_is_there_in_place_of_logs_is_told(tmp_path: Path) -> None:
    write_fake(tmp_path / "walks/data-1.0.0")
    with pytest.raises(
        BadInputError, match=r"walks contains versions of a dataset: name one of data-1\.0\.0"
    ):
        csv_files(tmp_path / "walks")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / RECORD).touch()
    with pytest.raises(BadInputError, match="run is a run; it has no datasets yet"):
        csv_files(tmp_path / "run")
    with pytest.raises(BadInputError, match="nothing: no such file, folder or dataset"):
        csv_files(tmp_path / "nothing")
