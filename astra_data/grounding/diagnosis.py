"""What paired episodes say before any fit: delays, what the simulator misses, hidden state, what was never tried."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from astra_data.core.arrays import Bools, Floats, Ints, as_rows
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import torch
from astra_data.core.progress import Progress, silent
from astra_data.dataset import columns as keys
from astra_data.dataset.checkup import Finding
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import open_dataset
from astra_data.robots.registry import Pairing, built, pairing_named
from astra_data.worlds.protocols import AbstractSimulator
from astra_data.worlds.user_code import stepped

LONGEST_S, LONGEST_STEPS = 2.0, 20  # longest delay that is looked for: the shorter of the two
FEWEST = 10  # recordings from which on a forecast is made
_SIMULATED = 1_000_000  # simulated steps for the responses; of more, a random share is used
_REFITS, _FORECASTS, _FOLDS = 200, 12, 5
_PAST_STEPS = 8  # steps of a history from which the simulator's error is predicted
_MOST_SQUARED = 16  # values whose products are features as well; of more, only the values
_VISIBLE = 0.1  # share of the simulator's response below which a command has no visible effect
_MATTERS = 0.05  # explained variance from which on what it adds is worth a sentence
_HARDLY = 0.01  # share of the simulator's squared error that is not worth more recordings


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
    is_simulated: bool  # whether it moves the simulator

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
    expected: Sequence[float]  # what is left with that many: value, low, high
    gain: Sequence[float]  # by which share of what is left now it is less then: value, low, high


@dataclass(frozen=True)
class Diagnosis:
    """What the recorded episodes say; see the module."""

    reference: str
    recordings: int
    steps: int
    responses: tuple[Response, ...]
    missed: tuple[Missed, ...]
    commands: dict[str, tuple[float, ...]]  # given, its 1 and 99 %; bounds, low and high, by default as recorded
    explained: dict[str, Floats]  # what predicts the error → held-out R² (1 + refits), of all, of resampled recordings
    forecast: Forecast | None  # None of fewer than `FEWEST` recordings
    findings: tuple[Finding, ...]


def diagnose(dataset: str | Path, simulator: str, progress: Progress = silent) -> Diagnosis:
    """Look at a paired dataset and its abstract simulator, as `pair` takes it, before anything is fitted."""
    source, pairing = open_dataset(dataset), pairing_named(simulator)
    log = _Log.of(source)
    labels = {column.name: column.labels for column in source.schema}
    names = labels[keys.ACTION]
    given = np.quantile(log.action, [0.01, 0.99, 0.0, 1.0], axis=0).T
    if pairing.columns:  # of a task, whose commands have bounds
        given[:, 2:] = [*pairing.commands.values()] if pairing.commands else (-1.0, 1.0)
    commands = dict(zip(names, map(tuple, given.tolist()), strict=True))
    felt = _Felt.of(log, pairing, source.info["fps"], progress)
    responses = _responses(log, felt, names, source.info["fps"])
    missed = _missed(log, pairing)
    recordings, known = len(np.unique(log.recording)), _Error.of(log, felt)
    long_enough = int(known.recording.max()) + 1 if known.error.size else 0
    explained, shown = _explained(log, known, labels[keys.STATE]) if long_enough > 1 else ({}, [])
    forecast = _forecast(known) if long_enough >= FEWEST else None
    findings = (
        *_of_responses(responses, source.info["fps"]),
        *_of_hidden_state([*explained.values()], shown),
        *_of_commands(log, commands),
        *(_of_forecast(forecast, missed) if known.error.size else ()),
    )
    return Diagnosis(
        source.reference, recordings, len(log.step), responses, missed, commands, explained, forecast, findings
    )


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
        after = (keys.ABSTRACT_SIMULATED_NEXT_STATE, keys.ABSTRACT_NEXT_STATE)
        names = (keys.ABSTRACT_STATE, keys.STATE, keys.ACTION, *after)
        columns, lengths = source.columns(names), source.lengths
        step = np.concatenate([np.arange(length) for length in lengths])
        state, target_state, action, landed, next_state = (as_rows(columns[name]).astype(np.float64) for name in names)
        recording = np.repeat(source.recordings, lengths)
        return cls(state, target_state, action, landed, next_state, step, recording)

    @property
    def error(self) -> Floats:
        """Where the robot went less where the simulator landed, (N, X)."""
        return self.next_state - self.landed

    def before(self, values: Floats, steps: int) -> Floats:
        """Return `values` (N, D) of so many steps before; of the same row where an episode is younger."""
        rows = np.arange(len(values))
        return np.asarray(values[np.where(self.step >= steps, rows - steps, rows)])


@dataclass(frozen=True)
class _Felt:
    """What the simulator does from the states of N rows with past commands; `alone` (N, X), with the mean command."""

    rows: Ints
    alone: Floats
    changes: Floats  # (N, A, K + 1, X): where a command of K steps before takes it, by axis, less `alone`

    @classmethod
    def of(cls, log: _Log, pairing: Pairing, fps: float, progress: Progress = silent) -> "_Felt":
        lengths = log.step[np.flatnonzero(np.diff(log.step, append=0) <= 0)] + 1
        lags = max(1, min(LONGEST_STEPS, int(LONGEST_S * fps), int(np.median(lengths)) // 2))
        rows, size = np.flatnonzero(log.step >= lags), log.action.shape[1]
        if not len(rows):
            raise BadInputError(f"expected an episode of {lags + 1} steps or more, got {lengths.max()}")
        count = max(1, _SIMULATED // (size * (lags + 1)))
        if len(rows) > count:
            rows = np.sort(np.random.default_rng(0).choice(rows, count, replace=False))
        middle, simulators = log.action.mean(axis=0), built(pairing, len(rows))
        alone = _moved(simulators, log.state[rows], np.broadcast_to(middle, (len(rows), size)))
        changes = np.empty((len(rows), size, lags + 1, alone.shape[1]))
        for lag in range(lags + 1):
            progress(lag / (lags + 1), f"{len(rows) * (1 + lag * size):,} steps of the simulator")
            for axis in range(size):
                one = np.tile(middle, (len(rows), 1))
                one[:, axis] = log.action[rows - lag, axis]
                changes[:, axis, lag] = _moved(simulators, log.state[rows], one) - alone
        return cls(rows, alone, changes)


def _responses(log: _Log, felt: _Felt, names: Sequence[str], fps: float) -> tuple[Response, ...]:
    _, size, lags, _ = felt.changes.shape
    moved = log.next_state[felt.rows] - felt.alone
    scale = moved.std(axis=0)
    used = scale > 1e-9 * max(1.0, float(np.abs(log.state).max()))  # the values that move
    features = (felt.changes[..., used] / scale[used]).reshape(len(felt.rows), size * lags, -1)
    moved = moved[:, used] / scale[used]
    weights = _refitted(features, moved, log.recording[felt.rows], size).reshape(-1, size, lags)
    found = []
    for axis, name in enumerate(names):
        gain = weights[:, axis].sum(axis=1)
        delay = weights[:, axis] @ np.arange(lags) / np.where(np.abs(gain) > 1e-9, gain, np.nan) / fps
        is_simulated = bool(np.abs(felt.changes[:, axis]).max() > 0)
        found.append(Response(name, weights[0, axis], with_ends(gain), with_ends(delay), is_simulated))
    return tuple(found)


def _moved(simulators: AbstractSimulator, state: Floats, action: Floats) -> Floats:
    """Return where N simulators that are set to `state` (N, X) land with `action` (N, A)."""
    simulators.reset_to(torch.from_numpy(state.astype(np.float32)))
    command = torch.from_numpy(np.ascontiguousarray(action, np.float32))
    return np.asarray(stepped(simulators, command, "step of the simulator"), np.float64)


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
    counts = _resampled(len(known))
    whole, right = np.tensordot(counts, squares, 1), counts @ products
    whole += (1e-6 * np.trace(whole[0]) / size + 1e-12) * np.eye(size)
    lag, criterion, best = np.arange(size) % (size // axes), np.inf, np.zeros_like(right)
    power = (moved**2).sum()
    for longest in range(size // axes):
        part = np.flatnonzero(lag <= longest)
        weights = np.linalg.solve(whole[:, part[:, None], part], right[:, part, None])[..., 0]
        wrong = power - 2 * weights[0] @ right[0, part] + weights[0] @ whole[0][np.ix_(part, part)] @ weights[0]
        now = len(moved) * np.log(max(wrong, 1e-12)) + len(part) * np.log(len(moved))
        if now < criterion:
            criterion, best = now, np.zeros_like(right)
            best[:, part] = weights
    return best


def with_ends(values: Floats) -> tuple[float, float, float]:
    """Return the first of a bootstrap's values, which is that of all recordings, and the 95 % interval of the rest."""
    low, high = np.nanpercentile(values[1:], [2.5, 97.5]) if np.isfinite(values[1:]).any() else (np.nan, np.nan)
    return float(values[0]), float(low), float(high)


