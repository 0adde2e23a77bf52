import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from shifted_method import Lossy, Shifted, ShiftedSimulator
from toy_episodes import no_episodes

from astra_data.core.checkpoint import load_tensors, save_tensors
from astra_data.core.errors import BadInputError
from astra_data.grounding import files
from astra_data.grounding.alignment import TargetEncoder
from astra_data.grounding.encoder import take_scales
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.simulator import EpisodeSimulator, PlacedSimulator
from astra_data.robots.registry import task_named


def test_a_history_model_comes_back_frozen(tmp_path: Path) -> None:
    shape = GroundingShape(4, 2, 2, latent_size=8, head_sizes=(16, 8), position_octaves=2)
    model = GroundingModel(shape)
    take_scales(model, {"state": torch.randn(50, 4)})
    failed = (torch.arange(50) == 7).float()
    model.set_reward_scales(torch.randn(50, 2) - 10.0 * failed[:, None], 1.0 - failed, failed)
    model.reward_shrinkage.fill_(0.4)
    path = tmp_path / "grounding.safetensors"
    files.save_grounding(path, HistoryGrounding(model), no_episodes())
    for loaded in (files.load_history_model(path), files.load_history_model(str(path))):
        assert (loaded.shape, loaded.training) == (shape, False)
        assert not any(parameter.requires_grad for parameter in loaded.parameters())
        latent, action, state = torch.randn(3, 8), torch.randn(3, 2), torch.randn(3, 4)
        assert torch.equal(loaded.correct(latent, action, state), model.correct(latent, action, state))
        given = latent, action, torch.randn(3)
        assert torch.equal(loaded.target_reward(*given), model.target_reward(*given))
        assert float(loaded.failure_cost) == float(model.failure_cost) < -5.0
    tensors, metadata = load_tensors(path)
    assert tensors.keys() == model.state_dict().keys()
    assert (metadata["kind"], metadata["dataset"], metadata["hash"]) == ("history", "toy@data-1.0.0", "0")


def test_a_grounding_of_the_users_own_is_read_once_it_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "grounding.safetensors"
    files.save_grounding(path, Shifted(torch.ones(2)), no_episodes())
    with pytest.raises(BadInputError, match="found kind shifted"):
        files.load_grounding(path)
    monkeypatch.setitem(files.kinds(), Shifted.kind, Shifted)
    monkeypatch.setitem(files.kinds(), Lossy.kind, Shifted)
    found = files.load_grounding(path)
    assert isinstance(found, Shifted) and found.shift.tolist() == [1.0, 1.0]
    with pytest.raises(BadInputError, match="expected a history model, got a grounding without latents"):
        files.load_history_model(path)


def test_a_target_encoder_comes_back_frozen(tmp_path: Path) -> None:
    encoder = TargetEncoder(29, 2, 3, embedding_size=16, latent_size=8, position_octaves=3)
    state, goal, action = torch.randn(5, 29), torch.randn(5, 2), torch.randn(5, 3)
    encoder.set_scales(3 * state, goal)
    encoder.latent_r2.fill_(0.95)
    path = tmp_path / "encoder.safetensors"
    files.save_target_encoder(path, encoder)
    loaded = files.load_target_encoder(str(path))
    assert not loaded.training and not any(parameter.requires_grad for parameter in loaded.parameters())
    assert loaded.is_deployed
    inputs = loaded.encoder_input(state, goal, action)
    assert torch.equal(inputs, encoder.encoder_input(state, goal, action))
    assert torch.equal(loaded.encoder.sequence(inputs[None])[0], encoder.encoder.sequence(inputs[None])[0])


@pytest.mark.parametrize(
    ("missing", "message"),
    [("kind", r"\(kind target encoder\), found a file without a kind"), ("sizes", "found no 'sizes'")],
)
def test_what_is_no_target_encoder_is_refused(missing: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "encoder.safetensors"
    files.save_target_encoder(path, TargetEncoder(29, 2, 3, embedding_size=16, latent_size=8))
    tensors, metadata = load_tensors(path)
    del metadata[missing]
    save_tensors(path, tensors, metadata)
    with pytest.raises(BadInputError, match=f"expected a target encoder .*{message}"):
        files.load_target_encoder(path)


SHIFTED = Shifted(torch.tensor([0.01]))


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(files.kinds(), Shifted.kind, Shifted)
    monkeypatch.setitem(files.kinds(), Lossy.kind, Shifted)


def test_what_a_grounding_of_one_s_own_saves_and_asks_for_is_checked(
    tmp_path: Path, known: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "grounding.safetensors"
    monkeypatch.setattr(Shifted, "to_file", lambda self: ({"offset": self.shift.numpy()}, {}))
    with pytest.raises(BadInputError, match=r"^Shifted.to_file: 'offset' is a ndarray, expected a torch"):
        files.save_grounding(path, SHIFTED, no_episodes())
    assert not path.exists()
    monkeypatch.setattr(Shifted, "to_file", lambda self: ({"offset": self.shift}, {"kind": "x", "hash": "y", "z": 0}))
    with pytest.raises(BadInputError, match=r"^Shifted.to_file: metadata of the names hash, kind, which the pack"):
        files.save_grounding(path, SHIFTED, no_episodes())
    monkeypatch.setattr(Shifted, "to_file", lambda self: ({"offset": self.shift}, {}))
    files.save_grounding(path, SHIFTED, no_episodes())
    told = r"^Shifted.from_file, given the tensors offset and .*, fails with KeyError: 'shift'"
    with pytest.raises(BadInputError, match=told):
        files.load_grounding(path)


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (SHIFTED, r"fit returned a Shifted: expected a pair \(grounding, dict of figures\)"),
        (None, "fit returned a NoneType: expected a pair"),
        ((SHIFTED, {}, 1), "fit returned a tuple: expected a pair"),
        ((SHIFTED, 0.5), "fit returned a float of figures: expected a dict"),
        (
            (Lossy(torch.zeros(1)), {}),
            "fit returned a Lossy, which cannot be read: expected grounding=Lossy of the Method",
        ),
        ((torch.zeros(1), {}), "fit returned a Tensor, which cannot be read: expected"),
    ],
)
def test_what_is_no_such_pair_is_refused(returned: object, told: str, known: None) -> None:
    with pytest.raises(BadInputError, match=f"^{told}"):
        files.fitted(returned)


