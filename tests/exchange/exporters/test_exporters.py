"""What we export, read by the other library, or compared with its layout where it cannot be installed."""

import json
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from fake_dataset import COLUMNS, fake_columns, fake_episodes, write_fake, writer
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import (
    ACTION,
    GOAL,
    NEXT_STATE,
    REWARD,
    STATE,
    TERMINATED,
    TRUNCATED,
    Array,
    Column,
    Episode,
)
from astra_data.exchange.exporters import EXPORTERS, export
from astra_data.exchange.importing import import_dataset

EXTRA = (Column(NEXT_STATE, size=3), Column(GOAL, size=2))


def write(root: Path, *, has_goal: bool = True) -> Dataset:
    """Five episodes in which every next state is the state of the next step."""
    extra = EXTRA if has_goal else EXTRA[:1]
    with writer(root, columns=[*COLUMNS, *extra]) as open_writer:
        for number, episode in enumerate(fake_episodes()):
            state = episode.columns[STATE]
            added: dict[str, Array] = {NEXT_STATE: np.concatenate([state[1:], state[:1] + 1])}
            if has_goal:
                added[GOAL] = np.full((len(episode), 2), number, np.float32)
            metadata = dict(episode.metadata) | ({"seed": 3} if number == 1 else {})
            open_writer.add(Episode(episode.uid, {**episode.columns, **added}, metadata))
    return Dataset.open(root)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write(tmp_path_factory.mktemp("exporters") / "set")


@pytest.mark.parametrize("has_goal", [True, False])
def test_minari_loads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_goal: bool) -> None:
    import minari  # noqa: PLC0415 - slow

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    dataset = write(tmp_path / "set", has_goal=has_goal)
    monkeypatch.chdir(tmp_path)
    export(dataset, Path("minari/fake/random-v2"), format="minari")
    loaded = minari.load_dataset("fake/random-v2")
    assert (loaded.total_episodes, loaded.total_steps) == (5, 55)
    assert loaded.spec.dataset_id == "fake/random-v2"
    for found, expected in zip(loaded.iterate_episodes(), dataset.episodes(), strict=True):
        values = expected.columns
        states = found.observations["observation"] if has_goal else found.observations
        np.testing.assert_array_equal(states[:-1], values[STATE])
        np.testing.assert_array_equal(states[1:], values[NEXT_STATE])
        if has_goal:
            np.testing.assert_array_equal(found.observations["desired_goal"][1:], values[GOAL])
            assert loaded.observation_space["desired_goal"].shape == (2,)
        np.testing.assert_array_equal(found.actions, values[ACTION])
        np.testing.assert_array_equal(found.rewards, values[REWARD])
        np.testing.assert_array_equal(found.terminations, values[TERMINATED])
        np.testing.assert_array_equal(found.truncations, values[TRUNCATED])
    assert [metadata.get("seed") for metadata in loaded.storage.get_episode_metadata(range(2))] == [None, 3]


