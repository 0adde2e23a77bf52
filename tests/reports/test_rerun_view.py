import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings_of_rerun import points, read, scalars
from toy_logs import COLUMNS, FPS, toy_columns, write_logs
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError, DiskError
from astra_data.dataset import Dataset, DatasetWriter
from astra_data.dataset.columns import (
    ABSTRACT_NEXT_STATE,
    ABSTRACT_SIMULATED_NEXT_STATE,
    ABSTRACT_STATE,
    ACTION,
    NEXT_STATE,
    REWARD,
    STATE,
    Column,
    Episode,
)
from astra_data.reports.rerun_view import view

STEPS = 40


def paired(root: Path) -> Dataset:
    """Two episodes whose abstract state [yaw, x, y] has no roles; the simulator lands 0.25 too far."""
    names = (ABSTRACT_STATE, ABSTRACT_NEXT_STATE, ABSTRACT_SIMULATED_NEXT_STATE)
    abstract = [Column(name, size=3, names=("yaw", "x", "y")) for name in names]
    description = {"name": "paired", "stage": "pair"}
    with DatasetWriter(root, [*COLUMNS, *abstract], fps=FPS, task="x", description=description) as writer:
        for uid in (4, 7):
            columns = toy_columns(uid, STEPS)
            del columns["time"]
            turned = [columns[name][:, [2, 0, 1]] for name in (STATE, NEXT_STATE)]
            columns |= dict(zip(names, [*turned, turned[1] + np.float32(0.25)], strict=True))
            writer.add(Episode(uid, columns))
    return Dataset.open(root)


def test_a_recording_holds_paths_commands_and_rewards_of_the_chosen_episode(tmp_path: Path) -> None:
    dataset = paired(tmp_path / "paired")
    view(dataset, [7], save=tmp_path / "paired.rrd")
    found = read(tmp_path / "paired.rrd")
    assert not [entity for entity in found if "episode_4" in entity]
    episode = {
        entity.removeprefix("/episode_7/"): table for entity, table in found.items() if "episode_7" in entity
    }
    (source,) = dataset.episodes(episodes=[1])
    values, steps = source.columns, np.arange(STEPS)

    place = np.concatenate([values[STATE], values[NEXT_STATE][-1:]])[:, :2]
    np.testing.assert_array_equal(points(episode["target"])[:, :2], place)
    assert not points(episode["target"])[:, 2].any()
    assert episode["target"]["step"].to_pylist() == [*steps, STEPS]

    landed = points(episode["simulator"])
    np.testing.assert_array_equal(landed[:, :2], values[NEXT_STATE][:, :2] + np.float32(0.25))
    assert episode["simulator"]["step"].to_pylist() == [*steps + 1]
    (line,) = episode["simulator/path"]["LineStrips3D:strips"].to_pylist()[0]
    np.testing.assert_array_equal(line, landed)

    np.testing.assert_array_equal(scalars(episode[f"{ACTION}/w"]), values[ACTION][:, 1])
    np.testing.assert_array_equal(scalars(episode[REWARD]), values[REWARD])
    np.testing.assert_array_equal(scalars(episode[f"{ABSTRACT_STATE}/yaw"]), values[STATE][:, 2])
    simulated = episode[f"{ABSTRACT_SIMULATED_NEXT_STATE}/x"]
    np.testing.assert_array_equal(scalars(simulated), values[NEXT_STATE][:, 0] + np.float32(0.25))
    assert simulated["step"].to_pylist() == [*steps + 1]
    seconds = episode[REWARD]["time"].cast("int64").to_numpy() / 1e9
    np.testing.assert_allclose(seconds, steps / FPS)


def test_without_abstract_states_the_position_is_the_path(tmp_path: Path) -> None:
    dataset = write_logs(tmp_path / "logs")
    result = CliRunner().invoke(
        cli.app, ["view", str(dataset.root), "--save", str(tmp_path / "new/logs.rrd"), "--episode", "3"]
    )
    assert result.output == f"written: {tmp_path / 'new/logs.rrd'}\n"
    found = read(tmp_path / "new/logs.rrd")
    np.testing.assert_array_equal(points(found["/episode_3/target"])[:-1, :2], toy_columns(3)[STATE][:, :2])
    assert "/episode_3/simulator" not in found
    assert f"/episode_3/{ACTION}/v" in found


