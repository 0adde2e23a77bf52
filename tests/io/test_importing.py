import os
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import LENGTHS, MAPPING, STEPS, imported, rows, write_table
from scipy.io import savemat

from astra_data.core.errors import BadInputError, RecipeError
from astra_data.dataset.columns import STATE
from astra_data.io.cutting import Cutter, Tally
from astra_data.io.importing import ImportReport, import_dataset

PER_FILE = MAPPING.replace('field = "trial"', "")
ONE_LOG = PER_FILE.replace('[columns."next.terminated"]\nfields = ["fell"]\n', "") + "files = false\n"


def parts(folder: Path) -> list[Path]:
    """Write the trials to files of their own."""
    fields = rows()
    return [
        write_table(folder / f"part_{8 + trial}.csv", {name: v[fields["trial"] == trial] for name, v in fields.items()})
        for trial in range(len(LENGTHS))
    ]


def test_each_file_is_an_episode(tmp_path: Path) -> None:
    dataset, report = imported(tmp_path, parts(tmp_path / "logs"), PER_FILE)
    assert dataset.lengths.tolist() == list(STEPS) and report.tally.split_points == {"file": 2}
    assert dataset.metadata["source"] == ["part_8.csv", "part_9.csv", "part_10.csv"]


def test_the_files_of_a_folder_or_archive_continue_one_another(tmp_path: Path) -> None:
    folder = parts(tmp_path / "logs")[0].parent
    with tarfile.open(tmp_path / "logs.tar.gz", "w:gz") as archive:
        archive.add(folder, "logs")
    state = rows()
    expected = np.stack([state["x"], state["y"]], axis=1)[:-1] * 0.001
    for recording in (folder, tmp_path / "logs.tar.gz"):
        dataset, report = imported(tmp_path / f"from{recording.suffix}", recording, ONE_LOG)
        np.testing.assert_array_equal(dataset.columns([STATE])[STATE], expected.astype(np.float32))
        assert len(dataset) == 1
        assert report.unused == ()  # all files are in it
    both, report = imported(tmp_path / "both", [folder, tmp_path / "logs.tar.gz"], ONE_LOG)
    assert len(both) == 2 and report.tally.split_points == {"file": 1}


def with_times(tmp_path: Path, seconds: np.ndarray[Any, Any]) -> Tally:
    path = write_table(tmp_path / "log.npz", rows() | {"unused": seconds, "fell": np.zeros(20, bool)})
    _, report = imported(tmp_path, path, 'time = "unused"\n' + PER_FILE)
    return report.tally


def test_time_that_goes_back_begins_an_episode_and_is_told(tmp_path: Path) -> None:
    tally = with_times(tmp_path, np.arange(20) % 8 / 10)
    assert tally.split_points == {"back": 2} and (tally.back_rows, tally.back_first) == (2, "log.npz row 8")


def test_rows_at_the_same_time_are_told_with_their_place(tmp_path: Path) -> None:
    """Once, wherever blocks end; a time that is not known stands still nowhere."""
    seconds = np.arange(20) / 10
    seconds[[5, 6, 12]] = seconds[[4, 4, 11]]
    tally = with_times(tmp_path, seconds)
    assert (tally.still_rows, tally.still_first, tally.split_points) == (3, "log.npz row 5", {})
    (tmp_path / "twice").mkdir()
    for still, times in ((10, np.repeat(np.arange(10), 2) / 10), (19, np.zeros(20))):
        with pytest.raises(
            BadInputError, match=rf"stands still in {still} of 20 rows, first in .* row 1: expected one"
        ):
            with_times(tmp_path / "twice", times)
    seconds[:] = np.arange(20) / 10
    seconds[7] = np.nan
    path = write_table(tmp_path / "unknown.npz", rows() | {"unused": seconds, "fell": np.zeros(20, bool)})
    extra = 'time = "unused"\nnot_finite = "drop"\n' + PER_FILE
    (tmp_path / "unknown").mkdir()
    assert imported(tmp_path / "unknown", path, extra)[1].tally.still_rows == 0


def test_times_in_no_order_are_told_with_their_place(tmp_path: Path) -> None:
    seconds = np.random.default_rng(0).permutation(20) / 10
    first = int((np.diff(seconds) < 0).argmax()) + 1
    back = int((np.diff(seconds) < 0).sum())
    with pytest.raises(
        BadInputError, match=rf"fps is 10: .*time goes back in {back} rows, first in log.npz row {first}: sort"
    ):
        with_times(tmp_path, seconds)


