"""Groundings and target encoders on disk: safetensors files with metadata."""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from astra_data.core.checkpoint import loaded, not_finite, save_tensors, understood
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.grounding.descent import seeded
from astra_data.grounding.paired_episodes import PairedEpisodes, PairedWindows
from astra_data.grounding.simulator import NO_GROUNDING, FittedGrounding, Grounding
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import answered, expect, expect_tensor, explained, parts_of, restored

if TYPE_CHECKING:
    from astra_data.grounding.alignment import TargetEncoder
    from astra_data.grounding.model import GroundingModel

GROUNDING, TARGET_ENCODER = "grounding.safetensors", "target_encoder.safetensors"  # files of their artifacts
_TARGET_ENCODER = "target encoder"
_TRIED_STEPS = 5  # delays and memories show in some
_WARM_START = 1e-4  # by how much steps of a user's simulator may differ, as one whose solver begins where it ended
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
        name = f"{type(grounding).__name__}.to_file"
        raise BadInputError(f"{name}: metadata of the names {', '.join(taken)}, which the package writes: rename them")
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
        raise BadInputError(f"fit returned a {type(returned).__name__}: expected a pair (grounding, dict of figures)")
    grounding, figures = returned
    name = type(grounding).__name__
    if kinds().get(getattr(grounding, "kind", "")) is not type(grounding):
        raise BadInputError(f"fit returned a {name}, which cannot be read: expected grounding={name} of the Method")
    if not isinstance(figures, dict):
        raise BadInputError(f"fit returned a {type(figures).__name__} of figures: expected a dict")
    return grounding, figures


@without_gradients
def check_step(task: Task, fit: FittedGrounding, written: FittedGrounding, episodes: PairedEpisodes) -> None:
    """Run the simulator of `task`, as corrected by what was `fit` and `written`, from where `episodes` begin."""
    first, second = (_Tried(task, grounding, episodes.windows).whole() for grounding in (fit, written))
    encoded = fit.encoder
    file = f"{type(fit).__name__}.from_file" if encoded is None else f"{type(encoded.encoder).__name__}.state_dict"
    lost = f"{file}: read again, steps end up to {{}} from those of what fit returned: expected all that they depend on"
    _expect_same(first, second, f"{lost} in the file")


class _Tried:
    """Two simulators as a grounding corrects them, started, stepped and resumed as in a training."""

    def __init__(self, task: Task, grounding: FittedGrounding, windows: PairedWindows) -> None:
        kind, every = type(grounding).__name__, grounding.start_stride
        self._what = f"a step of {task.name} as corrected by {kind}"
        self._state, self._goal = windows.state[:2, 0], windows.goal[:2, 0]
        self._rows = torch.arange(len(self._state), device=self._state.device)
        self._actions = windows.action[:2, :_TRIED_STEPS].unbind(1)
        hidden = answered(what := f"{kind}.hidden_before", grounding.hidden_before, windows, every)
        if hidden is not None:
            expect(what, hidden, (len(windows.state), -(-windows.state.shape[1] // every), -1))
        with explained(self._what), seeded(0, self._state.device):
            self._simulator = grounding.simulator(task, len(self._rows), str(self._state.device))
            latent, size = self._simulator.latent, self._simulator.latent_size
        self._name = type(self._simulator).__name__
        if latent is not None or size or grounding.encoder:
            expect(f"{self._name}.latent with latent_size = {size}", latent, (len(self._rows), size))
            if grounding.encoder is None:
                raise BadInputError(f"{kind}.encoder: expected ψ^s, whose latents policies see on the robot, got None")

    def whole(self) -> Tensor:
        """Return the states (T, B, X) of an episode; refuse steps that depend on what `start` or a checkpoint lacks."""
        forgets = (
            f"{self._name}.start: after other steps, the same episode ends {{}} elsewhere: expected "
            "`super().start(state, rows, goal)`, and all else that `step` depends on to begin anew"
        )
        resumes = (
            f"{self._name}.state_dict: resumed from it, steps end {{}} elsewhere: expected it, and load_state_dict, to "
            "hold all that `step` depends on, and draws from torch's generator"
        )
        spares = f"{self._name}.start: to start row 0 moves row 1 by {{}}: expected changes of `rows` alone"
        self._start(2)
        along, kept = self._walk(), self._simulator.state_dict()
        kept = {name: expect_tensor(f"{self._name}.state_dict: {name}", one).clone() for name, one in kept.items()}
        onward = self._walk()
        for restarted, otherwise in ((0, resumes), (1, spares)):
            self._simulator.load_state_dict({name: one.clone() for name, one in kept.items()})
            if restarted:
                self._start(restarted)
            _expect_same(self._walk()[:, restarted:], onward[:, restarted:], otherwise, _WARM_START)
        self._start(2)
        _expect_same(self._walk(), along, forgets, _WARM_START)
        return along

    def _start(self, count: int) -> None:
        """Start episodes in the first `count` rows."""
        state, rows, goal = self._state[:count], self._rows[:count], self._goal[:count]
        with explained(self._what), seeded(0, state.device):
            self._simulator.start(state, rows, goal, hidden=None, previous_action=None)

    def _walk(self) -> Tensor:
        """Return the states (T, B, X) that recorded actions lead to."""
        states, what = [], f"{self._name}.step"
        uncorrected = (
            f"{what}: returned states up to {{}} from its simulator's, which would go on uncorrected: expected "
            "`return self._settle(before, corrected)`, which moves the simulator there, as far as walls allow"
        )
        for number, action in enumerate(self._actions):
            with explained(self._what), seeded(number, action.device):
                landed: object = self._simulator.step(action.clone())
            states.append(self._simulator.state.clone())
            moved = expect(what, landed, tuple(self._state.shape), torch.float32)
            _expect_same(states[-1], moved, uncorrected)
        return torch.stack(states)


def _expect_same(first: Tensor, second: Tensor, otherwise: str, within: float = _ROUNDING) -> None:
    """Refuse what differs by more than `within`, relative and absolute, and say `otherwise`, by how much."""
    if not torch.allclose(first, second, rtol=within, atol=within, equal_nan=True):
        raise BadInputError(otherwise.format(f"{(first - second).abs().max():.3g}"))
