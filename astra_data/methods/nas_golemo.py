"""NAS as Golemo et al. (2018) built it: an LSTM that predicts the residual of each simulated state.

The policy sees no latent, so it has a memory of its own; its reward is the task's own on corrected states.
"""

from typing import Any

import torch

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.config import AtOnce, Config, Count, Positive, own_settings
from astra_data.core.errors import BadInputError
from astra_data.core.logbook import Logbook
from astra_data.core.seeding import derive, generator
from astra_data.grounding.diagnostics import correction_r2
from astra_data.grounding.fit import Fitting
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.raw import scatter_factor
from astra_data.grounding.residual import ResidualGrounding
from astra_data.learning.networks.residual import ResidualModel, ResidualShape
from astra_data.methods.method import Method, Table


class GolemoConfig(Config):
    """How the residual model is fitted; the defaults are the authors'."""

    epochs: Count = 5
    """Passes over the training episodes; each update uses one whole episode."""
    hidden_size: AtOnce = 128
    """Size of each LSTM layer."""
    layers: AtOnce = 3
    """Number of LSTM layers."""
    learning_rate: Positive = 1e-3
    """Learning rate of Adam, constant."""


def fit_residual(fitting: Fitting) -> tuple[ResidualGrounding, dict[str, Any]]:
    """Fit the residual model to whole episodes; return it and its telemetry.

    The loss is the squared error of residuals divided by their deviation in the training episodes.

    Raises:
        BadInputError: corrected states are not finite: the fit diverged.
    """
    config = own_settings(fitting.settings, GolemoConfig())
    training, windows = fitting.training, fitting.training.windows
    torch.manual_seed(derive(fitting.seed, "grounding"))
    states, actions = windows.state.shape[-1], windows.action.shape[-1]
    shape = ResidualShape(states, actions, config.hidden_size, config.layers)
    model = ResidualModel(shape).to(fitting.device)
    model.set_scales(
        training.steps(windows.state), training.steps(windows.next_state - windows.simulated_next)
    )
    metrics = _optimize(model, config, fitting)
    held_out = fitting.held_out
    residual = held_out.windows.next_state - _corrected(model, held_out)
    if not residual.isfinite().all():
        raise BadInputError(
            "the fit diverged: lower learning_rate in [nas_golemo], or look at the data's values"
        )
    model.residual_factor.copy_(scatter_factor(held_out.steps(residual)))
    return ResidualGrounding(model), metrics


def _optimize(model: ResidualModel, config: GolemoConfig, fitting: Fitting) -> dict[str, Any]:
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    episodes, count = fitting.training, len(fitting.training)

    def restore(state: dict[str, Any]) -> None:
        model.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])

    logbook = Logbook(fitting.folder / CHECKPOINT, restore)
    points, stopwatch = logbook.points, logbook.stopwatch
    for epoch in range(len(points), config.epochs):
        order = generator(fitting.seed, f"grounding epoch {epoch}").permutation(count)
        losses = 0.0
        for index, episode in enumerate(order.tolist()):
            losses += _update(model, optimizer, episodes.select(torch.tensor([episode]))) / count
            done = epoch * count + index + 1
            rate = done / stopwatch.seconds
            note = f"{rate:,.0f} episodes/s"
            if points and (explained := points[-1]["r2_state"]) is not None:
                note += f"  held-out R² of the correction {explained:.3f}"
            fitting.progress(done / (config.epochs * count), note)
        points.append({"step": done, "loss_state": losses, "r2_state": _r2(model, fitting.held_out)})
        logbook.keep({"model": model.state_dict(), "optimizer": optimizer.state_dict()})
    return {
        "episodes_per_second": config.epochs * count / stopwatch.seconds,
        **stopwatch.spent(),
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "epochs": points,
    }


def _update(model: ResidualModel, optimizer: torch.optim.Optimizer, episode: PairedEpisodes) -> float:
    """Make one update on an episode; return the loss."""
    steps, windows = slice(int(episode.lengths)), episode.windows
    corrected, _ = model.correct(
        windows.state[:, steps],
        windows.action[:, steps],
        windows.simulated_next[:, steps],
        model.initial_memory(1),
    )
    loss = ((corrected - windows.next_state[:, steps]) / model.correction_std).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return float(loss.detach())


@torch.no_grad()
def _corrected(model: ResidualModel, episodes: PairedEpisodes) -> torch.Tensor:
    """Return the corrected next states (E, T, X), each one step from the true state."""
    windows = episodes.windows
    memory = model.initial_memory(len(episodes))
    return model.correct(windows.state, windows.action, windows.simulated_next, memory)[0]


def _r2(model: ResidualModel, episodes: PairedEpisodes) -> float | None:
    return correction_r2(_corrected(model, episodes), episodes.windows, model.correction_std)


NAS_GOLEMO = Method(
    name="nas_golemo",
    title="NAS (Golemo et al.)",
    color="#0072B2",
    fit=fit_residual,
    table=Table("nas_golemo", GolemoConfig),
    configures="ground",
)
