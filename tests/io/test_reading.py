"""What is told of files that cannot be imported, and how they are left out."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from recordings import LOG, MAPPING, imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Array
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import import_dataset


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
    assert lines[1].startswith("3.csv: no field 'gait'") and lines[2].startswith("4.csv")
    assert len(lines) == 3 and not (tmp_path / "out").exists()


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
    assert names == [path.name for path in paths]
    one_log = MAPPING.replace('[columns."next.terminated"]\nfields = ["fell"]\n', "").replace(
        'field = "trial"', "files = false"
    )
    joined, _ = imported(tmp_path / "joined", tmp_path, one_log, skip_bad=True)
    assert joined.lengths.tolist() == [19, 19]  # no step leads from the first file to the last


def test_an_episode_that_is_bad_is_left_out_and_its_file_is_not(tmp_path: Path) -> None:
    """Of three trials in each file."""
    paths = [write_table(tmp_path / f"{number}.csv", rows(number)) for number in range(3)]
    damaged = rows(1)
    damaged["x"][6], damaged["command"][7] = np.nan, np.inf
    write_table(paths[1], damaged)
    whole, _ = imported(tmp_path / "whole", [write_table(tmp_path / "w" / f"{k}.csv", rows(k)) for k in range(3)])
    dataset, report = imported(tmp_path, paths, skip_bad=True)
    assert report.left_out == ("1.csv line 8: a value is not finite: its episode is left out",)
    kept = [episode for number, episode in enumerate(whole.episodes()) if number != 4]
    for episode, expected in zip(dataset.episodes(), kept, strict=True):
        for name, values in expected.columns.items():
            if name != "episode_uid":
                np.testing.assert_array_equal(episode.columns[name], values)
    with pytest.raises(BadInputError, match=r"2 of 60 rows .*: x in 1 row, 1\.csv line 8; command in 1 row, 1\.csv l"):
        imported(tmp_path / "refused", paths)


def test_a_demonstration_that_is_bad_is_left_out_and_its_file_is_not(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for number in range(5):
            fields = {name: values[:6] for name, values in rows(number).items()}
            if number == 1:
                del fields["command"]
            if number == 2:
                fields["gait"] = fields["gait"][:3]
            if number == 3:
                fields["gait"] = fields["gait"] + 0.5
            for name, values in fields.items():
                file[f"demo_{number}/{name}"] = values
    mapping = 'episodes = "demo_*"\n' + MAPPING
    dataset, report = imported(tmp_path, path, mapping, skip_bad=True)
    assert dataset.metadata["source"] == ["log.h5/demo_0", "log.h5/demo_4"]
    told = ["demo_1: no field 'command'", "demo_2: fields differ in their", "demo_3: columns.gait: expected whole"]
    for fault, found in zip(told, report.left_out, strict=True):
        assert found.startswith(f"log.h5/{fault}")


def test_nothing_is_imported_where_all_files_are_bad(tmp_path: Path) -> None:
    with pytest.raises(
        BadInputError, match=r"^1\.csv: no field 'command'[^\n]*\n2\.csv: no field .*\n3\.csv: no field 'gait'"
    ):
        imported(tmp_path, logs(tmp_path)[1:4], skip_bad=True)
    assert not (tmp_path / "out").exists()


def test_nothing_is_left_out_without_a_mapping(tmp_path: Path) -> None:
    path = write_table(tmp_path / "log.h5", {"observations": np.zeros((4, 2)), "actions": np.zeros((4, 1))})
    with pytest.raises(BadInputError, match="--skip-bad needs a --mapping"):
        import_dataset([path], name="log", fps=10, out=tmp_path / "out", skip_bad=True)


STACKED = f"""{LOG}[columns."observation.state"]
fields = ["state"]
[columns.action]
fields = ["command"]
"""


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".json", ".parquet", ".jsonl"])
def test_arrays_of_episodes_are_refused_or_taken_as_such(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(0)
    fields = {"state": rng.normal(size=(8, 50, 3)), "command": rng.normal(size=(8, 50, 2))}
    path = write_table(tmp_path / f"log{suffix}", fields)
    with pytest.raises(BadInputError, match=r"all fields have 50 rows in each .*: set stacked = true .* 8 epis"):
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
    with pytest.raises(BadInputError, match=r"stacked = true, but the fields' rows have the shapes \(4, 3\), \("):
        imported(tmp_path / "stacked", path, "stacked = true\n" + STACKED)


@pytest.mark.parametrize("widths", [((8, 50, 3), (8, 50), (8,)), ((8, 50), (8, 50), (8, 50))])
def test_arrays_of_few_episodes_are_told_whatever_lies_beside_them(
    tmp_path: Path, widths: tuple[tuple[int, ...], ...]
) -> None:
    """Such as a return of each episode; or numbers alone, which may be imported as episodes."""
    fields = {name: np.ones(shape) for name, shape in zip(("state", "command", "r"), widths, strict=True)}
    mapping = f'{STACKED}[columns.r]\nfields = ["r"]\n'
    path = write_table(tmp_path / "log.npz", fields)
    with pytest.raises(BadInputError, match=r"fields have 50 rows in each .* of shape \(8, 50.* 8 episodes"):
        imported(tmp_path, path, mapping)
    assert imported(tmp_path / "no", path, "stacked = false\n" + mapping)[0].lengths.tolist() == [7]
    if len(widths[2]) > 1:
        assert imported(tmp_path / "yes", path, "stacked = true\n" + mapping)[0].lengths.tolist() == [49] * 8
