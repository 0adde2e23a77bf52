import gc
import json
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from fake_dataset import COLUMNS, LENGTHS, NEXT, fake_columns, write_fake, write_transitions, writer

from astra_data.core.errors import BadInputError
from astra_data.dataset.cameras import Camera
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Column, Episode
from astra_data.dataset.reader import Dataset
from astra_data.io.exporters import EXPORTERS, export, hdf5_file
from astra_data.io.importing import import_dataset

FILES = {"d3rlpy": "set.h5", "d4rl": "set.hdf5", "minari": "set-v0", "robomimic": "set.hdf5"}
FULL = Path("/dev/full")
"""Every write to it fails: no space is left."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_transitions(tmp_path_factory.mktemp("exporters") / "set")


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_the_import_reads_what_the_export_writes(tmp_path: Path, format: str) -> None:
    dataset = write_transitions(tmp_path / "set", has_goal=False)
    export(dataset, tmp_path / FILES[format], format=format)
    import_dataset([tmp_path / FILES[format]], out=tmp_path / "back", name="back", fps=10)
    back = Dataset.open(tmp_path / "back")
    kept = list(dataset.episodes())
    if format == "d3rlpy":  # which has no next states: an episode of one step is none
        kept = [episode for episode in kept if len(episode) > 1]
    assert back.lengths.tolist() == [len(episode) - (format == "d3rlpy") for episode in kept]
    for found, expected in zip(back.episodes(), kept, strict=True):
        for name in (STATE, ACTION, NEXT_STATE):
            np.testing.assert_array_equal(found.columns[name], expected.columns[name][: len(found)])
        if format != "d3rlpy":
            for name in (REWARD, TERMINATED, TRUNCATED):
                np.testing.assert_array_equal(found.columns[name], expected.columns[name], err_msg=name)


VECTORS_OF = {
    "d3rlpy": ("observations_1", "actions_1"),
    "d4rl": ("observations", "actions", "next_observations", "infos/goal"),
    "minari": (*("episode_1/observations/observation", "episode_1/observations/desired_goal"), "episode_1/actions"),
    "robomimic": tuple(
        f"data/demo_1/{field}" for field in ("obs/state", "next_obs/state", "obs/goal", "next_obs/goal", "actions")
    ),
}


def test_cameras_are_named_as_left_out(
    dataset: Dataset, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(EXPORTERS, "d4rl", lambda _, path, __: path.touch())
    filmed = replace(dataset, cameras={"observation.images.top": Camera({}, {})})
    export(filmed, tmp_path / "out.hdf5", format="d4rl")
    assert caplog.messages[-1].endswith(": observation.images.top left out, pictures are not exported")


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_one_value_a_step_is_a_vector_of_one(tmp_path: Path, format: str, caplog: pytest.LogCaptureFixture) -> None:
    """As the other libraries expect states, goals and actions; rewards that are missing are zeros."""
    single = [Column(name) for name in (STATE, NEXT_STATE, GOAL, ACTION)]
    rest = [column for column in COLUMNS if column.name not in (STATE, ACTION, REWARD)]
    values = np.arange(6, dtype=np.float32)
    mine = {STATE: values[:-1], NEXT_STATE: values[1:], GOAL: values[:-1], ACTION: values[:-1]}
    columns = {name: v for name, v in fake_columns(5, seed=1).items() if name != REWARD} | mine
    episodes = (Episode(number, columns | {"goal": np.full(5, 7, np.float32)}) for number in range(2))
    source = write_fake(tmp_path / "set", episodes, columns=[*single, *rest, Column("goal")])
    out = tmp_path / FILES[format]
    export(source, out, format=format)
    assert caplog.messages == ["fake@data-1.0.0 has no next.reward: rewards are written as 0"]
    with h5py.File(out / "data/main_data.hdf5" if format == "minari" else out) as file:
        shapes = {field: file[field].shape for field in VECTORS_OF[format]}
        rewards = {
            "d3rlpy": "rewards_1",
            "d4rl": "rewards",
            "minari": "episode_1/rewards",
            "robomimic": "data/demo_1/rewards",
        }
        found = file[rewards[format]][()]
        assert found.ndim == (2 if format == "d3rlpy" else 1) and not found.any()
        other = {"d3rlpy": "infos/goal_1", "d4rl": "infos/goal_"}  # a column of the name of D4RL's field
        base = "episode_1/" if format == "minari" else "data/demo_1/"
        assert set(file[other.get(format, f"{base}infos/goal")][()]) == {7.0}
    width = 2 if format == "d3rlpy" else 1
    assert {shape[1:] for field, shape in shapes.items() if "actions" not in field} == {(width,)}
    assert {shape[1:] for field, shape in shapes.items() if "actions" in field} == {(1,)}


@pytest.mark.parametrize("format", sorted(EXPORTERS))
def test_nothing_is_overwritten_and_nothing_half_is_left(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str
) -> None:
    out = tmp_path / "random-v0"
    with monkeypatch.context() as patch:
        patch.setattr(Dataset, "episodes", lambda *_: iter([1]))
        with pytest.raises(AttributeError):
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
    for package in ("h5py", "minari"):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(BadInputError, match=f"{package} is needed but not installed: uv sync --extra"):
            export(dataset, tmp_path / "a", format="minari" if package == "minari" else "d4rl")


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


def test_d3rlpy_has_arrays_per_episode(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.h5", format="d3rlpy")
    with h5py.File(tmp_path / "set.h5") as file:
        assert file["version"][()] == b"2.1" and file["num_episodes"][()] == 5
        names = [key.decode() for key in file["columns"][()]]
        assert names == ["observations", "actions", "rewards", "terminated"]
        for number, episode in enumerate(dataset.episodes()):
            values = episode.columns
            observations = np.concatenate([values[STATE], values[GOAL]], axis=1)
            np.testing.assert_array_equal(file[f"observations_{number}"][()], observations)
            np.testing.assert_array_equal(file[f"actions_{number}"][()], values[ACTION])
            np.testing.assert_array_equal(file[f"rewards_{number}"][()], values[REWARD][:, None])
            assert file[f"terminated_{number}"][()] == values[TERMINATED][-1]


def test_robomimic_has_a_group_per_demonstration(dataset: Dataset, tmp_path: Path) -> None:
    export(dataset, tmp_path / "set.hdf5", format="robomimic")
    with h5py.File(tmp_path / "set.hdf5") as file:
        assert file["data"].attrs["total"] == 55
        arguments = {"env_name": "Fake-v0", "type": 2, "env_kwargs": {}}
        assert json.loads(file["data"].attrs["env_args"]) == arguments
        assert sorted(file["data"]) == [f"demo_{number}" for number in range(5)]
        fields = {"actions": ACTION, "rewards": REWARD, "dones": TERMINATED, "truncated": TRUNCATED}
        fields |= {"obs/state": STATE, "obs/goal": GOAL, "next_obs/state": NEXT_STATE}
        for number, episode in enumerate(dataset.episodes()):
            demo = file[f"data/demo_{number}"]
            assert demo.attrs["num_samples"] == len(episode)
            for key, name in fields.items():
                np.testing.assert_array_equal(demo[key][()], episode.columns[name])
        assert [name.decode() for name in file["mask/train"][()]] == [f"demo_{number}" for number in range(5)]
        assert "valid" not in file["mask"]


@pytest.mark.parametrize("held_out", [None, 3, 4])
def test_copies_of_a_recording_are_on_its_side_of_robomimics_masks(tmp_path: Path, held_out: int | None) -> None:
    with writer(tmp_path / "set", columns=[*COLUMNS, NEXT]) as open_writer:
        for uid in range(40):
            columns = fake_columns(2, seed=uid)
            metadata: dict[str, int | bool] = {"source_episode": uid % 10} if uid >= 10 else {}
            if held_out is not None:
                metadata["held_out"] = uid % 10 == held_out and uid < 20
            open_writer.add(Episode(uid, columns | {NEXT_STATE: columns[STATE]}, metadata))
    export(Dataset.open(tmp_path / "set"), tmp_path / "set.hdf5", format="robomimic")
    with h5py.File(tmp_path / "set.hdf5") as file:
        train, valid = (
            [int(name.decode().removeprefix("demo_")) for name in file[f"mask/{key}"][()]] for key in ("train", "valid")
        )
    assert sorted(train + valid) == list(range(40))
    (recording,) = {episode % 10 for episode in valid}
    assert sorted(valid) == [recording + 10 * number for number in range(4)] and held_out in (None, recording)


@pytest.mark.parametrize("has_goal", [True, False])
def test_minari_loads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_goal: bool) -> None:
    import minari  # noqa: PLC0415 - slow

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    dataset = write_transitions(tmp_path / "set", has_goal=has_goal)
    monkeypatch.chdir(tmp_path)
    export(dataset, Path("minari/fake/random-v2"), format="minari")
    loaded = minari.load_dataset("fake/random-v2")
    assert (loaded.total_episodes, loaded.total_steps) == (5, 55) and loaded.spec.dataset_id == "fake/random-v2"
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
    metadata = list(loaded.storage.get_episode_metadata(range(5)))
    assert [one["total_steps"] for one in metadata] == list(LENGTHS)
    assert [one.get("seed") for one in metadata[:2]] == [None, 3]


def test_minari_refuses_next_states_that_do_not_follow(tmp_path: Path) -> None:
    columns = fake_columns(4, seed=1)
    following = np.concatenate([columns[STATE][1:], columns[STATE][:1]])
    following[-2] += 1
    apart = write_fake(tmp_path / "set", [Episode(1, columns | {NEXT_STATE: following})], columns=[*COLUMNS, NEXT])
    with pytest.raises(BadInputError, match="a next state is not the state of the next step"):
        export(apart, tmp_path / "random-v0", format="minari")
    for name in ("no id!", "without-version"):
        with pytest.raises(BadInputError, match="not a Minari id; end --out with a name and a version"):
            export(apart, tmp_path / name, format="minari")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_the_failure_of_a_disk_is_raised() -> None:
    with pytest.raises(OSError, match="No space left"), hdf5_file(FULL) as file:
        file["a"] = np.zeros(100_000)
        loop: list[object] = [file]
        loop.append(loop)
    del file, loop
    gc.collect()  # which does not crash
