from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damaged import DATA, EPISODES, alter, drop, retype
from fake_dataset import fake_episodes, write_fake

from astra_data.dataset import Dataset
from astra_data.dataset import format as layout
from astra_data.dataset.columns import STATE
from astra_data.dataset.description import Digests, read_digests
from astra_data.dataset.doctor.salvage import rebuilt_metadata, whole_runs
from astra_data.dataset.plain import plain_columns, read_object

UIDS = [episode.uid for episode in fake_episodes()]


def salvaged(root: Path, digests: Digests | None = None) -> tuple[list[int], list[str]]:
    """Return the uids of the intact episodes, whose states are compared, and the notes."""
    info = read_object(root / "meta/info.json")
    assert not isinstance(info, str)
    notes: list[str] = []
    states = {episode.uid: episode.columns[STATE] for episode in fake_episodes()}
    uids = []
    for uid, run in whole_runs(root, plain_columns(info["features"])[0], digests or {}, 20, False, notes):
        np.testing.assert_array_equal(run.columns[STATE], states[uid])
        uids.append(uid)
    return uids, notes


@pytest.mark.parametrize(
    ("damage", "left", "note"),
    [
        # Whatever is wrong with an episode costs it alone.
        (alter(DATA, "action", 9, [np.nan, 0]), [0, 1, 3, 4], "left out episode 2: action is nan"),
        (alter(DATA, "next.done", 9, True), [0, 1, 3, 4], "left out episode 2: next.done is True"),
        (alter(DATA, "episode_uid", 7, -5), [0, 2, 3, 4], "left out episode 1: its uid -5 is taken or neg"),
        (alter(DATA, "index", 9, 70), [0, 1, 3, 4], "left out episode 2: index is 70"),
        (alter(DATA, "timestamp", 9, 7.0), [0, 1, 3, 4], "left out episode 2: timestamp is 7.0"),
        (alter(EPISODES, "length", 2, 11), [0, 1, 3, 4], "left out episode 2: it has 12 frames, expected 11"),
        (alter(DATA, "episode_index", 8, 90), [0, 1, 3, 4], "left out episode 2: episode_index is 90"),
        (retype(EPISODES, "episode_index", [1]), [0, 1, 2, 3, 4], "meta/episodes was rebuilt from the data"),
        (drop(EPISODES), [0, 1, 2, 3, 4], "meta/episodes was missing and was rebuilt from the data"),
    ],
)
def test_what_is_intact_is_read(root: Path, damage: Callable[[Path], object], left: list[int], note: str) -> None:
    damage(root)
    uids, notes = salvaged(root)
    assert uids == [UIDS[index] for index in left] and len(notes) == 1 and note in notes[0]


def test_a_number_that_is_missing_costs_its_episode(root: Path) -> None:
    alter(DATA, "action", 9, None)(root)
    uids, notes = salvaged(root)
    assert uids == UIDS[:2] + UIDS[-2:] and "rows 9 to 9 cannot be read (action: expected 2 values" in notes[1]


@pytest.mark.parametrize(
    "damage", [alter(DATA, "index", 9, 70), alter(DATA, "action", 9, [0.5, 0]), alter(DATA, "mode", 19, 3)]
)
def test_with_digests_an_altered_episode_costs_no_other(dataset: Dataset, damage: Callable[[Path], object]) -> None:
    digests = read_digests(dataset.root, dataset.features)
    damage(dataset.root)
    uids, [note] = salvaged(dataset.root, digests)
    assert uids == [uid for number, uid in enumerate(UIDS) if number != 2]
    assert f"other values than were written in {DATA} rows 8 to 19 (episode 2)" in note


def test_an_altered_length_costs_no_episode_whose_digests_agree(dataset: Dataset) -> None:
    alter(EPISODES, "length", 2, 11)(dataset.root)
    assert salvaged(dataset.root, read_digests(dataset.root, dataset.features)) == (UIDS, [])


