"""Episodes of a dataset in Rerun (https://rerun.io): paths, commands and rewards over steps and seconds."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional
from astra_data.dataset.columns import (
    ABSTRACT_NEXT_STATE,
    ABSTRACT_SIMULATED_NEXT_STATE,
    ABSTRACT_STATE,
    ACTION,
    NEXT_STATE,
    REWARD,
    STATE,
    Array,
    Column,
    Episode,
)
from astra_data.dataset.reader import Dataset

_TARGET, _SIMULATOR = (31, 119, 180), (255, 127, 14)
_RADIUS_PIXELS = 3.0


def view(dataset: Dataset, uids: Sequence[int] = (), *, save: Path | None = None) -> None:
    """Show episodes of `dataset` in Rerun's viewer, or write them to a recording, which is made in memory.

    Of each episode there are, below `episode_<uid>/`: `target`, the path of φ(s) on the plane, or of the
    state in a dataset without abstract states; `simulator`, where the raw simulator lands from each of these
    states, in a paired dataset; and every value of the abstract states, the simulator's next states, the
    commands and the reward. They stand at their `step`, and at their `time` in s; next states at the step
    after.

    Args:
        dataset: any.
        uids: of the episodes, by default all.
        save: the recording, an `.rrd` file, in place of the viewer.

    Raises:
        BadInputError: Rerun is not installed, its viewer does not open, or there is no such episode.
        CorruptDatasetError: a file cannot be read.
        DiskError: the recording cannot be written.
    """
    rerun = optional("rerun", "view")
    known = {int(uid): index for index, uid in enumerate(dataset.uids)}
    unknown = [str(uid) for uid in uids if uid not in known]
    if unknown:
        raise BadInputError(
            f"{dataset.reference} has no episode {', '.join(unknown)}; its {len(known)} uids lie between "
            f"{min(known)} and {max(known)}"
        )
    chosen = sorted({known[uid] for uid in uids}) if uids else None
    stream = rerun.RecordingStream("astra-data", recording_id=dataset.reference)
    if save is None:
        _open_viewer(stream)
        _send(rerun, stream, dataset, chosen)
        stream.flush()
        return
    # Rerun writes its own files in a thread that does not say why a disk refused them.
    recorded = stream.binary_stream()
    _send(rerun, stream, dataset, chosen)
    write_file(save, recorded.read())


def _open_viewer(stream: Any) -> None:  # noqa: ANN401
    try:
        stream.spawn()
    except RuntimeError as error:
        reason = str(error).partition("\n")[0]
        raise BadInputError(
            f"the viewer does not open ({reason}): activate the environment where rerun-sdk is installed, or "
            "write a recording with --save FILE.rrd"
        ) from error


def _send(rerun: Any, stream: Any, dataset: Dataset, chosen: list[int] | None) -> None:  # noqa: ANN401
    """Send the episodes of indices `chosen`, one at a time."""
    fps = int(dataset.info["fps"])
    stream.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    shown = (ABSTRACT_STATE, ABSTRACT_SIMULATED_NEXT_STATE, ACTION, REWARD)
    schema = {column.name: column for column in dataset.schema}
    names = [name for name in (*shown, STATE, NEXT_STATE, ABSTRACT_NEXT_STATE) if name in schema]
    for episode in dataset.episodes(names or list(schema), chosen):
        root = f"episode_{episode.uid}"
        for path, points, after, color in _paths(schema, episode):
            entity = f"{root}/{path}"
            style = {"colors": color, "radii": -_RADIUS_PIXELS}  # negative: in pixels
            stream.log(f"{entity}/path", rerun.LineStrips3D([points], colors=color), static=True)
            stream.log(entity, rerun.Points3D.from_fields(**style), static=True)
            times = _times(rerun, len(points), after, fps)
            stream.send_columns(entity, times, rerun.Points3D.columns(positions=points))
        for name in shown:
            if name in episode.columns:
                times = _times(rerun, len(episode), name == ABSTRACT_SIMULATED_NEXT_STATE, fps)
                table = episode.columns[name].reshape(len(episode), -1)
                for label, values in zip(_labels(schema[name]), table.T, strict=True):
                    scalars = rerun.Scalars.columns(scalars=values.astype(np.float64))
                    stream.send_columns(f"{root}/{label}", times, scalars)


def _paths(
    schema: dict[str, Column], episode: Episode
) -> Iterator[tuple[str, Array, bool, tuple[int, int, int]]]:
    """Yield name, points (n, 3), whether they come a step later, and colour of each path on the plane."""
    for state, following in ((ABSTRACT_STATE, ABSTRACT_NEXT_STATE), (STATE, NEXT_STATE)):
        plane = _plane(schema[state]) if state in schema else None
        if plane is None:
            continue
        points = episode.columns[state][:, plane]
        if following in schema:
            points = np.concatenate([points, episode.columns[following][-1:, plane]])
        yield "target", _lifted(points), False, _TARGET
        if state == ABSTRACT_STATE and ABSTRACT_SIMULATED_NEXT_STATE in schema:
            landed = episode.columns[ABSTRACT_SIMULATED_NEXT_STATE][:, plane]
            yield "simulator", _lifted(landed), True, _SIMULATOR
        return


def _plane(column: Column) -> slice | None:
    """Return the two values of `column` that are a place: by role, else by the names x and y; or None."""
    for role, group in column.roles:
        if role == "position":
            return group
    names = list(column.names or ())
    at = names.index("x") if "x" in names else len(names)
    return slice(at, at + 2) if names[at + 1 : at + 2] == ["y"] else None


def _lifted(points: Array) -> Array:
    """Put points (n, 2) on the floor of space, (n, 3)."""
    return np.column_stack([points, np.zeros(len(points), points.dtype)])


def _labels(column: Column) -> list[str]:
    if column.size == 1 and not column.names:
        return [column.name]
    return [f"{column.name}/{name}" for name in column.names or range(column.size)]


def _times(rerun: Any, count: int, after: bool, fps: int) -> list[Any]:  # noqa: ANN401
    steps = np.arange(count) + int(after)
    return [rerun.TimeColumn("step", sequence=steps), rerun.TimeColumn("time", duration=steps / fps)]
