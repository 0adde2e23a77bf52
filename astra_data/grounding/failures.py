"""A failure model: the probability that the target fails soon, given lags behind commands and walls ahead."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from astra_data.core.arrays import normalized
from astra_data.core.lazy import scipy
from astra_data.core.seeding import derive
from astra_data.grounding.descent import Descent, DescentConfig, seeded
from astra_data.grounding.encoder import Members, take_scales
from astra_data.grounding.open_loop import Moments
from astra_data.grounding.paired_episodes import BINS, RISK_STEPS, PairedEpisodes, PairedWindows, before_failures
from astra_data.grounding.simulator import Grounding
from astra_data.worlds.task import Task

AVERAGED_S = (0.25, 0.5, 1.0)  # time constants of the averages of the magnitudes, beside their present values
AHEAD_S = (0.25, 0.5, 1.0, 1.5, 2.0)  # how far ahead walls are looked for, as the robot moves and as the simulator does
FAILURE_STEPS = 2
"""Steps within which failures are predicted: of 2, 5, 10 and 20 the one with the highest likelihood of the
moments of failures on a cart, an ant and a NAO."""
_FARTHEST_M = 3.0  # walls farther away than this are alike
_MAGNITUDES = 5
_AVERAGES = len(AVERAGED_S) * _MAGNITUDES
_MOST_FOLDS = 5
AHEAD_STEPS = ((1, 20), (11, 30), (21, 40))  # windows before a failure, in steps, in which it is to be foreseen
_REPLAYED = 3 * RISK_STEPS  # steps of a replay: the last come after as long as the averages of a failure model remember
_BATCH = 512
_FAILING_SHARE = 0.25  # of each batch: steps that fail soon are too rare to be drawn as often as they come
_WEIGHT_DECAY = 1.0
_DESCENT = DescentConfig(updates=200, learning_rate=3e-3)


@dataclass(frozen=True)
class FailureShape:
    """Sizes of the failure model."""

    state_size: int
    action_size: int
    timestep_s: float
    maze_cells: tuple[int, int] = (0, 0)  # (height, width) of the maze's fine grid; zeros where there is none
    cell_m: float = 1.0  # side of its cells
    members: int = 5  # networks, whose probabilities are averaged
    risk_steps: int = FAILURE_STEPS  # within which failures are predicted
    latent_size: int = 0  # of the latent among the inputs; 0 where it is none of them
    hidden_size: int = 32  # of the networks' two layers
    dropout: float = 0.2  # after each

    @property
    def input_size(self) -> int:
        """I: magnitudes, their averages, distances from walls, and the latent."""
        walls = 1 + 2 * len(AHEAD_S) if any(self.maze_cells) else 0
        return _MAGNITUDES + _AVERAGES + walls + self.latent_size


class FailureModel(nn.Module):
    """Estimate the probability of a failure within `risk_steps`; the memory (B, M) is never kept."""

    def __init__(self, shape: FailureShape) -> None:
        super().__init__()
        self.shape = shape
        self.members = Members(shape.members, shape.input_size, shape.hidden_size, shape.dropout)
        self.wanted_std, self.moved_std, self.missed_std = (nn.Buffer(torch.ones(shape.state_size)) for _ in range(3))
        self.input_mean = nn.Buffer(torch.zeros(shape.input_size))
        self.input_std = nn.Buffer(torch.ones(shape.input_size))
        self.log_odds_shift = nn.Buffer(torch.zeros(()))
        self.clearance = nn.Buffer(torch.zeros(shape.maze_cells))
        self.half_extent = nn.Buffer(torch.zeros(2))
        rates = [1 - torch.tensor(-shape.timestep_s / seconds).exp() for seconds in AVERAGED_S]
        self.rates = nn.Buffer(torch.stack(rates)[:, None], persistent=False)
        self._parts = [shape.state_size, shape.state_size, shape.action_size, _AVERAGES]
        self.memory_size = sum(self._parts)

    def set_move_scales(self, windows: PairedWindows) -> None:
        """Take the deviations of moves from training episodes."""
        mask = windows.mask.bool()
        for deviation, moves in (
            (self.wanted_std, windows.simulated_next - windows.state),
            (self.moved_std, windows.next_state - windows.state),
            (self.missed_std, windows.next_state - windows.simulated_next),
        ):
            deviation.copy_(moves[mask].std(0).clamp_min(1e-3))

    def initial_memory(self, state: Tensor, previous_action: Tensor, averages: Tensor | None = None) -> Tensor:
        """Return the memory (n, M) of episodes from `state` (n, X), with `averages` (n, 15) of before."""
        averages = state.new_zeros(len(state), _AVERAGES) if averages is None else averages
        return torch.cat([state, state, previous_action, averages], dim=-1)

    def inputs(
        self,
        state: Tensor,
        action: Tensor,
        landed: Tensor,
        latent: Tensor | None,
        memory: Tensor,
        walls: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return what networks see of a step, (B, I), and the next memory (B, M); simulators `landed` (B, X).

        In a maze, `walls` (B, 11) are the distances from walls, by default those of this step.
        """
        before, landed_before, action_before, averages = memory.split(self._parts, dim=-1)
        wanted, moved, missed = landed - state, state - before, state - landed_before
        moves = (wanted / self.wanted_std, moved / self.moved_std, missed / self.missed_std)
        commands = ((action - action_before).norm(dim=-1), action.norm(dim=-1))
        magnitudes = torch.stack([*(move.square().mean(-1).sqrt() for move in moves), *commands], dim=-1)
        now = averages.unflatten(-1, (len(AVERAGED_S), _MAGNITUDES))
        averages = (now + self.rates * (magnitudes.unsqueeze(-2) - now)).flatten(-2)
        seen = [magnitudes, averages]
        if self.clearance.numel():
            seen.append(self._clearances(state, wanted, moved) if walls is None else walls)
        if latent is not None:
            seen.append(latent[..., : self.shape.latent_size])
        return torch.cat(seen, dim=-1), torch.cat([state, landed, action, averages], dim=-1)

    def recorded_clearances(self, windows: PairedWindows) -> Tensor:
        """Return the distances (E, T, 11) in m from walls of recorded steps."""
        moved = torch.zeros_like(windows.state)
        moved[:, 1:] = windows.state.diff(dim=1)
        return self._clearances(windows.state, windows.simulated_next - windows.state, moved)

    def _clearances(self, state: Tensor, *moves: Tensor) -> Tensor:
        """Return distances (..., 11) in m to the nearest wall, as far as it matters, here and along `moves`."""
        seconds = torch.tensor(AHEAD_S, device=state.device)[:, None]
        position = state[..., None, :2]
        ways = [move[..., None, :2] * seconds / self.shape.timestep_s for move in moves]
        places = torch.cat([position, *(position + way for way in ways)], dim=-2)
        column, row = ((places + self.half_extent) / self.shape.cell_m).floor().long().unbind(-1)
        height, width = self.clearance.shape
        return self.clearance[row.clamp(0, height - 1), column.clamp(0, width - 1)].clamp_max(_FARTHEST_M)

    def probability(self, inputs: Tensor) -> Tensor:
        """Return the mean (...) of the members' probabilities for `inputs` (..., I)."""
        return (self.log_odds(inputs) + self.log_odds_shift).sigmoid().mean(0)

    def log_odds(self, inputs: Tensor) -> Tensor:
        """Return log-odds (K, ...) by each member for `inputs` (..., I), without `log_odds_shift`."""
        return torch.as_tensor(self.members(normalized(inputs, self.input_mean, self.input_std)))

    def hazard(self, probability: Tensor) -> Tensor:
        """Return the probability (...) of a failure in the very step, given that within `risk_steps`."""
        return probability / self.shape.risk_steps