def test_recordings_that_do_not_fit_are_all_told(tmp_path: Path) -> None:
    csv, npz = (write_table(tmp_path / name, rows()) for name in ("a.csv", "b.npz"))
    with pytest.raises(BadInputError) as caught:
        imported(tmp_path, [tmp_path / "none.csv", csv, npz, tmp_path / "mapping.toml"])
    for told in ("none.csv does not exist", "of one format, got", "mapping.toml: its format cannot be inf"):
        assert told in str(caught.value)


def test_a_dataset_needs_no_import(tmp_path: Path) -> None:
    dataset, _ = imported(tmp_path / "my own", write_table(tmp_path / "a.csv", rows()))
    told = f"is a LeRobot dataset, not logs, and needs no import: .*`astra-data inspect '{dataset.root}'`, or"
    for mapping in (None, MAPPING):
        with pytest.raises(BadInputError, match=told):
            imported(tmp_path / "again", dataset.root, mapping)


def test_formats_that_need_seeking_are_not_read_from_archives(tmp_path: Path) -> None:
    path = write_table(tmp_path / "a.npz", rows())
    with tarfile.open(tmp_path / "a.tar", "w") as archive:
        archive.add(path, "a.npz")
    with pytest.raises(BadInputError, match="npz cannot be read from an archive: unpack it"):
        imported(tmp_path, tmp_path / "a.tar")


def test_a_mapping_with_a_format_that_does_not_exist_is_told(tmp_path: Path) -> None:
    path = write_table(tmp_path / "a.csv", rows())
    with pytest.raises(BadInputError, match="no format 'cvs': did you mean 'csv'"):
        imported(tmp_path, path, 'format = "cvs"\n' + MAPPING)


def test_a_name_that_is_not_utf8_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    path = write_table(tmp_path / "log.csv", rows())
    os.rename(os.fsencode(path), os.fsencode(tmp_path) + b"/log\xff.csv")
    with pytest.raises(BadInputError, match=r"'log\\udcff\.csv': expected a name in UTF-8; rename the file"):
        imported(tmp_path, [tmp_path / os.fsdecode(b"log\xff.csv")], PER_FILE)


def test_no_recordings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="expected one recording or more to import, got none"):
        import_dataset(sorted(tmp_path.glob("*.csv")))


def test_an_episode_that_does_not_fit_into_memory_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(self: object, **_: object) -> Iterator[object]:
        raise MemoryError("Unable to allocate 3.3 GiB")
        yield

    monkeypatch.setattr(Cutter, "cut", none_left)
    with pytest.raises(BadInputError, match=r"does not fit into memory \(Unable to .*\[split\]"):
        imported(tmp_path, write_table(tmp_path / "log.npz", rows()))


def test_what_an_archive_unpacks_to_is_bounded_over_all_its_blocks(tmp_path: Path) -> None:
    text = write_table(tmp_path / "log.csv", rows()).read_text()
    head, _, body = text.partition("\n")
    (tmp_path / "log.csv").write_text(head + "\n" + body * 10)
    (tmp_path / "mapping.toml").write_text(MAPPING)
    # Seven fields of 200 rows, eight bytes each.
    with pytest.raises(BadInputError, match=r"log.csv holds values of 11200 bytes or more, .* --max-bytes"):
        import_dataset([tmp_path / "log.csv"], tmp_path / "mapping.toml", out=tmp_path / "out", max_bytes=11_199)
    assert not (tmp_path / "out").exists()
    import_dataset([tmp_path / "log.csv"], tmp_path / "mapping.toml", out=tmp_path / "out", max_bytes=11_200)


def test_what_is_given_beside_a_mapping_overrides_it(tmp_path: Path) -> None:
    log = write_table(tmp_path / "log.npz", rows())
    dataset, _ = imported(tmp_path, log, name="strolls", fps=25, task="stroll")
    assert (dataset.description["name"], dataset.info["fps"], dataset.task) == ("strolls", 25, "stroll")


def csv_logs(folder: Path, *texts: str) -> Path:
    (folder / "logs").mkdir()
    for number, text in enumerate(texts):
        (folder / f"logs/{number}.csv").write_text(text)
    mapping = folder / "logs.toml"
    mapping.write_text(
        'name = "logs"\ntask = "t"\nfps = 10\ntime = "t"\nnot_finite = "split"\n[split]\ngap_s = 0.5\n'
        '[columns."observation.state"]\nfields = ["x"]\n[columns.action]\nfields = ["a"]\n'
    )
    return mapping


def drive(rows: int, period: float = 0.1) -> str:
    return "t,x,a\n" + "".join(f"{row * period},{row},{row}\n" for row in range(rows))


