from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import LENGTHS, concatenated, fake_episodes, write_fake, writer
from rich.console import Console

from astra_data.cli.inspection_page import inspection_page, shaded, sparkline
from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset.checkup.checkup import Checkup
from astra_data.dataset.columns import ACTION, STATE, Column, Episode, Scalar
from astra_data.dataset.edit import filter_episodes
from astra_data.dataset.inspection import BINS, CELLS, Inspection, Map, inspect_dataset, visited
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter
from astra_data.io.hub.card import render_card
from astra_data.io.hub.notes import Notes


@pytest.fixture(scope="module")
def inspection(tmp_path_factory: pytest.TempPathFactory) -> Inspection:
    return inspect_dataset(write_fake(tmp_path_factory.mktemp("inspect") / "fake"))


def test_spreads_are_numpys_histograms(inspection: Inspection) -> None:
    spreads = {spread.column.name: spread for spread in inspection.spreads}
    for name in (STATE, ACTION, "mode"):
        values = concatenated(name).reshape(sum(LENGTHS), -1).astype(np.float64)
        spread = spreads[name]
        np.testing.assert_allclose(spread.mean, values.mean(axis=0), rtol=1e-5)
        for index, column in enumerate(values.T):
            assert (spread.low[index], spread.high[index]) == (column.min(), column.max())
            theirs, _ = np.histogram(column, BINS)
            assert np.abs(spread.counts[index] - theirs).sum() <= 2  # on the edge of two bins
            assert spread.counts[index].sum() == sum(LENGTHS)


def test_the_map_counts_every_position_where_it_was(inspection: Inspection) -> None:
    places = inspection.positions
    assert places is not None
    points = concatenated(STATE)[:, :2].astype(np.float64)
    left, right, bottom, top = places.extent
    edges = [
        np.linspace(bottom, top, len(places.counts) + 1),
        np.linspace(left, right, places.counts.shape[1] + 1),
    ]
    theirs, _, _ = np.histogram2d(points[:, 1], points[:, 0], edges)
    assert np.abs(places.counts - theirs).sum() <= 4
    assert places.counts.sum() == sum(LENGTHS)
    assert inspection.velocities is None  # no column has that role


def test_positions_alone_give_the_same_map(tmp_path: Path, inspection: Inspection) -> None:
    planar = visited(write_fake(tmp_path / "set"))
    assert planar is not None
    assert inspection.positions is not None
    np.testing.assert_array_equal(planar.counts, inspection.positions.counts)
    assert planar.extent == inspection.positions.extent


def test_episodes_are_summed_up(inspection: Inspection) -> None:
    assert inspection.lengths.tolist() == list(LENGTHS)
    assert inspection.success == 2
    assert (inspection.reference, inspection.fps) == ("fake@data-1.0.0", 20)


