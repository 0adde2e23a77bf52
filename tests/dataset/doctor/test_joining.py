from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import COLUMNS, fake_columns, write_fake, writer

from astra_data.dataset.columns import Array, Episode
from astra_data.dataset.doctor.repair import join
from astra_data.dataset.reader import Dataset


def stored(*datasets: Dataset) -> list[tuple[int, dict[str, Array]]]:
    return [(episode.uid, dict(episode.columns)) for dataset in datasets for episode in dataset.episodes()]


@pytest.fixture
def other(tmp_path: Path) -> Dataset:
    """Two episodes; the first has a uid of the fake dataset, the second was made from it."""
    with writer(tmp_path / "other") as open_writer:
        open_writer.add(Episode(4, fake_columns(3, seed=50), {"floor": "carpet"}))
        open_writer.add(Episode(99, fake_columns(3, seed=51), {"source_episode": 4}))
    return Dataset.open(tmp_path / "other")


def test_each_has_the_metadata_of_its_own_dataset(tmp_path: Path, other: Dataset) -> None:
    fake = write_fake(tmp_path / "set")
    joined = join(stored(other, fake), COLUMNS, [fake, other])
    # The fake dataset's episode 4 comes later, and is the one with a new uid.
    assert [episode.uid for episode in joined[:3]] == [4, 99, 13]
    assert joined[0].metadata == {"floor": "carpet"}
    assert joined[1].metadata == {"source_episode": 4}
    assert joined[3].uid not in (4, 99, *fake.uids.tolist())
    assert joined[3].metadata["merged_uid"] == 4
    assert all(episode.is_known for episode in joined)


def test_sources_of_copies_follow_their_new_uids(tmp_path: Path, other: Dataset) -> None:
    fake = write_fake(tmp_path / "set")
    joined = join(stored(fake, other), COLUMNS, [fake, other])
    assert joined[-1].metadata == {"source_episode": joined[-2].uid}
    assert joined[-2].uid != 4


def test_an_episode_of_two_datasets_has_the_metadata_of_the_first(tmp_path: Path) -> None:
    for name in ("first", "second"):
        with writer(tmp_path / name) as open_writer:
            open_writer.add(Episode(4, fake_columns(3, seed=50), {"floor": name}))
    first, second = (Dataset.open(tmp_path / name) for name in ("first", "second"))
    [joined] = join(stored(second), COLUMNS, [first, second])
    assert joined.metadata == {"floor": "first"}


def test_the_same_episode_again_has_another_uid_the_same_in_every_run(tmp_path: Path) -> None:
    fake = write_fake(tmp_path / "set")
    first, again = (join(stored(fake, fake, fake), COLUMNS, [fake]) for _ in range(2))
    uids = [episode.uid for episode in first]
    assert len(set(uids)) == 3 * len(fake)
    assert min(uids) >= 0 and max(uids) < 2**63
    assert uids == [episode.uid for episode in again]


def test_other_values_are_another_episode(tmp_path: Path) -> None:
    fake = write_fake(tmp_path / "set")
    altered = [(uid, columns | {"action": columns["action"] + 1}) for uid, columns in stored(fake)]
    joined = join(altered, COLUMNS, [fake])
    assert [(episode.metadata, episode.is_known) for episode in joined] == [({}, False)] * len(fake)
    doubles = [
        (uid, columns | {"action": columns["action"].astype(np.float64)}) for uid, columns in stored(fake)
    ]
    assert all(episode.is_known for episode in join(doubles, COLUMNS, [fake]))
    wider = [*COLUMNS, replace(COLUMNS[0], name="more")]
    assert all(episode.is_known for episode in join(stored(fake), wider, [fake]))