def _missed(log: _Log, pairing: Pairing) -> tuple[Missed, ...]:
    column, found = pairing.abstract_state, []
    speed = np.linalg.norm((log.next_state - log.state) / (log.state.std(axis=0) + 1e-9), axis=1)
    command = np.linalg.norm(log.action - log.action.mean(axis=0), axis=1)
    factors = {"fast": speed, "commands are far from their mean": command}
    for place in (log.state[:, part] for role, part in column.roles if role == "position"):
        factors["far from the middle"] = np.linalg.norm(place - place.mean(axis=0), axis=1)
    for index, (name, unit) in enumerate(zip(column.labels, column.units, strict=True)):
        square = log.error[:, index] ** 2
        still = np.sqrt(((log.next_state - log.state)[:, index] ** 2).mean())
        where, most = "", 1.5 if square.mean() > (1e-3 * still) ** 2 else np.inf  # not of rounding errors
        for factor, values in factors.items():
            low, high = np.quantile(values, [1 / 3, 2 / 3])
            least, largest = (np.sqrt(square[part].mean()) for part in (values <= low, values >= high))
            if least > 0 and largest / least > most:
                most = float(largest / least)
                where = f"{most:.1f} times as large where {factor} as where not"
        found.append(Missed(name, unit, float(np.sqrt(square.mean())), float(still), where))
    return tuple(found)


