"""Convert the fields of a recording to columns of a dataset."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import as_column
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import NEXT_STATE, REWARD, STATE, TERMINATED, Array, Column
from astra_data.dataset.lerobot_rows import DERIVED_FLAGS, next_state_of
from astra_data.io.mapping import MAPPED_FLAGS, ColumnMapping, ImportMapping
from astra_data.io.recording import Block

Mask = NDArray[np.bool_]
EXACT = 2**53
"""Floats represent whole numbers below this exactly."""
_LARGE = 2**16
"""Numbers beyond it that float32 cannot hold are refused: times, and positions far from their origin."""
_ROUNDED = 0.05
"""Mean error of a step, as a share of a typical step, from which on rounding is warned of ..."""
_LOST = 0.5
"""... and from which on large numbers are refused."""
_TYPICAL = 0.9
"""Quantile of the steps that is typical: robots often stand still, and their sensors do not."""
_ENOUGH = 10
"""Fewer steps tell nothing of rounding."""
_SAMPLES, _MOST_SAMPLES = 2**9, 2**15
"""Steps that are looked at in a block, and in all."""
_KINDS = {"U": "text", "S": "text", "O": "values that are not numbers, such as missing ones"}


class Converter:
    """Converts the blocks of one recording.

    Attributes:
        columns: of the dataset, including derived ones; known after the first block.
    """

    def __init__(self, mapping: ImportMapping) -> None:
        """Convert by `mapping`."""
        self.columns: tuple[Column, ...] = ()
        self._mapping = mapping
        self._converted: dict[str, Column] = {}
        self._rounding: dict[str, _Rounding] = {}

    def convert(self, block: Block) -> tuple[dict[str, Array], dict[str, Mask]]:
        """Return the columns of `block` with n rows, (n,) or (n, size), and rows where fields are not finite.

        Raises:
            BadInputError: values do not fit their columns, or change in size; lists every fault.
        """
        faults: list[str] = []
        fields = {name: _as_rows(name, block.values[name], faults) for name in self._mapping.fields}
        if faults:
            raise BadInputError(f"{block.origin}: {'; '.join(faults)}")
        columns, bad = {}, dict[str, Mask]()
        for name in (*self._mapping.split.ends, *([self._mapping.time] if self._mapping.time else [])):
            bad[name] = np.asarray(~np.isfinite(fields[name]).all(axis=1))
        for name, spec in self._mapping.columns.items():
            try:
                values = _transformed(np.concatenate([fields[f] for f in spec.fields], axis=1), spec)
                column = self._converted.get(name) or column_of(name, spec, values.shape[1])
                if values.shape[1] != column.size:
                    raise BadInputError(f"{values.shape[1]} values, before there were {column.size}")
                cast, finite = _cast(values, column)
                ok = finite.all(axis=1)
                if column.dtype == "float32" and not np.can_cast(values.dtype, np.float32):
                    self._rounding.setdefault(name, _Rounding(column, spec)).add(values[ok], cast[ok])
            except BadInputError as error:
                faults.append(f"columns.{name}: {error}")
                continue
            self._converted[name] = column
            columns[name] = as_column(cast)
            widths = [(field, fields[field].shape[1]) for field in spec.fields]
            sources = [f"{field}[{at}]" if n > 1 else field for field, n in widths for at in range(n)]
            for entry in np.flatnonzero(~finite.all(axis=0)).tolist():
                source = sources[spec.take[entry] if spec.take else entry]
                bad[source] = bad.get(source, False) | ~finite[:, entry]
        if not faults:
            faults += self._size_faults()
        if faults:
            raise BadInputError(f"{block.origin}: {'; '.join(faults)}")
        self.columns = self.columns or _complete(self._converted, self._mapping.terminal)
        return columns, {name: mask for name, mask in bad.items() if mask.any()}

    def rounded(self) -> list[str]:
        """Return a warning for each column whose steps float32 holds badly, with the offset that helps.

        Raises:
            BadInputError: most of the steps of large numbers are lost.
        """
        found = [each for rounding in self._rounding.values() if (each := rounding.found())]
        if lost := [warning for warning, is_lost in found if is_lost]:
            raise BadInputError("; ".join(lost))
        return [warning for warning, _ in found]

    def _size_faults(self) -> list[str]:
        sizes = {name: column.size for name, column in self._converted.items()}
        faults = []
        if sizes.get(NEXT_STATE) not in (None, sizes.get(STATE)):
            faults.append(f"{NEXT_STATE} has {sizes[NEXT_STATE]} values, {STATE} {sizes.get(STATE, 0)}")
        for name in (REWARD, *MAPPED_FLAGS):
            if sizes.get(name, 1) > 1:
                faults.append(f"{name}: {sizes[name]} values, expected 1")
        jump = self._mapping.split.jump
        if jump and max(jump.values) >= sizes[jump.column]:
            size = f"{jump.column} has {sizes[jump.column]} values, counted from 0"
            faults.append(f"split.jump.values {list(jump.values)}: {size}")
        return faults


def column_of(name: str, spec: ColumnMapping, size: int) -> Column:
    """Return the column `name` with `size` values.

    Raises:
        BadInputError: lists do not have that many entries.
    """
    lists: dict[str, Sequence[str]] = {"unit": spec.unit, "frame": spec.frame, "role": spec.role}
    for key, words in lists.items():
        if len(words) not in (0, 1, size):
            raise BadInputError(f"{key} has {len(words)} words for {size} values")
    astra = {key: list(words) * (size if len(words) == 1 else 1) for key, words in lists.items() if words}
    dtype = spec.dtype or ("bool" if name in MAPPED_FLAGS else "float32")
    # Fields of one value each name what they hold; `size` tells that none holds more.
    names = spec.names or (spec.fields if len(spec.fields) == size > 1 and not spec.take else None)
    return Column(name, dtype, size, names, spec.meaning, astra or None)


def _complete(converted: dict[str, Column], terminal: str) -> tuple[Column, ...]:
    columns = dict(converted)
    if STATE in columns:
        following = next_state_of(columns[STATE])
        if recorded := columns.get(NEXT_STATE):
            following = replace(
                following,
                names=recorded.names or following.names,
                meaning=recorded.meaning or following.meaning,
                astra={**(following.astra or {}), **(recorded.astra or {})} or None,
            )
        elif TERMINATED in columns and terminal == "stand_still":
            made_up = "; where an episode terminates, not recorded: the state itself"
            following = replace(following, meaning=f"{following.meaning}{made_up}")
        columns[NEXT_STATE] = following
    return (*columns.values(), *(column for column in DERIVED_FLAGS if column.name not in columns))


def _as_rows(name: str, values: Array, faults: list[str]) -> Array:
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        faults.append(f"field '{name}': expected numbers, got {_KINDS.get(array.dtype.kind, array.dtype)}")
    elif 0 in array.shape:
        faults.append(f"field '{name}' has no values, its shape is {array.shape}")
    return array.reshape(len(array), -1)


def _transformed(values: Array, spec: ColumnMapping) -> Array:
    """Apply `take`, `scale`, `offset` and `clip` to `values` (n, width)."""
    if spec.take:
        if max(spec.take) >= values.shape[1]:
            size = f"{', '.join(spec.fields)} hold {values.shape[1]} values, counted from 0"
            raise BadInputError(f"take {list(spec.take)}: {size}")
        values = values[:, list(spec.take)]
    for key, numbers in (("scale", spec.scale), ("offset", spec.offset)):
        if len(numbers) not in (0, 1, values.shape[1]):
            raise BadInputError(f"{key} has {len(numbers)} numbers for {values.shape[1]} values")
    with np.errstate(over="ignore", invalid="ignore"):
        if spec.scale:
            values = values * np.array(spec.scale)
        if spec.offset:
            values = values + np.array(spec.offset)
    if spec.clip is not None:
        values = np.where(np.isfinite(values), np.clip(values, *spec.clip), values)
    return values


def _cast(values: Array, column: Column) -> tuple[Array, Mask]:
    """Return `values` (n, size) in the column's dtype, and which of them are finite."""
    finite: Mask = np.asarray(np.isfinite(values))
    sound = values[finite.all(axis=1)]
    if column.dtype == "float32":
        if sound.dtype.kind in "iu" and ((sound > EXACT) | (sound < -EXACT)).any():
            raise BadInputError(
                'integers beyond 2^53 do not fit float32; set dtype = "int64", or a scale or an offset that '
                "makes them small"
            )
        with np.errstate(over="ignore"):
            cast = np.ascontiguousarray(values, np.float32)
        return cast, finite & np.isfinite(cast)
    if column.dtype == "bool" and not np.isin(sound, (0, 1)).all():
        raise BadInputError("expected true and false, or 1 and 0")
    if column.dtype == "int64" and sound.dtype.kind == "f":
        if not (sound == np.floor(sound)).all():
            raise BadInputError("expected whole numbers")
        if (abs(sound.astype(float)) >= EXACT).any():
            raise BadInputError(
                "numbers of 2^53 or more came as floats, which cannot represent them; "
                "expected integers: no fractions or empty cells among them, no float fields in the column, "
                "no scale, offset or clip"
            )
    elif column.dtype == "int64" and sound.dtype == np.uint64 and (sound >= 2**63).any():
        raise BadInputError("expected whole numbers below 2^63")
    whole = np.asarray(finite.all(axis=1))
    return np.where(whole[:, None], values, 0).astype(column.dtype), finite


