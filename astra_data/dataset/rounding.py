"""Which steps of a column are lost where float32 holds its values."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from astra_data.core.arrays import as_rows
from astra_data.dataset.columns import Array, Column

_LARGE = 2**16  # numbers beyond it that float32 cannot hold are refused: times, and positions far from their origin
_ROUNDED = 0.05  # mean error of a step, as a share of a typical step, from which on rounding is warned of ...
_LOST = 0.5  # ... and from which on large numbers are refused
_TYPICAL = 0.9  # quantile of the steps that is typical: robots often stand still, and their sensors do not
_ENOUGH = 10  # fewer steps tell nothing of rounding
_SAMPLES, _MOST_SAMPLES = 2**9, 2**15  # steps that are looked at in a block, and in all


class Rounding:
    """Compares the steps of a column's values (n, size) with those that float32 holds."""

    def __init__(self, column: Column, offset: Sequence[float] = ()) -> None:
        """Compare those of `column`, to which `offset` was added."""
        self._column, self._offset = column, offset
        self._low, self._high = np.full(column.size, np.inf), np.full(column.size, -np.inf)
        self._samples: list[Array] = []

    def add(self, values: Array, held: Array) -> None:
        """Look at consecutive rows, all finite."""
        exact = values.astype(np.float64)
        self._low = np.minimum(self._low, exact.min(axis=0, initial=np.inf))
        self._high = np.maximum(self._high, exact.max(axis=0, initial=-np.inf))
        rows = np.arange(0, len(exact) - 1, max(1, len(exact) // _SAMPLES))
        # Between integers first: those of uint64 may be equal as float64.
        steps = np.where(values[rows + 1] == values[rows], 0.0, exact[rows + 1] - exact[rows])
        errors = held[rows + 1].astype(np.float64) - held[rows] - steps
        # Less is the noise of a computation with float64.
        steps[np.abs(steps) < 64 * np.spacing(np.abs(exact[rows]))] = 0.0
        self._samples.append(np.abs([steps, errors]))
        if sum(part.shape[1] for part in self._samples) > _MOST_SAMPLES:
            self._samples = [np.concatenate(self._samples, axis=1)[:, ::2]]

    def found(self) -> tuple[str, bool] | None:
        """Return a warning, and whether most steps are lost; None where all are held well enough."""
        if not self._samples:
            return None
        steps, errors = np.concatenate(self._samples, axis=1)
        lost, helps, coarse = False, True, []
        offset = np.broadcast_to(self._offset or 0.0, self._column.size).tolist()
        for entry, (low, high) in enumerate(zip(self._low.tolist(), self._high.tolist(), strict=True)):
            moved = steps[:, entry] > 0
            if moved.sum() < _ENOUGH:
                continue
            step = float(np.quantile(steps[moved, entry], _TYPICAL))
            share = float(errors[moved, entry].mean()) / step
            if share < _ROUNDED:
                continue
            largest = max(-low, high)
            spacing = float(np.spacing(np.float32(largest)))
            is_count = spacing <= 2 and step == round(step)
            lost |= share >= _LOST and largest > _LARGE and not is_count
            digit = 10.0 ** np.floor(np.log10(high - low))
            offset[entry] = round(offset[entry] - digit * round((low + high) / 2 / digit), 12)
            helps &= float(np.spacing(np.float32(high - low))) / 3 < _ROUNDED * step
            name = self._column.names[entry] if self._column.names else f"entry {entry}"
            coarse.append(f"{name} (up to {largest:.6g}) in steps of {spacing:.2g}, but it moves by {step:.2g}")
        if not coarse:
            return None
        listed = ", ".join(f"{one:.1f}" if one == round(one) else f"{one:.15g}" for one in offset)
        advice = f"set offset = [{listed}]" if helps else "leave out what is a time"
        if lost and helps:
            advice += ', leave out what is a time, or store counts with dtype = "int64"'
        return f"columns.{self._column.name}: float32 holds {'; '.join(coarse)}: {advice}", lost


class Roundings:
    """Compares the steps of columns that were recorded as more than float32 holds."""

    def __init__(self, columns: Iterable[Column], dtypes: Mapping[str, str]) -> None:
        """Compare those of `columns`, recorded as `dtypes`."""
        self._of = {
            column.name: Rounding(column)
            for column in columns
            if column.dtype == "float32" and not np.can_cast(dtypes.get(column.name, "float32"), np.float32)
        }

    def add(self, columns: Mapping[str, Array]) -> None:
        """Look at the rows (T,) or (T, size) of an episode, all finite."""
        for name, rounding in self._of.items():
            rows = as_rows(columns[name])
            with np.errstate(over="ignore", invalid="ignore"):
                rounding.add(rows, rows.astype(np.float32))

    def found(self) -> list[str]:
        """Return a warning for each column whose steps are held badly."""
        found = [each for rounding in self._of.values() if (each := rounding.found())]
        return [f"{warning} in a mapping for an import of the data files" for warning, _ in found]
