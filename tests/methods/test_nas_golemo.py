from dataclasses import replace
from pathlib import Path

import pytest
import torch
from spending import SPENT, spend
from stopping import Stopped, stop_past
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.core.progress import silent
from astra_data.core.seeding import derive, generator
from astra_data.grounding.diagnostics import correction_r2
from astra_data.grounding.fit import Fitting, GroundConfig
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.residual import ResidualModel, ResidualShape
from astra_data.methods.nas_golemo import GolemoConfig, fit_residual
from astra_data.worlds.registry import TASKS

CONFIG = GolemoConfig(epochs=12, hidden_size=16, layers=2, learning_rate=0.01)
STEPS = 40


def episodes(count: int, lacking: Tensor, action: Tensor) -> PairedEpisodes:
    """Return episodes of random states in which the simulator's next states lack `lacking` (E, T, 4)."""
    state, simulated = torch.randn(2, count, STEPS, 4)
    mask = torch.ones(count, STEPS)
    mask[0, 25:] = 0.0
    return toy_episodes(state, action, next_state=simulated + lacking, simulated_next=simulated, mask=mask)


def fitting(both: PairedEpisodes, folder: Path, config: GolemoConfig = CONFIG) -> Fitting:
    training, held_out = both.select(torch.arange(24)), both.select(torch.arange(24, len(both)))
    task = TASKS["antmaze-umaze"]
    return Fitting(task, GroundConfig(), config, training, held_out, 0, "cpu", folder, silent)


def explained(model: ResidualModel, held_out: PairedEpisodes, *, forgets: bool) -> float:
    windows = held_out.windows
    steps = [windows.state, windows.action, windows.simulated_next]
    if forgets:
        steps = [one.flatten(0, 1).unsqueeze(1) for one in steps]
    memory = model.initial_memory(len(steps[0]))
    corrected = model.correct(steps[0], steps[1], steps[2], memory)[0].detach()
    share = correction_r2(corrected.view_as(windows.state), windows, model.correction_std)
    assert share is not None
    return share


def test_learns_a_constant_offset_and_how_what_is_left_scatters(tmp_path: Path) -> None:
    torch.manual_seed(0)
    offset = torch.tensor([0.3, -0.2, 0.0, 1.0])
    noise = torch.tensor([0.1, 0.1, 0.02, 0.2]) * torch.randn(48, STEPS, 4)
    given = fitting(episodes(48, offset + noise, torch.randn(48, STEPS, 2)), tmp_path)
    grounding, metrics = fit_residual(given)
    model = grounding.model
    windows = given.held_out.windows
    memory = model.initial_memory(len(windows.state))
    corrected, _ = model.correct(windows.state, windows.action, windows.simulated_next, memory)
    added = (corrected - windows.simulated_next).detach().mean((0, 1))
    assert added.tolist() == pytest.approx(offset.tolist(), abs=0.05)
    scatter = (model.residual_factor @ model.residual_factor.T).diagonal().sqrt()
    assert scatter.tolist() == pytest.approx([0.1, 0.1, 0.02, 0.2], rel=0.25)
    assert [point["step"] for point in metrics["epochs"]] == [24 * (epoch + 1) for epoch in range(12)]
    assert metrics["epochs"][-1]["r2_state"] == pytest.approx(
        explained(model, given.held_out, forgets=False), abs=1e-6
    )


def test_the_bar_shows_the_figure_of_the_last_epoch(tmp_path: Path) -> None:
    torch.manual_seed(0)
    both, notes = episodes(25, torch.randn(25, STEPS, 4), torch.randn(25, STEPS, 2)), list[str]()
    config = GolemoConfig(epochs=4, hidden_size=4, layers=1, learning_rate=0.05)

    def note(_: float, text: str = "") -> None:
        notes.append(text)

    given = replace(fitting(both, tmp_path, config), progress=note)
    _, metrics = fit_residual(given)
    shown = [text.rpartition("correction ")[2] for text in notes if "correction" in text]
    found = [f"{point['r2_state']:.3f}" for point in metrics["epochs"]]
    assert len(set(found)) > 2 and [*dict.fromkeys(shown)] == [*dict.fromkeys(found[:-1])]


def test_the_scatter_is_that_of_held_out_episodes(tmp_path: Path) -> None:
    torch.manual_seed(0)
    deviation = torch.tensor([0.1] * 24 + [1.0] * 24)[:, None, None]
    given = fitting(episodes(48, deviation * torch.randn(48, STEPS, 4), torch.randn(48, STEPS, 2)), tmp_path)
    given = replace(given, settings=CONFIG.model_copy(update={"epochs": 1, "hidden_size": 4}))
    grounding, _ = fit_residual(given)
    model = grounding.model
    scatter = (model.residual_factor @ model.residual_factor.T).diagonal().sqrt()
    assert scatter.tolist() == pytest.approx([1.0] * 4, rel=0.1)


