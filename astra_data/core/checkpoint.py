"""Weights as safetensors, and training states as torch saves them, read without running code: written atomically."""

import json
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

from safetensors import SafetensorError, safe_open

from astra_data.core.artifact import check_intact
from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.naming import first_few
from astra_data.core.progress import Stopwatch

CHECKPOINT_SECONDS = 60.0


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Write `tensors` and `metadata` (JSON values) to `path`; an existing file is replaced atomically."""
    from safetensors.torch import save  # noqa: PLC0415 - it loads torch

    if not tensors:
        raise BadInputError(f"{path}: expected at least one tensor to save")
    # safetensors refuses tensors that share memory, such as tied weights or views.
    copies = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
    data = save(copies, {key: json.dumps(value) for key, value in metadata.items()})
    write_file(path, _with_sorted_metadata(data))


def _with_sorted_metadata(data: bytes) -> bytes:
    """Sort the metadata in a safetensors file's header, so that the same content gives the same bytes."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    header["__metadata__"] = dict(sorted(header.get("__metadata__", {}).items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[start:]


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors (on the CPU) and the metadata that `save_tensors` wrote, or raise a BadInputError."""
    if not path.is_file():
        raise BadInputError(f"{path} does not exist: expected a safetensors file")
    check_intact(path)
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            metadata = {key: json.loads(value) for key, value in (file.metadata() or {}).items()}
    except SafetensorError as error:
        raise BadInputError(f"{path} is not a complete safetensors file: {error}") from None
    except json.JSONDecodeError:
        raise BadInputError(f"{path} was not written by astra-data: its metadata is not JSON") from None
    return tensors, metadata


def not_finite(tensors: Mapping[str, Tensor]) -> str:
    """Say which weights are not finite; an infinite deviation is how networks leave out a part of their input."""
    wrong = {name: one.isnan() if name.endswith("_std") else ~one.isfinite() for name, one in tensors.items()}
    named = [name for name, where in wrong.items() if where.any()]
    return f"NaN or infinity in {first_few(named, 3)}" if named else ""


@contextmanager
def understood(
    path: Path, what: str, kinds: Collection[str], device: str
) -> Iterator[tuple[dict[str, Tensor], dict[str, Any]]]:
    """Yield the tensors (on `device`) and the metadata, of one of `kinds`, from which the block builds `what`."""
    tensors, metadata = load_tensors(path)
    kind = metadata.get("kind")
    if kind not in kinds:
        found = "a file without a kind" if kind is None else f"kind {kind}"
        raise BadInputError(f"{path}: expected {what} (kind {' or '.join(kinds)}), found {found}: run that stage again")
    if wrong := not_finite(tensors):
        raise BadInputError(f"{path}: expected finite weights, found {wrong}: run that stage again")
    moved = {name: tensor.to(device) for name, tensor in tensors.items()}
    try:
        yield moved, metadata
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        found = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        wanted = f"expected {what} as this version writes it"
        raise BadInputError(f"{path}: {wanted}, found {found}: run that stage again") from error


def as_part(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    """Return the tensors of a `part` of what a file holds, by their names in the file."""
    return {f"{part}.{name}": tensor for name, tensor in tensors.items()}


def part_of(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    """Return the tensors of a `part`, by their names within it: what `as_part` was given."""
    prefix = f"{part}."
    return {name.removeprefix(prefix): one for name, one in tensors.items() if name.startswith(prefix)}


def of_json[Shape](shape: type[Shape], sizes: Mapping[str, Any]) -> Shape:
    """Return the sizes of networks as they were before JSON made lists of tuples."""
    return shape(**{key: tuple(value) if isinstance(value, list) else value for key, value in sizes.items()})


def loaded[Module: torch.nn.Module](model: Module, weights: Mapping[str, Tensor], device: str = "cpu") -> Module:
    """Return `model` with these weights, on `device`, frozen and out of training."""
    model.load_state_dict(weights)
    return model.to(device).requires_grad_(False).eval()


class Logbook:
    """The log of a training run that can be interrupted: its `points` (JSON values) and `stopwatch`."""

    def __init__(self, checkpoint: Path | None, go_on: Callable[[dict[str, Any]], object]) -> None:
        """Start, or resume: `go_on` restores the state that `keep` wrote to `checkpoint`, if that exists."""
        self._checkpoint = checkpoint
        self.points, spent = list[dict[str, Any]](), None
        if checkpoint and checkpoint.exists():
            try:
                found = torch.load(checkpoint, map_location="cpu", weights_only=True)
            except (EOFError, RuntimeError, UnpicklingError) as error:
                raise BadInputError(f"{checkpoint} is not a complete checkpoint: remove {checkpoint.parent}") from error
            try:
                metadata = json.loads(found["metadata"])
                go_on(found["state"])
                self.points, spent = metadata["points"], metadata["spent"]
            except (KeyError, TypeError, ValueError, RuntimeError) as error:
                expected = f"expected a checkpoint of this version, found something else ({error})"
                raise BadInputError(f"{checkpoint}: {expected}: remove {checkpoint.parent}") from error
        self.stopwatch, self._kept = Stopwatch(spent), time.perf_counter()

    @property
    def is_due(self) -> bool:
        """Whether the next checkpoint is due."""
        return time.perf_counter() - self._kept >= CHECKPOINT_SECONDS

    def keep(self, state: Mapping[str, Any]) -> None:
        """Write a checkpoint: `state`, tensors and numbers in containers, the points and the time spent."""
        if self._checkpoint is not None:
            data, metadata = BytesIO(), {"points": self.points, "spent": self.stopwatch.spent()}
            torch.save({"state": state, "metadata": json.dumps(metadata)}, data)
            write_file(self._checkpoint, data.getvalue())
        self._kept = time.perf_counter()
