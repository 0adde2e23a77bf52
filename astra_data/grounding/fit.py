"""Fit a grounding: the inputs of a method's fit, and the fit of history models."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from astra_data.core.artifact import CHECKPOINT
from astra_data.core.config import AtOnce, Config, Positive
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import torch, without_gradients
from astra_data.core.progress import Progress
from astra_data.core.seeding import derive
from astra_data.dataset.columns import REWARD
from astra_data.grounding.descent import Descent, DescentConfig, WindowedConfig
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import FittedGrounding
from astra_data.worlds.task import Task

if TYPE_CHECKING:
    from astra_data.grounding.encoder import Encoder
    from astra_data.grounding.history import HistoryGrounding
    from astra_data.grounding.model import GroundingModel, LossWeights

_MEASURED_EVERY = 100
_POSITION_OCTAVES = 4
_CLOSEST_SHARE = 0.01  # of the recorded steps: those that were closer to a wall are not what a robot can rely on


class GroundConfig(WindowedConfig):
    """How the grounding model is fitted."""

    latent_weight: Positive = 0.1
    """λ1, weight of the loss of the next latent; at 1 it crowds out the correction."""
    reward_weight: Positive = 1.0
    """λ2, weight of the loss of the reward; λ3, the weight of the correction, is 1."""
    latent_size: AtOnce = 64
    """Z, also the size of the encoder's hidden state."""
    held_out_share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Fraction of the episodes to hold out, for measuring the error and for fitting the scatter around the
    correction, unless the dataset holds some out itself."""


@dataclass(frozen=True)
class Fitting:
    """What a method is given to fit its grounding to."""

    task: Task
    config: GroundConfig  # the recipe's `[ground]`
    settings: Config | None  # the method's own table of the recipe, if it has one
    training: PairedEpisodes  # to fit
    held_out: PairedEpisodes  # to measure on
    seed: int  # of all randomness
    device: str  # of the networks
    folder: Path  # for checkpoints and further files; files left in it become part of the artifact
    progress: Progress  # called with the share done and a note

    @property
    def descent(self) -> DescentConfig:
        """The number of updates, derived from the training steps unless given, and the learning rate."""
        return self.config.descent(int(self.training.lengths.sum()))


Fit = Callable[[Fitting], tuple[FittedGrounding, dict[str, Any]]]  # returns also figures of how good and fast it was


@dataclass(frozen=True)
class HistoryFit:
    """Fit a history model: the correction, and the other parts that a method has (paper, Section IV-A)."""

    latent: bool  # whether the next latent is predicted
    reward: bool  # whether the target's reward is predicted
    failures: bool = True  # whether failures are predicted by a failure model, if there are some
    scatter: bool = True  # whether the simulator scatters around the correction as the target does
    encoder: "type[Encoder] | None" = None  # the class of ψ, by default a GRU
    printed: bool = False
    """Whether R_pred learns the whole reward, failures included, as the paper prints it. By default it learns
    the residual reward: the target's less the task's own on the recorded abstract states."""

    def __call__(self, fitting: Fitting) -> "tuple[HistoryGrounding, dict[str, Any]]":
        """Return the grounding and its figures."""
        from astra_data.grounding.failures import failing, failure_skill, fit_failures, has_failures, replayed_inputs
        from astra_data.grounding.history import HistoryGrounding, fit_hits, fit_scatter

        task = fitting.task
        if self.reward and not fitting.training.has_rewards:
            advice = "take one that does not, such as nas"
            raise BadInputError(f"{fitting.training.reference} has no {REWARD}, which the method predicts: {advice}")
        predicts_failures = self.failures and has_failures(task, fitting.training)
        both = fitting.training, fitting.held_out
        training, held_out = (self._rewarded(task, episodes, predicts_failures) for episodes in both)
        fitting = replace(fitting, training=training, held_out=held_out)
        corrects_reward = training.windows.own_reward is not None
        model, metrics = self._fitted(fitting, corrects_reward=corrects_reward)
        if model.hits is not None:
            fit_hits(model, training, fitting.seed)
        if self.reward and corrects_reward:
            model.shrink_reward(held_out.windows)
            metrics["reward_shrinkage"] = float(model.reward_shrinkage)
        fails_at_walls = task.objective.ends_at_walls
        grounding = HistoryGrounding(model, fails_at_walls=fails_at_walls)
        if not self.printed and not fails_at_walls:
            metrics["clearance_m"] = clearance = recorded_clearance_m(task, training)
            grounding = replace(grounding, clearance_m=clearance)
        if self.scatter:
            scatter_model, metrics["scatter"] = fit_scatter(model, training, held_out, fitting.seed)
            grounding = replace(grounding, scatter_model=scatter_model)
        if predicts_failures:
            failures, metrics["failure_model"] = fit_failures(task, grounding, training, fitting.seed)
            probability = failures.probability(replayed_inputs(task, grounding, failures, held_out))
            metrics["failures"] = {"failure_model": failure_skill(probability, failing(task, held_out))}
            grounding = replace(grounding, failures=failures)
        return grounding, metrics | metrics.pop("stopwatch").spent()

    def _fitted(self, fitting: Fitting, *, corrects_reward: bool) -> "tuple[GroundingModel, dict[str, Any]]":
        from astra_data.grounding.encoder import HistoryEncoder, check_encoder, take_scales
        from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights, recorded_rewards

        config, training, windows = fitting.config, fitting.training, fitting.training.windows
        torch.manual_seed(derive(fitting.seed, "grounding"))
        shape = GroundingShape(
            state_size=windows.state.shape[-1],
            action_size=windows.action.shape[-1],
            goal_size=windows.goal.shape[-1],
            latent_size=config.latent_size,
            position_octaves=_POSITION_OCTAVES if fitting.task.plane else 0,
            ball_index=fitting.task.ball_index,
            ball_rolls=fitting.task.ball_rolls,
            corrects_reward=corrects_reward,
            encoder=(self.encoder or HistoryEncoder).kind,
        )
        model = GroundingModel(shape).to(fitting.device)
        if self.encoder:
            first = [each[:2, : config.window] for each in (windows.state, windows.goal, windows.previous_action)]
            check_encoder(model.encoder, model.encoder_input(*first))
        correction = windows.next_state - windows.simulated_next
        columns = {"state": windows.state, "goal": windows.goal, "correction": correction}
        take_scales(model, {name: training.steps(values) for name, values in columns.items()})
        rewards = recorded_rewards(windows)
        model.set_reward_scales(*map(training.steps, (rewards, windows.goes_on, windows.failed)))
        weights = LossWeights(config.latent_weight * self.latent, config.reward_weight * self.reward)
        metrics = _optimize(model, weights, fitting)
        return model.eval(), metrics

    def _rewarded(self, task: Task, episodes: PairedEpisodes, predicts_failures: bool) -> PairedEpisodes:
        """Return the episodes with the rewards that R_pred learns."""
        windows = episodes.windows
        if not predicts_failures:
            windows = replace(windows, goes_on=windows.goes_on + windows.failed)
        episodes = replace(episodes, windows=windows)
        if self.printed or not episodes.has_rewards:
            return episodes
        episodes.check(task, needs_goals=True)
        return with_own_rewards(task, episodes)


def with_own_rewards(task: Task, episodes: PairedEpisodes) -> PairedEpisodes:
    """Add the task's rewards on abstract states; where these show an end, R_pred learns nothing, as it is not used."""
    windows, objective = episodes.windows, task.objective
    before, after, goal = (values.flatten(0, 1) for values in (windows.state, windows.next_state, windows.goal))
    shown = objective.decided(after, goal)
    own = objective.reward(before, after, goal, torch.zeros_like(shown)).reshape(windows.mask.shape)
    own = torch.where(windows.mask.bool(), own, 0.0)  # a user's reward need not know what padding is
    open_ended = ~shown.reshape(windows.mask.shape)
    goes_on, failed = windows.goes_on * open_ended, windows.failed * open_ended
    return replace(episodes, windows=replace(windows, own_reward=own, goes_on=goes_on, failed=failed))