def test_an_update_is_adams_on_whole_episodes_with_residuals_in_their_deviations(tmp_path: Path) -> None:
    torch.manual_seed(0)
    both = episodes(
        25, torch.randn(25, STEPS, 4) * torch.tensor([0.1, 1.0, 2.0, 5.0]), torch.randn(25, STEPS, 2)
    )
    given = fitting(both, tmp_path, GolemoConfig(epochs=1, hidden_size=4, layers=1, learning_rate=0.02))
    steps = given.training.windows.mask.bool()
    residual = (given.training.windows.next_state - given.training.windows.simulated_next)[steps]
    fitted, metrics = fit_residual(given)
    ours = fitted.model
    torch.manual_seed(derive(0, "grounding"))
    theirs = ResidualModel(ResidualShape(4, 2, 4, 1))
    theirs.set_scales(given.training.windows.state[steps], residual)
    torch.testing.assert_close(theirs.correction_std, residual.std(0), rtol=1e-3, atol=1e-6)
    optimizer, losses = torch.optim.Adam(theirs.parameters(), lr=0.02), []
    for episode in generator(0, "grounding epoch 0").permutation(24).tolist():
        length = 25 if episode == 0 else STEPS
        state, action = (
            both.windows.state[episode, None, :length],
            both.windows.action[episode, None, :length],
        )
        simulated = both.windows.simulated_next[episode, None, :length]
        corrected, _ = theirs.correct(state, action, simulated, theirs.initial_memory(1))
        wrong = (corrected - both.windows.next_state[episode, None, :length]) / residual.std(0)
        losses.append(wrong.square().mean())
        optimizer.zero_grad()
        losses[-1].backward()
        optimizer.step()
    for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)
    assert metrics["epochs"][0]["loss_state"] == pytest.approx(
        float(torch.stack(losses).mean().detach()), rel=1e-3
    )


def test_learns_a_lag_that_only_a_memory_knows(tmp_path: Path) -> None:
    torch.manual_seed(0)
    action = torch.randn(32, STEPS, 2)
    lacking = torch.zeros(32, STEPS, 4)
    lacking[:, 2:, :2] = 0.1 * action[:, :-2]
    lacking[..., 2:] = 0.01 * torch.randn(32, STEPS, 2)
    given = fitting(episodes(32, lacking, action), tmp_path)
    # Scales apart, the last two entries are noise: compare the first two alone.
    model = fit_residual(given)[0].model
    model.correction_std[2:] = 1e6
    assert explained(model, given.held_out, forgets=False) > 0.8
    assert explained(model, given.held_out, forgets=True) < 0.2


def test_what_lies_beyond_an_episodes_end_teaches_nothing(tmp_path: Path) -> None:
    torch.manual_seed(0)
    both = episodes(32, torch.randn(32, STEPS, 4), torch.randn(32, STEPS, 2))
    config = GolemoConfig(epochs=1, hidden_size=4, layers=1)
    models = []
    for name in ("zeros", "numbers"):
        (tmp_path / name).mkdir()
        models.append(fit_residual(fitting(both, tmp_path / name, config))[0].model)
        both.windows.next_state[0, 25:] = 100.0
    for ours, theirs in zip(models[0].parameters(), models[1].parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_the_time_before_an_interruption_counts(tmp_path: Path) -> None:
    torch.manual_seed(0)
    both = episodes(32, torch.randn(32, STEPS, 4), torch.randn(32, STEPS, 2))
    given = fitting(both, tmp_path, GolemoConfig(epochs=2, hidden_size=4, layers=1))
    with pytest.raises(Stopped):
        fit_residual(replace(given, progress=stop_past(0.5)))
    spend(tmp_path / "checkpoint.safetensors")
    _, metrics = fit_residual(given)
    assert all(seconds < metrics[clock] < seconds + 500 for clock, seconds in SPENT.items())
    assert metrics["episodes_per_second"] == pytest.approx(2 * 24 / metrics["wall_seconds"], rel=0.01)


def test_a_fit_that_diverged_is_told(tmp_path: Path) -> None:
    torch.manual_seed(0)
    both = episodes(30, torch.ones(30, STEPS, 4), torch.randn(30, STEPS, 2))
    config = GolemoConfig(epochs=1, hidden_size=4, layers=1, learning_rate=1e30)
    with pytest.raises(BadInputError, match=r"the fit diverged: lower learning_rate in \[nas_golemo\]"):
        fit_residual(fitting(both, tmp_path, config))
