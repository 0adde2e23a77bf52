"""Groundings and target encoders on disk: safetensors files with metadata."""

from pathlib import Path
from typing import cast

from astra_data.core.checkpoint import loaded, save_tensors, understood
from astra_data.core.errors import BadInputError
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.networks.alignment import TargetEncoder
from astra_data.grounding.networks.grounding import GroundingModel
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import FittedGrounding, Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.worlds.own_saving import parts_of, restored

KINDS: dict[str, type[FittedGrounding]] = {HistoryGrounding.kind: HistoryGrounding}
"""The groundings that can be read, by what their files call them."""

GROUNDING, TARGET_ENCODER = "grounding.safetensors", "target_encoder.safetensors"
"""Names of the files of their artifacts."""
_TARGET_ENCODER = "target encoder"


def save_grounding(path: Path, grounding: FittedGrounding, episodes: PairedEpisodes) -> None:
    """Write `grounding`, which was fitted to `episodes`, to `path`.

    Raises:
        BadInputError: its `to_file` fails, or returns something else than tensors and JSON values.
    """
    tensors, metadata = parts_of(grounding)
    save_tensors(path, tensors, episodes.named | {"kind": grounding.kind} | metadata)


def load_grounding(path: Path | str, device: str = "cpu") -> FittedGrounding:
    """Read a grounding; the parameters of its networks are frozen.

    Raises:
        BadInputError: the file is missing, holds something else, or is from an older version.
    """
    with understood(Path(path), "a grounding", KINDS, device) as (tensors, metadata):
        return restored(KINDS[metadata["kind"]], tensors, metadata, device)


def grounding_at(path: Path | None, device: str = "cpu") -> Grounding:
    """Read a grounding; without a `path`, that is none.

    Raises:
        BadInputError: as `load_grounding`.
    """
    return load_grounding(path, device) if path else NO_GROUNDING


def load_history_model(path: Path | str, device: str = "cpu") -> GroundingModel:
    """Read a grounding that has to be a history model.

    Raises:
        BadInputError: as `load_grounding`, and if it is another grounding.
    """
    grounding = load_grounding(path, device)
    if grounding.kind != HistoryGrounding.kind:
        raise BadInputError(f"{path}: expected a history model, got a grounding without latents")
    return cast(HistoryGrounding, grounding).model


def save_target_encoder(path: Path, encoder: TargetEncoder) -> None:
    """Write `encoder` to `path`."""
    save_tensors(path, encoder.state_dict(), {"kind": _TARGET_ENCODER, "sizes": encoder.sizes})


def load_target_encoder(path: Path | str) -> TargetEncoder:
    """Read a target encoder; its parameters are frozen.

    Raises:
        BadInputError: the file is missing, holds something else, or is from an older version.
    """
    with understood(Path(path), "a target encoder", (_TARGET_ENCODER,), "cpu") as (tensors, metadata):
        return loaded(TargetEncoder(**metadata["sizes"]), tensors)