class _Rounding:
    """Compares the steps of a column's values (n, size) with those that float32 holds."""

    def __init__(self, column: Column, spec: ColumnMapping) -> None:
        self._column, self._offset = column, spec.offset
        self._low, self._high = np.full(column.size, np.inf), np.full(column.size, -np.inf)
        self._steps: list[Array] = []
        self._errors: list[Array] = []

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
        self._steps.append(np.abs(steps))
        self._errors.append(np.abs(errors))
        if sum(map(len, self._steps)) > _MOST_SAMPLES:
            self._steps = [np.concatenate(self._steps)[::2]]
            self._errors = [np.concatenate(self._errors)[::2]]

    def found(self) -> tuple[str, bool] | None:
        """Return a warning, and whether most steps are lost; None where all are held well enough."""
        steps, errors = np.concatenate(self._steps), np.concatenate(self._errors)
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
            coarse.append(
                f"{name} (up to {largest:.6g}) in steps of {spacing:.2g}, but it moves by {step:.2g}"
            )
        if not coarse:
            return None
        listed = ", ".join(
            f"{number:.1f}" if number == round(number) else f"{number:.15g}" for number in offset
        )
        advice = f"set offset = [{listed}]" if helps else "leave out what is a time"
        if lost:
            advice += ', leave out what is a time, or store counts with dtype = "int64"' if helps else ""
        return f"columns.{self._column.name}: float32 holds {'; '.join(coarse)}: {advice}", lost
