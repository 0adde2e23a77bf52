"""New versions of a dataset with other episodes: subset, filter and merge; nothing is edited in place."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.config import only_given
from astra_data.core.errors import BadInputError
from astra_data.core.naming import first_few
from astra_data.dataset.columns import REWARD, Scalar, distinct_uids, renamed_metadata
from astra_data.dataset.compare import schema_differences
from astra_data.dataset.inspection import outcome_of
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import next_version

MOST_UIDS = 8  # uids listed in a message
_IMPORTED = (
    "one of another origin gets the meanings of the others, and no robot_type, by an import of its files: "
    "`astra-data import FOLDER/data/*/*.parquet --mapping FILE`, with the others' mapping"
)


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
        raise BadInputError(
            f"{source.reference} has {available} episodes, but the subset has {wanted}: expected 1 "
            f"to {available}. Episodes are never repeated: collect or augment more, or give a smaller --of."
        )
    chosen = source.subset_seed if seed is None else seed
    config: dict[str, Any] = {"episodes": count, "percent": percent, "of": of, "seed": chosen}
    order = source.uids[source.subset(len(source), chosen)].tolist()
    taken = [uid for uid in order if uid not in always][:count]
    return _write(source, {*always, *taken}, stage="subset", config=config, name=name, out=out, seed=chosen)


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
    return _write(source, kept, stage="filter", config=config, name=name, out=out)


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
    faults = [
        f"{other.reference}: {fault}"
        for other in others
        for fault in schema_differences(first, other, ("environment", "simulator"))
    ]
    if faults:
        expected = f"the columns, fps, environment and simulator of {first.reference} in all of them"
        faults += [_IMPORTED] if any(source.recorded for source in sources) else []
        raise BadInputError("\n  ".join([f"the datasets do not match: expected {expected}:", *faults]))
    # Episodes have tasks of their own where there are several.
    of_episodes = [(source.task, task) for source in sources for task in source.metadata.get("task", [None])]
    tasks = list(dict.fromkeys(usual if task is None else str(task) for usual, task in of_episodes))
    names = _merged_uids(sources, new_uids)
    config = {"datasets": [source.reference for source in sources], "new_uids": new_uids}
    described: dict[str, Any] = {"stage": "merge", "config": config, "name": name, "out": out}
    parents = [other.identity for other in others]
    with next_version(first, "episodes", parents=parents, task=" / ".join(tasks), **described) as writer:
        for source, named in zip(sources, names, strict=True):
            for episode in source.episodes():
                metadata = renamed_metadata(episode.uid, episode.metadata, named)
                if len(tasks) > 1:
                    metadata = {"task": source.task, **metadata}
                writer.add(replace(episode, uid=named[episode.uid], metadata=metadata))
    return writer.root


def _write(source: Dataset, kept: set[int], *, seed: int | None = None, **described: Any) -> Path:
    if not kept:
        raise BadInputError(f"{source.reference}: none of its {len(source)} episodes would be left")
    with next_version(source, "episodes", subset_seed=seed, **described) as writer:
        chosen = [index for index, uid in enumerate(source.uids.tolist()) if uid in kept]
        for episode in source.episodes(episodes=chosen):
            writer.add(episode)
    return writer.root


def _facts(source: Dataset, key: str) -> Sequence[Scalar | None]:
    if key == "length":
        return [int(length) for length in source.lengths]
    if key == "success" and (successes := source.successes()) is not None:
        return successes
    if key in source.metadata:
        return source.metadata[key]
    if key == "return" and REWARD in source.features:
        return [outcome_of(episode.columns)[key] for episode in source.episodes([REWARD])]
    raise BadInputError(f"the episodes of {source.reference} have no {key!r}: run `astra-data label --task`")


def _merged_uids(sources: Sequence[Dataset], new_uids: bool) -> list[dict[int, int]]:
    """Return, for each of `sources`, its episodes' new uids by their old ones."""
    found = [(uid, f"{source.content_hash} ".encode()) for source in sources for uid in source.uids.tolist()]
    given = iter(distinct_uids(found))
    names = [{uid: next(given) for uid in source.uids.tolist()} for source in sources]
    repeated = sorted(uid for named in names for uid, name in named.items() if uid != name)
    if repeated and not new_uids:
        which = f"{len(repeated)} episodes have the uid of an earlier one ({first_few(repeated, MOST_UIDS)})"
        raise BadInputError(f"{which}: leave them out, or give them new ones with --new-uids")
    return names