def folds(fails: Tensor, recordings: Tensor) -> list[Tensor]:
    """Split episodes (E,) at random by `recordings` (E,), those that fail alike; return who is in each of 5 at most."""
    known: dict[int, int] = {}  # numbered as they come, so that without copies each episode is drawn for in turn
    numbered = [known.setdefault(name, len(known)) for name in recordings.tolist()]
    recording = torch.tensor(numbered, device=fails.device)
    failing = torch.bincount(recording[fails], minlength=len(known)) > 0
    count = min(_MOST_FOLDS, int(failing.sum()))
    if count < 2:
        return []
    numbers = torch.empty(len(known), dtype=torch.long, device=fails.device)
    for rows in (failing.nonzero().squeeze(1), (~failing).nonzero().squeeze(1)):
        numbers[rows[torch.randperm(len(rows))]] = torch.arange(len(rows), device=rows.device) % count
    return [(numbers == fold)[recording] for fold in range(count)]


def calibration(odds: Tensor, fails: Tensor, risk_steps: int) -> tuple[Tensor, Tensor]:
    """Return scale and shift of log-odds (K, N) that come true (Platt); log-scales have a standard normal prior."""
    odds, fails = odds.double(), fails.double().expand_as(odds)
    start = [torch.zeros((), device=odds.device), fails.mean().logit() - odds.mean()]
    scale, shift = (one.double().clone().requires_grad_() for one in start)
    optimizer = torch.optim.LBFGS([scale, shift], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        surprise = functional.binary_cross_entropy_with_logits(scale.exp() * odds + shift, fails)
        total: Tensor = surprise + 0.5 * scale.square() * risk_steps / odds.shape[1]
        total.backward()
        return total

    optimizer.step(loss)
    return scale.detach().exp(), shift.detach()


def failing(task: Task, episodes: PairedEpisodes, risk_steps: int = FAILURE_STEPS) -> PairedEpisodes:
    """Return the episodes with the last `risk_steps` before a failure that no abstract state shows as `fails_soon`."""
    windows, last = episodes.windows, episodes.lengths - 1
    each = torch.arange(len(episodes), device=last.device)
    is_shown = task.objective.missed(windows.next_state[each, last], windows.goal[each, last])
    fails = windows.fails_soon.any(1) & ~is_shown
    soon = before_failures(fails, windows.mask, risk_steps)
    return replace(episodes, windows=replace(windows, fails_soon=soon))


def has_failures(task: Task, episodes: PairedEpisodes) -> bool:
    """Whether a failure model can be fitted: some steps are before a failure, and not every one."""
    return _has_both(episodes.steps(failing(task, episodes, RISK_STEPS).windows.fails_soon))


def fit_failures(
    task: Task, grounding: Grounding, training: PairedEpisodes, seed: int
) -> tuple[FailureModel, dict[str, Any]]:
    """Fit a failure model to replays, calibrated by cross-fitting, with the latent if that makes failures likelier."""
    torch.manual_seed(derive(seed, "failure model"))
    episodes = failing(task, training)
    seen = replayed_inputs(task, grounding, _untrained(task, grounding, training, sees_latent=True), training)
    divided = folds(episodes.windows.fails_soon.any(1), training.recordings)
    candidates = []
    for sees_latent in (False, True):
        torch.manual_seed(derive(seed, f"failure model {sees_latent}"))
        untrained = _untrained(task, grounding, training, sees_latent=sees_latent)
        inputs = seen[..., : untrained.shape.input_size]
        take_scales(untrained, {"input": training.steps(inputs)})
        candidates.append((_cross_fitted(untrained, episodes, inputs, divided), untrained, inputs))
    found, untrained, inputs = max(candidates, key=lambda one: one[0][0] if one[0] else -math.inf)
    model = _descended(untrained, episodes, inputs)
    if found:
        _, scale, shift = found
        with torch.no_grad():
            for parameter in (model.members.last_weight, model.members.last_bias):
                parameter.mul_(scale)
        model.log_odds_shift.copy_(shift)
    gains = [{"latent": bool(at), "nats_per_failure": fit and fit[0]} for at, (fit, *_) in enumerate(candidates)]
    return model.requires_grad_(False).eval(), {"latent": bool(model.shape.latent_size), "candidates": gains}


def _cross_fitted(
    untrained: FailureModel, episodes: PairedEpisodes, inputs: Tensor, divided: Sequence[Tensor]
) -> tuple[float, Tensor, Tensor] | None:
    """Predict each fold by the others; return nats per failure over a constant hazard, and the calibration."""
    windows, predicted = episodes.windows, []
    for fold in divided:
        others = episodes.select((~fold).nonzero().squeeze(1))
        if _has_both(others.steps(others.windows.fails_soon)):
            fitted = _descended(untrained, others, inputs[~fold])
            mask = windows.mask[fold].bool()
            predicted.append((fitted.log_odds(inputs[fold][mask]).detach(), fold, mask))
    if not predicted:
        return None
    odds = torch.cat([odds for odds, *_ in predicted], dim=1)
    happened = torch.cat([windows.fails_soon[fold][mask] for _, fold, mask in predicted])
    if not _has_both(happened):
        return None
    scale, shift = calibration(odds, happened, untrained.shape.risk_steps)
    hazard = untrained.hazard((scale * odds + shift).sigmoid().mean(0)).clamp(1e-9, 1 - 1e-9)
    failing_step = before_failures(windows.fails_soon.bool().any(1), windows.mask, 1)
    now = torch.cat([failing_step[fold][mask] for _, fold, mask in predicted])
    rate = now.mean()
    constant = now.sum() * rate.log() + (len(now) - now.sum()) * (1 - rate).log()
    likelihood = (now * hazard.log() + (1 - now) * (1 - hazard).log()).sum()
    return float((likelihood - constant) / now.sum()), scale, shift


def _has_both(fails: Tensor) -> bool:
    return bool(fails.any() and not fails.all())


def _untrained(task: Task, grounding: Grounding, training: PairedEpisodes, *, sees_latent: bool) -> FailureModel:
    windows, maze, encoder = training.windows, task.plane, grounding.encoder
    shape = FailureShape(
        state_size=windows.state.shape[-1],
        action_size=windows.action.shape[-1],
        timestep_s=task.timestep_s,
        maze_cells=(len(maze.fine_walls), len(maze.fine_walls[0])) if maze else (0, 0),
        cell_m=maze.fine_m if maze else 1.0,
        latent_size=encoder.encoder.latent_size if sees_latent and encoder is not None else 0,
    )
    model = FailureModel(shape).to(windows.mask.device)
    if maze is not None:
        model.clearance.copy_(torch.from_numpy(maze.clearance_field))
        model.half_extent.copy_(torch.from_numpy(maze.half_extent))
    model.set_move_scales(windows)
    return model


def _descended(untrained: FailureModel, episodes: PairedEpisodes, inputs: Tensor) -> FailureModel:
    """Return a copy of `untrained`, fitted to inputs (E, T, I) of the steps of episodes and whether they fail soon."""
    inputs, fails = map(episodes.steps, (inputs, episodes.windows.fails_soon))
    model, few = copy.deepcopy(untrained), round(_BATCH * _FAILING_SHARE)
    parts = [(fails.nonzero().squeeze(1), few), ((fails == 0).nonzero().squeeze(1), _BATCH - few)]
    descent = Descent(model, _DESCENT, weight_decay=_WEIGHT_DECAY)
    while not descent.is_over:
        rows = torch.cat([of[torch.randint(len(of), (count,), device=of.device)] for of, count in parts])
        odds = model.log_odds(inputs[rows])
        descent.update(functional.binary_cross_entropy_with_logits(odds, fails[rows].expand_as(odds)))
    model.log_odds_shift.copy_(fails.mean().logit() - torch.tensor(_FAILING_SHARE).logit())
    return model.eval()


@torch.no_grad()
def replayed_inputs(task: Task, grounding: Grounding, failures: FailureModel, episodes: PairedEpisodes) -> Tensor:
    """Return what is seen of each step (E, T, I): walls as recorded, all else in simulated replays.

    A step is seen by the replay that began longest before it.
    """
    windows = episodes.windows
    moments = Moments.every(windows, RISK_STEPS)
    simulator = grounding.simulator(task, len(moments), str(windows.mask.device))
    hidden = grounding.hidden_before(windows, RISK_STEPS)
    moments.start(simulator, None if hidden is None else hidden[moments.episode, moments.first // RISK_STEPS])
    state = moments.state
    memory = failures.initial_memory(state, moments.previous_action)
    replayed = state.new_zeros(*windows.mask.shape, failures.shape.input_size)
    # Replays drift, which blurs how near a wall is too near.
    walls = failures.recorded_clearances(windows) if failures.clearance.numel() else None
    for count in range(_REPLAYED):
        now, action = moments.after(count), moments.action(count)
        latent = simulator.latent
        simulator.step(action)
        near = None if walls is None else walls[moments.episode, now]
        inputs, memory = failures.inputs(state, action, simulator.landed, latent, memory, near)
        state = simulator.state
        real = now == moments.first + count
        # A replay that began earlier comes to a step later, and replaces what was seen of it.
        replayed[moments.episode[real], now[real]] = inputs[real]
    return replayed


def averages_before(task: Task, grounding: Grounding, failures: FailureModel, episodes: PairedEpisodes) -> Tensor:
    """Return the averages that a failure model remembers before each step, (E, T, 15), as in replays."""
    with seeded(0, episodes.windows.mask.device):
        seen = replayed_inputs(task, grounding, failures, episodes)
    return functional.pad(seen[:, :-1, _MAGNITUDES : _MAGNITUDES + _AVERAGES], (0, 0, 1, 0))


def failure_skill(probability: Tensor, episodes: PairedEpisodes) -> dict[str, Any]:
    """Measure probabilities (E, T) of `fails_soon`: AUC by window ahead, Brier skill, reliability by bin."""
    windows = episodes.windows
    mask = windows.mask.bool()
    fails = windows.fails_soon.bool() & mask
    count = int(fails.any(1).sum())
    if not count:
        return {"failures": 0, "auc": None, "brier_skill": None, "reliability": None}
    calm = AHEAD_STEPS[-1][1] + mask.shape[1]  # no failure comes, however short the episode is
    left = torch.where(fails.any(1, keepdim=True), mask.flip(1).cumsum(1).flip(1), calm)
    safe = probability[mask & (left > AHEAD_STEPS[-1][1])].double().numpy(force=True)
    auc: dict[str, float | None] = {}
    for first, last in AHEAD_STEPS:
        before = probability[mask & (left >= first) & (left <= last)].double().numpy(force=True)
        auc[f"{first}-{last}"] = None
        if pairs := len(before) * len(safe):
            above = scipy.stats.mannwhitneyu(before, safe, method="asymptotic").statistic
            auc[f"{first}-{last}"] = float(above) / pairs
    predicted, happened = probability[mask].numpy(force=True), fails[mask].numpy(force=True)
    usual = np.square(happened - happened.mean()).mean()
    bins = np.digitize(predicted, BINS[1:-1])
    return {
        "failures": count,
        "auc": auc,
        "brier_skill": float(1 - np.square(predicted - happened).mean() / usual) if usual else None,
        "reliability": [
            [float(predicted[bins == one].mean()), float(happened[bins == one].mean()), int((bins == one).sum())]
            for one in np.unique(bins)
        ],
    }