def windows_of(count: int) -> Any:
    """Return episodes that begin on the rail of small_cart.py."""
    parts = {"state": 0.3, "goal": 1.0, "action": 0.5}
    return SimpleNamespace(windows=SimpleNamespace(**{name: torch.full((count, 5, 1), v) for name, v in parts.items()}))


RAIL = f"{Path(__file__).parents[1] / 'small_cart.py'}:TASK"


class Drifting(ShiftedSimulator):
    """Drifts by the actions of the episode so far."""

    def __init__(self, simulator: PlacedSimulator, shift: torch.Tensor) -> None:
        super().__init__(simulator, shift)
        self.drift = torch.zeros_like(simulator.state)

    def start(self, state: torch.Tensor, rows: torch.Tensor, goal: torch.Tensor, **before: Any) -> None:
        super().start(state, rows, goal, **before)
        self.drift = self.drift.index_fill(0, rows, 0.0)

    def step(self, action: torch.Tensor) -> torch.Tensor:
        self.drift = self.drift + 0.1 * action
        return self._settle(self.state, self.simulator.step(action) + self.drift + self.shift)

    def state_dict(self) -> dict[str, torch.Tensor]:
        return super().state_dict() | {"drift": self.drift}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        super().load_state_dict(state)
        self.drift = state["drift"].clone()


STEP = Drifting.step
START: Any = EpisodeSimulator.start
NOISE = torch.Generator()
UNCORRECTED = r"go on uncorrected: expected `return self._settle\(before, corrected\)`"


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"step": lambda self, action: STEP(self, action)[:, :0]}, r"step: expected shape \(2, 1\), got \(2, 0\)"),
        ({"step": lambda self, action: STEP(self, action).double()}, "step: expected torch.float32, got torch.float64"),
        (
            {"step": lambda self, action: self.simulator.step(action) + 1e-5},
            rf"step: returned .* 1\S*e-05 .*{UNCORRECTED}",
        ),
        ({"start": START}, "start: after other steps, .* ends .* elsewhere: expected `super"),
        ({"start": lambda self, *_, **__: None}, "start: after other steps, the same episode ends .* elsewhere"),
        (
            {"start": lambda self, *given, **_: (START(self, *given), self.drift.zero_())},
            "start: to start row 0 moves row 1 by .*: expected changes of `rows` alone",
        ),
        (
            {"state_dict": lambda self: {"drift": self.drift, "n": 2}},
            "state_dict: n: expected a torch tensor, got a int",
        ),
        ({"load_state_dict": EpisodeSimulator.load_state_dict}, "state_dict: resumed from it, steps end .* elsewhere"),
        (
            {"step": lambda self, action: STEP(self, action + torch.rand((), generator=NOISE))},
            "state_dict: resumed .*, and draws from torch's generator",
        ),
        ({"latent_size": 3}, "latent with latent_size = 3: expected a torch tensor, got a NoneType"),
        ({"latent": torch.zeros(2, 3), "latent_size": 3}, r"encoder: expected ψ\^s, whose latents policies see on"),
        (
            {"hidden_before": lambda *_: torch.zeros(4, 5, 1)},
            r"hidden_before: expected shape \(4, 3, any\), got \(4, 5, 1",
        ),
    ],
)
def test_a_simulator_that_a_training_would_not_run_as_it_is_meant_is_refused(
    changed: dict[str, Any], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Shifted, "corrected", lambda self, simulator: Drifting(simulator, self.shift))
    monkeypatch.setattr(Shifted, "start_stride", 2)
    files.check_step(task_named(RAIL), SHIFTED, SHIFTED, windows_of(4))
    for name, value in changed.items():
        monkeypatch.setattr(Shifted if "hidden" in name else Drifting, name, value)
    with pytest.raises(BadInputError, match=rf"^(Drifting|Shifted)\.{told}"):
        files.check_step(task_named(RAIL), SHIFTED, SHIFTED, windows_of(4))


def test_what_is_not_restored_as_it_was_or_not_finite_is_refused(tmp_path: Path) -> None:
    whole, lost = Shifted(torch.tensor([0.01])), Shifted(torch.tensor([0.0]))
    files.check_step(task_named(RAIL), whole, whole, windows_of(4))
    with pytest.raises(BadInputError, match=r"^Shifted\.from_file: read again, steps end up to 0\.05 from those"):
        files.check_step(task_named(RAIL), whole, lost, windows_of(4))
    with pytest.raises(BadInputError, match=r"^fit returned a Shifted with NaN or infinity in shift: expected finite"):
        files.save_grounding(tmp_path / "g", Shifted(torch.tensor([math.nan])), no_episodes())
    assert not (tmp_path / "g").exists()