def test_minari_refuses_next_states_that_do_not_follow(tmp_path: Path) -> None:
    with writer(tmp_path / "set", columns=[*COLUMNS, EXTRA[0]]) as open_writer:
        columns = fake_columns(4, seed=1)
        open_writer.add(Episode(1, columns | {NEXT_STATE: columns[STATE] + 1}))
    apart = Dataset.open(tmp_path / "set")
    with pytest.raises(BadInputError, match="a next state is not the state of the next step"):
        export(apart, tmp_path / "random-v0", format="minari")
    with pytest.raises(BadInputError, match="no id of Minari"):
        export(apart, tmp_path / "no id!", format="minari")
    with pytest.raises(BadInputError, match="no id of Minari; end --out with a name and a version"):
        export(apart, tmp_path / "without-version", format="minari")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_d4rl_is_flat(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.hdf5", format="d4rl")
    names = {
        "observations": STATE,
        "actions": ACTION,
        "rewards": REWARD,
        "next_observations": NEXT_STATE,
        "terminals": TERMINATED,
        "infos/goal": GOAL,
    }
    expected = dataset.columns(list(names.values()))
    with h5py.File(tmp_path / "set.hdf5") as file:
        for key, name in names.items():
            np.testing.assert_array_equal(file[key][()], expected[name])
            assert file[key].dtype == expected[name].dtype
        ends = np.flatnonzero(file["terminals"][()] | file["timeouts"][()])
        assert not (file["terminals"][()] & file["timeouts"][()]).any()
    np.testing.assert_array_equal(ends, np.cumsum(dataset.lengths) - 1)


def test_robomimic_has_a_group_per_demonstration(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.hdf5", format="robomimic")
    with h5py.File(tmp_path / "set.hdf5") as file:
        assert file["data"].attrs["total"] == 55
        assert json.loads(file["data"].attrs["env_args"]) == {
            "env_name": "Fake-v0",
            "type": 2,
            "env_kwargs": {},
        }
        assert sorted(file["data"]) == [f"demo_{number}" for number in range(5)]
        for number, episode in enumerate(dataset.episodes()):
            demo, values = file[f"data/demo_{number}"], episode.columns
            assert demo.attrs["num_samples"] == len(episode)
            for key, name in (
                ("actions", ACTION),
                ("rewards", REWARD),
                ("obs/state", STATE),
                ("obs/goal", GOAL),
                ("next_obs/state", NEXT_STATE),
            ):
                np.testing.assert_array_equal(demo[key][()], values[name])
            np.testing.assert_array_equal(demo["dones"][()], values[TERMINATED])
            np.testing.assert_array_equal(demo["truncated"][()], values[TRUNCATED])
        assert [name.decode() for name in file["mask/train"][()]] == [f"demo_{number}" for number in range(5)]
        assert "valid" not in file["mask"]


@pytest.mark.parametrize("format", ["d4rl", "robomimic"])
def test_the_way_there_and_back_keeps_how_episodes_end(dataset: Dataset, tmp_path: Path, format: str) -> None:
    export(dataset, tmp_path / "set.hdf5", format=format)
    report = import_dataset([tmp_path / "set.hdf5"], out=tmp_path / "back", name="back", fps=10)
    names = [ACTION, REWARD, TERMINATED, TRUNCATED]
    back, expected = Dataset.open(report.root), dataset.columns(names)
    assert back.lengths.tolist() == dataset.lengths.tolist()
    assert expected[TERMINATED].any()
    assert expected[TRUNCATED].any()
    for name, values in back.columns(names).items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)


def test_robomimics_masks_share_the_episodes(tmp_path: Path) -> None:
    with writer(tmp_path / "set", columns=[*COLUMNS, EXTRA[0]]) as open_writer:
        for uid in range(20):
            columns = fake_columns(2, seed=uid)
            open_writer.add(Episode(uid, columns | {NEXT_STATE: columns[STATE]}))
    export(Dataset.open(tmp_path / "set"), tmp_path / "set.hdf5", format="robomimic")
    with h5py.File(tmp_path / "set.hdf5") as file:
        train, valid = set(file["mask/train"][()]), set(file["mask/valid"][()])
        assert (len(train), len(valid)) == (18, 2)
        assert train | valid == {name.encode() for name in file["data"]}


def test_d3rlpy_has_arrays_per_episode(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.h5", format="d3rlpy")
    with h5py.File(tmp_path / "set.h5") as file:
        assert file["version"][()] == b"2.1"
        assert file["num_episodes"][()] == 5
        assert [key.decode() for key in file["columns"][()]] == [
            "observations",
            "actions",
            "rewards",
            "terminated",
        ]
        for number, episode in enumerate(dataset.episodes()):
            values = episode.columns
            observations = np.concatenate([values[STATE], values[GOAL]], axis=1)
            np.testing.assert_array_equal(file[f"observations_{number}"][()], observations)
            np.testing.assert_array_equal(file[f"actions_{number}"][()], values[ACTION])
            np.testing.assert_array_equal(file[f"rewards_{number}"][()], values[REWARD][:, None])
            assert file[f"terminated_{number}"][()] == values[TERMINATED][-1]


def test_d3rlpy_is_told_how_the_last_step_ends(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = next(dataset.episodes()).columns
    inner = Episode(1, {**columns, TERMINATED: np.arange(len(columns[TERMINATED])) == 1})
    monkeypatch.setattr(Dataset, "episodes", lambda *_: iter([inner]))
    export(dataset, tmp_path / "set.h5", format="d3rlpy")
    with h5py.File(tmp_path / "set.h5") as file:
        assert not file["terminated_0"][()]


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_nothing_is_overwritten_and_nothing_half_is_left(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str
) -> None:
    out = tmp_path / "random-v0"
    with monkeypatch.context() as patch:
        patch.setattr(Dataset, "episodes", lambda *_: iter([1]))
        with pytest.raises((AttributeError, TypeError)):
            export(dataset, out, format=format)
    assert list(tmp_path.iterdir()) == []
    out.write_text("mine")
    with pytest.raises(BadInputError, match="exists already"):
        export(dataset, out, format=format)
    assert out.read_text() == "mine"


def test_what_is_missing_is_told(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadInputError, match=r"format 'd4lr': unknown: did you mean 'd4rl'\?"):
        export(dataset, tmp_path / "a", format="d4lr")
    with pytest.raises(BadInputError, match=r"it lacks next\.observation\.state"):
        export(write_fake(tmp_path / "bare"), tmp_path / "a", format="d4rl")
    monkeypatch.setitem(sys.modules, "h5py", None)
    told = (
        r'h5py is needed and not installed: uv sync --extra hdf5 in .*, else pip install "astra-data\[hdf5\]"'
    )
    with pytest.raises(BadInputError, match=told):
        export(dataset, tmp_path / "a", format="d4rl")
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(BadInputError, match=r'pip install "astra-data\[minari\]"'):
        export(dataset, tmp_path / "a", format="minari")


def test_the_command_exports(dataset: Dataset, tmp_path: Path) -> None:
    arguments = ["export", str(dataset.root), "--format", "d4rl", "--out", str(tmp_path / "set.hdf5")]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.output == f"finished: {tmp_path / 'set.hdf5'}\n"
