"""Fit a grounding: the inputs of a method's fit, and the fit of history models."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.config import AtOnce, Config, CountFromZero, Positive, Share
from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, part
from astra_data.core.seeding import derive, generator
from astra_data.core.stopwatch import CLOCKS
from astra_data.dataset.columns import REWARD
from astra_data.grounding.clearance import recorded_clearance_m
from astra_data.grounding.diagnostics import telemetry
from astra_data.grounding.failures import compared_foresight, fit_failures, tells_failures
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import FittedGrounding
from astra_data.grounding.raw import scatter_factor
from astra_data.grounding.scatter import fit_scatter
from astra_data.learning.descent import Descent, DescentConfig
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape, LossWeights, TargetKind
from astra_data.learning.networks.paired_windows import RISK_STEPS
from astra_data.worlds.task import Task

_KEEP_EVERY = 250


class GroundConfig(DescentConfig):
    """How the grounding model is fitted."""

    batch_windows: AtOnce = 48
    """Windows per update."""
    window: AtOnce = 100
    """Steps per window, in backpropagation through time."""
    latent_weight: Positive = 0.1
    """λ1, weight of the loss of the next latent; at 1 it crowds out the correction."""
    reward_weight: Positive = 1.0
    """λ2, weight of the loss of the reward; λ3, the weight of the correction, is 1."""
    target: TargetKind = "ema"
    """Target of the latent loss: a slowly updated copy of the encoder ("ema"), or the encoder itself without
    its gradient ("detach") or with it ("online": the loss as printed, which is unbounded below)."""
    ema_rate: Share = 0.01
    """Fraction by which the slow copy of "ema" follows the encoder in each update."""
    latent_size: AtOnce = 64
    """Z, also the size of the encoder's hidden state."""
    position_octaves: CountFromZero = 4
    """Number of wavelengths of sines and cosines of the position, from 16 m down, each half the previous; 0
    for none. No effect if a task has no positions."""
    correction_heads: AtOnce = 1
    """Number of heads that predict the correction. Each learns from its own random half of every batch; the
    correction is their mean, and `disagreement_penalty` keeps policies away from states where they disagree.
    """
    members: CountFromZero = Field(default=0, exclude_if=lambda members: not members)
    """Number of further models, each fitted to a bootstrap sample of the training episodes. With
    `keep_member` they correct simulated episodes instead of the model that is fitted to all episodes."""
    reward: Literal["whole", "correction"] = "whole"
    """What R_pred learns. "whole": the target's reward, as in the paper. "correction": the residual reward,
    the target's minus the task's own on the recorded abstract states. Matters only to policies that learn
    from the predicted reward. Augmented copies are rewarded on abstract states, so their residual is zero."""
    reward_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Dropout rate on R_pred's input latent in training, so that it does not memorize failures."""
    failure_weight: Positive = 1.0
    """Weight of failures in the loss of the reward. With 1, predicting the average of the failures costs as
    much as predicting the average of all other steps."""
    failure_members: CountFromZero = Field(default=0, exclude_if=lambda members: not members)
    """Number of networks in the failure model, which predicts failures from the last second of motion and
    replaces the failure predictions of R_pred and the topple head; 0 for none. No effect if no episode fails.
    """
    failure_steps: AtOnce = Field(default=RISK_STEPS, exclude_if=lambda steps: steps == RISK_STEPS)
    """Number of steps within which the failure model predicts failures: with fewer it knows better when they
    come, with more it warns earlier."""
    recorded_clearance: bool = Field(default=False, exclude_if=lambda used: not used)
    """Keep corrected states as far from walls as the robot was in 98 of 100 recorded steps: a body slimmer
    than the robot's slides along walls where nothing was recorded. No effect if a task has no walls."""
    scatter: bool = Field(default=False, exclude_if=lambda used: not used)
    """Add noise to corrected states, distributed as held-out episodes are around the correction; its size
    depends on the moment. Without it a simulator moves more smoothly than any robot and never disturbs
    policies."""
    held_out_share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Fraction of the episodes to hold out, for measuring the error and for fitting the scatter around the
    correction, unless the dataset holds some out itself."""


@dataclass(frozen=True)
class Fitting:
    """What a method is given to fit its grounding to.

    Attributes:
        task: the task. config: the recipe's `[ground]`.
        settings: the method's own table of the recipe, if it has one.
        training: paired episodes to fit. held_out: paired episodes to measure on.
        seed: of all randomness. device: of the networks.
        folder: for checkpoints and further files; files left in it become part of the artifact.
        progress: called with the share done and a note.
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


