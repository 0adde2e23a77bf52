"""Steps of the state unlike those before and after: the robot localised itself anew, or was carried."""

from collections.abc import Iterator, Mapping

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.numbers import as_rows
from astra_data.dataset.checkup.angles import TURNS, is_angle
from astra_data.dataset.checkup.finding import Finding, channels, deletion, labels
from astra_data.dataset.columns import NEXT_STATE, STATE, Array, Column, Episode
from astra_data.dataset.reader import Dataset

LARGE = 20.0
"""Median steps above which a step may be a jump; steps without any movement do not count for the median."""
ALONE = 10.0
"""How much larger than each of its neighbors a jump is."""
NEIGHBORS = 3
"""Steps on either side that are compared."""
LONGEST = 2
"""Consecutive large steps that are still one jump: there and back, or in two."""
ROUGH = 0.02
"""Share of large steps above which a value moves in jerks, such as a joint, and none of them is a jump."""
PLACES = ("", "1", "m", "cm", "mm", "km", "rad", "deg")
"""Units of what cannot jump; "" where it is unknown."""
RARE = 0.001
"""Largest share of steps that an advised split cuts."""
SAMPLES = 2**18
"""Steps from which the median and the share are estimated; of a dataset with no more, exactly."""

WHOLE = 0.01
"""Share of a turn by which the step of an angle that wraps may be off ..."""
USUAL = 3
"""... or so many median steps, if that is more."""