@dataclass(frozen=True)
class _Error:
    """The simulator's errors (N, X') in the values in which it makes any; `recording` (N,) numbers from 0.

    Features of the present are (N, D), a constant among them; past commands, as the simulator feels them from
    here, (X', N, D'); past errors (N, D'').
    """

    rows: Ints
    error: Floats
    recording: Ints
    present: Floats
    commands: Floats
    past: Floats

    @classmethod
    def of(cls, log: _Log, felt: _Felt) -> "_Error":
        made = log.error
        moved = np.abs(log.next_state - log.state).max(axis=0) + 1e-12
        wrong = made[felt.rows].std(axis=0) > 1e-6 * moved
        commands = felt.changes[:, :, 1 : _PAST_STEPS + 1].reshape(len(felt.rows), -1, len(wrong))[..., wrong]
        past = [log.before(made[:, wrong], steps)[felt.rows] for steps in range(1, _PAST_STEPS + 1)]
        return cls(
            felt.rows,
            made[felt.rows][:, wrong],
            np.unique(log.recording[felt.rows], return_inverse=True)[1],
            _products(np.concatenate([log.state, log.action], axis=1)[felt.rows]),
            commands.transpose(2, 0, 1),
            np.concatenate(past, axis=1),
        )

    def left(self, sets: Sequence[Floats], fitted: Bools, out: Bools) -> Floats:
        """Return what a ridge regression on `sets` of features, fitted to some rows, leaves of others."""
        left = np.empty_like(self.error[out])
        for index in range(left.shape[1]):
            features = np.concatenate([one[index] if one.ndim == 3 else one for one in sets], axis=1)
            known = features[fitted]
            square = known.T @ known
            ridge = np.diag(1e-3 * square.diagonal() + 1e-12)
            weights = np.linalg.solve(square + ridge, known.T @ self.error[fitted, index])
            left[:, index] = self.error[out, index] - features[out] @ weights
        return left

    def share_left(self, recordings: Ints, tested: Ints) -> float:
        """Return the share of error variance, at most 1, that histories fitted to `recordings` leave of `tested`."""
        out, sets = np.isin(self.recording, tested), [self.present, self.commands, self.past]
        wrong = self.left(sets, np.isin(self.recording, recordings), out)
        return float(np.minimum(1.0, (wrong**2).mean(axis=0) / self.error.var(axis=0)).mean())


