"""Ground: fit the history model that corrects the abstract simulator, and report how good it is."""

import json
import time
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from astra_data.checkpoint import finished_folder, flatten, load_tensors, save_tensors, unflatten
from astra_data.dataset.pairs import PairedEpisodes
from astra_data.errors import BadInputError
from astra_data.gap import gap_report
from astra_data.grounding_file import save_grounding
from astra_data.methods import method_named
from astra_data.models.grounding import GroundingModel, GroundingShape, LossWeights, TargetKind
from astra_data.progress import Progress
from astra_data.recipe import Config, Count, Positive, Share
from astra_data.results.provenance import origin
from astra_data.seeding import derive
from astra_data.tasks import task_named

_CHECKPOINT_EVERY = 250


class GroundConfig(Config):
    """How the grounding model is fitted. The paper prints none of these."""

    updates: Count = 1500
    """Gradient updates in all."""
    batch_windows: Count = 48
    """Windows per update."""
    window: Count = 100
    """Steps per window, in backpropagation through time."""
    learning_rate: Positive = 1e-3
    """At the start; falls to zero along a half cosine."""
    gradient_norm: Positive = 1.0
    """Gradients are clipped to this norm."""
    target: TargetKind = "ema"
    """Where the next latent of the latent loss comes from; "online" is the printed loss, unbounded below."""
    ema_rate: Share = 0.01
    """Share by which the slow encoder of "ema" follows, per update."""
    latent_size: Count = 64
    """Z, also the size of the encoder's memory."""
    position_octaves: int = 4
    """Sines and cosines of the position from 16 m down by halves; 0 for the bare position."""
    held_out_share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Share of the episodes on which nothing is fitted but the residual's scatter, unless the dataset sets
    some aside itself."""


def ground(
    task: str,
    method: str,
    config: GroundConfig,
    *,
    dataset: Path,
    seed: int,
    out: Path,
    device: str,
    progress: Progress,
) -> None:
    """Fit a grounding model to a paired dataset; write it, its telemetry and its gap report to `out`.

    Raises:
        BadInputError: the method does not ground, or the dataset is not paired.
    """
    weights = method_named(method).loss_weights
    if weights is None:
        raise BadInputError(f"method '{method}' does not ground its simulator")
    world, made = task_named(task), origin(device)
    episodes = PairedEpisodes.load(dataset, device)
    training, held_out = episodes.split(config.held_out_share, seed)
    torch.manual_seed(derive(seed, "grounding"))
    model = GroundingModel(
        GroundingShape(
            state_size=training.windows.state.shape[-1],
            action_size=training.windows.action.shape[-1],
            goal_size=training.windows.goal.shape[-1],
            latent_size=config.latent_size,
            position_octaves=config.position_octaves,
        ),
        config.target,
    ).to(device)
    windows = training.windows
    model.set_scales(
        {
            "state": training.steps(windows.state),
            "goal": training.steps(windows.goal),
            "correction": training.steps(windows.next_state - windows.simulated_next),
            "reward": training.steps(windows.reward),
        }
    )
    with finished_folder(out) as folder:
        metrics = _fit(model, training, held_out, weights, config, seed, folder, progress)
        _fit_residual(model, held_out)
        progress(1.0, "gap report")
        gap = gap_report(world, model, held_out, seed=seed)
        save_grounding(folder / "grounding.safetensors", model, episodes)
        (folder / "metrics.json").write_text(json.dumps(made | metrics, indent=1))
        (folder / "gap.json").write_text(json.dumps(gap, indent=1))
        (folder / "config.json").write_text(config.model_dump_json(indent=1))
        (folder / "checkpoint.safetensors").unlink(missing_ok=True)


def _fit(
    model: GroundingModel,
    training: PairedEpisodes,
    held_out: PairedEpisodes,
    weights: LossWeights,
    config: GroundConfig,
    seed: int,
    folder: Path,
    progress: Progress,
) -> dict[str, Any]:
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.updates)
    epochs: list[dict[str, float | None]] = []
    seconds, first = 0.0, 0
    checkpoint = folder / "checkpoint.safetensors"
    if checkpoint.exists():
        tensors, told = load_tensors(checkpoint)
        state = unflatten(tensors)
        model.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])
        schedule.load_state_dict(told["schedule"])
        epochs, seconds, first = told["epochs"], told["seconds"], told["update"]
    began = time.perf_counter() - seconds
    for update in range(first, config.updates):
        torch.manual_seed(derive(seed, f"grounding update {update}"))
        windows, _ = training.draw_windows(config.batch_windows, config.window)
        loss, parts = model.losses(windows, weights)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, config.gradient_norm)
        optimizer.step()
        schedule.step()
        model.update_target(config.ema_rate)
        done = update + 1
        seconds = time.perf_counter() - began
        if done % _CHECKPOINT_EVERY == 0 or done == config.updates:
            losses = {f"loss_{name}": float(value.detach()) for name, value in parts.items()}
            epochs.append({"step": done, **losses, **telemetry(model, held_out, weights)})
            state = {"model": model.state_dict(), "optimizer": optimizer.state_dict()}
            told = {
                "update": done,
                "seconds": seconds,
                "epochs": epochs,
                "schedule": {k: v for k, v in schedule.state_dict().items() if not k.startswith("_get")},
            }
            save_tensors(checkpoint, flatten(state), told)
        if done % 10 == 0:
            rate = done * config.batch_windows / seconds
            note = f"{rate:,.0f} windows/s"
            explained = epochs[-1]["r2_state"] if epochs else None
            if explained is not None:
                note += f"  held-out R² of the correction {explained:.3f}"
            progress(done / config.updates, note)
    return {
        "windows_per_second": config.updates * config.batch_windows / seconds,
        "wall_seconds": seconds,
        "parameters": sum(parameter.numel() for parameter in parameters),
        "epochs": epochs,
    }


@torch.no_grad()
def telemetry(
    model: GroundingModel, episodes: PairedEpisodes, weights: LossWeights
) -> dict[str, float | None]:
    """Return what falling losses do not show, on `episodes`.

    R² of each head that is trained (of the correction: of the simulator's error that it removes), None where
    there is nothing to explain, as in a perfect simulator; the mean standard deviation of the latent's
    entries, and the latent's effective rank (exponential of the entropy of the covariance's normalised
    eigenvalues).
    """
    windows = episodes.windows
    inputs = model.encoder_input(windows.state, windows.goal, windows.previous_action)
    latent, _ = model.encoder(inputs)
    mask = windows.mask.bool()
    corrected = model.correct(latent, windows.action, windows.simulated_next)
    wrong = ((corrected - windows.next_state) / model.correction_std)[mask].square().sum()
    raw = ((windows.simulated_next - windows.next_state) / model.correction_std)[mask].square().sum()
    figures = {"r2_state": _explained(wrong, raw)}
    if weights.reward > 0:
        predicted = model.predict_reward_parts(latent, windows.action)[mask]
        for part, name in enumerate(("r2_reward", "r2_final_reward")):
            figures[name] = _r2(predicted[:, part], windows.reward[mask][:, part])
    if weights.latent > 0:
        mean, _ = model.predict_latent(latent[:, :-1], windows.action[:, :-1])
        both = mask[:, :-1] & mask[:, 1:]
        figures["r2_latent"] = _r2(mean[both], latent[:, 1:][both])
    samples = latent[mask]
    eigenvalues = torch.linalg.eigvalsh(torch.cov(samples.T)).clamp_min(1e-12)
    shares = eigenvalues / eigenvalues.sum()
    figures["latent_std"] = float(samples.std(0).mean())
    figures["latent_rank"] = float(torch.exp(-(shares * shares.log()).sum()))
    return figures


def _r2(predicted: Tensor, true: Tensor) -> float | None:
    return _explained((predicted - true).square().sum(), (true - true.mean(0)).square().sum())


def _explained(residual: Tensor, total: Tensor) -> float | None:
    return float(1.0 - residual / total) if total > 0 else None


@torch.no_grad()
def _fit_residual(model: GroundingModel, held_out: PairedEpisodes) -> None:
    """Fit the Gaussian scatter of the target around the correction, on episodes not trained on."""
    windows = held_out.windows
    inputs = model.encoder_input(windows.state, windows.goal, windows.previous_action)
    latent, _ = model.encoder(inputs)
    residual = held_out.steps(
        windows.next_state - model.correct(latent, windows.action, windows.simulated_next)
    )
    covariance = torch.cov(residual.T) + 1e-9 * torch.eye(residual.shape[1], device=residual.device)
    model.residual_factor.copy_(torch.linalg.cholesky(covariance))