Fit = Callable[[Fitting], tuple[FittedGrounding, dict[str, Any]]]
"""Returns the grounding, and figures of how good it is and how fast it was fitted."""


@dataclass(frozen=True)
class HistoryFit:
    """Fit a history model: the correction, and the other parts that a method has (paper, Section IV-A).

    Attributes:
        latent: whether the next latent is predicted. reward: whether the target's reward is predicted.
    """

    latent: bool
    reward: bool

    def weights(self, config: GroundConfig, *, failures: bool = True) -> LossWeights:
        """Return the weights of the losses; `failures` is whether failures are learned."""
        return LossWeights(
            latent=config.latent_weight if self.latent else 0.0,
            reward=config.reward_weight if self.reward else 0.0,
            failures=float(failures),
        )

    def __call__(self, fitting: Fitting) -> tuple[HistoryGrounding, dict[str, Any]]:
        """Return the grounding and its figures.

        Raises:
            BadInputError: the reward is to be predicted, and none was recorded.
        """
        config = fitting.config
        if self.reward and not fitting.training.has_rewards:
            raise BadInputError(
                f"{fitting.training.reference} has no {REWARD}, which the method predicts: take one "
                "that does not, such as nas"
            )
        if config.reward == "correction" and fitting.training.has_rewards:
            fitting = replace(
                fitting,
                training=residual_rewards(fitting.task, fitting.training),
                held_out=residual_rewards(fitting.task, fitting.held_out),
            )
        can_tell = tells_failures(fitting.task, fitting.training, config.failure_steps)
        foresees = bool(config.failure_members) and can_tell
        weights, count = self.weights(config, failures=not foresees), 1 + config.members
        first, *others = (_fitted(fitting, weights, number, count) for number in range(count))
        (model, metrics), members = first, tuple(other for other, _ in others)
        _measure_corrections(model, members, fitting.held_out)
        if members:
            metrics["members"] = [figures["epochs"][-1] for _, figures in others]
            for clock in CLOCKS:
                metrics[clock] += sum(figures[clock] for _, figures in others)
        grounding = HistoryGrounding(model, members=members)
        if config.recorded_clearance:
            metrics["clearance_m"] = clearance = recorded_clearance_m(fitting.task, fitting.training)
            grounding = replace(grounding, clearance_m=clearance)
        if config.scatter:
            scatter_model, metrics["scatter"] = fit_scatter(
                model, fitting.training, fitting.held_out, fitting.seed
            )
            grounding = replace(grounding, scatter_model=scatter_model)
        if foresees:
            sizes = config.failure_members, fitting.seed, config.failure_steps
            failures = fit_failures(fitting.task, grounding, fitting.training, *sizes)
            grounding = replace(grounding, failures=failures)
        if config.failure_members:
            metrics["failures"] = compared_foresight(fitting.task, grounding, fitting.held_out, self.reward)
        return grounding, metrics