def _explained(log: _Log, known: _Error, values: Sequence[str]) -> tuple[dict[str, Floats], list[str]]:
    """Return R² by what predicts the error, and those of the recorded `values` that show what histories leave of it."""
    steps = f"{_PAST_STEPS} steps before"
    recorded = np.concatenate([log.target_state, log.action], axis=1)[known.rows]
    sets = {
        "the present abstract state and command": [known.present],
        f"and the commands of {steps}": [known.present, known.commands],
        f"and the errors of {steps}": [known.present, known.commands, known.past],
        "instead, the robot's whole recorded state and command": [_products(recorded)],
    }
    count, left = int(known.recording.max()) + 1, {}
    fold = np.random.default_rng(0).permutation(count)[known.recording] % min(_FOLDS, count)
    for name, features in sets.items():
        left[name] = np.empty_like(known.error)
        for number in np.unique(fold):
            left[name][fold == number] = known.left(features, fold != number, fold == number)
    counts, member = _resampled(count), known.recording == np.arange(count)[:, None]
    whole = counts @ (member @ (known.error - known.error.mean(axis=0)) ** 2)
    r2 = {name: np.maximum(0.0, 1 - counts @ (member @ wrong**2) / whole).mean(axis=-1) for name, wrong in left.items()}
    state, rest = log.target_state[known.rows], [*left.values()][2]
    state = (state - state.mean(axis=0)) / (state.std(axis=0) + 1e-9)
    shares = (state.T @ (rest / rest.std(axis=0)) / len(state)) ** 2
    order = np.argsort(-shares.max(axis=1), kind="stable")[:3]
    return r2, [values[one] for one in order if shares[one].max() > _MATTERS / 2]


def _resampled(count: int) -> Floats:
    """Return how often each of `count` recordings counts, (1 + refits, count): once, then as a bootstrap draws them."""
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), _REFITS)
    return np.concatenate([np.ones((1, count)), draws])


def _products(values: Floats) -> Floats:
    scaled = (values - values.mean(axis=0)) / (values.std(axis=0) + 1e-9)
    first, second = np.triu_indices(values.shape[1] if values.shape[1] <= _MOST_SQUARED else 0)
    return np.concatenate([np.ones((len(values), 1)), scaled, scaled[:, first] * scaled[:, second]], axis=1)


