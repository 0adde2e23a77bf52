"""Fit: what a method is given to learn about its simulator from pairs, and the way of the history models."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from astra_data.core.config import Config, Count, Number, Positive, Share
from astra_data.core.progress import Progress
from astra_data.core.seeding import derive
from astra_data.grounding.diagnostics import telemetry
from astra_data.grounding.grounding_file import Grounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.descent import Descent, DescentConfig
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape, LossWeights, TargetKind
from astra_data.worlds.task import Task

_KEEP_EVERY = 250


class GroundConfig(DescentConfig):
    """How the grounding model is fitted."""

    batch_windows: Count = 48
    """Windows per update."""
    window: Count = 100
    """Steps per window, in backpropagation through time."""
    latent_weight: Positive = 0.1
    """λ1, of the loss of the next latent. At 1 it crowds out the correction: on the Long Maze held-out R²
    0.826 against 0.835 of NAS, 200-step position error 0.92 m against 0.65 m; at 0.1: 0.833, 0.72 m."""
    reward_weight: Positive = 1.0
    """λ2, of the loss of the reward; λ3, of the correction's, is 1."""
    target: TargetKind = "ema"
    """Where the next latent of the latent loss comes from; "online" is the printed loss, unbounded below."""
    ema_rate: Share = 0.01
    """Share by which the slow encoder of "ema" follows, per update."""
    latent_size: Count = 64
    """Z, also the size of the encoder's memory."""
    position_octaves: Number = 4
    """Sines and cosines of the position from 16 m down by halves; 0 for the bare position. Without effect
    where a task has no positions."""
    correction_heads: Count = 1
    """Heads that correct the state, each of which learns from half of every batch, drawn for it; their mean
    corrects, and `doubt_penalty` keeps policies from where they disagree."""
    reward: Literal["whole", "correction"] = "whole"
    """What R_pred learns: "whole", the target's reward, as in the paper; "correction", what the task's own
    reward on recorded abstract states lacks of it, as f_abs corrects the state. Only for policies that learn
    from the predicted reward; augmented copies are judged by abstract states, which lack nothing."""
    reward_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the latent that R_pred does not see while it learns, so that it learns no failure by heart."""
    failure_weight: Positive = 1.0
    """Of the failures in the loss of the reward. With 1, predicting their average costs as much as predicting
    that of the rest does."""
    held_out_share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Share of the episodes on which nothing is fitted but the residual's scatter, unless the dataset sets
    some aside itself."""


@dataclass(frozen=True)
class Fitting:
    """What a method has to learn about its simulator from.

    Attributes:
        task: the task. config: the recipe's `[ground]`.
        settings: the method's own table of the recipe, if it has one.
        training: paired episodes to fit. held_out: those that only measure.
        seed: of all randomness. device: of the networks.
        folder: for checkpoints and further files; what is left in it becomes part of the artefact.
        progress: told the share done and the rate.
    """

    task: Task
    config: GroundConfig
    settings: Config | None
    training: PairedEpisodes
    held_out: PairedEpisodes
    seed: int
    device: str
    folder: Path
    progress: Progress


Fit = Callable[[Fitting], tuple[Grounding, dict[str, Any]]]
"""Returns what was learned, and figures that say how well and how fast."""


@dataclass(frozen=True)
class HistoryFit:
    """Fit a history model: the correction, and what else a method learns (paper, Section IV-A).

    Attributes:
        latent: whether it predicts the next latent. reward: whether it predicts the target's reward.
    """

    latent: bool
    reward: bool

    def weights(self, config: GroundConfig) -> LossWeights:
        """Return the weights of the losses."""
        return LossWeights(
            latent=config.latent_weight if self.latent else 0.0,
            reward=config.reward_weight if self.reward else 0.0,
        )

    def __call__(self, fitting: Fitting) -> tuple[GroundingModel, dict[str, Any]]:
        """Return the model and its telemetry."""
        config = fitting.config
        if config.reward == "correction":
            fitting = replace(
                fitting,
                training=what_rewards_lack(fitting.task, fitting.training),
                held_out=what_rewards_lack(fitting.task, fitting.held_out),
            )
        torch.manual_seed(derive(fitting.seed, "grounding"))
        training = fitting.training
        windows = training.windows
        model = GroundingModel(
            GroundingShape(
                state_size=windows.state.shape[-1],
                action_size=windows.action.shape[-1],
                goal_size=windows.goal.shape[-1],
                latent_size=config.latent_size,
                position_octaves=config.position_octaves if fitting.task.plane else 0,
                ball_index=fitting.task.ball_index,
                correction_heads=config.correction_heads,
                corrects_reward=config.reward == "correction",
                reward_dropout=config.reward_dropout,
            ),
            config.target,
        ).to(fitting.device)
        model.set_scales(
            {
                "state": training.steps(windows.state),
                "goal": training.steps(windows.goal),
                "correction": training.steps(windows.next_state - windows.simulated_next),
            }
        )
        model.set_reward_scales(training.steps(windows.reward), config.failure_weight)
        metrics = _optimise(model, self.weights(config), fitting)
        _fit_residual(model, fitting.held_out)
        return model, metrics