def test_files_of_which_nothing_is_left_are_named(tmp_path: Path) -> None:
    mapping = csv_logs(tmp_path, drive(9), drive(1), drive(5))
    report = import_dataset([tmp_path / "logs"], mapping, out=tmp_path / "out")
    assert (report.episodes, report.unused) == (2, ("1.csv",))
    assert "\nfiles without an episode: 1.csv\n" in str(report)


@pytest.mark.parametrize("begun", ["", "t,x", "t,x,a", "t,x,a\n"])
def test_a_file_without_a_row_is_one_without_an_episode(tmp_path: Path, begun: str) -> None:
    mapping = csv_logs(tmp_path, begun, drive(9), begun, drive(5))
    report = import_dataset([tmp_path / "logs"], mapping, out=tmp_path / "out")
    assert (report.episodes, report.unused) == (2, ("0.csv", "2.csv"))
    with pytest.raises(BadInputError, match=r"0\.csv: no episodes"):
        import_dataset([tmp_path / "logs/0.csv"], mapping, out=tmp_path / "none")


def test_files_of_other_endings_are_named(tmp_path: Path) -> None:
    mapping = csv_logs(tmp_path, drive(9))
    logs = tmp_path / "logs"
    names = ("drive_10.txt", "drive_3.csv.gz", "drive_4.TSV", "map.toml", "README", "readme.txt", "notes.md", ".x")
    for name in names:
        (logs / name).write_text(drive(9).replace(",", "\t"))
    report = import_dataset([logs], mapping, out=tmp_path / "out")
    assert report.unread == ("drive_3.csv.gz", "drive_10.txt")
    assert "\nfiles of other endings, not read: drive_3.csv.gz, drive_10.txt\n" in str(report)
    with tarfile.open(tmp_path / "logs.tar", "w") as archive:
        archive.add(logs, "logs")
    report = import_dataset([tmp_path / "logs.tar"], mapping, out=tmp_path / "again")
    assert report.unread == ("logs.tar/logs/drive_3.csv.gz", "logs.tar/logs/drive_10.txt")
    assert import_dataset([logs / "0.csv"], mapping, out=tmp_path / "one").unread == ()


def test_a_second_import_is_told_to_raise_the_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mapping = csv_logs(tmp_path, drive(9))
    import_dataset([tmp_path / "logs"], mapping, out=tmp_path / "out")
    with pytest.raises(BadInputError, match=r"out exists already: give another --out, or delete it"):
        import_dataset([tmp_path / "logs"], mapping, out=tmp_path / "out")
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    import_dataset([tmp_path / "logs"], mapping)
    told = r"data-1\.0\.0 exists already: raise `version` in the mapping \(now 1\.0\.0\), give another --name"
    with pytest.raises(BadInputError, match=told):
        import_dataset([tmp_path / "logs"], mapping)


@pytest.mark.parametrize(
    ("split", "log", "why"),
    [
        (
            "[split]",
            "t,x,a\n" + "".join(f"{row / 10},{row},{row}\n" for row in range(20, 0, -1)),
            "'t' goes back in 19 rows, first in 0.csv line 3: sort the rows by it",
        ),
        ('[split]\nfield = "x"', drive(20), "'x' changes in 19 rows: sort by it, or write a file of each"),
    ],
)
def test_what_cuts_every_row_is_named(tmp_path: Path, split: str, log: str, why: str) -> None:
    mapping = csv_logs(tmp_path, log)
    mapping.write_text(mapping.read_text().replace("[split]", split))
    with pytest.raises(BadInputError, match=f"no episodes, {why}"):
        import_dataset([tmp_path / "logs"], mapping, out=tmp_path / "out")


def test_times_are_scaled_to_seconds(tmp_path: Path) -> None:
    """A log in ms, with a silence of 0.7 s: gaps and rate count in seconds."""
    lines = [*drive(9, 100).splitlines(), *(f"{1500 + 100 * row},{row},{row}" for row in range(9))]
    mapping = csv_logs(tmp_path, "\n".join(lines) + "\n")
    mapping.write_text(mapping.read_text().replace("[split]", "time_scale = 0.001\n[split]"))
    report = import_dataset([tmp_path / "logs"], mapping, out=tmp_path / "out")
    assert report.episodes == 2 and report.tally.split_points == {"gap": 1}
    assert report.tally.clock.startswith("10 Hz declared, 10 Hz by t")


