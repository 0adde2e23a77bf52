"""Features of a camera's pictures, made by a frozen encoder and stored as a column of a dataset."""

from dataclasses import replace
from functools import cache
from itertools import batched
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import as_column
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import torch, without_gradients
from astra_data.core.progress import Progress, silent
from astra_data.core.seeding import generator
from astra_data.dataset.cameras import pictures_of
from astra_data.dataset.columns import Column
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import next_version
from astra_data.worlds.user_code import explained, file_of, user_object

CAMERAS, FEATURES = "observation.images.", "observation.features."
MADE_BY = "features"  # key of a dataset's environment: camera and encoder of each column of features
DEFAULT = f"{__name__}:ENCODER"
_AT_ONCE = 256  # pictures decoded into memory at once
_BLUR_PIXELS, _SHARPNESS = 1.2, 20.0
_PIXELS = 64  # larger pictures are reduced to twice this at most


class PictureEncoder(Protocol):
    """A frozen network; equal pictures have to have equal features."""

    size: int

    def __call__(self, pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features (B, size) of pictures (B, H, W, 3)."""


class ColorPlaces:
    """Where in a picture each of 32 colors, fixed at random, is strongest: a smoothing convolution, a spatial softmax.

    Small things of strong color are found to a fraction of a pixel, whatever their surroundings; shapes are not seen.
    """

    size = 64

    def __init__(self) -> None:
        colors = generator(0, "colors").normal(size=(self.size // 2, 3, 1, 1))
        bell = np.exp(-(np.arange(-2, 3) ** 2) / (2 * _BLUR_PIXELS**2))
        smooth = np.outer(bell, bell) / bell.sum() ** 2
        weights = colors / np.linalg.norm(colors, axis=1, keepdims=True) * smooth
        self._weights = weights.astype(np.float32)

    @without_gradients
    def __call__(self, pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features (B, 64) of pictures (B, H, W, 3): how far right, and down, each color is, within ±1."""
        shown = torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255.0
        shown = torch.nn.functional.avg_pool2d(shown, max(1, min(shown.shape[2:]) // _PIXELS))
        shown = torch.nn.functional.pad(shown, (2, 2, 2, 2), mode="replicate")
        maps = torch.nn.functional.conv2d(shown, torch.from_numpy(self._weights))
        flat = maps.flatten(2) - maps.mean((2, 3)).unsqueeze(-1)
        shares = (_SHARPNESS * flat / (flat.amax(-1, keepdim=True) + 1e-3)).softmax(-1).view_as(maps)
        down, right = (torch.linspace(-1.0, 1.0, count) for count in maps.shape[2:])
        return torch.cat([(shares.sum(2) * right).sum(-1), (shares.sum(3) * down).sum(-1)], dim=1).numpy()


ENCODER = ColorPlaces()


@cache
def encoder_named(name: str, sha256: str = "") -> PictureEncoder:
    """Return the encoder "file.py:NAME", whose file has this sha256, if one is given; a class is made there."""
    if sha256 and file_of(name).get("file_sha256", sha256) != sha256:
        raise BadInputError(f"{name} changed since it made the features: restore it, or make them again")
    made = user_object(name)
    with explained(f"making {name}"):
        made = made() if isinstance(made, type) else made
    size = getattr(made, "size", None)
    if not callable(made) or type(size) is not int or size < 1:
        raise BadInputError(f"{name}: expected an encoder with an int `size` and __call__(pictures), got {made!r:.80}")
    encoder: PictureEncoder = made
    return encoder


def encoded(pictures: NDArray[Any], name: str, sha256: str = "") -> NDArray[np.float32]:
    """Return the features (B, size) of pictures (B, H, W, 3) by an encoder, see `encoder_named`."""
    if pictures.ndim != 4 or pictures.shape[-1] != 3 or pictures.dtype != np.uint8:
        raise BadInputError(f"expected pictures (B, H, W, 3) of uint8, got {pictures.dtype} of shape {pictures.shape}")
    encoder = encoder_named(name, sha256)
    with explained(f"encoding pictures by {name}"):
        features = np.asarray(encoder(pictures), np.float32)
    if features.shape != (expected := (len(pictures), encoder.size)):
        raise BadInputError(f"{name}: expected features of shape {expected}, got {features.shape}")
    if not np.isfinite(features).all():
        raise BadInputError(f"{name}: expected finite features, got {features[~np.isfinite(features)][0]}")
    return features


def features(
    source: Dataset,
    camera: str,
    encoder: str = DEFAULT,
    *,
    name: str | None = None,
    out: Path | None = None,
    progress: Progress = silent,
) -> Path:
    """Write `source` with a column of features of a camera's pictures; return the new folder.

    A camera is named with or without "observation.images."; the column is "observation.features." and the rest. The
    `encoder` is "file.py:NAME" of a `PictureEncoder`; `name` and `out` are as for `subset`.
    """
    camera = camera if camera in source.cameras else f"{CAMERAS}{camera}"
    source.camera(camera)
    column = f"{FEATURES}{camera.removeprefix(CAMERAS)}"
    if column in source.features:
        raise BadInputError(f"{source.reference} has {column} already: encode the dataset that it was made from")
    size, origin = encoder_named(encoder).size, {"camera": camera, "encoder": encoder, **file_of(encoder)}
    environment, more = source.description["environment"], [Column(column, size=size, meaning=f"features of {camera}")]
    about = {**environment, MADE_BY: {**environment.get(MADE_BY, {}), column: origin}}
    with next_version(
        source, "columns", stage="features", config=origin, name=name, out=out, more=more, environment=about
    ) as writer:
        for index, episode in enumerate(source.episodes()):
            blocks = batched(pictures_of(episode.cameras[camera]), _AT_ONCE)
            values = np.concatenate([encoded(np.stack(block), encoder) for block in blocks])
            writer.add(replace(episode, columns={**episode.columns, column: as_column(values)}))
            progress((index + 1) / len(source), f"episode {index + 1} of {len(source)}")
    return writer.root
