"""What paired episodes say before any fit: delays, what the simulator misses, hidden state, what was never tried."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from astra_data.core.arrays import Bools, Floats, Ints, as_rows
from astra_data.core.errors import BadInputError
from astra_data.dataset import columns as keys
from astra_data.dataset.checkup import Finding
from astra_data.dataset.compare import recordings_of
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import open_dataset
from astra_data.robots.registry import Pairing, built, pairing_named
from astra_data.worlds.commands import Commands
from astra_data.worlds.protocols import AbstractSimulator

LONGEST_S, LONGEST_STEPS = 2.0, 20  # longest delay that is looked for: the shorter of the two
FEWEST = 8  # recordings from which on a forecast is made
_SIMULATED = 400_000  # simulated steps for the responses; of more, a random share is used
_REFITS, _FORECASTS, _FOLDS = 200, 12, 5
_PAST_STEPS = 8  # steps of a history from which the simulator's error is predicted
_MOST_SQUARED = 16  # values whose products are features as well; of more, only the values
_VISIBLE = 0.1  # share of the simulator's response below which a command has no visible effect
_MATTERS = 0.05  # explained variance from which on what it adds is worth a sentence
_FEW_FAILURES = 10


@dataclass(frozen=True)
class Response:
    """How the robot responds to a command, measured by what the simulator does at once.

    The change of abstract states is a sum of the simulator's responses to the present and the past K commands;
    `weights` (K + 1,) are their shares. Intervals are a bootstrap over recordings.
    """

    name: str
    weights: Floats
    gain: tuple[float, float, float]  # sum of the weights: value, low, high; 1 if as far as in the simulator
    delay_s: tuple[float, float, float]  # mean lag, dead time and time constant together: value, low, high

    @property
    def is_visible(self) -> bool:
        """Whether the command moves the robot at all, so that its delay is known."""
        return self.gain[1] > _VISIBLE


@dataclass(frozen=True)
class Missed:
    """Error of the raw simulator in one value of the abstract state, one step ahead, root mean square."""

    name: str
    unit: str
    error: float
    still: float  # that of the persistence baseline
    where: str  # where it is largest; empty if it is alike everywhere


@dataclass(frozen=True)
class Forecast:
    """Error left on held-out recordings, as a share of the raw simulator's, by number of recordings fitted to.

    Of a ridge regression on histories, which is refitted to random recordings; a grounding's is smaller, but falls
    alike. `sizes` are recordings, `left` (len(sizes), refits) the shares.
    """

    sizes: tuple[int, ...]
    left: Floats
    more: int  # half as many recordings again
    expected: tuple[float, float, float]  # what is left with that many: value, low, high

    @property
    def is_enough(self) -> bool:
        """Whether half as many recordings again take away less than a twentieth of what is left."""
        return float(np.median(self.left[-1])) - self.expected[0] < 0.05 * float(np.median(self.left[-1]))


@dataclass(frozen=True)
class Diagnosis:
    """What the recorded episodes say; see the module."""

    reference: str
    responses: tuple[Response, ...]
    best_shift: int  # steps by which the commands are shifted where the simulator's one-step error is least
    missed: tuple[Missed, ...]
    explained: dict[str, float]  # R² of the simulator's error on held-out recordings, by what predicts it; 0 or more
    forecast: Forecast | None  # None of fewer than `FEWEST` recordings
    findings: tuple[Finding, ...]


def diagnose(dataset: str | Path, simulator: str) -> Diagnosis:
    """Look at a paired dataset and its abstract simulator before anything is fitted.

    Args:
        dataset: a paired dataset, by name or folder.
        simulator: as `pair` takes it; a file of the user's is run.

    Raises:
        BadInputError: the dataset has not been paired, or has no two steps in a row.
    """
    source, pairing = open_dataset(dataset), pairing_named(simulator)
    if keys.ABSTRACT_STATE not in source.features:
        raise BadInputError(f"{source.root} has no column {keys.ABSTRACT_STATE}: expected a dataset that was paired")
    log = _Log.of(source)
    names = next(column for column in source.schema if column.name == keys.ACTION).labels
    bounds = pairing.commands or Commands.recorded(dataset)
    responses, best_shift = _responses(log, pairing, names, source.info["fps"])
    missed = _missed(log, pairing)
    error, aged = _errors(log), log.step >= _PAST_STEPS
    present, history = _histories(log, error)
    explained = _explained(log, error, aged, present, history) if error.size else {}
    may_forecast = error.size and log.recording.max() + 1 >= FEWEST
    forecast = _forecast(history[aged], error[aged], log.recording[aged]) if may_forecast else None
    findings = (
        *_of_responses(responses, source.info["fps"]),
        *_of_hidden_state(explained),
        *_of_commands(log, names, bounds),
        *_of_rates(log, source.info["fps"]),
        *_of_failures(source, log),
        *_of_forecast(forecast, missed),
    )
    return Diagnosis(source.reference, responses, best_shift, missed, explained, forecast, tuple(findings))


@dataclass(frozen=True)
class _Log:
    """N steps, one below the other; `step` counts within episodes, `recording` says which they are of."""

    state: Floats
    target_state: Floats
    action: Floats
    landed: Floats
    next_state: Floats
    step: Ints
    recording: Ints

    @classmethod
    def of(cls, source: Dataset) -> "_Log":
        names = (
            keys.ABSTRACT_STATE,
            keys.STATE,
            keys.ACTION,
            keys.ABSTRACT_SIMULATED_NEXT_STATE,
            keys.ABSTRACT_NEXT_STATE,
        )
        columns = source.columns(names)
        lengths = source.lengths
        step = np.concatenate([np.arange(length) for length in lengths])
        state, target_state, action, landed, next_state = (as_rows(columns[name]).astype(np.float64) for name in names)
        recording = np.repeat(recordings_of(source), lengths)
        return cls(state, target_state, action, landed, next_state, step, recording)

    @property
    def error(self) -> Floats:
        """Where the robot went less where the simulator landed, (N, X)."""
        return self.next_state - self.landed

    def before(self, values: Floats, steps: int) -> Floats:
        """Return `values` (N, D) of so many steps before; of the same row where an episode is younger."""
        rows = np.arange(len(values))
        return np.asarray(values[np.where(self.step >= steps, rows - steps, rows)])


def _responses(log: _Log, pairing: Pairing, names: Sequence[str], fps: float) -> tuple[tuple[Response, ...], int]:
    lags = min(LONGEST_STEPS, int(LONGEST_S * fps), int(log.step.max()))
    rows = np.flatnonzero(log.step >= lags)
    size = log.action.shape[1]
    count = max(1, _SIMULATED // (size * (lags + 1)))
    if len(rows) > count:
        rows = np.sort(np.random.default_rng(0).choice(rows, count, replace=False))
    middle, simulators = log.action[rows].mean(axis=0), built(pairing, len(rows))
    alone = _moved(simulators, log.state[rows], np.broadcast_to(middle, (len(rows), size)))
    moved = log.next_state[rows] - alone
    scale = moved.std(axis=0)
    used = scale > 1e-9 * max(1.0, float(np.abs(log.state).max()))
    scale, errors = np.where(used, scale, 1.0), []
    features = np.empty((len(rows), size * (lags + 1), int(used.sum())))
    for lag in range(lags + 1):
        past = log.action[rows - lag]
        apart = (_moved(simulators, log.state[rows], past) - log.next_state[rows]) / scale
        errors.append(float((apart[:, used] ** 2).mean()) if used.any() else 0.0)
        for axis in range(size):
            one = np.tile(middle, (len(rows), 1))
            one[:, axis] = past[:, axis]
            felt = (_moved(simulators, log.state[rows], one) - alone) / scale
            features[:, axis * (lags + 1) + lag] = felt[:, used]
    weights = _refitted(features, (moved / scale)[:, used], log.recording[rows], size).reshape(-1, size, lags + 1)
    found = []
    for axis, name in enumerate(names):
        gain = weights[:, axis].sum(axis=1)
        delay = weights[:, axis] @ np.arange(lags + 1) / np.where(np.abs(gain) > 1e-9, gain, np.nan) / fps
        found.append(Response(name, weights[0, axis], _with_ends(gain), _with_ends(delay)))
    return tuple(found), int(np.argmin(errors))


def _moved(simulators: AbstractSimulator, state: Floats, action: Floats) -> Floats:
    """Return where N simulators that are set to `state` (N, X) land with `action` (N, A)."""
    simulators.reset_to(torch.from_numpy(state.astype(np.float32)))
    return np.asarray(simulators.step(torch.from_numpy(np.ascontiguousarray(action, np.float32))), np.float64)


def _refitted(features: Floats, moved: Floats, recording: Ints, axes: int) -> Floats:
    """Return least-squares weights (1 + refits, D) of features (N, D, X): of all rows, then of resampled recordings.

    As many lags are used as the Bayesian information criterion wants; the weights of others are 0.
    """
    known, of = np.unique(recording, return_inverse=True)
    size = features.shape[1]
    squares, products = np.zeros((len(known), size, size)), np.zeros((len(known), size))
    for number in range(len(known)):
        rows = of == number
        flat = features[rows].transpose(0, 2, 1).reshape(-1, size)
        squares[number], products[number] = flat.T @ flat, flat.T @ moved[rows].ravel()
    draws = np.random.default_rng(0).multinomial(len(known), np.full(len(known), 1 / len(known)), _REFITS)
    counts = np.concatenate([np.ones((1, len(known))), draws])
    whole, right = np.tensordot(counts, squares, 1), counts @ products
    whole += (1e-6 * np.trace(whole[0]) / size + 1e-12) * np.eye(size)
    lag, criterion, best = np.arange(size) % (size // axes), np.inf, np.zeros_like(right)
    for longest in range(size // axes):
        part = np.flatnonzero(lag <= longest)
        weights = np.linalg.solve(whole[:, part[:, None], part], right[:, part, None])[..., 0]
        wrong = (
            (moved**2).sum() - 2 * weights[0] @ right[0, part] + weights[0] @ whole[0][np.ix_(part, part)] @ weights[0]
        )
        now = len(moved) * np.log(max(wrong, 1e-12)) + len(part) * np.log(len(moved))
        if now < criterion:
            criterion, best = now, np.zeros_like(right)
            best[:, part] = weights
    return best


def _with_ends(values: Floats) -> tuple[float, float, float]:
    low, high = np.nanpercentile(values[1:], [2.5, 97.5]) if np.isfinite(values[1:]).any() else (np.nan, np.nan)
    return float(values[0]), float(low), float(high)


def _missed(log: _Log, pairing: Pairing) -> tuple[Missed, ...]:
    column, found = pairing.abstract_state, []
    speed = np.linalg.norm((log.next_state - log.state) / (log.state.std(axis=0) + 1e-9), axis=1)
    command = np.linalg.norm(log.action - log.action.mean(axis=0), axis=1)
    factors = {"fast": speed, "commands are far from their mean": command}
    for role, part in column.roles:
        if role == "position":
            factors["far from the middle"] = np.linalg.norm(
                log.state[:, part] - log.state[:, part].mean(axis=0), axis=1
            )
    for index, (name, unit) in enumerate(zip(column.labels, column.units, strict=True)):
        square = log.error[:, index] ** 2
        where, most = "", 1.5
        for factor, values in factors.items():
            low, high = np.quantile(values, [1 / 3, 2 / 3])
            least, largest = (np.sqrt(square[part].mean()) for part in (values <= low, values >= high))
            if least > 0 and largest / least > most:
                most = float(largest / least)
                where = f"{most:.1f} times as large where {factor} as where not"
        still = np.sqrt(((log.next_state - log.state)[:, index] ** 2).mean())
        found.append(Missed(name, unit, float(np.sqrt(square.mean())), float(still), where))
    return tuple(found)


def _errors(log: _Log) -> Floats:
    """Return the simulator's errors (N, X'), in the values in which it makes any after a history."""
    error = log.error[log.step >= _PAST_STEPS]
    moved = np.abs(log.next_state - log.state).max(axis=0) + 1e-12
    return log.error[:, error.std(axis=0) > 1e-6 * moved] if len(error) else log.error[:, :0]


def _histories(log: _Log, error: Floats) -> tuple[Floats, Floats]:
    """Return features of the present, (N, D), a constant among them, and those with the past steps as well."""
    present = _products(np.concatenate([log.state, log.action], axis=1))
    past = [log.before(values, steps) for steps in range(1, _PAST_STEPS + 1) for values in (error, log.action)]
    return present, np.concatenate([present, *past], axis=1)


def _explained(log: _Log, error: Floats, aged: Bools, present: Floats, history: Floats) -> dict[str, float]:
    """Return how much of the simulator's error is predicted from the present, the past, and all that is recorded."""
    sets = {
        "the present abstract state and command": present,
        f"a history of {_PAST_STEPS} steps": history,
        "the robot's whole recorded state": _products(np.concatenate([log.target_state, log.action], axis=1)),
    }
    return {name: _held_out_r2(values[aged], error[aged], log.recording[aged]) for name, values in sets.items()}