def _forecast(known: _Error) -> Forecast:
    count, rng = int(known.recording.max()) + 1, np.random.default_rng(0)
    fitted = count - max(1, count // 5)
    sizes = tuple(sorted({max(2, round(fitted * share)) for share in (0.35, 0.5, 0.7, 1.0)}))
    left = np.empty((len(sizes), _FORECASTS))
    for refit in range(_FORECASTS):
        order = rng.permutation(count)
        for number, size in enumerate(sizes):
            left[number, refit] = known.share_left(order[:size], order[fitted:])
    return _extrapolated(sizes, left, round(1.5 * count))


def _extrapolated(sizes: tuple[int, ...], left: Floats, more: int) -> Forecast:
    # To what no number of recordings explains; faster than with 1 / recordings, as that of least squares does.
    (before, last), (less, now) = 1 / np.square(sizes[-2:], dtype=float), left[-2:]
    at = np.maximum(0.0, now + (now - less) * (1 / more**2 - last) / (last - before))
    expected, gain = np.percentile([at, 1 - at / left[-1]], [50, 2.5, 97.5], axis=1).T.tolist()
    return Forecast(sizes, left, more, expected, gain)


def _of_forecast(forecast: Forecast | None, missed: Sequence[Missed]) -> Iterator[Finding]:
    if forecast is None:
        yield Finding("warning", "too few recordings for a forecast", f"record {FEWEST} or more")
        return
    now, (then, low, high), (gain, least, _) = float(np.median(forecast.left[-1])), forecast.expected, forecast.gain
    what = (
        f"of the simulator's error, histories leave {now:.2f}, with {forecast.more} "
        f"recordings {then:.2f} [{low:.2f}, {high:.2f}]"
    )
    where = [one.where.partition("where ")[2].removesuffix(" as where not") for one in missed if one.where]
    above = f", above all where {' and where '.join(dict.fromkeys(where))}" if where else ""
    if gain < _MATTERS or now - then < _HARDLY:
        yield Finding("note", what, "these are enough: more of the same make hardly a difference")
    elif least > 0:
        yield Finding("note", what, f"record more{above}")
    else:
        yield Finding("note", what, f"more may help or not: record some more{above}, and look again")


def _of_responses(responses: Sequence[Response], fps: float) -> Iterator[Finding]:
    for one in responses:
        (delay, low, high), half = one.delay_s, 0.5 / fps
        if not one.is_simulated:
            advice = "that of the robot is not seen either: model it, or leave it out of the commands"
            yield Finding("note", f"{one.name} has no effect in the simulator", advice)
        elif not one.is_visible:
            what = f"{one.name} has no effect that can be seen ({one.gain[0]:.2f} of the simulator's)"
            advice = "check its units, its order among the commands and the abstraction φ, or record it varied more"
            yield Finding("warning", what, advice)
        elif low > half:
            yield Finding(
                "note",
                f"{one.name} acts {delay:.2f} s [{low:.2f}, {high:.2f}] later than in the simulator, with "
                f"{one.gain[0]:.2f} [{one.gain[1]:.2f}, {one.gain[2]:.2f}] of its effect",
                "a grounding learns this from histories; if no such delay is expected, compare the clocks of the logs",
            )


def _of_hidden_state(explained: Sequence[Floats], shown: Sequence[str]) -> Iterator[Finding]:
    if not explained:
        return
    present, late, history, recorded = explained

    def adds(more: Floats, less: Floats) -> bool:
        value, low, _ = with_ends(more - less)
        return value > _MATTERS and low > 0

    what = (
        f"of the simulator's error, the present explains {present[0]:.2f}, with the past commands {late[0]:.2f}, "
        f"with the past errors {history[0]:.2f}"
    )
    if adds(history, late):
        advice = "there is state that neither the abstract state nor commands show: train `astra_plus`"
        yield Finding("note", what, advice)
    elif adds(late, present):
        yield Finding("note", what, "a delay or a lag of the commands is what is hidden: any grounding learns it")
    elif present[0] > _MATTERS:
        advice = "for the motion nothing hidden shows: `nas`, or a parameter of the simulator, may do"
        yield Finding("note", what, advice)
    if adds(recorded, history):
        which = f", such as {' and '.join(shown)}," if shown else ""
        advice = f"the simulator may gain from more of it{which} in φ"
        yield Finding("note", f"the robot's whole recorded state explains {recorded[0]:.2f} of it", advice)


def _of_commands(log: _Log, commands: Mapping[str, tuple[float, ...]]) -> Iterator[Finding]:
    for name, (least, largest, low, high) in commands.items():
        if min(largest, high) - max(least, low) < 0.5 * (high - low):
            what = f"{name} was given between {least:.3g} and {largest:.3g} alone, of {low:.3g} to {high:.3g}"
            advice = "no grounding knows what the rest does: record it, or narrow the bounds of `commands`"
            yield Finding("warning", what, advice)
    scaled = (log.action - log.action.mean(axis=0)) / (log.action.std(axis=0) + 1e-9)
    values, directions = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    if len(values) > 1 and values[0] < 0.02 * values[-1] and log.action.std(axis=0).min() > 0:
        together = " and ".join(np.array([*commands])[np.abs(directions[:, 0]) > 0.3])
        yield Finding("warning", f"{together} only ever vary together", "vary them one at a time: their effects mix")
