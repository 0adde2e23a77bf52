from pathlib import Path

import numpy as np
import pytest
from fake_dataset import LENGTHS, concatenated, write_fake

from astra_data.dataset import Dataset, DatasetWriter
from astra_data.dataset.columns import ACTION, NEXT_STATE, REWARD, STATE, SUCCESS, TERMINATED, Column, Episode
from astra_data.dataset.inspection import BINS, CELLS, Endings, Inspection, endings_of, inspect_dataset, outcome_of


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
    edges = [np.linspace(bottom, top, len(places.counts) + 1), np.linspace(left, right, places.counts.shape[1] + 1)]
    assert (right - left, top - bottom) == pytest.approx(places.cell * np.array(places.counts.shape[::-1]))
    assert max(places.counts.shape) == CELLS and places.cell == pytest.approx(np.ptp(points, axis=0).max() / CELLS)
    theirs, _, _ = np.histogram2d(points[:, 1], points[:, 0], edges)
    assert np.abs(places.counts - theirs).sum() <= 4 and places.counts.sum() == sum(LENGTHS)
    assert inspection.velocities is None  # no column has that role


def test_episodes_are_summed_up(inspection: Inspection) -> None:
    assert inspection.lengths.tolist() == list(LENGTHS) and inspection.success == 2
    assert (inspection.reference, inspection.fps) == ("fake@data-1.0.0", 20)


def test_a_robot_that_never_moved_has_a_map_of_one_cell(fake: Dataset, tmp_path: Path) -> None:
    root = tmp_path / "still"
    columns = fake.schema
    with DatasetWriter(root, columns, fps=20, task="rest", description={"name": "still", "stage": "x"}) as writer:
        for episode in fake.episodes():
            episode.columns[STATE][:] = 1.5
            writer.add(episode)
    places = inspect_dataset(Dataset.open(root)).positions
    assert places is not None and places.counts.tolist() == [[sum(LENGTHS)]]


def test_only_a_terminated_last_step_that_stands_still_was_made_up(tmp_path: Path) -> None:
    moves = np.arange(8, dtype=np.float32).reshape(4, 2)
    stops = np.concatenate([moves[1:], moves[-1:]])
    nearly = stops + np.array([0, 1e-6], np.float32) * np.array([[0], [0], [0], [1]], np.float32)
    over, on = np.array([False, False, False, True]), np.zeros(4, bool)
    columns = [Column(STATE, size=2), Column(NEXT_STATE, size=2), Column(TERMINATED, "bool")]
    kinds = [(stops, over), (nearly, over), (stops, on), (stops, on)]
    description = {"name": "ends", "stage": "import"}
    with DatasetWriter(tmp_path / "d", columns, fps=10, task="end", description=description) as writer:
        for uid, (after, ended) in enumerate(kinds):
            writer.add(Episode(uid, {STATE: moves, NEXT_STATE: after, TERMINATED: ended}))

    found = endings_of(Dataset.open(tmp_path / "d"))
    assert found == Endings(terminated=2, cut_off=2, made_up=1)
    assert str(found).startswith("2 terminated, 2 cut off; 1 next states of terminated episodes were made up")
    assert str(Endings(3, 1)) == "3 terminated, 1 cut off"


def test_an_outcome_is_of_all_steps() -> None:
    reward, never = np.array([0.1, 0.2, -1.0], np.float32), np.zeros(3, bool)
    early, last = np.array([True, False, False]), np.array([False, False, True])
    for success, terminated, expected in (
        (never, never, (False, False)),
        (never, last, (False, True)),
        (last, last, (True, False)),
        (early, last, (True, False)),
        (last, never, (True, False)),
    ):
        outcome = outcome_of({SUCCESS: success, TERMINATED: terminated, REWARD: reward})
        assert (outcome["success"], outcome["failed"]) == expected
        assert outcome["return"] == reward.sum(dtype=np.float64) and isinstance(outcome["return"], float)