def deface(path: Path, group: int, column: str) -> None:
    """Overwrite what a row group of a parquet file has of a column."""
    metadata = pq.read_metadata(path).row_group(group)
    parts = [metadata.column(number) for number in range(metadata.num_columns)]
    [part] = [part for part in parts if part.path_in_schema.split(".list")[0] == column]
    data = bytearray(path.read_bytes())
    first, size = part.dictionary_page_offset or part.data_page_offset, part.total_compressed_size
    data[first : first + size] = b"\xff" * size
    path.write_bytes(data)


@pytest.mark.parametrize("column", ["action", "episode_index", "frame_index"])
@pytest.mark.parametrize("is_digested", [False, True])
@pytest.mark.parametrize(("group_rows", "lost", "rows"), [(1, [2], "8 to 19"), (20, [0, 1, 2], "0 to 19")])
def test_an_unreadable_row_group_costs_its_episodes_alone(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    column: str,
    group_rows: int,
    lost: list[int],
    rows: str,
    *,
    is_digested: bool,
) -> None:
    monkeypatch.setattr(layout, "GROUP_ROWS", group_rows)
    dataset = write_fake(tmp_path / "set")
    digests = read_digests(dataset.root, dataset.features) if is_digested else None
    deface(dataset.root / DATA, 2 if len(lost) == 1 else 0, column)
    uids, notes = salvaged(dataset.root, digests)
    assert uids == [uid for number, uid in enumerate(UIDS) if number not in lost]
    assert notes[0].startswith(f"{DATA} rows {rows} cannot be read (")
    which = " 2" if len(lost) == 1 else "s 0 to 2"
    assert notes[1:] == [f"left out episode{which}: rows that belong there cannot be read"]


def test_of_a_shared_row_group_before_the_end_of_a_cut_file_every_episode_is_recovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout, "GROUP_ROWS", 30)
    root = write_fake(tmp_path / "set").root  # episodes 0 to 2, 3, and 4
    path = root / DATA
    metadata = pq.read_metadata(path)
    path.write_bytes(path.read_bytes()[: metadata.row_group(1).column(0).data_page_offset + 1])
    uids, notes = salvaged(root)
    assert uids == UIDS[:3] and notes[1:] == ["left out episodes 3 to 4: rows that belong there cannot be read"]


@pytest.mark.parametrize(
    ("size", "group", "left"),
    [
        (10, 0, [3, 4]),  # episodes 0 and 1, and a part of 2
        (10, 1, [0, 1, 3, 4]),  # the rest of 2
        (20, 0, [3, 4]),
        (20, 1, [0, 1, 2, 4]),  # a part of 3
        (20, 2, [0, 1, 2]),
        (25, 1, [0, 1, 2, 4]),  # the most of 3
    ],
)
def test_episodes_with_rows_in_an_unreadable_row_group_are_left_out(
    root: Path, size: int, group: int, left: list[int]
) -> None:
    pq.write_table(pq.read_table(root / DATA), root / DATA, row_group_size=size)
    deface(root / DATA, group, "index")
    assert salvaged(root)[0] == [UIDS[index] for index in left]


@pytest.mark.usefixtures("lonely")
def test_without_meta_episodes_the_rows_tell_which_episode_follows(root: Path) -> None:
    drop(EPISODES)(root)
    deface(root / DATA, 1, "action")
    uids, notes = salvaged(root)
    # Whether episode 0 went on in the rows that are lost, nothing tells.
    assert uids == UIDS[2:] and notes[-1] == "left out episodes 0 to 1: rows that belong there cannot be read"


@pytest.mark.usefixtures("scattered")
def test_a_file_that_comes_twice_costs_no_episode(root: Path) -> None:
    (root / DATA.replace("file-000", "file-002a")).write_bytes(
        (root / DATA.replace("file-000", "file-001")).read_bytes()
    )
    uids, [note] = salvaged(root)
    assert uids == UIDS
    assert note == "left out rows 0 to 0 of data/chunk-000/file-002a.parquet: they are of episode 1 once more"