def _optimize(model: "GroundingModel", weights: "LossWeights", fitting: Fitting) -> dict[str, Any]:
    from astra_data.grounding.model import telemetry

    config, training = fitting.config, fitting.training
    settings = fitting.descent
    descent = Descent(model, settings, checkpoint=fitting.folder / CHECKPOINT)
    window = min(config.window, training.windows.mask.shape[1])
    while not descent.is_over:
        torch.manual_seed(derive(fitting.seed, f"grounding update {descent.done}"))
        windows, _ = training.draw_windows(config.batch_windows, window)
        loss, parts = model.losses(windows, weights)
        descent.update(loss)
        model.update_target()
        if descent.done % _MEASURED_EVERY == 0 or descent.done == settings.updates:
            losses = {f"loss_{name}": float(value.detach()) for name, value in parts.items()}
            model.eval()  # a user's encoder may have parts that only learning draws
            error = _held_out_error(model, fitting.held_out, weights)
            descent.keep(error, **losses, **telemetry(model, fitting.held_out, weights))
            model.train()
        if descent.done % 10 == 0:
            note = f"{descent.done * config.batch_windows / descent.stopwatch.seconds:,.0f} windows/s"
            explained = descent.points[-1]["r2_state"] if descent.points else None
            if explained is not None:
                note += f"  held-out R² of the correction {explained:.3f}"
            fitting.progress(descent.share, note)
    descent.finish()
    return {"stopwatch": descent.stopwatch, "window": window, "updates": descent.best, "epochs": descent.points}


@without_gradients
def _held_out_error(model: "GroundingModel", episodes: PairedEpisodes, weights: "LossWeights") -> float:
    """Return the losses of correction and reward on whole `episodes`; latents have no scale to compare."""
    loss, _ = model.losses(episodes.windows, replace(weights, latent=0.0))
    return float(loss)


def recorded_clearance_m(task: Task, episodes: PairedEpisodes) -> float | None:
    """Return the distance in m from walls that 99 % of steps kept, up to a fine cell too large; None without walls."""
    if task.plane is None:
        return None
    positions = episodes.steps(episodes.windows.state)[:, :2].numpy(force=True)
    return float(np.quantile(task.maze.clearance(positions), _CLOSEST_SHARE))