def what_rewards_lack(task: Task, episodes: PairedEpisodes) -> PairedEpisodes:
    """Take from the rewards in the windows of `episodes` what the task's own reward pays on abstract states.

    Where abstract states show a goal, or one out of reach, and the target goes on, nothing is lacking: there
    simulators decide otherwise, and R_pred is not asked.
    """
    windows, objective = episodes.windows, task.objective
    before, after, goal = (
        values.flatten(0, 1) for values in (windows.state, windows.next_state, windows.goal)
    )
    decided = objective.reached(after, goal) | objective.missed(after, goal)
    own = objective.reward(before, after, goal, torch.zeros_like(decided))
    going_on, failing = windows.reward.unbind(-1)
    own, decided = own.reshape(going_on.shape), decided.reshape(going_on.shape)
    asked = windows.mask.bool() & ~decided
    lacking = torch.stack(
        [
            torch.where(asked & ~episodes.terminated, going_on - own, 0.0),
            torch.where(asked & (failing != 0), failing - own, failing),
        ],
        dim=-1,
    )
    return replace(episodes, windows=replace(windows, reward=lacking))


def _optimise(model: GroundingModel, weights: LossWeights, fitting: Fitting) -> dict[str, Any]:
    config = fitting.config
    descent = Descent(model, config, checkpoint=fitting.folder / "checkpoint.safetensors")
    while not descent.is_over:
        torch.manual_seed(derive(fitting.seed, f"grounding update {descent.done}"))
        windows, _ = fitting.training.draw_windows(config.batch_windows, config.window)
        loss, parts = model.losses(windows, weights)
        descent.update(loss)
        model.update_target(config.ema_rate)
        if descent.done % _KEEP_EVERY == 0 or descent.is_over:
            losses = {f"loss_{name}": float(value.detach()) for name, value in parts.items()}
            descent.keep(**losses, **telemetry(model, fitting.held_out, weights))
        if descent.done % 10 == 0:
            note = f"{descent.done * config.batch_windows / descent.stopwatch.seconds:,.0f} windows/s"
            explained = descent.points[-1]["r2_state"] if descent.points else None
            if explained is not None:
                note += f"  held-out R² of the correction {explained:.3f}"
            fitting.progress(descent.share, note)
    return {
        "windows_per_second": config.updates * config.batch_windows / descent.stopwatch.seconds,
        **descent.stopwatch.spent(),
        "parameters": sum(parameter.numel() for parameter in descent.parameters),
        "epochs": descent.points,
    }


def scatter_factor(residual: Tensor) -> Tensor:
    """Return the factor (X, X) of the Gaussian noise that scatters like `residual` (N, X)."""
    covariance = torch.cov(residual.T) + 1e-9 * torch.eye(residual.shape[1], device=residual.device)
    return torch.as_tensor(torch.linalg.cholesky(covariance))


@torch.no_grad()
def _fit_residual(model: GroundingModel, held_out: PairedEpisodes) -> None:
    """Fit the scatter of the target around the correction, and of its heads, on episodes not trained on."""
    windows = held_out.windows
    latent, _ = model.encode(windows)
    opinions = model.opinions(latent, windows.action, windows.simulated_next)
    model.residual_factor.copy_(scatter_factor(held_out.steps(windows.next_state - opinions.mean(0))))
    if len(opinions) > 1:
        model.usual_disagreement.copy_(held_out.steps(model.doubt(opinions)).mean())
