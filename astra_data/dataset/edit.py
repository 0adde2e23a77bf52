"""New versions of a dataset with other episodes or steps: subset, filter, merge, trim, resample; never in place."""

import logging
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import eq, ge, gt, le, lt, ne
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.arrays import Bools, Floats, as_rows
from astra_data.core.config import did_you_mean, only_given
from astra_data.core.errors import BadInputError
from astra_data.core.naming import first_few
from astra_data.dataset import columns as names
from astra_data.dataset.checkup import SHOWN, full_turns, is_clock, quaternions
from astra_data.dataset.columns import Array, Column, Episode, Scalar, distinct_uids, new_uid, renamed_metadata
from astra_data.dataset.inspection import outcome_of
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Change, next_version, schema_differences

_log = logging.getLogger(__name__)

MOST_UIDS = 8  # uids listed in a message
_IMPORTED = (
    "one of another origin gets the meanings of the others, and no robot_type, by an import of its files: "
    "`astra-data import FOLDER/data/*/*.parquet --mapping FILE`, with the others' mapping"
)
_COMPARED = {"<=": le, ">=": ge, "==": eq, "!=": ne, "<": lt, ">": gt}
_NUMBER = r"true|false|[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"
_CONDITION = re.compile(rf"\s*(.+?)\s*(<=|>=|==|!=|<|>)\s*({_NUMBER})\s*", re.IGNORECASE | re.ASCII)
_FINEST = 100  # times the recorded rate
type _Turns = dict[int, float]  # full turns of the angles in a column, by their index


def subset(
    source: Dataset,
    *,
    episodes: int | None = None,
    percent: int | None = None,
    of: int | None = None,
    seed: int | None = None,
    always: Collection[int] = (),
    name: str | None = None,
    out: Path | None = None,
) -> Path:
    """Write a random subset; subsets with the same seed are nested, also subsets of subsets.

    Copies of a recording, as `augment` makes them, go together: a tenth of the episodes is a tenth of the recordings.

    Args:
        source: the dataset.
        episodes: number of episodes; or
        percent: their share in per cent, which may exceed 100, of
        of: a number of episodes, by default all.
        seed: of the permutation whose first episodes are taken, by default that of `source`.
        always: uids of episodes that every subset has; numbers and shares are of the others.
        name: of the new dataset; by default it is the next version of `source`.
        out: its folder, by default under `versions.home()`.

    Raises:
        BadInputError: not exactly one of `episodes` and `percent`, or more episodes than there are.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import Dataset, subset
        >>> half = subset(Dataset.open("walks"), percent=50, out=Path("half"))
        >>> len(Dataset.open(half))
        6
    """
    if (episodes is None) == (percent is None) or (of is not None and percent is None):
        raise BadInputError("a subset needs either a number of episodes or a percentage (optionally with --of)")
    available = len(source) - len(always)
    whole = available if of is None else of
    count = episodes if percent is None else share(percent, whole)
    assert count is not None
    if not 1 <= count <= available:
        wanted = f"{count} episodes" if percent is None else f"{percent} % of {whole} = {count}"
        fault = f"{source.reference} has {available} episodes, but the subset has {wanted}: expected 1 to {available}"
        advice = "Episodes are never repeated: collect or augment more, or give a smaller --of."
        raise BadInputError(f"{fault}. {advice}")
    chosen = source.subset_seed if seed is None else seed
    config: dict[str, Any] = {"episodes": count, "percent": percent, "of": of, "seed": chosen}
    order = source.uids[source.subset(len(source), chosen)].tolist()
    taken = [uid for uid in order if uid not in always][:count]
    described: dict[str, Any] = {"stage": "subset", "config": config, "name": name, "out": out}
    return _write(source, "episodes", _of_uids(source, {*always, *taken}), subset_seed=chosen, **described)


def share(percent: int, episodes: int) -> int:
    """Return `percent` per cent of `episodes`, rounded half up."""
    return (percent * episodes + 50) // 100


def check_uids(dataset: Dataset, uids: Collection[int]) -> None:
    """Raise a BadInputError unless `dataset` has the episodes `uids`."""
    known = sorted(dataset.uids.tolist())
    if unknown := sorted(set(uids) - set(known)):
        its = f"its {len(dataset)} uids lie between {known[0]} and {known[-1]}: {first_few(known, MOST_UIDS)}"
        raise BadInputError(f"{dataset.reference} has no episode {first_few(unknown, MOST_UIDS)}; {its}")


