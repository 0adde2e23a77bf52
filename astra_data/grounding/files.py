"""Groundings and target encoders on disk: safetensors files with metadata."""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from astra_data.core.checkpoint import loaded, not_finite, save_tensors, understood
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import torch, without_gradients
from astra_data.grounding.descent import seeded
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import NO_GROUNDING, FittedGrounding, Grounding
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import expect_tensor, explained, parts_of, restored

if TYPE_CHECKING:
    from astra_data.grounding.alignment import TargetEncoder
    from astra_data.grounding.model import GroundingModel

GROUNDING, TARGET_ENCODER = "grounding.safetensors", "target_encoder.safetensors"  # files of their artifacts
_TARGET_ENCODER = "target encoder"
_ROUNDING = 1e-6  # between states that are the same, relative to their size and absolute


@cache
def kinds() -> dict[str, type[FittedGrounding]]:
    """Return the groundings that can be read, by what their files call them; methods of the user's add theirs."""
    from astra_data.grounding.history import HistoryGrounding

    return {HistoryGrounding.kind: HistoryGrounding}


def save_grounding(path: Path, grounding: FittedGrounding, episodes: PairedEpisodes) -> None:
    """Write `grounding`, which was fitted to `episodes`, to `path`."""
    tensors, metadata = parts_of(grounding)
    if wrong := not_finite(tensors):
        raise BadInputError(f"fit returned a {type(grounding).__name__} with {wrong}: expected finite values")
    about = episodes.named | {"kind": grounding.kind}
    if taken := sorted(about.keys() & metadata):
        raise BadInputError(
            f"{type(grounding).__name__}.to_file: metadata of the names {', '.join(taken)}, which the package writes: "
            "rename them"
        )
    save_tensors(path, tensors, about | metadata)


def load_grounding(path: Path | str, device: str = "cpu") -> FittedGrounding:
    """Read a grounding; the parameters of its networks are frozen."""
    with understood(Path(path), "a grounding", kinds(), device) as (tensors, metadata):
        return restored(kinds()[metadata["kind"]], tensors, metadata, device)


def grounding_at(path: Path | None, device: str = "cpu") -> Grounding:
    """Read a grounding; without a `path`, that is none."""
    return load_grounding(path, device) if path else NO_GROUNDING


def load_history_model(path: Path | str, device: str = "cpu") -> "GroundingModel":
    """Read a grounding that has to be a history model."""
    from astra_data.grounding.history import HistoryGrounding

    grounding = load_grounding(path, device)
    if not isinstance(grounding, HistoryGrounding):
        raise BadInputError(f"{path}: expected a history model, got a grounding without latents")
    return grounding.model


def save_target_encoder(path: Path, encoder: "TargetEncoder") -> None:
    """Write `encoder` to `path`."""
    save_tensors(path, encoder.state_dict(), {"kind": _TARGET_ENCODER, "sizes": encoder.sizes})


def load_target_encoder(path: Path | str) -> "TargetEncoder":
    """Read a target encoder; its parameters are frozen."""
    from astra_data.grounding.alignment import TargetEncoder

    with understood(Path(path), "a target encoder", (_TARGET_ENCODER,), "cpu") as (tensors, metadata):
        return loaded(TargetEncoder(**metadata["sizes"]), tensors)


def fitted(returned: object) -> tuple[FittedGrounding, dict[str, Any]]:
    """Return the grounding and the figures that a fit `returned`."""
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise BadInputError(
            f"fit returned a {type(returned).__name__}: expected a pair, the grounding and a dict of figures"
        )
    grounding, figures = returned
    name = type(grounding).__name__
    if kinds().get(getattr(grounding, "kind", "")) is not type(grounding):
        raise BadInputError(
            f"fit returned a {name}, which cannot be read again: expected grounding={name} of the Method"
        )
    if not isinstance(figures, dict):
        raise BadInputError(f"fit returned a {type(figures).__name__} of figures: expected a dict")
    return grounding, figures


@without_gradients
def check_step(task: Task, fit: FittedGrounding, written: FittedGrounding, episodes: PairedEpisodes) -> None:
    """Step the simulator of `task` once, as corrected by what was `fit` and `written`, where `episodes` begin."""
    windows = episodes.windows
    state, goal, action = (values[:2, 0] for values in (windows.state, windows.goal, windows.action))
    landings = []
    for grounding in (fit, written):
        with explained(f"a step of {task.name} as corrected by {type(grounding).__name__}"), seeded(0, state.device):
            simulator = grounding.simulator(task, len(state), str(state.device))
            simulator.start(state, torch.arange(len(state), device=state.device), goal)
            landed: object = simulator.step(action)
            reached = simulator.state
            landings.append(reached.clone())
    moved = expect_tensor(what := f"{type(simulator).__name__}.step", landed)
    wanted, got = (f"{one.dtype} of shape {tuple(one.shape)}" for one in (state, moved))
    if got != wanted:
        raise BadInputError(f"{what}: expected states, {wanted}, got {got}")
    if not torch.allclose(reached, moved, rtol=_ROUNDING, atol=_ROUNDING, equal_nan=True):
        apart = f"{(reached - moved).abs().max():.3g}"
        raise BadInputError(
            f"{what}: returned states up to {apart} from its simulator's, which "
            "would go on uncorrected: expected `return self._settle(before, corrected)`, which moves the "
            "simulator to the corrected states, as far as walls allow"
        )
    first, second = landings
    if not torch.allclose(first, second, rtol=_ROUNDING, atol=_ROUNDING, equal_nan=True):
        apart = f"{(first - second).abs().max():.3g}"
        raise BadInputError(
            f"{type(fit).__name__}.from_file: steps of what it returns end up to {apart} from those of what fit "
            "returned: expected what to_file wrote"
        )