@pytest.mark.usefixtures("scattered")
@pytest.mark.parametrize("has_places", [True, False])
@pytest.mark.parametrize("damage", ["defaced", "rubbish", "without a column", "missing"])
def test_a_lost_file_costs_its_episodes_alone(root: Path, damage: str, *, has_places: bool) -> None:
    if not has_places:
        drop(EPISODES)(root)
    names = [DATA.replace("file-000", f"file-00{file}") for file in (1, 2)]
    for path in (root / name for name in names):
        if damage == "defaced":
            deface(path, 0, "action")
        elif damage == "rubbish":
            path.write_bytes(b"PAR1 rubbish" * 50)
        elif damage == "without a column":
            pq.write_table(pq.read_table(path).drop_columns(["index"]), path)
        else:
            path.unlink()
    uids, notes = salvaged(root)
    assert uids == [UIDS[0], *UIDS[3:]]
    *named, lost = notes if has_places else [*notes[1:-1], notes[-1]]
    assert lost == "left out episodes 1 to 2: rows that belong there cannot be read"
    if has_places or damage != "missing":
        assert [note.split(" ")[0] for note in named] == names


@pytest.mark.parametrize("compression", ["snappy", "zstd"])
@pytest.mark.parametrize("use_dictionary", [True, False])
def test_footers_are_rebuilt_for_many_pages_per_column(tmp_path: Path, compression: str, use_dictionary: bool) -> None:
    rng = np.random.default_rng(0)
    rows = 5000
    listed = pa.FixedSizeListArray.from_arrays(pa.array(rng.normal(size=3 * rows).astype(np.float32)), 3)
    schema = pa.schema([("few", pa.int64()), ("listed", listed.type), ("flag", pa.bool_()), ("many", pa.float64())])
    arrays = [rng.integers(0, 3, rows), listed, rng.random(rows) < 0.5, rng.normal(size=rows)]
    table = pa.Table.from_arrays([pa.array(array) for array in arrays], schema=schema)
    for version in ("1.0", "2.0"):
        path = tmp_path / f"{version}.parquet"
        pq.write_table(
            table,
            path,
            row_group_size=2100,
            data_page_size=1000,
            write_batch_size=100,
            dictionary_pagesize_limit=4000,
            compression=compression,
            use_dictionary=use_dictionary,
            data_page_version=version,
        )
        whole = path.read_bytes()
        length = int.from_bytes(whole[-8:-4], "little")
        path.write_bytes(whole[: -8 - length])
        metadata = rebuilt_metadata(path, schema)
        assert metadata.num_row_groups == 3
        with pq.ParquetFile(path, metadata=metadata) as file:
            assert file.read().equals(table)


def test_pages_of_narrow_values_are_not_taken_for_those_of_a_wide_column(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=1000)
    table = pa.table({"narrow": values.astype(np.float32), "wide": values[::-1].copy()})
    path = tmp_path / "pages.parquet"
    pq.write_table(table, path, data_page_size=1, write_batch_size=250, use_dictionary=False, compression="snappy")
    whole = path.read_bytes()
    path.write_bytes(whole[: -8 - int.from_bytes(whole[-8:-4], "little")])
    metadata = rebuilt_metadata(path, table.schema)
    assert metadata.num_row_groups == 1
    with pq.ParquetFile(path, metadata=metadata) as file:
        assert file.read().equals(table)


def test_a_row_group_that_lacks_its_last_byte_is_not_whole(tmp_path: Path) -> None:
    table = pa.table({"x": np.arange(30.0)})
    path = tmp_path / "cut.parquet"
    pq.write_table(table, path, row_group_size=10, compression="snappy")
    whole = path.read_bytes()
    end = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
    for kept, groups in ((end, 3), (end - 1, 2)):
        path.write_bytes(whole[:kept])
        assert rebuilt_metadata(path, table.schema).num_row_groups == groups