def filter_episodes(
    source: Dataset,
    *,
    without: Collection[int] = (),
    success: bool | None = None,
    min_return: float | None = None,
    max_return: float | None = None,
    min_length: int | None = None,
    max_length: int | None = None,
    name: str | None = None,
    out: Path | None = None,
) -> Path:
    """Write the episodes of `source`, without some uids, that meet all conditions.

    Bounds are inclusive, and what is unknown meets none.
    """
    check_uids(source, without)
    given = {"success": success, "min_return": min_return, "max_return": max_return}
    config = only_given(**given, min_length=min_length, max_length=max_length)
    config |= {"without": sorted(set(without))} if without else {}
    if np.isnan([bound for bound in (min_return, max_return) if bound is not None]).any():
        raise BadInputError("a filter's bounds on the return: expected numbers, got nan")
    if not config:
        raise BadInputError("a filter needs a condition: on success, return or length, or uids to leave out")
    uids = source.uids.tolist()
    kept = set(uids) - set(without)
    bounds = {"success": (success, success), "return": (min_return, max_return), "length": (min_length, max_length)}
    for key, (low, high) in bounds.items():
        if (low, high) != (None, None):
            least, most = -np.inf if low is None else low, np.inf if high is None else high
            facts = zip(uids, _facts(source, key), strict=True)
            kept &= {uid for uid, fact in facts if isinstance(fact, int | float) and least <= fact <= most}
    return _write(source, "episodes", _of_uids(source, kept), stage="filter", config=config, name=name, out=out)


def merge(
    sources: Sequence[Dataset], *, new_uids: bool = False, name: str | None = None, out: Path | None = None
) -> Path:
    """Write the episodes of all `sources` one after another; name, version and seeds are those of the first.

    They have equal columns, fps, environment and simulator. Where tasks differ, the dataset has them all, and
    each episode its own as "task" in its metadata. With `new_uids`, an episode whose uid an earlier one has
    gets a new one, the same in every run; the old one is kept as "merged_uid", and "source_episode" follows.

    Raises:
        BadInputError: the datasets do not fit together; lists every difference.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import Dataset, merge
        >>> walks = Dataset.open("walks")
        >>> twice = merge([walks, walks], new_uids=True, out=Path("twice"))
        >>> len(Dataset.open(twice))
        24
    """
    if len(sources) < 2:
        raise BadInputError("expected two datasets or more to merge")
    first, *others = sources
    also = ("environment", "simulator")
    faults = [f"{other.reference}: {fault}" for other in others for fault in schema_differences(first, other, also)]
    if faults:
        expected = f"the columns, fps, environment and simulator of {first.reference} in all of them"
        faults += [_IMPORTED] if any(source.recorded for source in sources) else []
        raise BadInputError("\n  ".join([f"the datasets do not match: expected {expected}:", *faults]))
    # Episodes have tasks of their own where there are several.
    of_episodes = [(source.task, task) for source in sources for task in source.metadata.get("task", [None])]
    tasks = list(dict.fromkeys(usual if task is None else str(task) for usual, task in of_episodes))
    renamed = (
        replace(one, uid=uids[one.uid], metadata=task | renamed_metadata(one.uid, one.metadata, uids))
        for source, uids in zip(sources, _merged_uids(sources, new_uids), strict=True)
        for task in [{"task": source.task} if len(tasks) > 1 else {}]
        for one in source.episodes()
    )
    config = {"datasets": [source.reference for source in sources], "new_uids": new_uids}
    described: dict[str, Any] = {"stage": "merge", "config": config, "name": name, "out": out}
    parents = [other.identity for other in others]
    return _write(first, "episodes", renamed, parents=parents, task=" / ".join(tasks), **described)