def test_the_page_shows_every_value_within_80_columns(inspection: Inspection) -> None:
    console = Console(width=80, file=StringIO())
    with console.capture() as captured:
        console.print(inspection_page(inspection, Checkup("fake@data-1.0.0", (), ())))
    text = captured.get()
    for words in ("fake@data-1.0.0: 5 episodes, 55 steps", "success 2 of 5", "yaw", "rad", "mode (1) int64"):
        assert words in text
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_the_longer_side_of_the_map_has_as_many_cells_as_a_side_may_have(tmp_path: Path) -> None:
    source = write_fake(tmp_path / "fake")
    description = {"name": "far", "stage": "x"}
    with DatasetWriter(tmp_path / "far", source.schema, fps=20, task="go", description=description) as writer:
        for episode in source.episodes():
            episode.columns[STATE][:, :2] = np.linspace([0, 0], [6.4, 1.6], len(episode))
            writer.add(episode)
    places = inspect_dataset(Dataset.open(tmp_path / "far")).positions
    assert places is not None
    assert places.counts.shape == (CELLS // 4, CELLS) and places.counts.sum() == sum(LENGTHS)
    assert places.cell * CELLS == pytest.approx(6.4)


def test_a_side_that_is_longer_by_rounding_alone_gets_no_row_of_its_own(tmp_path: Path) -> None:
    """Of 1 m by 0.5 m, and 2^-37 m more: less than a billionth of a cell."""
    source = write_fake(tmp_path / "fake")
    description = {"name": "edge", "stage": "x"}
    with DatasetWriter(
        tmp_path / "edge", source.schema, fps=20, task="go", description=description
    ) as writer:
        for episode in source.episodes():
            episode.columns[STATE][:, :2] = np.linspace([0, -(2.0**-37)], [1.0, 0.5], len(episode))
            writer.add(episode)
    places = inspect_dataset(Dataset.open(tmp_path / "edge")).positions
    assert places is not None
    assert places.counts.shape == (CELLS // 2, CELLS) and places.counts.sum() == sum(LENGTHS)


def test_bars_and_shades_follow_the_counts() -> None:
    assert sparkline(np.array([0, 1, 4, 8])) == " ▁▄█"
    assert sparkline(np.zeros(3, dtype=np.int64)) == "   "
    # Four lines of cells make two of characters; the lowest comes last.
    counts = np.array([[9, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 36], [0, 1, 0]])
    assert shaded(Map(counts, np.zeros(2), 1.0)) == " ░\n  █\n▒"


def test_a_robot_that_never_moved_has_a_map_of_one_cell(tmp_path: Path) -> None:
    root = tmp_path / "still"
    source = write_fake(tmp_path / "fake")
    columns = source.schema
    with DatasetWriter(
        root, columns, fps=20, task="rest", description={"name": "still", "stage": "x"}
    ) as writer:
        for episode in source.episodes():
            episode.columns[STATE][:] = 1.5
            writer.add(episode)
    places = inspect_dataset(Dataset.open(root)).positions
    assert places is not None
    assert places.counts.tolist() == [[sum(LENGTHS)]]


@pytest.mark.parametrize(
    "metadata",
    [
        lambda uid: {},
        lambda uid: {} if uid == 4 else {"success": False},
        lambda uid: {"success": "perhaps"},
        lambda uid: {"success": float(uid in (13, 2**53 + 1))},
    ],
)
def test_whether_episodes_succeeded_has_one_answer(
    tmp_path: Path, metadata: Callable[[int], dict[str, Scalar]]
) -> None:
    with writer(tmp_path / "set") as open_writer:
        for episode in fake_episodes():
            open_writer.add(replace(episode, metadata=metadata(episode.uid)))
    dataset = Dataset.open(tmp_path / "set")
    assert dataset.successes() == [True, False, True, False, False]  # as next.success says
    assert inspect_dataset(dataset).success == 2
    assert "2 of 5 episodes (40.0%)" in render_card(dataset, Notes())
    kept = Dataset.open(filter_episodes(dataset, success=True, out=tmp_path / "kept"))
    assert kept.uids.tolist() == [13, 2**53 + 1]


def test_without_metadata_and_column_success_is_unknown(tmp_path: Path) -> None:
    columns = [Column("x")]
    description = {"name": "x", "stage": "x"}
    with DatasetWriter(tmp_path / "set", columns, fps=5, task="x", description=description) as open_writer:
        open_writer.add(Episode(0, {"x": np.zeros(3, np.float32)}))
    dataset = Dataset.open(tmp_path / "set")
    assert dataset.successes() is None
    assert inspect_dataset(dataset).success is None
    with pytest.raises(BadInputError, match="have no 'success'"):
        filter_episodes(dataset, success=True, out=tmp_path / "kept")


@pytest.mark.parametrize(
    "statistics",
    [
        "{",
        "{}",
        '{"observation.state": {"min": [0], "max": 1, "mean": {}}}',
        '{"observation.state": {"min": [0, 2, 0], "max": [1, 1, 1], "mean": [0, 1, 0]}}',
    ],
)
def test_malformed_statistics_are_told(tmp_path: Path, statistics: str) -> None:
    dataset = write_fake(tmp_path / "set")
    (dataset.root / "meta/stats.json").write_text(statistics)
    for read in (inspect_dataset, visited):
        with pytest.raises(CorruptDatasetError, match=r"meta/stats\.json is .*; astra-data repair"):
            read(dataset)
