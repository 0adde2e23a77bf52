"""What is told of files that cannot be imported, and how they are left out."""

from pathlib import Path

import numpy as np
import pytest
from recordings import MAPPING, imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import Array
from astra_data.exchange.importing import import_dataset


def without(name: str) -> dict[str, Array]:
    return {field: values for field, values in rows().items() if field != name}


def logs(folder: Path) -> list[Path]:
    """Write six logs, of which the first and last are good."""
    paths = [write_table(folder / f"{number}.csv", rows()) for number in range(6)]
    for path in paths[1:3]:
        write_table(path, without("command"))
    write_table(paths[3], without("gait"))
    write_table(paths[4], rows() | {"x": np.full(20, "far")})
    return paths


def test_all_files_that_cannot_be_read_are_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        imported(tmp_path, logs(tmp_path))
    lines = str(caught.value).splitlines()
    assert lines[0].startswith("1.csv, 2.csv: no field 'command'")
    assert lines[1].startswith("3.csv: no field 'gait'")
    assert lines[2].startswith("4.csv")
    assert len(lines) == 3 and not (tmp_path / "out").exists()


def test_a_file_alone_is_told_as_before(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"^3\.csv: no field 'gait'[^\n]*$"):
        imported(tmp_path, logs(tmp_path)[3])


def test_bad_files_are_left_out_where_that_is_asked_for_and_told(tmp_path: Path) -> None:
    paths = logs(tmp_path)
    alone, _ = imported(tmp_path / "alone", [paths[0], paths[5]])
    dataset, report = imported(tmp_path, paths, skip_bad=True)
    for episode, expected in zip(dataset.episodes(), alone.episodes(), strict=True):
        for name, values in expected.columns.items():
            np.testing.assert_array_equal(episode.columns[name], values)
    assert dataset.metadata["source"] == alone.metadata["source"]
    told = str(report)
    assert "\nfiles that cannot be imported, left out: 4\n  1.csv: no field 'command'" in told
    assert "\n  2.csv: no field 'command'" in told and "\n  3.csv: no field 'gait'" in told
    assert len(report.left_out) == 4 and "\n  4.csv" in told
    assert Dataset.open(report.root).description["left_out"] == list(report.left_out)
    names = [one["name"] for one in dataset.description["config"]["recordings"]]
    assert names == ["0.csv", "5.csv"]


def test_a_file_that_is_bad_in_its_midst_is_left_out_as_a_whole(tmp_path: Path) -> None:
    """Values that are not finite are found after an episode is complete."""
    paths = [write_table(tmp_path / f"{number}.csv", rows()) for number in range(2)]
    damaged = rows()
    damaged["x"][-1] = np.nan
    write_table(paths[0], damaged)
    dataset, report = imported(tmp_path, paths, skip_bad=True)
    assert set(dataset.metadata["source"]) == {"1.csv"}
    assert "1 of 20 rows have values that are not finite; the first is 0.csv line 21" in report.left_out[0]


def test_a_file_with_columns_of_other_sizes_is_left_out(tmp_path: Path) -> None:
    """Each can be imported by itself, but not all together."""
    mapping = """
name = "log"
task = "walk"
fps = 10
[columns."observation.state"]
fields = ["state"]
[columns.action]
fields = ["command"]
"""
    paths = [
        write_table(tmp_path / f"{number}.npz", {"state": np.zeros((4, size)), "command": np.zeros(4)})
        for number, size in enumerate((2, 3, 2))
    ]
    dataset, report = imported(tmp_path, paths, mapping, skip_bad=True)
    assert dataset.metadata["source"] == ["0.npz", "2.npz"]
    assert report.left_out == ("1.npz: observation.state has 3 values, in the files before 2",)


def test_nothing_is_imported_where_all_files_are_bad(tmp_path: Path) -> None:
    with pytest.raises(
        BadInputError, match=r"^1\.csv, 2\.csv: no field 'command'[^\n]*\n3\.csv: no field 'gait'"
    ):
        imported(tmp_path, logs(tmp_path)[1:4], skip_bad=True)
    assert not (tmp_path / "out").exists()


def test_nothing_is_left_out_without_a_mapping(tmp_path: Path) -> None:
    path = write_table(tmp_path / "log.h5", {"observations": np.zeros((4, 2)), "actions": np.zeros((4, 1))})
    with pytest.raises(BadInputError, match="--skip-bad needs a --mapping"):
        import_dataset([path], name="log", fps=10, out=tmp_path / "out", skip_bad=True)


def test_a_good_import_tells_of_nothing_left_out(tmp_path: Path) -> None:
    for skip_bad in (False, True):
        folder = tmp_path / str(skip_bad)
        dataset, report = imported(
            folder, write_table(tmp_path / "log.csv", rows()), MAPPING, skip_bad=skip_bad
        )
        assert "imported, left out" not in str(report) and "left_out" not in dataset.description


STACKED = """
name = "log"
task = "walk"
fps = 10
[columns."observation.state"]
fields = ["state"]
[columns.action]
fields = ["command"]
"""


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".json", ".parquet", ".jsonl"])
def test_arrays_of_episodes_are_refused_or_taken_as_such(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(0)
    fields = {"state": rng.normal(size=(8, 50, 3)), "command": rng.normal(size=(8, 50, 2))}
    path = write_table(tmp_path / f"log{suffix}", fields)
    with pytest.raises(
        BadInputError, match=r"all fields have 50 rows in each .*: set stacked = true .* 8 epis"
    ):
        imported(tmp_path, path, STACKED)
    dataset, _ = imported(tmp_path / "yes", path, "stacked = true\n" + STACKED)
    assert dataset.lengths.tolist() == [49] * 8
    assert dataset.metadata["source"] == [f"log{suffix}/{number}" for number in range(8)]
    for episode, states in zip(dataset.episodes(), fields["state"], strict=True):
        np.testing.assert_array_equal(episode.columns["observation.state"], states[:-1].astype(np.float32))
    dataset, _ = imported(tmp_path / "no", path, "stacked = false\n" + STACKED)
    assert (dataset.lengths.tolist(), dataset.schema[0].size) == ([7], 150)


@pytest.mark.parametrize("command", [(200, 2), (200,), (200, 12)])
def test_rows_of_matrices_are_no_episodes(tmp_path: Path, command: tuple[int, ...]) -> None:
    """Such as the positions of four feet."""
    path = write_table(tmp_path / "log.npz", {"state": np.zeros((200, 4, 3)), "command": np.zeros(command)})
    dataset, _ = imported(tmp_path, path, STACKED)
    assert (dataset.lengths.tolist(), dataset.schema[0].size) == ([199], 12)
    with pytest.raises(
        BadInputError, match=r"stacked = true, but the fields' rows have the shapes \(4, 3\), \("
    ):
        imported(tmp_path / "stacked", path, "stacked = true\n" + STACKED)


def test_a_batch_in_d4rls_layout_is_episodes(tmp_path: Path) -> None:
    fields = {
        "observations": np.zeros((8, 50, 3)),
        "actions": np.zeros((8, 50, 2)),
        "rewards": np.ones((8, 50)),
    }
    dataset, _ = imported(tmp_path, write_table(tmp_path / "log.h5", fields), None, name="log", fps=10)
    assert dataset.lengths.tolist() == [49] * 8
    assert dataset.metadata["return"] == [49.0] * 8