def _fitted(
    whole: Fitting, weights: LossWeights, number: int, count: int
) -> tuple[GroundingModel, dict[str, Any]]:
    """Fit model `number` of `count`, and return its figures; 0 is fitted to all the training episodes."""
    config, training, seed = whole.config, whole.training, whole.seed
    name = CHECKPOINT
    if number:
        seed, name = derive(seed, f"member {number}"), f"member_{number}_{name}"
        drawn = generator(seed, "bootstrap").integers(len(training), size=len(training))
        training = training.select(torch.from_numpy(drawn).to(training.target_state.device))
    progress = part(whole.progress, number / count, (number + 1) / count)
    torch.manual_seed(derive(seed, "grounding"))
    windows = training.windows
    model = GroundingModel(
        GroundingShape(
            state_size=windows.state.shape[-1],
            action_size=windows.action.shape[-1],
            goal_size=windows.goal.shape[-1],
            latent_size=config.latent_size,
            position_octaves=config.position_octaves if whole.task.plane else 0,
            ball_index=whole.task.ball_index,
            correction_heads=config.correction_heads,
            corrects_reward=config.reward == "correction",
            reward_dropout=config.reward_dropout,
        ),
        config.target,
    ).to(whole.device)
    model.set_scales(
        {
            "state": training.steps(windows.state),
            "goal": training.steps(windows.goal),
            "correction": training.steps(windows.next_state - windows.simulated_next),
        }
    )
    rewards, goes_on, failed = map(training.steps, (windows.reward, windows.goes_on, windows.failed))
    # Where a failure model tells them, R_pred would fill the latent with the failures of the data in vain.
    model.set_reward_scales(rewards, goes_on, failed, config.failure_weight * weights.failures)
    fitting = replace(whole, training=training, seed=seed, progress=progress)
    return model, _optimize(model, weights, fitting, whole.folder / name)


def residual_rewards(task: Task, episodes: PairedEpisodes) -> PairedEpisodes:
    """Subtract the task's own reward on abstract states from the rewards in the windows of `episodes`.

    Where abstract states show that the goal is reached, or out of reach, there is no residual, and no failure
    to foresee: there the simulator ends the episode and pays, and R_pred is not used.
    """
    windows, objective = episodes.windows, task.objective
    before, after, goal = (
        values.flatten(0, 1) for values in (windows.state, windows.next_state, windows.goal)
    )
    decided = objective.decided(after, goal)
    own = objective.reward(before, after, goal, torch.zeros_like(decided))
    going_on, failing = windows.reward.unbind(-1)
    own, decided = own.reshape(going_on.shape), decided.reshape(going_on.shape)
    goes_on, failed = windows.goes_on * ~decided, windows.failed * ~decided
    residual = torch.stack(
        [
            torch.where(goes_on.bool(), going_on - own, 0.0),
            torch.where(failed.bool(), failing - own, 0.0),
        ],
        dim=-1,
    )
    return replace(episodes, windows=replace(windows, reward=residual, goes_on=goes_on, failed=failed))


def _optimize(
    model: GroundingModel, weights: LossWeights, fitting: Fitting, checkpoint: Path
) -> dict[str, Any]:
    config = fitting.config
    descent = Descent(model, config, checkpoint=checkpoint)
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


@torch.no_grad()
def _measure_corrections(
    model: GroundingModel, members: Sequence[GroundingModel], held_out: PairedEpisodes
) -> None:
    """Measure the scatter of the target around the correction, and how far corrections are usually apart.

    That is between the heads of the `model`, or between it and each of its `members`.
    """
    windows = held_out.windows

    def corrected(by: GroundingModel) -> Tensor:
        latent, _ = by.encode(windows)
        return by.ensemble_predictions(latent, windows.action, windows.simulated_next)

    predictions = corrected(model)
    own = predictions.mean(0)
    model.residual_factor.copy_(scatter_factor(held_out.steps(windows.next_state - own)))
    if len(predictions) > 1:
        model.usual_disagreement.copy_(held_out.steps(model.disagreement(predictions)).mean())
    for member in members:
        apart = member.disagreement(torch.stack([own, corrected(member).mean(0)]))
        member.usual_disagreement.copy_(held_out.steps(apart).mean())
