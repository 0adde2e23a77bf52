from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_dataset import fake_episode, write_images, writer

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Clip
from astra_data.dataset.edit import subset, trim
from astra_data.dataset.reader import Dataset
from astra_data.grounding.features import DEFAULT, ENCODER, encoded, features

TOP, COLUMN = "observation.images.top", "observation.features.top"
LENGTHS = {3: 14, 8: 9, 5: 30}
ENCODERS = """
import numpy as np

class Pixels:
    size = 2
    def __call__(self, pictures):
        return pictures[:, 0, :2, 1].astype(np.float32)

class One(Pixels):
    size = 1

class Infinite(Pixels):
    def __call__(self, pictures):
        return np.full((len(pictures), 2), np.inf)

class Broken(Pixels):
    def __call__(self, pictures):
        raise ValueError("no pixel")

sizeless = len
"""


def picture(number: int) -> Any:
    made = np.random.default_rng(number).integers(0, 255, (6, 8, 3)).astype(np.uint8)
    made[0, 0] = number
    return made


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Three episodes whose column "mode" numbers the steps, as the first pixel of their pictures does."""
    folder, first = tmp_path_factory.mktemp("features"), 0
    images = write_images(folder / "images.parquet", TOP, map(picture, range(sum(LENGTHS.values()))))
    feature = {"dtype": "image", "shape": [6, 8, 3], "names": ["height", "width", "channels"]}
    with writer(folder / "set", cameras={TOP: feature}) as opened:
        for uid, steps in LENGTHS.items():
            episode = fake_episode(uid, steps)
            columns = {**episode.columns, "mode": np.arange(first, first + steps)}
            clip = Clip(images, TOP, first, 1, steps)
            opened.add(replace(episode, columns=columns, cameras={TOP: clip}))
            first += steps
    return Dataset.open(folder / "set")


@pytest.fixture(scope="module")
def encoders(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("encoders") / "encoders.py"
    path.write_text(ENCODERS)
    return str(path)


def test_rows_have_the_features_of_their_own_pictures_through_all_edits(
    source: Dataset, encoders: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.grounding.features._AT_ONCE", 4)
    made = features(source, "top", f"{encoders}:Pixels", out=tmp_path / "made")
    cut = trim(Dataset.open(made), start_s=0.15, end_s=0.1, out=tmp_path / "cut")
    few = subset(Dataset.open(cut), episodes=2, out=tmp_path / "few")
    for root, steps in ((made, 53), (cut, 38), (few, int(Dataset.open(few).lengths.sum()))):
        columns = Dataset.open(root).columns(["mode", COLUMN])
        expected = np.array([picture(number)[0, :2, 1] for number in columns["mode"]], np.float32)
        assert len(expected) == steps
        np.testing.assert_array_equal(columns[COLUMN], expected)


def test_the_new_version_has_all_that_was_there_and_says_what_made_the_column(
    source: Dataset, encoders: str, tmp_path: Path
) -> None:
    made = Dataset.open(features(source, "top", f"{encoders}:Pixels", name="seen", out=tmp_path / "made"))
    assert made.verify() == [] and made.description["stage"] == "features"
    assert made.description["parents"] == [source.identity] and made.reference == "seen@data-1.0.0"
    names = [column.name for column in source.schema]
    for name, values in source.columns(names).items():
        np.testing.assert_array_equal(made.columns([name])[name], values)
    np.testing.assert_array_equal(made.pictures(TOP, 1), source.pictures(TOP, 1))
    origin = made.description["environment"]["features"][COLUMN]
    assert (origin["camera"], origin["encoder"]) == (TOP, f"{encoders}:Pixels") and len(origin["file_sha256"]) == 64
    assert made.description["environment"]["id"] == "Fake-v0"
    with pytest.raises(BadInputError, match=f"has {COLUMN} already"):
        features(made, "top", out=tmp_path / "again")


def test_the_packages_encoder_says_where_in_a_picture_something_is(source: Dataset, tmp_path: Path) -> None:
    made = features(source, "top", out=tmp_path / "made")
    columns = Dataset.open(made).columns(["mode", COLUMN])
    assert columns[COLUMN].shape == (53, 64) and np.abs(columns[COLUMN]).max() <= 1.0
    pictures = np.stack([picture(number) for number in columns["mode"][:14]])
    np.testing.assert_allclose(columns[COLUMN][:14], ENCODER(pictures), atol=1e-6)
    again = features(source, "top", out=tmp_path / "again")
    assert Dataset.open(again).content_hash == Dataset.open(made).content_hash
    right, down = np.exp(-((np.arange(64) - np.array([[20.25], [40.75]])) ** 2) / 8)
    spot = (np.outer(down, right)[..., None] * [250, 120, 30]).astype(np.uint8)
    right_px, down_px = (ENCODER(spot[None])[0].reshape(2, 32) + 1) / 2 * 63
    assert sum(abs(right_px - 20.25) < 0.05) > 16 and sum(abs(down_px - 40.75) < 0.05) > 16  # colors like the spot's


@pytest.mark.parametrize(
    ("camera", "encoder", "message"),
    [
        ("left", "Pixels", r"no camera 'observation.images.left'; it has observation.images.top"),
        ("top", "One", r"encoders.py:One: expected features of shape \(14, 1\), got \(14, 2\)"),
        ("top", "Infinite", "encoders.py:Infinite: expected finite features, got inf"),
        ("top", "Broken", r"fails with ValueError: no pixel \(encoders.py, line 18\)"),
        ("top", "sizeless", "expected an encoder with an int `size` and __call__"),
        ("top", "Missing", "has no 'Missing'; it has Pixels"),
    ],
)
def test_what_cannot_be_encoded_is_refused_and_nothing_written(
    camera: str, encoder: str, message: str, source: Dataset, encoders: str, tmp_path: Path
) -> None:
    with pytest.raises(BadInputError, match=message):
        features(source, camera, f"{encoders}:{encoder}", out=tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_a_depth_camera_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"expected pictures \(B, H, W, 3\) of uint8, got uint16 of shape"):
        encoded(np.zeros((2, 4, 4), np.uint16), DEFAULT)