def _products(values: Floats) -> Floats:
    scaled = (values - values.mean(axis=0)) / (values.std(axis=0) + 1e-9)
    first, second = np.triu_indices(values.shape[1] if values.shape[1] <= _MOST_SQUARED else 0)
    return np.concatenate([np.ones((len(values), 1)), scaled, scaled[:, first] * scaled[:, second]], axis=1)


def _held_out_r2(features: Floats, error: Floats, recording: Ints) -> float:
    known, of = np.unique(recording, return_inverse=True)
    fold = np.random.default_rng(0).permutation(len(known))[of] % min(_FOLDS, len(known))
    if len(known) < 2:
        return float("nan")
    left = np.empty_like(error)
    for number in np.unique(fold):
        out: Bools = fold == number
        left[out] = error[out] - features[out] @ _ridge(features[~out], error[~out])
    return max(0.0, float(np.mean(1 - (left**2).mean(axis=0) / error.var(axis=0))))


def _ridge(features: Floats, error: Floats) -> Floats:
    square = features.T @ features
    ridge = 1e-3 * np.trace(square) / len(square) * np.eye(len(square))
    return np.asarray(np.linalg.solve(square + ridge, features.T @ error))


def _forecast(features: Floats, error: Floats, recording: Ints) -> Forecast:
    error = error / error.std(axis=0)
    known, rng = np.unique(recording), np.random.default_rng(0)
    fitted = len(known) - max(1, len(known) // 5)
    sizes = tuple(sorted({max(2, round(fitted * share)) for share in (0.2, 0.35, 0.6, 1.0)}))
    left = np.empty((len(sizes), _FORECASTS))
    for refit in range(_FORECASTS):
        order = rng.permutation(known)
        out = np.isin(recording, order[fitted:])
        for number, size in enumerate(sizes):
            rows = np.isin(recording, order[:size])
            wrong = error[out] - features[out] @ _ridge(features[rows], error[rows])
            left[number, refit] = float((wrong**2).mean() / (error[out] ** 2).mean())
    # The error that is left falls with 1 / recordings, to what no number of them explains.
    more = round(1.5 * len(known))
    line = np.stack([np.ones(len(sizes)), 1 / np.array(sizes)], axis=1)
    at = np.array([1.0, 1 / more]) @ np.linalg.lstsq(line[-3:], left[-3:], rcond=None)[0]
    low, middle, high = (float(value) for value in np.percentile(at, [2.5, 50, 97.5]))
    return Forecast(sizes, left, more, (middle, low, high))


def _of_forecast(forecast: Forecast | None, missed: Sequence[Missed]) -> Iterator[Finding]:
    if forecast is None:
        yield Finding("warning", "too few recordings for a forecast", f"record {FEWEST} or more")
        return
    now, (then, low, high) = float(np.median(forecast.left[-1])), forecast.expected
    then_text = f"{then:.2f} [{low:.2f}, {high:.2f}]"
    what = f"of the simulator's error, {now:.2f} are left, with {forecast.more} recordings {then_text}"
    if forecast.is_enough:
        yield Finding("note", what, "these are enough: more of the same make hardly a difference")
    else:
        kinds = list(
            dict.fromkeys(one.where.partition("where ")[2].removesuffix(" as where not") for one in missed if one.where)
        )
        most = f", above all where {' and where '.join(kinds)}" if kinds else ""
        yield Finding("note", what, f"record more{most}")


def _of_responses(responses: Sequence[Response], fps: float) -> Iterator[Finding]:
    for one in responses:
        (delay, low, high), half = one.delay_s, 0.5 / fps
        if not one.is_visible:
            yield Finding(
                "warning",
                f"{one.name} has no effect that can be seen ({one.gain[0]:.2f} of the simulator's)",
                "check its units, its order among the commands and the abstraction φ, or record it varied more",
            )
        elif low > half:
            yield Finding(
                "note",
                f"{one.name} acts {delay:.2f} s [{low:.2f}, {high:.2f}] later than in the simulator, with "
                f"{one.gain[0]:.2f} [{one.gain[1]:.2f}, {one.gain[2]:.2f}] of its effect",
                "a grounding learns this from histories; if no such delay is expected, compare the clocks of the logs",
            )


def _of_hidden_state(explained: dict[str, float]) -> Iterator[Finding]:
    if not explained or np.isnan([*explained.values()]).any():
        return
    present, history, recorded = explained.values()
    what = f"of the simulator's error, the present explains {present:.2f}, a history {history:.2f}"
    if history > present + _MATTERS:
        yield Finding("note", what, "there is state that no single abstract state shows: train `astra`")
    elif present > _MATTERS:
        yield Finding("note", what, "nothing hidden shows: `nas`, or a parameter of the simulator, may do")
    if recorded > history + _MATTERS:
        advice = "the simulator may gain from more of the state in φ"
        yield Finding("note", f"the robot's whole recorded state explains {recorded:.2f} of it", advice)


def _of_commands(log: _Log, names: Sequence[str], bounds: Commands) -> Iterator[Finding]:
    for index, (name, (low, high)) in enumerate(zip(names, bounds.values(), strict=True)):
        least, largest = np.quantile(log.action[:, index], [0.01, 0.99])
        share = (min(largest, high) - max(least, low)) / (high - low)
        if share < 0.5:
            yield Finding(
                "warning",
                f"{name} was given between {least:.3g} and {largest:.3g} alone, of {low:.3g} to {high:.3g}",
                "no grounding knows what the rest does: record it, or narrow the bounds of `commands`",
            )
    scaled = (log.action - log.action.mean(axis=0)) / (log.action.std(axis=0) + 1e-9)
    values, directions = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    if len(values) > 1 and values[0] < 0.02 * values[-1] and log.action.std(axis=0).min() > 0:
        together = " and ".join(np.array(names)[np.abs(directions[:, 0]) > 0.3])
        yield Finding("warning", f"{together} only ever vary together", "vary them one at a time: their effects mix")


def _of_rates(log: _Log, fps: float) -> Iterator[Finding]:
    """Yield a warning if the state is repeated from step to step: it comes at a lower rate."""
    values = log.target_state
    rate = fps * float((values[1:] != values[:-1]).any(axis=1).mean()) if len(values) > 1 else fps
    if rate < 0.8 * fps:
        yield Finding(
            "warning",
            f"{keys.STATE} changes {rate:.3g} times a second, of {fps:g} rows",
            "it is sampled more slowly than it was logged: import with its own rate (`fps`)",
        )


def _of_failures(source: Dataset, log: _Log) -> Iterator[Finding]:
    if keys.TERMINATED not in source.features:
        return
    names = [name for name in (keys.TERMINATED, keys.SUCCESS) if name in source.features]
    columns = source.columns(names)
    failed = columns[keys.TERMINATED] & ~columns.get(keys.SUCCESS, np.zeros(len(log.step), bool))
    count = int(failed.sum())
    if count < _FEW_FAILURES:
        yield Finding(
            "note",
            f"{count} episodes end in a failure",
            f"a failure model wants {_FEW_FAILURES} or more: record some, or do not use `astra_plus` where it can fail",
        )