@pytest.mark.parametrize(
    ("set_keys", "told"),
    [
        ("[split]\ngap_s = 0.5", r"split\.gap_s without `time`"),
        ("time_scale = 0.001\n[split]", "time_scale without `time`"),
        ("time_scale = 0.001\n[split]\ngap_s = 0.5", r"split\.gap_s and time_scale without `time`"),
    ],
)
def test_keys_about_times_need_a_time(tmp_path: Path, set_keys: str, told: str) -> None:
    mapping = csv_logs(tmp_path, drive(9))
    text = mapping.read_text().replace('time = "t"\n', "")
    mapping.write_text(text.replace("[split]\ngap_s = 0.5", set_keys))
    with pytest.raises(RecipeError, match=f"logs.toml: {told}: set time to the field with the times"):
        import_dataset([tmp_path / "logs"], mapping, out=tmp_path / "out")
    mapping.write_text(text.replace("[split]\ngap_s = 0.5", "time_scale = 1.0\n[split]"))
    assert import_dataset([tmp_path / "logs"], mapping, out=tmp_path / "out").episodes == 1


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("log.npy", r"log\.npy is a NumPy array without a name: .*numpy\.savez"),
        ("log.csv.gz", r"log\.csv\.gz is compressed: unpack it \(gunzip"),
        ("log.bag", r"log\.bag is a bag of ROS 1: run `uvx --from rosbags rosbags-convert"),
        ("log.ulg", r"log\.ulg is a log of PX4: run `uvx --from pyulog ulog2csv FILE`, .*joined by time"),
        ("rlds/1.0.0/demos.tfrecord-00000-of-00001", r"RLDS \(TensorFlow Datasets\): .*numpy\.savez"),
        ("log.zarr/.zgroup", r"\.zgroup is Zarr: save its arrays"),
        ("log.zarr/zarr.json", r"zarr\.json is Zarr: save its arrays"),
        ("bag/bag_0.db3", r"bag_0\.db3 is a bag of ROS 2 in SQLite, .*ros2 bag convert -i BAG"),
        ("log.mcap.zstd", r"log\.mcap\.zstd is compressed: unpack it \(.*unzstd"),
        ("log.pkl", r"log\.pkl is a pickle, which is code and never run"),
    ],
)
def test_formats_that_are_not_read_are_named_with_what_to_do(tmp_path: Path, name: str, told: str) -> None:
    path = tmp_path / "logs" / name
    path.parent.mkdir(parents=True)
    path.write_bytes(b"{}")
    for place in (tmp_path / "logs" / name.partition("/")[0], tmp_path / "logs"):
        with pytest.raises(BadInputError, match=rf"{place.name}: {told}[^\n]*$"):
            imported(tmp_path / "out", place)
    with pytest.raises(BadInputError, match=told):
        imported(tmp_path / "out", tmp_path / "logs", file_format="csv")


def test_matlabs_older_format_is_named_with_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "log.mat"
    savemat(path, {name: values for name, values in rows().items()})
    with pytest.raises(BadInputError, match=r"log\.mat is of MATLAB's format 5, .*save\('NEW\.mat', '-v7\.3'\)"):
        imported(tmp_path / "out", path)


def test_fields_that_are_not_finite_are_named_with_their_places(tmp_path: Path) -> None:
    fields = rows() | {"y": np.full(20, np.nan)}
    fields["command"][[3, 7]], fields["x"][5] = np.inf, np.nan
    path = write_table(tmp_path / "log.csv", fields)
    told = "y is empty in all 20 rows: leave it out; x in 1 row, log.csv line 7; command in 2 rows, "
    told += "first log.csv line 5"
    with pytest.raises(BadInputError, match=f"20 of 20 rows have values that are not finite: {told}; set not_finite"):
        imported(tmp_path / "refuse", path)
    with pytest.raises(BadInputError, match=rf"no episodes, .*rejected 20 \({told}\)"):
        imported(tmp_path / "drop", path, 'not_finite = "drop"\n' + MAPPING)
    wide = write_table(tmp_path / "log.npz", rows() | {"x": np.where(np.eye(20, 3), np.nan, 1.0)})
    mapping = MAPPING.replace('fields = ["x", "y"]', 'fields = ["x"]\ntake = [2, 0]')
    with pytest.raises(
        BadInputError, match=r"2 of 20 rows .*: x\[2\] in 1 row, log\.npz row 2; x\[0\] in 1 row, log\.npz row 0"
    ):
        imported(tmp_path / "wide", wide, mapping.replace('role = ["position"]\n', ""))


def test_what_is_strange_about_topics_of_several_files_is_told_once() -> None:
    tally = Tally(topics={"/odom is late": ["0.mcap"], "/odom is slow": [f"{k}.mcap" for k in range(9)]})
    tally.notes += ["0.csv: 40 Hz, 20 Hz declared"]
    lines = ["", "0.mcap: /odom is late", "0.mcap, 1.mcap and 7 more: /odom is slow", *tally.notes, "rejected"]
    assert "\n".join(lines) in str(ImportReport(Path("out"), 2, 7, tally, 0.25))