def trim(
    source: Dataset,
    *,
    start_s: float = 0.0,
    end_s: float = 0.0,
    still: bool = False,
    without: str | None = None,
    name: str | None = None,
    out: Path | None = None,
) -> Path:
    """Write `source` with shorter episodes; an episode of which nothing is left is left out.

    Where steps go from the middle of an episode, it becomes several: the first keeps its uid, the others have
    new ones, and it as "source_episode". An episode that lost its end is marked as truncated there.

    `start_s` and `end_s` are removed from the ends of each episode, with `still` the steps there in which the state
    does not change, and the steps that meet the condition `without`, such as "v < 0.05"; `name`, `out`: see `subset`.
    """
    config = {"start_s": start_s, "end_s": end_s, "still": still, "without": without}
    if not (any(config.values()) and 0 <= start_s < np.inf and 0 <= end_s < np.inf):
        got = f"--start {start_s:g} and --end {end_s:g}" if start_s or end_s else "none"
        wanted = "expected a time of 0 s or more at the start or the end, --still or --without a condition"
        raise BadInputError(f"trim: {wanted}, got {got}")
    condition = _condition(source, without) if without else None
    source.specs([names.STATE] if still else [])
    first, last = (round(seconds * source.info["fps"]) for seconds in (start_s, end_s))
    if not (first or last or still or without):
        raise BadInputError(f"trim: expected a step or more, {1 / source.info['fps']:g} s, got less")

    def kept(episode: Episode) -> Bools:
        left = np.zeros(len(episode), bool)
        left[first : max(0, len(episode) - last)] = True
        if still:
            state = as_rows(episode.columns[names.STATE])
            moves = (state[1:] != state[:-1]).any(axis=1)
            moves = np.append(moves, moves[-1:].any())  # an unknown last step goes on as the one before
            if names.NEXT_STATE in episode.columns:
                moves = (state != as_rows(episode.columns[names.NEXT_STATE])).any(axis=1)
            moving = np.flatnonzero(left & moves)
            left[: moving[0] if moving.size else None] = left[moving[-1] + 1 if moving.size else 0 :] = False
        return left & ~condition(episode) if condition else left

    known = set(source.uids.tolist())
    pieces = (piece for episode in source.episodes() for piece in _pieces(episode, kept(episode), source, known))
    return _write(source, "episodes", pieces, stage="trim", config=config, name=name, out=out)


def resample(source: Dataset, fps: int, *, name: str | None = None, out: Path | None = None) -> Path:
    """Write `source` at another rate: commands are held, states interpolated, rewards summed, times true.

    Angles within a turn, by unit, role or name, are interpolated the shorter way, quaternions as such. Columns of a
    pairing are left out, since steps of another length land elsewhere: pair it again. What is left of an episode
    after its last whole step adds its reward and ending to that step; one shorter than a step is left out.
    """
    most = _FINEST * source.info["fps"]
    if not 1 <= fps <= most or fps == source.info["fps"]:
        rates = f"another rate than {source.info['fps']} per second, from 1 to {most}"
        raise BadInputError(f"resample: expected {rates}, got {fps}")
    if source.cameras and source.info["fps"] % fps:
        wanted = f"expected a rate that divides {source.info['fps']}, got {fps}"
        raise BadInputError(f"resample: {source.reference} has cameras, whose pictures are not interpolated: {wanted}")
    schema = [column for column in source.schema if not column.name.startswith("abstract.")]
    turns = {column.name: (column, _turns(column, source)) for column in schema}
    if {names.STATE, names.NEXT_STATE} <= turns.keys():  # next states are states, whatever is known of their own angles
        state, angles = turns[names.STATE]
        turns[names.NEXT_STATE] = replace(state, name=names.NEXT_STATE), angles
    each = (_resampled(episode, [*turns.values()], source.info["fps"], fps) for episode in source.episodes())
    config = {"fps": fps, "from_fps": source.info["fps"]}
    described: dict[str, Any] = {"stage": "resample", "config": config, "name": name, "out": out}
    made = _write(source, "columns", filter(None, each), schema=schema, fps=fps, **described)
    if paired := [column.name for column in source.schema if column not in schema]:
        _log.warning("left out, since steps of another length land elsewhere: %s; pair it again", ", ".join(paired))
    return made


