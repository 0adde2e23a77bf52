"""Fit the failure model, and measure how well it predicts failures."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from astra_data.core.seeding import derive
from astra_data.grounding.calibration import calibration, folds
from astra_data.grounding.descent import Descent, DescentConfig
from astra_data.grounding.generators import seeded
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.moments import Moments
from astra_data.grounding.networks.failure import FAILURE_STEPS, FailureModel, FailureShape
from astra_data.grounding.networks.paired_windows import RISK_STEPS, before_failures
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.worlds.task import Task

AHEAD_STEPS = ((1, 20), (11, 30), (21, 40))
"""Windows before a failure, in steps, in which it is to be foreseen."""
_REPLAYED = 3 * RISK_STEPS
"""Steps of a replay: the last of them come after as long as the averages of a failure model remember."""
_BATCH = 1024
_FAILING_SHARE = 0.25
"""Of each batch: steps that fail soon are too rare to be drawn as often as they come."""
_WEIGHT_DECAY = 1.0
_DESCENT = DescentConfig(updates=200, learning_rate=3e-3)
BINS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Edges of the probabilities in a reliability diagram."""


def failing(task: Task, episodes: PairedEpisodes, risk_steps: int = FAILURE_STEPS) -> PairedEpisodes:
    """Return the episodes with what a failure model learns of them as `fails_soon`.

    That is the last `risk_steps` before a failure that no abstract state shows. Where one does, as with a
    ball beside the goal, simulators end episodes themselves, and a failure model would end them twice. A
    touch of a wall is learned: where a simulated body touches one, the robot's often does not, and the other
    way round.
    """
    windows, last = episodes.windows, episodes.lengths - 1
    each = torch.arange(len(episodes), device=last.device)
    is_shown = task.objective.missed(windows.next_state[each, last], windows.goal[each, last])
    fails = windows.fails_soon.any(1) & ~is_shown
    soon = before_failures(fails, windows.mask, risk_steps)
    return replace(episodes, windows=replace(windows, fails_soon=soon))


def has_failures(task: Task, episodes: PairedEpisodes) -> bool:
    """Whether a failure model can be fitted: some steps are before a failure, and not every one."""
    return _is_mixed(failing(task, episodes, RISK_STEPS))


def _is_mixed(episodes: PairedEpisodes) -> bool:
    return _has_both(episodes.steps(episodes.windows.fails_soon))


def fit_failures(
    task: Task, grounding: HistoryGrounding, training: PairedEpisodes, seed: int
) -> tuple[FailureModel, dict[str, Any]]:
    """Fit a failure model to replays of whole episodes, calibrated by cross-fitting.

    It sees the latent if this makes the moments of failures likelier in cross-fitting. The episodes are such
    that `has_failures`.

    Returns:
        the model; and "latent", whether it sees the latent, and "candidates" with their log-likelihood in
        nats per failure over a constant rate, None where a single recording fails.
    """
    torch.manual_seed(derive(seed, "failure model"))
    untrained = _untrained(task, grounding, training, sees_latent=True)
    inputs = replayed_inputs(task, grounding, untrained, training)
    divided = folds(failing(task, training).windows.fails_soon.any(1), training.recordings)
    compared: list[dict[str, Any]] = []
    chosen, best = None, -math.inf
    for sees_latent in (False, True):
        torch.manual_seed(derive(seed, f"failure model {sees_latent}"))
        candidate = _Candidate.of(task, grounding, training, inputs, sees_latent=sees_latent)
        gain = candidate.cross_fit(divided)
        compared.append({"latent": sees_latent, "nats_per_failure": gain})
        if chosen is None or (gain is not None and gain > best):
            chosen, best = candidate, -math.inf if gain is None else gain
    assert chosen is not None
    model = chosen.fitted()
    return model, {"latent": bool(model.shape.latent_size), "candidates": compared}