def test_a_place_is_known_by_its_role_too(tmp_path: Path) -> None:
    roles = {"role": ["heading", "position", "position"]}
    columns = [Column(STATE, size=3, names=("yaw", "east", "north"), astra=roles)]
    description = {"name": "field", "stage": "x"}
    values = np.arange(12, dtype=np.float32).reshape(4, 3)
    with DatasetWriter(tmp_path / "field", columns, fps=5, task="x", description=description) as writer:
        writer.add(Episode(0, {STATE: values}))
    view(Dataset.open(tmp_path / "field"), save=tmp_path / "field.rrd")
    (line,) = read(tmp_path / "field.rrd")["/episode_0/target/path"]["LineStrips3D:strips"].to_pylist()[0]
    assert line == [[1, 2, 0], [4, 5, 0], [7, 8, 0], [10, 11, 0]]


def test_without_places_there_are_values_alone(tmp_path: Path) -> None:
    columns = [Column(STATE, size=2, names=("x", "height")), Column(ACTION)]
    description = {"name": "rail", "stage": "x"}
    with DatasetWriter(tmp_path / "rail", columns, fps=5, task="x", description=description) as writer:
        for uid in range(2):
            values = np.full((6, 2), uid, np.float32)
            writer.add(Episode(uid, {STATE: values, ACTION: values[:, 0]}))
    view(Dataset.open(tmp_path / "rail"), save=tmp_path / "rail.rrd")
    found = read(tmp_path / "rail.rrd")
    assert {entity for entity in found if "episode" in entity} == {"/episode_0/action", "/episode_1/action"}
    assert scalars(found["/episode_1/action"]).tolist() == [1.0] * 6


def test_the_viewer_is_opened_without_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import rerun  # noqa: PLC0415 - only to stand in for its viewer

    opened: list[Path] = []

    def spawn(stream: Any) -> None:  # noqa: ANN401
        opened.append(tmp_path / "shown.rrd")
        stream.save(opened[0])

    monkeypatch.setattr(rerun.RecordingStream, "spawn", spawn)
    view(paired(tmp_path / "paired"))
    assert len(opened) == 1
    assert {"/episode_4/target", "/episode_7/target"} <= set(read(opened[0]))


def test_a_recording_replaces_no_other_kind_of_file(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(BadInputError, match=r"notes\.txt: expected a file that ends in \.rrd"):
        view(paired(tmp_path / "paired"), save=tmp_path / "notes.txt")
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_without_a_viewer_one_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import rerun  # noqa: PLC0415 - only to stand in for its viewer

    def spawn(stream: Any) -> None:  # noqa: ANN401
        raise RuntimeError("No viewer in PATH.\n\n  Install it.")

    monkeypatch.setattr(rerun.RecordingStream, "spawn", spawn)
    with pytest.raises(BadInputError, match=r"does not open \(No viewer in PATH\.\): .* --save FILE\.rrd$"):
        view(paired(tmp_path / "paired"))


def test_a_disk_that_is_full_is_told(tmp_path: Path) -> None:
    dataset = paired(tmp_path / "paired")
    (tmp_path / "old.rrd").write_text("old")
    most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, most[1]))
    try:
        with pytest.raises(DiskError, match=r"old\.rrd cannot be written"):
            view(dataset, save=tmp_path / "old.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, most)
    assert (tmp_path / "old.rrd").read_text() == "old"


def test_what_is_missing_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = paired(tmp_path / "paired")
    with pytest.raises(BadInputError, match=r"has no episode 5, 6; its 2 uids lie between 4 and 7"):
        view(dataset, [4, 5, 6], save=tmp_path / "x.rrd")
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(BadInputError, match=r'rerun is needed .* pip install "astra-data\[view\]"'):
        view(dataset, save=tmp_path / "x.rrd")
    assert not (tmp_path / "x.rrd").exists()
