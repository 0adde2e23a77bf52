"""Episodes of a dataset in Rerun (https://rerun.io): paths, commands and rewards over steps and seconds."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError
from astra_data.core.numbers import as_rows
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
from astra_data.dataset.edit import check_uids
from astra_data.dataset.reader import Dataset

_TARGET, _SIMULATOR = (31, 119, 180), (255, 127, 14)
_RADIUS_PIXELS = 3.0


@dataclass(frozen=True)
class ReplayedEpisode:
    """An episode of T steps that was replayed open loop in a simulator.

    Attributes:
        simulator: its name. color: of its path, red, green and blue up to 255.
        state: φ(s_0), and where each step ended, (T + 1, X).
        measures: further values of each step, (T,), by name.
    """

    simulator: str
    color: tuple[int, int, int]
    state: Array
    measures: Mapping[str, Array]


def view(
    dataset: Dataset,
    uids: Sequence[int] = (),
    *,
    save: Path | None = None,
    replays: Mapping[int, Sequence[ReplayedEpisode]] | None = None,
) -> None:
    """Show episodes of `dataset` in Rerun's viewer, or write them to a recording, which is made in memory.

    Of each episode there are, below `episode_<uid>/`: `target`, the path of φ(s) on the plane, or of the
    state in a dataset without abstract states; `simulator`, where the raw simulator lands from each of these
    states, in a paired dataset; and every value of the abstract states, the simulator's next states, the
    commands and the reward. They stand at their `step`, and at their `time` in s; next states at the step
    after. Below `open_loop/<simulator>` are the path, values and measures of each of its `replays`.

    Args:
        dataset: any.
        uids: of the episodes, by default all.
        save: the recording, a file that ends in `.rrd` and is replaced, in place of the viewer.
        replays: of episodes, by their uids.

    Raises:
        BadInputError: Rerun is not installed, its viewer does not open, there is no such episode, or `save`
            is no `.rrd` file.
        CorruptDatasetError: a file cannot be read.
        DiskError: the recording cannot be written.
    """
    rerun = optional("rerun")
    if save is not None and save.suffix != ".rrd":
        raise BadInputError(f"--save {save}: expected a file that ends in .rrd")
    known = {int(uid): index for index, uid in enumerate(dataset.uids)}
    check_uids(dataset, uids)
    chosen = sorted({known[uid] for uid in uids}) if uids else None
    stream = rerun.RecordingStream("astra-data", recording_id=dataset.reference)
    if save is None:
        _open_viewer(stream)
        _send(rerun, stream, dataset, chosen, replays or {})
        stream.flush()
        return
    # Rerun writes its own files in a thread that does not say why a disk refused them.
    recorded = stream.binary_stream()
    _send(rerun, stream, dataset, chosen, replays or {})
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


def _send(
    rerun: Any,  # noqa: ANN401
    stream: Any,  # noqa: ANN401
    dataset: Dataset,
    chosen: list[int] | None,
    replays: Mapping[int, Sequence[ReplayedEpisode]],
) -> None:
    """Send the episodes of indices `chosen`, one at a time."""
    fps = int(dataset.info["fps"])
    stream.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    shown = (ABSTRACT_STATE, ABSTRACT_SIMULATED_NEXT_STATE, ACTION, REWARD)
    schema = {column.name: column for column in dataset.schema}
    names = [name for name in (*shown, STATE, NEXT_STATE, ABSTRACT_NEXT_STATE) if name in schema]
    for episode in dataset.episodes(names or list(schema), chosen):
        root = f"episode_{episode.uid}"
        for path, points, after, color in _paths(schema, episode):
            _send_path(rerun, stream, f"{root}/{path}", points, _times(rerun, len(points), after, fps), color)
        for name in shown:
            if name in episode.columns:
                times = _times(rerun, len(episode), name == ABSTRACT_SIMULATED_NEXT_STATE, fps)
                table = as_rows(episode.columns[name])
                for label, values in zip(_labels(schema[name]), table.T, strict=True):
                    _send_values(rerun, stream, f"{root}/{label}", values, times)
        for replay in replays.get(episode.uid, ()):
            entity = f"{root}/open_loop/{replay.simulator}"
            times = _times(rerun, len(replay.state), False, fps)
            plane = _plane(schema[ABSTRACT_STATE])
            if plane is not None:
                points = _lifted(replay.state[:, plane])
                _send_path(rerun, stream, entity, points, times, replay.color)
            for label, values in zip(_labels(schema[ABSTRACT_STATE]), replay.state.T, strict=True):
                _send_values(rerun, stream, f"{entity}/{label}", values, times)
            for label, values in replay.measures.items():
                _send_values(
                    rerun, stream, f"{entity}/{label}", values, _times(rerun, len(values), False, fps)
                )


def _send_path(
    rerun: Any,  # noqa: ANN401
    stream: Any,  # noqa: ANN401
    entity: str,
    points: Array,
    times: list[Any],
    color: tuple[int, int, int],
) -> None:
    """Send points (n, 3) at `times`, and the line through them."""
    style = {"colors": color, "radii": -_RADIUS_PIXELS}  # negative: in pixels
    stream.log(f"{entity}/path", rerun.LineStrips3D([points], colors=color), static=True)
    stream.log(entity, rerun.Points3D.from_fields(**style), static=True)
    stream.send_columns(entity, times, rerun.Points3D.columns(positions=points))


def _send_values(rerun: Any, stream: Any, entity: str, values: Array, times: list[Any]) -> None:  # noqa: ANN401
    stream.send_columns(entity, times, rerun.Scalars.columns(scalars=values.astype(np.float64)))


def _paths(
    schema: dict[str, Column], episode: Episode
) -> Iterator[tuple[str, Array, bool, tuple[int, int, int]]]:
    """Yield name, points (n, 3), whether they come a step later, and color of each path on the plane."""
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
    return [f"{column.name}/{name}" for name in column.labels]


def _times(rerun: Any, count: int, after: bool, fps: int) -> list[Any]:  # noqa: ANN401
    steps = np.arange(count) + int(after)
    return [rerun.TimeColumn("step", sequence=steps), rerun.TimeColumn("time", duration=steps / fps)]