@dataclass
class _Candidate:
    """A failure model to fit to what is seen of each step, `inputs` (E, T, I).

    Attributes:
        odds, happened: log-odds (K, N) and outcomes (N,) of steps that were predicted in cross-fitting.
    """

    untrained: FailureModel
    episodes: PairedEpisodes
    inputs: Tensor
    odds: Tensor | None = None
    happened: Tensor | None = None

    @classmethod
    def of(
        cls,
        task: Task,
        grounding: HistoryGrounding,
        training: PairedEpisodes,
        inputs: Tensor,
        *,
        sees_latent: bool,
    ) -> "_Candidate":
        """Return the candidate; `inputs` (E, T, I) end with the latent."""
        untrained = _untrained(task, grounding, training, sees_latent=sees_latent)
        inputs = inputs[..., : untrained.shape.input_size]
        untrained.set_input_scales(training.steps(inputs))
        return cls(untrained, failing(task, training), inputs)

    def cross_fit(self, divided: Sequence[Tensor]) -> float | None:
        """Predict each fold's episodes by the others; return the log-likelihood of the failures' moments.

        That is of the hazard at every step, over that of a constant one, in nats per failure; None without
        folds.
        """
        windows, predicted = self.episodes.windows, []
        for fold in divided:
            others = self.episodes.select((~fold).nonzero().squeeze(1))
            if not _is_mixed(others):
                continue
            fitted = _descended(self.untrained, *_steps(others, self.inputs[~fold]))
            mask = windows.mask[fold].bool()
            predicted.append((fitted.log_odds(self.inputs[fold][mask]).detach(), fold, mask))
        if not predicted:
            return None
        self.odds = torch.cat([odds for odds, *_ in predicted], dim=1)
        self.happened = torch.cat([windows.fails_soon[fold][mask] for _, fold, mask in predicted])
        if not _has_both(self.happened):
            return None
        scale, shift = calibration(self.odds, self.happened, self.untrained.shape.risk_steps)
        soon = (scale * self.odds + shift).sigmoid().mean(0)
        hazard = self.untrained.hazard(soon).clamp(1e-9, 1 - 1e-9)
        failing_step = before_failures(windows.fails_soon.bool().any(1), windows.mask, 1)
        now = torch.cat([failing_step[fold][mask] for _, fold, mask in predicted])
        rate = now.mean()
        constant = now.sum() * rate.log() + (len(now) - now.sum()) * (1 - rate).log()
        likelihood = (now * hazard.log() + (1 - now) * (1 - hazard).log()).sum()
        return float((likelihood - constant) / now.sum())

    def fitted(self) -> FailureModel:
        """Return the model fitted to all episodes, and calibrated if it was cross-fitted."""
        model = _descended(self.untrained, *_steps(self.episodes, self.inputs))
        if self.odds is not None and self.happened is not None and _has_both(self.happened):
            model.calibrate(*calibration(self.odds, self.happened, model.shape.risk_steps))
        return model.requires_grad_(False).eval()


def _steps(episodes: PairedEpisodes, inputs: Tensor) -> tuple[Tensor, Tensor]:
    return episodes.steps(inputs), episodes.steps(episodes.windows.fails_soon)


def _has_both(fails: Tensor) -> bool:
    return bool(fails.any() and not fails.all())


def _untrained(
    task: Task, grounding: HistoryGrounding, training: PairedEpisodes, *, sees_latent: bool
) -> FailureModel:
    windows, maze = training.windows, task.objective.layout
    shape = FailureShape(
        state_size=windows.state.shape[-1],
        action_size=windows.action.shape[-1],
        timestep_s=task.timestep_s,
        maze_cells=(len(maze.fine_walls), len(maze.fine_walls[0])) if maze else (0, 0),
        cell_m=maze.fine_m if maze else 1.0,
        latent_size=grounding.model.shape.latent_size if sees_latent else 0,
    )
    model = FailureModel(shape).to(windows.mask.device)
    if maze is not None:
        model.clearance.copy_(torch.from_numpy(maze.clearance_field))
        model.half_extent.copy_(torch.from_numpy(maze.half_extent))
    model.set_move_scales(windows)
    return model


def _descended(untrained: FailureModel, inputs: Tensor, fails: Tensor) -> FailureModel:
    """Return a copy of `untrained`, fitted to inputs (N, I) of steps and whether they fail soon (N,)."""
    model = copy.deepcopy(untrained)
    failing, going_on = fails.nonzero().squeeze(1), (fails == 0).nonzero().squeeze(1)
    descent = Descent(model, _DESCENT, weight_decay=_WEIGHT_DECAY)
    few = round(_BATCH * _FAILING_SHARE)
    while not descent.is_over:
        rows = torch.cat([_drawn(failing, few), _drawn(going_on, _BATCH - few)])
        odds = model.log_odds(inputs[rows])
        descent.update(functional.binary_cross_entropy_with_logits(odds, fails[rows].expand_as(odds)))
    model.log_odds_shift.copy_(fails.mean().logit() - torch.tensor(_FAILING_SHARE).logit())
    return model.eval()


def _drawn(rows: Tensor, count: int) -> Tensor:
    return rows[torch.randint(len(rows), (count,), device=rows.device)]


