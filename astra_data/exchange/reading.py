"""Recordings, read block by block and cut into episodes; every file that cannot be read is told at once."""

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType

import numpy as np

from astra_data.core.errors import AstraDataError, BadInputError, in_short
from astra_data.core.wording import first_few
from astra_data.exchange.cutting import Cut, Cutter
from astra_data.exchange.mapping import ImportMapping
from astra_data.exchange.recording import VALUE_BYTES, Block, Source
from astra_data.exchange.tally import Tally

_NAMED = 50
"""Files with one and the same fault that are named."""


def episodes(
    sources: Sequence[Source], module: ModuleType, mapping: ImportMapping, cutter: Cutter
) -> Iterator[Cut]:
    """Yield the episodes of `sources`, as the format's `module` reads them.

    Raises:
        BadInputError: a file cannot be read, or an episode does not fit into memory. The files after it that
            cannot either, as far as their beginnings tell, are listed with it.
    """
    recording = None
    size = 0
    try:
        for number, source in enumerate(sources):
            is_apart = mapping.split.files or source.recording != recording
            origin, row = "", 0
            for block in _unstacked(_blocks_or_faults(sources[number:], module, mapping), mapping):
                size += VALUE_BYTES * sum(values.size for values in block.values.values())
                source.refuse_beyond(size)
                recording = source.recording
                row = row if block.origin == origin else 0
                yield from cutter.feed(block, row, is_apart=is_apart)
                is_apart, origin, row = False, block.origin, row + len(block)
        yield from cutter.finish()
    except MemoryError as error:
        raise BadInputError(
            f"an episode does not fit into memory ({in_short(error)}): cut it by [split] in the mapping"
        ) from error


def importable(
    sources: Sequence[Source], module: ModuleType, mapping: ImportMapping
) -> tuple[list[Source], tuple[str, ...]]:
    """Return the sources that can be imported together, and what is wrong with the others.

    Each is read to its end. Columns must be of the same sizes as in the first that can be imported.

    Raises:
        BadInputError: there are no such sources.
    """
    good, faults = [], {}
    sizes: dict[str, int] = {}
    for source in sources:
        cutter = Cutter(mapping)
        try:
            deque(episodes([source], module, mapping, cutter), maxlen=0)
            refuse_rejected(cutter.tally, mapping)
            found = {column.name: column.size for column in cutter.columns}
            for name in found:
                if found[name] != sizes.get(name, found[name]):
                    raise BadInputError(
                        f"{source}: {name} has {found[name]} values, in the files before {sizes[name]}"
                    )
            sizes = sizes or found
            good.append(source)
        except BadInputError as error:
            faults[source] = str(error)
    if not good:
        raise BadInputError("\n".join(_by_fault(faults)))
    return good, tuple(faults.values())


@contextmanager
def explained(source: Source, module: ModuleType) -> Iterator[None]:
    """Turn any exception of the library that reads a file into one clear message."""
    try:
        yield
    except AstraDataError:
        raise
    except Exception as error:
        file_format = module.__name__.rpartition(".")[2]
        message = in_short(error) or type(error).__name__
        raise BadInputError(f"{source} cannot be read as {file_format}: {message}") from error


def refuse_rejected(tally: Tally, mapping: ImportMapping) -> None:
    """Raise BadInputError where rows have values that are not finite, which `mapping` refuses."""
    not_finite = tally.rejected_rows - tally.torn_rows
    if not_finite and mapping.not_finite == "refuse":
        raise BadInputError(
            f"{not_finite} of {tally.rows} rows have values that are not finite; the first is "
            f'{tally.rejected_first}; set not_finite in the mapping to leave them out: "split" ends '
            'the episode there, "drop" goes on with the next row as if one step had passed'
        )


def _unstacked(blocks: Iterator[Block], mapping: ImportMapping) -> Iterator[Block]:
    """Yield `blocks`; where fields are (episodes, steps, ...), a block for each episode.

    Raises:
        BadInputError: fields may be so, and the mapping does not say whether they are.
    """
    row, origin = 0, ""
    for block in blocks:
        row, origin = (row if block.origin == origin else 0), block.origin
        shapes = [values.shape[1:] for values in map(np.asarray, block.values.values())]
        steps = shapes[0][0] if shapes[0] else 1
        may_be = steps > 1 and {shape[:1] for shape in shapes} == {(steps,)} and max(map(len, shapes)) > 1
        if not mapping.stacked:
            if may_be and mapping.stacked is None and (len(shapes) > 1 or len(block) < steps):
                raise BadInputError(
                    f"{origin}: all fields have {steps} rows in each of their rows, such as "
                    f"{next(iter(block.values))} of shape {(len(block), *shapes[0])}: set stacked = true in "
                    f"the mapping if these are the steps of {len(block)} episodes, else stacked = false"
                )
            yield block
            continue
        if not may_be:
            raise BadInputError(
                f"{origin}: stacked = true, but the fields' rows have the shapes "
                f"{', '.join(map(str, shapes))}; expected (steps, ...) with as many steps in each"
            )
        for episode in range(len(block)):
            values = {field: np.asarray(stack)[episode] for field, stack in block.values.items()}
            yield Block(values, f"{origin}/{row + episode}", starts=True, known=block.known)
        row += len(block)


def _blocks_or_faults(
    sources: Sequence[Source], module: ModuleType, mapping: ImportMapping
) -> Iterator[Block]:
    """Yield the blocks of the first of `sources`; if it cannot be read, tell which others cannot, too."""
    try:
        yield from _blocks(sources[0], module, mapping)
    except BadInputError as error:
        faults = {sources[0]: str(error)}
        for source in sources[1:]:
            try:
                _check(source, module, mapping)
            except BadInputError as other:
                faults[source] = str(other)
        raise BadInputError("\n".join(_by_fault(faults))) from error


def _blocks(source: Source, module: ModuleType, mapping: ImportMapping) -> Iterator[Block]:
    with explained(source, module):
        yield from module.read(source, mapping)


def _check(source: Source, module: ModuleType, mapping: ImportMapping) -> None:
    """Raise BadInputError where the beginning of `source` tells that it cannot be read."""
    if not hasattr(module, "check"):
        next(_blocks(source, module, mapping), None)
        return
    with explained(source, module):
        module.check(source, mapping)


def _by_fault(faults: dict[Source, str]) -> list[str]:
    """Return a line for each fault, with the names of the files that have it."""
    names: dict[str, list[str]] = {}
    for source, fault in faults.items():
        begins = str(source) if fault.startswith(str(source)) else ""
        names.setdefault(fault.removeprefix(begins), []).append(begins)
    return [f"{first_few([name for name in of if name], _NAMED)}{fault}" for fault, of in names.items()]