class Jumps:
    """The steps of a dataset's states in `column` (T, S), of `steps` in all."""

    def __init__(self, column: Column, steps: int) -> None:
        self._column = column
        # A velocity may change at once, where the robot hits something, and so may a force or a timer.
        self._placed = np.array(
            [
                unit in PLACES and role != "vector"
                for unit, role in zip(column.units, _role_of_each(column), strict=True)
            ]
        )
        self._turns = full_turns(column)
        self._quaternions = [group for role, group in column.roles if role == "quaternion"]
        self._every = -(-steps // SAMPLES)
        self._seen = 0
        self._samples: list[Floats] = []
        self._largest: list[Floats] = []

    def add(self, episode: Episode) -> None:
        """Measure the steps of the next episode."""
        steps = self.steps(episode.columns)
        self._samples.append(steps[-self._seen % self._every :: self._every])
        self._seen += len(steps)
        self._largest.append(steps.max(axis=0, initial=0.0))

    def steps(self, columns: Mapping[str, Array]) -> Floats:
        """Return how far each value moves in each step, (T, S) or without next states (T - 1, S)."""
        state: Floats = as_rows(columns[STATE]).astype(np.float64)
        if NEXT_STATE in columns:
            following: Floats = as_rows(columns[NEXT_STATE]).astype(np.float64)
        else:
            state, following = state[:-1], state[1:].copy()
        for group in self._quaternions:  # q and -q are the same rotation
            flipped = (state[:, group] * following[:, group]).sum(axis=1) < 0
            following[flipped, group] *= -1
        return np.abs(shortest(following - state, self._turns))

    def limits(self) -> Floats:
        """Return for each value (S,) the step above which it may jump; infinite where no jump can be told."""
        sampled = np.concatenate(self._samples)
        limits = np.full(self._column.size, np.inf)
        for index in np.flatnonzero(self._placed):
            moved = sampled[:, index][sampled[:, index] > 0]
            if len(moved):
                limit = LARGE * float(np.median(moved))
                if (sampled[:, index] > limit).mean() <= ROUGH:
                    limits[index] = limit
        return limits

    def findings(self, dataset: Dataset, called: str) -> list[Finding]:
        """Tell where the state jumps; episodes with large steps are read a second time.

        Raises:
            CorruptDatasetError: a file cannot be read.
        """
        limits = self.limits()
        suspects = np.flatnonzero((np.array(self._largest) > limits).any(axis=1)).tolist()
        names = [name for name in (STATE, NEXT_STATE) if name in dataset.features]
        sizes: dict[int, list[float]] = {}
        wraps: dict[str, dict[int, set[int]]] = {}
        uids, count = [], 0
        for episode in dataset.episodes(names, suspects) if suspects else ():
            steps = self.steps(episode.columns)
            jumped: set[int] = set()
            for index in np.flatnonzero(steps.max(axis=0, initial=0.0) > limits).tolist():
                for at in jumps(steps[:, index], limits[index]):
                    if unit := self._wraps(index, float(steps[at, index]), float(limits[index]) / LARGE):
                        wraps.setdefault(unit, {}).setdefault(index, set()).add(episode.uid)
                        continue
                    sizes.setdefault(index, []).append(float(steps[at, index]))
                    jumped.add(at)
            count += len(jumped)
            uids += [episode.uid] if jumped else []
        wrapped = [self._wrapping(unit, found) for unit, found in wraps.items()]
        if not uids:
            return wrapped
        where = channels(self._column, sorted(sizes))
        worst = max(sizes, key=lambda index: max(sizes[index]) / limits[index])
        # Where large steps are many, a split at the smallest jump would leave no episodes.
        usual = np.quantile(np.concatenate(self._samples)[:, worst], 1 - RARE)
        above, most = max(float(usual), 0.9 * min(sizes[worst])), max(sizes[worst])
        digit = 10.0 ** (np.floor(np.log10(above)) - 1)
        above = digit * np.floor(above / digit)  # two digits; rounded up, it might be above all jumps
        what = (
            f"{count} single-step jump{'s' if count > 1 else ''} in {where}; the largest is {most:.3g} in "
            f"{labels(self._column)[worst]}, whose median step is {limits[worst] / LARGE:.2g}"
        )
        advice = (
            f'begin new episodes there ([split.jump] in the mapping: column = "{STATE}", values = [{worst}], '
            f"above = {above:.2g}) and import again, or {deletion(called, uids)}"
        )
        return [*wrapped, Finding("warning", what, advice, tuple(uids))]

    def _wraps(self, index: int, step: float, median: float) -> str:
        """Return the unit in which `step` is a full turn of what is called an angle; "" if it is none."""
        if self._turns[index] or not is_angle(labels(self._column)[index]):
            return ""
        for unit, turn in TURNS.items():
            if abs(step - turn) <= max(WHOLE * turn, USUAL * median):
                return unit
        return ""

    def _wrapping(self, unit: str, found: Mapping[int, set[int]]) -> Finding:
        what = f"{channels(self._column, sorted(found))} jumps by a full turn, like an angle that wraps"
        advice = f'store its cosine and sine instead, or declare it an angle with unit = "{unit}"'
        return Finding("warning", what, advice, tuple(sorted(set().union(*found.values()))))


def full_turns(column: Column) -> Floats:
    """Return what a full turn adds to each value of a column, (size,); 0 for values that are no angles."""
    turns = [
        TURNS.get(unit, 2 * np.pi if role == "heading" else 0.0)
        for unit, role in zip(column.units, _role_of_each(column), strict=True)
    ]
    return np.array(turns)


def _role_of_each(column: Column) -> list[str]:
    """Return the role of each value; "" where they are unknown."""
    return (column.astra or {}).get("role", [""] * column.size)


def shortest(steps: Floats, turns: Floats) -> Floats:
    """Return `steps` (T, S) less whole `turns` (S,), where these are not 0."""
    angles = turns > 0
    whole = np.rint(np.divide(steps, turns, out=np.zeros_like(steps), where=angles))
    left: Floats = steps - turns * whole
    return left


def jumps(steps: Floats, limit: float) -> Iterator[int]:
    """Yield where in `steps` (T,) one, or two in a row, are above `limit` and far above their neighbors."""
    large = np.flatnonzero(steps > limit)
    for run in np.split(large, np.flatnonzero(np.diff(large) > 1) + 1):
        if 0 < len(run) <= LONGEST:
            first, last = int(run[0]), int(run[-1])
            before = steps[max(0, first - NEIGHBORS) : first]
            beside = np.concatenate([before, steps[last + 1 : last + 1 + NEIGHBORS]])
            if len(beside) >= NEIGHBORS and steps[run].min() > ALONE * beside.max():
                yield first
