import itertools
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import datasets
import numpy as np
import pyarrow.parquet as pq
import pytest
from damaged import DATA, alter
from fake_dataset import COLUMNS, LENGTHS, assert_same, concatenated, fake_columns, fake_episodes, write_fake

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import Dataset
from astra_data.dataset import format as layout
from astra_data.dataset.columns import ACTION, STATE, SUCCESS, Episode
from astra_data.dataset.doctor.check import check
from astra_data.dataset.doctor.repair import repair


@pytest.mark.parametrize("block_rows", [1, 10, 2**16])
def test_values_come_back_whole_and_episode_by_episode(
    fake: Dataset, monkeypatch: pytest.MonkeyPatch, block_rows: int
) -> None:
    monkeypatch.setattr(layout, "BLOCK_ROWS", block_rows)
    for name, values in fake.columns([column.name for column in COLUMNS]).items():
        expected = concatenated(name)
        assert values.dtype == expected.dtype and values.flags.c_contiguous
        np.testing.assert_array_equal(values, expected)
    found = list(fake.episodes())
    assert_same(found, fake_episodes())
    assert all(values.flags.writeable for episode in found for values in episode.columns.values())
    assert list(found[0].columns) == list(fake_episodes()[0].columns)
    assert [list(episode.columns) for episode in fake.episodes([STATE])] == [[STATE]] * len(LENGTHS)


@pytest.mark.parametrize(
    ("group_rows", "chosen", "groups"),
    [(1, [4, 0, 2], [0, 2, 4]), (20, [4, 0, 2], [0, 2]), (20, [1], [0]), (20, [3], [1]), (2**12, [1], [0])],
)
def test_only_the_row_groups_of_chosen_episodes_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group_rows: int, chosen: list[int], groups: list[int]
) -> None:
    monkeypatch.setattr(layout, "GROUP_ROWS", group_rows)
    dataset = write_fake(tmp_path / "set")
    read = pq.ParquetFile.read_row_groups
    found: list[int] = []

    def spy(file: pq.ParquetFile, row_groups: list[int], **options: object) -> object:
        found.extend(row_groups)
        return read(file, row_groups, **options)

    monkeypatch.setattr(pq.ParquetFile, "read_row_groups", spy)
    columns = dataset.columns([STATE, "mode"], episodes=chosen)
    assert found == groups
    whole = fake_episodes()
    for name, values in columns.items():
        assert values.flags.c_contiguous
        np.testing.assert_array_equal(values, np.concatenate([whole[index].columns[name] for index in sorted(chosen)]))
    assert dataset.columns([]) == {}


def test_what_the_writer_was_told_comes_back(fake: Dataset) -> None:
    assert fake.schema == list(COLUMNS)
    assert fake.features[STATE]["astra"]["role"] == ["position", "position", "heading"]
    assert fake.uids.tolist() == [13, 4, 2**53 + 1, 6, 0]
    assert fake.metadata["success"] == [True, False, True, False, False]
    assert fake.metadata["source_episode"] == [None, None, 2**53, 5, -1]
    assert fake.description["config"] == {"episodes": 5, "noise_m": 0.1} and fake.info["fps"] == 20
    assert fake.reference == "fake@data-1.0.0"
    assert repr(fake).startswith("Dataset(fake@data-1.0.0, 5 episodes, 55 steps, observation.state (3) float32")


def test_subsets_are_nested_and_follow_the_uid(fake: Dataset, tmp_path: Path) -> None:
    subsets = [fake.subset(count) for count in range(1, 6)]
    assert all(small == large[: len(small)] for small, large in itertools.pairwise(subsets))
    assert sorted(subsets[-1]) == [0, 1, 2, 3, 4]
    other = write_fake(tmp_path / "reversed", fake_episodes()[::-1])
    assert other.uids[other.subset(3)].tolist() == fake.uids[fake.subset(3)].tolist()
    assert write_fake(tmp_path / "seeded", subset_seed=1).subset(5) != fake.subset(5)
    with pytest.raises(BadInputError, match="a subset of 6 episodes, expected 1 to 5"):
        fake.subset(6)
    with pytest.raises(BadInputError, match="a subset of 0 episodes"):
        fake.subset(0)


def test_success_is_taken_from_the_metadata_or_else_from_the_column(tmp_path: Path) -> None:
    def successes(name: str, *metadata: dict[str, bool | str]) -> list[bool | None] | None:
        episodes = [Episode(uid, fake_columns(3, seed=uid), facts) for uid, facts in enumerate(metadata)]
        for episode in episodes:  # in the column, those of odd uids succeed
            episode.columns[SUCCESS][:] = [False, bool(episode.uid % 2), False]
        return write_fake(tmp_path / name, episodes).successes()

    assert successes("metadata", {"success": True}, {"success": False}) == [True, False]
    assert successes("column", {}, {}) == [False, True] and successes("some", {"success": True}, {}) == [False, True]
    assert successes("text", {"success": "yes"}, {"success": "no"}) == [False, True]