def _condition(source: Dataset, text: str) -> Callable[[Episode], Bools]:
    """Return a function that says in which steps of an episode "NAME < NUMBER" holds."""
    if not (parts := _CONDITION.fullmatch(text)):
        raise BadInputError(f"expected a condition such as 'v < 0.05' or 'next.success == true', got {text!r}")
    value, compared, number = parts.groups()
    limit = float({"true": 1, "false": 0}.get(number.lower(), number))
    known = {
        label: (column, index)
        for column in reversed(source.schema)  # of names that several have, the first
        for index, value in enumerate(column.labels)
        for label in ([column.name] if column.size == 1 else [value, f"{column.name}.{value}"])
    }
    if value not in known:
        raise BadInputError(f"{source.reference} has no value {value!r}{did_you_mean(value, known)}")
    column, index = known[value]
    if column.dtype == "bool" and limit not in (0.0, 1.0):
        raise BadInputError(f"{value} is true or false: expected one of them, got {number}")
    compare = _COMPARED[compared]
    return lambda episode: compare(as_rows(episode.columns[column.name])[:, index].astype(np.float64), limit)


def _pieces(episode: Episode, kept: Bools, source: Dataset, known: set[int]) -> Iterator[Episode]:
    """Yield the runs of steps that are kept."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], kept, [False]]).astype(np.int8)))
    for number, (first, end) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        if (first, end) == (0, len(episode)):
            yield episode
            return
        columns = {name: values[first:end].copy() for name, values in episode.columns.items()}
        cameras = {name: clip.part(first, end) for name, clip in episode.cameras.items()}
        if end < len(episode):
            for name in {names.TRUNCATED, names.DONE} & columns.keys():
                columns[name][-1] = True
        uid, metadata = episode.uid, _with_outcome(episode.metadata, columns)
        if number:
            uid = new_uid(uid, f"{source.content_hash} {first} ".encode(), known | {uid})
            known.add(uid)
            metadata.setdefault("source_episode", episode.uid)
        yield replace(episode, uid=uid, columns=columns, metadata=metadata, cameras=cameras)


def _with_outcome(metadata: Mapping[str, Any], columns: Mapping[str, Array]) -> dict[str, Any]:
    """Return the metadata, with what they say of the outcome as the steps that are left have it."""
    return {**metadata, **{key: value for key, value in outcome_of(columns).items() if key in metadata}}


def _resampled(episode: Episode, turns: Sequence[tuple[Column, _Turns]], before: int, fps: int) -> Episode | None:
    has_next = names.NEXT_STATE in episode.columns
    duration_s = (len(episode) - (not has_next)) / before
    steps = int(duration_s * fps + 1e-6) + (not has_next)
    if steps < 1:
        return None
    times_s = np.arange(steps + 1) / fps
    row = np.minimum((times_s * before + 1e-6).astype(int), len(episode))
    columns: dict[str, Array] = {}
    for column, angles in turns:
        values, is_next = episode.columns[column.name], column.name.startswith("next.")
        is_observed = column.name.removeprefix("next.").startswith("observation.") and column.name != names.GOAL
        if column.name == names.REWARD:
            sums = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
            found = np.diff(sums[[*row[:-1], len(episode)]])
        elif column.name in (names.TERMINATED, names.TRUNCATED, names.DONE, names.SUCCESS):
            counts = np.concatenate([[0], np.cumsum(values)])
            found = np.diff(counts[[*row[:-1], len(episode)]]) > 0
        elif is_clock(column) or (column.dtype == "float32" and is_observed):
            of = episode.columns[names.STATE] if column.name == names.NEXT_STATE else values
            if has_next and column.name in (names.STATE, names.NEXT_STATE):
                of = np.concatenate([of, episode.columns[names.NEXT_STATE][-1:]])
            elif is_clock(column):
                of = np.concatenate([of, 2 * of[-1:] - of[-2:-1]]) if len(of) > 1 else of
            at = times_s[is_next : steps + is_next] * before - (is_next and column.name != names.NEXT_STATE)
            begin = of[0] if column.dtype == "int64" else 0  # from there on, float64 holds times of 2^53 and more
            found = _interpolated(as_rows(of - begin).astype(np.float64), at, column, angles)
            found = found.reshape(steps, *values.shape[1:])
            found = np.rint(found).astype(np.int64) + begin if column.dtype == "int64" else found
        else:
            found = values[np.minimum(np.maximum(row[:-1], row[1:] - 1) if is_next else row[:-1], len(episode) - 1)]
        columns[column.name] = found.astype(values.dtype)
    cameras = {name: clip.part(0, steps * (before // fps), before // fps) for name, clip in episode.cameras.items()}
    return replace(episode, columns=columns, metadata=_with_outcome(episode.metadata, columns), cameras=cameras)


def _turns(column: Column, source: Dataset) -> _Turns:
    """Return the full turns of the angles in a column by index; those that range over more are counted, and go on."""
    if not full_turns(column, np.zeros(column.size)).any():  # of a recording, statistics take a reading of all values
        return {}
    least, most = (np.ravel(source.statistics()[column.name][key]) for key in ("min", "max"))
    turns = full_turns(column, np.maximum(-least, most)).tolist()
    return {index: turn for index, turn in enumerate(turns) if 0 < most[index] - least[index] <= 1.001 * turn}


def _interpolated(values: Floats, at: Floats, column: Column, turns: _Turns) -> Floats:
    """Return rows of `values` (N, D) `at` places between 0 and N - 1, (M, D); `turns` are those of wrapped angles."""
    recorded = values
    values = values.copy()
    for index, turn in turns.items():
        values[:, index] = np.unwrap(values[:, index], period=turn)
    low = np.minimum(at.astype(int), len(values) - 1)
    high = np.minimum(low + 1, len(values) - 1)
    share = np.clip(at - low, 0.0, 1.0)[:, None]
    share[share < 1e-6] = 0.0
    first, second = values[low], values[high]
    found = (1 - share) * first + share * second
    for part in quaternions(column):  # q and -q are one rotation
        ends = first[:, part], second[:, part]
        sign = np.where((ends[0] * ends[1]).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        turned = (1 - share) * ends[0] + sign * share * ends[1]
        lengths = [np.linalg.norm(one, axis=1, keepdims=True) for one in (*ends, turned)]
        found[:, part] = turned * ((1 - share) * lengths[0] + share * lengths[1]) / np.maximum(lengths[2], 1e-9)
    found = np.where(share == 0.0, first, found)
    for index, turn in turns.items():
        if (values[:, index] != recorded[:, index]).any():  # wrapped angles stay so
            least = 0.0 if recorded[:, index].min() >= 0.0 else -turn / 2
            found[:, index] = (found[:, index] - least) % turn + least
    return np.asarray(found)


def _write(source: Dataset, change: Change, episodes: Iterable[Episode], **described: Any) -> Path:
    """Write `episodes`, made of those of `source`, as its next version, `described` as `next_version` takes it."""
    gone = dict.fromkeys(source.uids.tolist())
    with next_version(source, change, **described) as writer:
        for episode in episodes:
            writer.add(episode)
            gone.pop(episode.uid, None)
        if len(gone) == len(source):
            raise BadInputError(f"{source.reference}: none of its {len(source)} episodes would be left")
    if gone and described["stage"] in ("trim", "resample"):  # which do not choose among episodes
        _log.warning("nothing remains of %d of %d episodes: %s", len(gone), len(source), first_few([*gone], SHOWN))
    return writer.root


def _of_uids(source: Dataset, kept: Collection[int]) -> Iterable[Episode]:
    chosen = [index for index, uid in enumerate(source.uids.tolist()) if uid in kept]
    return source.episodes(episodes=chosen) if chosen else ()


def _facts(source: Dataset, key: str) -> Sequence[Scalar | None]:
    if key == "length":
        return [int(length) for length in source.lengths]
    found = source.successes() if key == "success" else source.metadata.get(key)
    if key == "return" and names.REWARD in source.features and (found is None or None in found):
        return [outcome_of(episode.columns)[key] for episode in source.episodes([names.REWARD])]
    if found is not None:
        return found
    raise BadInputError(f"the episodes of {source.reference} have no {key!r}: run `astra-data label --task`")


def _merged_uids(sources: Sequence[Dataset], new_uids: bool) -> list[dict[int, int]]:
    """Return, for each of `sources`, its episodes' new uids by their old ones."""
    found = [(uid, f"{source.content_hash} ".encode()) for source in sources for uid in source.uids.tolist()]
    given = iter(distinct_uids(found))
    renamed = [{uid: next(given) for uid in source.uids.tolist()} for source in sources]
    repeated = sorted(uid for named in renamed for uid, name in named.items() if uid != name)
    if repeated and not new_uids:
        which = f"{len(repeated)} episodes have the uid of an earlier one ({first_few(repeated, MOST_UIDS)})"
        raise BadInputError(f"{which}: leave them out, or give them new ones with --new-uids")
    return renamed
