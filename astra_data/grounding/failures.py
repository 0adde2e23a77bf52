"""Fit the failure model, and measure how well failures are foreseen."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from astra_data.core.seeding import derive
from astra_data.grounding.calibration import calibration, folds
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.moments import Moments
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.descent import Descent, DescentConfig
from astra_data.learning.generators import seeded
from astra_data.learning.networks.failure import FailureModel, FailureShape
from astra_data.learning.networks.paired_windows import RISK_STEPS, before_failures
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


def failing(task: Task, episodes: PairedEpisodes, risk_steps: int) -> PairedEpisodes:
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


def tells_failures(task: Task, episodes: PairedEpisodes, risk_steps: int = RISK_STEPS) -> bool:
    """Whether a failure model can be fitted: some steps are before a failure, and not every one."""
    return _tells(failing(task, episodes, risk_steps))


def _tells(episodes: PairedEpisodes) -> bool:
    return _has_both(episodes.steps(episodes.windows.fails_soon))


def fit_failures(
    task: Task,
    grounding: HistoryGrounding,
    training: PairedEpisodes,
    members: int,
    seed: int,
    risk_steps: int = RISK_STEPS,
) -> FailureModel:
    """Fit a failure model of `members` networks to replays of whole episodes; calibrate it by cross-fitting.

    The episodes are such that `tells_failures`.
    """
    training = failing(task, training, risk_steps)
    fails = training.windows.fails_soon
    torch.manual_seed(derive(seed, "failure model"))
    untrained = _untrained(task, training, members, risk_steps)
    inputs = replayed_inputs(task, grounding, untrained, training)
    seen = training.steps(inputs)
    untrained.set_input_scales(seen)
    model = _descended(untrained, seen, training.steps(fails))
    odds, happened = [], []
    for fold in folds(fails.any(1), training.recordings):
        others = training.select((~fold).nonzero().squeeze(1))
        if not _tells(others):
            continue
        fitted = _descended(untrained, others.steps(inputs[~fold]), others.steps(others.windows.fails_soon))
        own = training.select(fold.nonzero().squeeze(1))
        odds.append(fitted.log_odds(own.steps(inputs[fold])).detach())
        happened.append(own.steps(own.windows.fails_soon))
    if odds and _has_both(torch.cat(happened)):
        model.calibrate(*calibration(torch.cat(odds, dim=1), torch.cat(happened), risk_steps))
    return model.requires_grad_(False).eval()


def _has_both(fails: Tensor) -> bool:
    return bool(fails.any() and not fails.all())


def _untrained(task: Task, training: PairedEpisodes, members: int, risk_steps: int) -> FailureModel:
    windows, maze = training.windows, task.objective.layout
    shape = FailureShape(
        state_size=windows.state.shape[-1],
        action_size=windows.action.shape[-1],
        timestep_s=task.timestep_s,
        maze_cells=(len(maze.fine_walls), len(maze.fine_walls[0])) if maze else (0, 0),
        cell_m=maze.fine_m if maze else 1.0,
        members=members,
        risk_steps=risk_steps,
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
    that began longest before it: nearly all that the averages remember is simulated then. They go as near to
    walls as a judge's episodes do: see `HistoryGrounding.foreseeing`.
    """
    windows = episodes.windows
    grounding = grounding.foreseeing(task.objective).reduced(members=False, failures=False)
    moments = Moments.every(windows, RISK_STEPS)
    simulator = grounding.corrected(task.simulator(len(moments), str(windows.mask.device)), None)
    hidden = grounding.hidden_before(windows, RISK_STEPS)
    moments.start(simulator, hidden[moments.episode, moments.first // RISK_STEPS])
    state = moments.state
    memory = failures.initial_memory(state, moments.previous_action)
    replayed = state.new_zeros(*windows.mask.shape, failures.shape.input_size)
    for count in range(_REPLAYED):
        now, action = moments.after(count), moments.action(count)
        simulator.step(action)
        inputs, memory = failures.inputs(state, action, simulator.landed, memory)
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
def compared_foresight(
    task: Task,
    grounding: HistoryGrounding,
    held_out: PairedEpisodes,
    predicts_reward: bool,
    ahead: Sequence[tuple[int, int]] = AHEAD_STEPS,
) -> dict[str, Any]:
    """Return the `foresight` on held-out episodes: of R_pred, and of failure model or topple head, as fitted.

    The failure model is measured on replays, the others on what was recorded.
    """
    windows, model, failures = held_out.windows, grounding.model, grounding.failures
    latent, _ = model.encode(windows)
    found = {}
    if predicts_reward and model.failure_weight > 0:
        parts = model.predict_reward_parts(latent, windows.action)
        probability = (parts[..., 1] / model.failure_cost * RISK_STEPS).clamp(0.0, 1.0)
        found["predicted_reward"] = foresight(probability, held_out, ahead)
    if failures is not None:
        probability = failures.probability(replayed_inputs(task, grounding, failures, held_out))
        found["failure_model"] = foresight(
            probability, failing(task, held_out, failures.shape.risk_steps), ahead
        )
    else:
        probability = model.topple_logit(latent, windows.action, windows.next_state).sigmoid()
        found["topple_head"] = foresight(probability, held_out, ahead)
    return found


def foresight(
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