@torch.no_grad()
def replayed_inputs(
    task: Task, grounding: HistoryGrounding, failures: FailureModel, episodes: PairedEpisodes
) -> Tensor:
    """Return what a failure model sees of each step, (E, T, I), where recorded commands are simulated.

    The simulator moves more smoothly than the target, so that a failure announces itself less. Replays of
    `_REPLAYED` steps begin at every `RISK_STEPS`-th recorded moment. What is seen of a step is from the one
    that began longest before it: nearly all that the averages remember is simulated then.
    """
    windows = episodes.windows
    grounding = replace(grounding, failures=None)
    moments = Moments.every(windows, RISK_STEPS)
    simulator = grounding.corrected(task.simulator(len(moments), str(windows.mask.device)))
    hidden = grounding.hidden_before(windows, RISK_STEPS)
    moments.start(simulator, hidden[moments.episode, moments.first // RISK_STEPS])
    state = moments.state
    memory = failures.initial_memory(state, moments.previous_action)
    replayed = state.new_zeros(*windows.mask.shape, failures.shape.input_size)
    for count in range(_REPLAYED):
        now, action = moments.after(count), moments.action(count)
        latent = simulator.latent
        simulator.step(action)
        inputs, memory = failures.inputs(state, action, simulator.landed, latent, memory)
        state = simulator.state
        real = now == moments.first + count
        # A replay that began earlier comes to a step later, and replaces what was seen of it.
        replayed[moments.episode[real], now[real]] = inputs[real]
    return replayed


def averages_before(
    task: Task, grounding: HistoryGrounding, failures: FailureModel, episodes: PairedEpisodes
) -> Tensor:
    """Return the averages that a failure model remembers before each step, (E, T, 15), as in replays."""
    with seeded(0, episodes.windows.mask.device):
        after = failures.averages_of(replayed_inputs(task, grounding, failures, episodes))
    return functional.pad(after[:, :-1], (0, 0, 1, 0))


@torch.no_grad()
def failure_figures(
    task: Task,
    grounding: HistoryGrounding,
    failures: FailureModel,
    held_out: PairedEpisodes,
    ahead: Sequence[tuple[int, int]] = AHEAD_STEPS,
) -> dict[str, Any]:
    """Return the `failure_skill` of a failure model on replays of held-out episodes."""
    probability = failures.probability(replayed_inputs(task, grounding, failures, held_out))
    return failure_skill(probability, failing(task, held_out, failures.shape.risk_steps), ahead)


def failure_skill(
    probability: Tensor, episodes: PairedEpisodes, ahead: Sequence[tuple[int, int]] = AHEAD_STEPS
) -> dict[str, Any]:
    """Measure probabilities (E, T) of what `fails_soon` marks on episodes that were not fitted.

    Returns:
        "failures": of the episodes. "auc": by window `ahead` of the failure, the probability that a step
        there is ranked above one with no failure up to the end of the last; None without such steps.
        "brier_skill": the share of the squared error of always saying the rate that is removed, None where
        there is no such error. "reliability": predicted and observed rate, and number of steps, by predicted
        probability. All but the first None without failures.
    """
    windows = episodes.windows
    mask = windows.mask.bool()
    fails = windows.fails_soon.bool() & mask
    count = int(fails.any(1).sum())
    if not count:
        return {"failures": 0, "auc": None, "brier_skill": None, "reliability": None}
    calm = ahead[-1][1] + mask.shape[1]  # no failure comes, however short the episode is
    left = torch.where(fails.any(1, keepdim=True), mask.flip(1).cumsum(1).flip(1), calm)
    safe = probability[mask & (left > ahead[-1][1])].numpy(force=True)
    auc: dict[str, float | None] = {}
    for first, last in ahead:
        before = probability[mask & (left >= first) & (left <= last)].numpy(force=True)
        auc[f"{first}-{last}"] = ranked_above(before, safe)
    predicted, happened = probability[mask].numpy(force=True), fails[mask].numpy(force=True)
    usual = np.square(happened - happened.mean()).mean()
    bins = np.digitize(predicted, BINS[1:-1])
    return {
        "failures": count,
        "auc": auc,
        "brier_skill": float(1 - np.square(predicted - happened).mean() / usual) if usual else None,
        "reliability": [
            [
                float(predicted[bins == one].mean()),
                float(happened[bins == one].mean()),
                int((bins == one).sum()),
            ]
            for one in np.unique(bins)
        ],
    }


def ranked_above(before: NDArray[Any], safe: NDArray[Any]) -> float | None:
    """Return the AUC: how probably one of `before` (N,) is above one of `safe` (M,); None without either."""
    from scipy.stats import mannwhitneyu  # noqa: PLC0415 - half a second to import

    pairs = len(before) * len(safe)
    return float(mannwhitneyu(before, safe).statistic / pairs) if pairs else None