def test_an_unknown_column_answers_with_the_known_ones(fake: Dataset) -> None:
    with pytest.raises(BadInputError, match=r"has no column reward; it has observation\.state, action"):
        fake.columns(["reward"])
    with pytest.raises(BadInputError, match=r"expected a list of columns, got the text 'action': write \['act"):
        fake.columns("action")
    assert [*fake.columns(name for name in ["action"])] == ["action"]  # type: ignore[arg-type]


def test_a_run_names_its_datasets(tmp_path: Path) -> None:
    def told() -> set[str]:
        reads = Dataset.open, check, lambda run: repair(run, out=tmp_path / "saved")
        found = set()
        for read in reads:
            with pytest.raises(BadInputError) as caught:
                read(tmp_path)
            found.add(str(caught.value))
        return found

    (tmp_path / "recipe.json").touch()
    assert told() == {f"{tmp_path} is a run; it has no datasets yet"}
    places = ["label/seed_0", "label/seed_1", "pair/seed_0", "pair/seed_1", "subset/percent_025/seed_0"]
    for place in (*places, "set_aside/1/pair/seed_0"):
        write_fake(tmp_path / place)
    named = ", ".join(f"{tmp_path}/{place}" for place in places[:4])
    assert told() == {f"{tmp_path} is a run; its datasets are {named} and 1 more"}


def test_a_folder_of_versions_is_no_dataset(tmp_path: Path) -> None:
    for version in ("1.0.0", "1.1.0"):
        write_fake(tmp_path / f"fake/data-{version}")
    with pytest.raises(BadInputError, match=r"contains versions .*: name one of data-1.0.0, data-1.1.0"):
        Dataset.open(tmp_path / "fake")


def test_verify_finds_altered_values(dataset: Dataset) -> None:
    alter(DATA, "frame_index", 9, 7)(dataset.root)
    [altered] = Dataset.open(dataset.root).verify()
    assert altered == f"frame_index: other values than were written in {DATA} rows 8 to 19 (episode 2)"


def test_the_content_hash_sees_values_only(fake: Dataset, tmp_path: Path) -> None:
    renamed = write_fake(tmp_path / "two", task="walk", description={"name": "other", "stage": "import"})
    assert renamed.content_hash == fake.content_hash
    columns = fake_columns(7, seed=13)
    columns[STATE][3, 0] = np.nextafter(columns[STATE][3, 0], np.float32(9))
    other = write_fake(tmp_path / "three", [Episode(13, columns), *fake_episodes()[1:]])
    assert other.content_hash != fake.content_hash


def test_reading_needs_no_heavy_package(fake: Dataset) -> None:
    code = (
        "import sys; from pathlib import Path; from astra_data.dataset.reader import Dataset; "
        "Dataset.open(Path(sys.argv[1])).columns(['action'], episodes=[2]); "
        "print(*sys.modules)"
    )
    command = [sys.executable, "-c", code, str(fake.root)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    heavy = {"torch", "lerobot", "datasets", "matplotlib", "mujoco", "gymnasium", "pandas"}
    assert not heavy & set(done.stdout.split())


def test_a_folder_of_logs_is_no_dataset_yet(tmp_path: Path) -> None:
    (tmp_path / "Drive.CSV").write_text("x\n1\n")
    written = write_fake(tmp_path / "set").root
    (written / "notes.csv").write_text("")
    assert len(Dataset.open(written)) > 0
    with pytest.raises(BadInputError, match=r"contains logs \(Drive\.CSV and so on\): .*`astra-data import`"):
        Dataset.open(tmp_path)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_the_rows_are_those_of_lerobots_object(fake: Dataset, lerobot: SimpleNamespace) -> None:
    rows, opened = fake.to_huggingface(), fake.to_lerobot()
    assert isinstance(rows, datasets.Dataset) and isinstance(opened, lerobot.dataset.LeRobotDataset)
    assert rows.features == opened.hf_dataset.features
    assert rows.with_format("arrow")[:].equals(opened.hf_dataset.with_format("arrow")[:])
    for name, values in fake.columns(list(rows.features)).items():
        np.testing.assert_array_equal(np.array(rows[:][name]), values)
    assert (opened.num_episodes, len(opened)) == (len(fake), len(rows))


@pytest.mark.usefixtures("lerobot")  # its cache, and no network
def test_altered_values_are_not_handed_on(fake: Dataset, tmp_path: Path) -> None:
    root = shutil.copytree(fake.root, tmp_path / "altered")
    alter(DATA, ACTION, 0, [9.0, 9.0])(root)
    altered = Dataset.open(root)
    for convert in (altered.to_huggingface, altered.to_lerobot):
        with pytest.raises(CorruptDatasetError):
            convert()
