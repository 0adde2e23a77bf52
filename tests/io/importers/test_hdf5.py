import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from recordings import LOG, MAPPING, imported, rows

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Array
from astra_data.io.hdf5_file import check_storage, refuse_links, stored_datasets, unpacked_bytes


def d4rl(path: Path, *, next_observations: bool) -> dict[str, Array]:
    """Write two episodes of 7 and 5 steps, the first ends by a terminal, the second by a timeout."""
    rng = np.random.default_rng(1)
    fields: dict[str, Array] = {
        "observations": rng.normal(size=(12, 4)).astype(np.float32),
        "actions": rng.uniform(-1, 1, size=(12, 2)).astype(np.float32),
        "rewards": rng.normal(size=12).astype(np.float32),
        "terminals": np.arange(12) == 6,
        "timeouts": np.arange(12) == 11,
        "infos/goal": rng.normal(size=(12, 2)).astype(np.float32),
    }
    if next_observations:
        fields["next_observations"] = rng.normal(size=(12, 4)).astype(np.float32)
    with h5py.File(path, "w") as file:
        for name, values in fields.items():
            file.create_dataset(name, data=values, compression="gzip")
        file["metadata/policy"] = "random"
    return fields


def test_d4rl_needs_no_mapping(tmp_path: Path) -> None:
    fields = d4rl(tmp_path / "ant.hdf5", next_observations=True)
    dataset, report = imported(tmp_path, tmp_path / "ant.hdf5", None, name="ant", fps=20)
    assert dataset.lengths.tolist() == [7, 5]
    got = dataset.columns([STATE, ACTION, REWARD, TERMINATED, TRUNCATED, NEXT_STATE, GOAL])
    for name, field in zip(got, [*list(fields)[:5], "next_observations", "infos/goal"], strict=True):
        np.testing.assert_array_equal(got[name], fields[field], err_msg=name)
    assert report.tally.split_points == {"end": 1} and dataset.info["fps"] == 20


def test_without_next_observations_episodes_lose_their_last_row(tmp_path: Path) -> None:
    fields = d4rl(tmp_path / "ant.hdf5", next_observations=False)
    dataset, report = imported(tmp_path, tmp_path / "ant.hdf5", None, name="ant", fps=20)
    assert dataset.lengths.tolist() == [6, 4] and (report.tally.last_rows, report.tally.last_terminated) == (2, 1)
    assert report.tally.last_reward == pytest.approx(fields["rewards"][11])
    state, got = fields["observations"], dataset.columns([NEXT_STATE, TERMINATED, TRUNCATED, REWARD])
    np.testing.assert_array_equal(got[NEXT_STATE], [*state[1:7], *state[8:]])
    np.testing.assert_array_equal(got[TERMINATED], np.arange(10) == 5)
    np.testing.assert_array_equal(got[TRUNCATED], np.arange(10) == 9)
    fields["rewards"][5] += fields["rewards"][6]
    np.testing.assert_array_equal(got[REWARD], np.delete(fields["rewards"], [6, 11]))
    assert dataset.metadata["return"] == pytest.approx([fields["rewards"][:6].sum(), fields["rewards"][7:11].sum()])
    assert "taken without a mapping: observation.state from observations; action from act" in str(report)


def test_robomimic_needs_no_mapping(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    demos = {}
    with h5py.File(tmp_path / "lift.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 20}})
        for name, length in (("demo_0", 4), ("demo_10", 6), ("demo_2", 5)):
            demos[name] = {
                "obs/eef_pos": rng.normal(size=(length, 3)),
                "obs/gripper": rng.normal(size=length),
                "obs/image": np.zeros((length, 2, 2, 3), np.uint8),
                "next_obs/eef_pos": rng.normal(size=(length, 3)),
                "next_obs/gripper": rng.normal(size=length),
                "actions": rng.normal(size=(length, 7)),
                "rewards": np.arange(length, dtype=float),
                "dones": (np.arange(length) == length - 1).astype(np.int64),
            }
            for field, values in demos[name].items():
                data[f"{name}/{field}"] = values[:, None] if field.endswith("gripper") else values
        file["mask/train"] = [b"demo_0"]
    dataset, report = imported(tmp_path, tmp_path / "lift.hdf5", None, name="lift", task="lift the cube")
    assert dataset.lengths.tolist() == [4, 5, 6] and dataset.info["fps"] == 20
    for spec in dataset.specs([STATE, NEXT_STATE]):
        assert spec.names == ("eef_pos_0", "eef_pos_1", "eef_pos_2", "gripper")
    assert report.tally.split_points == {"source": 2} and dataset.metadata["source_row"] == [0, 0, 0]
    for episode, demo in zip(dataset.episodes(), ("demo_0", "demo_2", "demo_10"), strict=True):
        fields = demos[demo]
        state = np.column_stack([fields["obs/eef_pos"], fields["obs/gripper"]]).astype(np.float32)
        next_state = np.column_stack([fields["next_obs/eef_pos"], fields["next_obs/gripper"]])
        np.testing.assert_array_equal(episode.columns[STATE], state)
        np.testing.assert_array_equal(episode.columns[NEXT_STATE], next_state.astype(np.float32))
        np.testing.assert_array_equal(episode.columns[ACTION], fields["actions"].astype(np.float32))
        np.testing.assert_array_equal(episode.columns[TERMINATED], fields["dones"] == 1)
        assert episode.metadata["source"] == f"lift.hdf5/data/{demo}"


def test_d3rlpy_needs_no_mapping(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    episodes: list[dict[str, Array]] = []
    # As its `ReplayBuffer.dump` writes them; two digits, to see the order.
    with h5py.File(tmp_path / "hopper.h5", "w") as file:
        for number, length in enumerate([4, 3, *[2] * 9]):
            episode = {
                "observations": rng.normal(size=(length, 3)).astype(np.float32),
                "actions": rng.normal(size=(length, 2)).astype(np.float32),
                "rewards": rng.normal(size=(length, 1)).astype(np.float32),
            }
            for key, values in episode.items():
                file.create_dataset(f"{key}_{number}", data=values)
            file.create_dataset(f"terminated_{number}", data=number == 1)
            episodes.append(episode)
        file.create_dataset("columns", data=[*episodes[0], "terminated"])
        file.create_dataset("num_episodes", data=len(episodes))
        file.create_dataset("version", data="2.1")
    dataset, report = imported(tmp_path, tmp_path / "hopper.h5", None, name="hopper", fps=20)
    assert dataset.lengths.tolist() == [3, 2, *[1] * 9] and report.tally.split_points == {"source": 10}
    for number, (found, episode) in enumerate(zip(dataset.episodes(), episodes, strict=True)):
        state, steps = episode["observations"], len(found)
        np.testing.assert_array_equal(found.columns[STATE], state[:steps])
        np.testing.assert_array_equal(found.columns[NEXT_STATE][: len(state) - 1], state[1:])
        np.testing.assert_array_equal(found.columns[ACTION], episode["actions"][:steps])
        rewards = episode["rewards"][:steps, 0].copy()
        rewards[-1] += episode["rewards"][-1, 0] * (number == 1)  # that of the terminated row
        np.testing.assert_array_equal(found.columns[REWARD], rewards)
        is_last = np.arange(steps) == steps - 1
        np.testing.assert_array_equal(found.columns[TERMINATED], is_last & (number == 1))


def test_transposed_files_are_those_of_matlab(tmp_path: Path) -> None:
    joints = np.random.default_rng(3).normal(size=(5, 40))
    with h5py.File(tmp_path / "walking.mat", "w") as file:
        file["estimator/joints"] = joints
        file["names"] = h5py.Empty("f8")
    mapping = f"""{LOG}transposed = true
[columns."observation.state"]
fields = ["estimator/joints"]
take = [4, 0]
"""
    dataset, _ = imported(tmp_path, tmp_path / "walking.mat", mapping)
    np.testing.assert_array_equal(dataset.columns([STATE])[STATE], joints[[4, 0], :-1].T.astype(np.float32))


def test_a_file_of_groups_asks_for_their_pattern(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for trial in range(12):
            for name, values in rows(trial).items():
                file[f"flights/trial_{trial}/{name}"] = values
        file["notes/x"] = file["flights/made"] = np.zeros(3)
    told = r"the fields are in 12 groups, such as flights/trial_0: give .* episodes = \"flights/trial_\*\""
    with pytest.raises(BadInputError, match=told):
        imported(tmp_path, path)
    dataset, _ = imported(tmp_path, path, 'episodes = "flights/*"\n' + MAPPING)
    assert len(dataset) >= 12
    with h5py.File(path, "a") as file:
        file["x"] = np.zeros(3)  # some of the fields
    with pytest.raises(BadInputError, match="no field"):
        imported(tmp_path / "again", path)


def test_dones_that_stay_set_end_an_episode_once(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "lift.hdf5", "w") as file:
        for demo in ("demo_0", "demo_1"):
            for field in ("obs/x", "next_obs/x", "actions"):
                file[f"data/{demo}/{field}"] = np.zeros((5, 2))
            file[f"data/{demo}/dones"] = np.array([0, 0, 1, 1, 1])
    dataset, report = imported(tmp_path, tmp_path / "lift.hdf5", None, name="lift", fps=20)
    assert dataset.lengths.tolist() == [3, 3] and report.tally.short_rows == 4


@pytest.mark.parametrize("link", [h5py.ExternalLink("secret.h5", "/"), h5py.SoftLink("/kept")])
@pytest.mark.parametrize("place", ["runs/two", "runs"])
def test_groups_that_are_links_are_refused(tmp_path: Path, link: object, place: str) -> None:
    with h5py.File(tmp_path / "secret.h5", "w") as secret:
        for name, values in rows().items():
            secret[name] = secret[f"one/{name}"] = values
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in rows().items():
            file[f"kept/{name}"] = file[f"kept/one/{name}"] = values
            if place == "runs/two":
                file[f"runs/one/{name}"] = values
        file[place] = link
    with pytest.raises(BadInputError, match=f"log.h5/{place} is a link; replace it by a copy of its target"):
        imported(tmp_path, tmp_path / "log.h5", 'episodes = "runs/*"\n' + MAPPING)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["link", "virtual", "external"])
def test_values_in_other_files_are_not_read(tmp_path: Path, kind: str) -> None:
    fields = rows()
    with h5py.File(tmp_path / "secret.h5", "w") as secret:
        secret["x"] = fields["x"]
    (tmp_path / "raw").write_bytes(fields["x"].tobytes())
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in fields.items():
            if name != "x":
                file[name] = values
        if kind == "link":
            file["x"] = h5py.ExternalLink("secret.h5", "/x")
        elif kind == "virtual":
            virtual = h5py.VirtualLayout(shape=(20,), dtype=float)
            virtual[:] = h5py.VirtualSource(tmp_path / "secret.h5", "x", shape=(20,))
            file.create_virtual_dataset("x", virtual)
        else:
            file.create_dataset("x", (20,), float, external=[(str(tmp_path / "raw"), 0, 160)])
    with pytest.raises(BadInputError, match=r"no field 'x'|lies in another file"):
        imported(tmp_path, tmp_path / "log.h5")


def test_a_file_that_unpacks_to_far_more_than_its_size_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.io.recording.SMALL_BYTES", 10**5)
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for field in rows():
            file.create_dataset(field, data=np.zeros(10**5), compression="gzip")
    with pytest.raises(BadInputError, match=r"log.h5 holds values of 5600000 bytes or more.*--max-bytes"):
        imported(tmp_path, path)


def write_demos(path: Path, successes: list[bool | None], **fields: tuple[int, ...]) -> Path:
    """Write a demonstration for each success, None for none that is recorded, with fields of these shapes."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for number, success in enumerate(successes):
            for name, shape in fields.items():
                file[f"data/demo_{number}/{name.replace('__', '/')}"] = rng.normal(size=(9, *shape))
            if success is not None:
                file[f"data/demo_{number}"].attrs["success"] = success
    return path


def test_commands_among_observations_are_left_out_and_the_success_of_a_demonstration_is_read(tmp_path: Path) -> None:
    """As in what Isaac Lab's recorder writes."""
    shapes: dict[str, tuple[int, ...]] = {"actions": (2,), "obs__joint_pos": (3,), "obs__contraction": ()}
    shapes |= {"obs__actions": (2,), "obs__last_action": (2,), "obs__camera": (4, 4, 3), "states": (5,)}
    path = write_demos(tmp_path / "isaac.hdf5", [True, False, True], **shapes)
    dataset, report = imported(tmp_path, path, None, name="isaac", fps=20)
    [state] = dataset.specs([STATE])
    assert state.names == ("contraction", "joint_pos_0", "joint_pos_1", "joint_pos_2")
    assert dataset.successes() == [True, False, True]
    assert [episode.columns["next.success"].sum() for episode in dataset.episodes()] == [1, 0, 1]
    told = str(report)
    assert "observation.state from obs/contraction, obs/joint_pos; next.success from @success; without obs/" in told
    assert "\nfields left out: obs/actions, obs/camera, obs/last_action, states\n" in told


def test_a_success_that_only_some_demonstrations_have_is_left_out_and_told(tmp_path: Path) -> None:
    path = write_demos(tmp_path / "isaac.hdf5", [True, None], actions=(2,), obs__x=(3,))
    dataset, report = imported(tmp_path, path, None, name="isaac", fps=20)
    assert dataset.successes() is None and "without the attribute success, which 1 of 2 have\n" in str(report)


def test_demonstrations_without_observations_are_refused(tmp_path: Path) -> None:
    """As robosuite writes them, before observations are rendered."""
    path = write_demos(tmp_path / "raw.hdf5", [None, None], actions=(2,), states=(3,))
    told = r"data/demo_0 has no obs .*\(its fields: actions, states\): run robomimic's dataset_states_to_obs"
    with pytest.raises(BadInputError, match=told):
        imported(tmp_path, path, None, name="raw", fps=20)
    assert not (tmp_path / "out").exists()


def test_only_what_the_file_holds_is_taken(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["group/x"] = np.zeros((4, 2))
        file.create_dataset("claimed", (10**9,), "f8", chunks=(1000,))
        datasets = stored_datasets(file)
        assert sorted(datasets) == ["claimed", "group/x"] and unpacked_bytes({"x": datasets["group/x"]}) == 64
        check_storage({"x": datasets["group/x"]}, "a.hdf5")
        with pytest.raises(BadInputError, match=r"a.hdf5: field 'claimed' claims the shape"):
            check_storage(datasets, "a.hdf5")
        refuse_links(file, "a.hdf5")
        file["link"] = h5py.SoftLink("/group/x")
        with pytest.raises(BadInputError, match=r"a.hdf5: link: expected no links"):
            refuse_links(file, "a.hdf5")


def test_what_was_never_written_is_not_read_as_zeros(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.create_dataset("never", (100, 2), "f4")
        file.create_dataset("partly", (100, 2), "f4", chunks=(30, 1))[:60] = 1
        file.create_dataset("whole", (100, 2), "f4", chunks=(30, 1), compression="gzip")[:] = 0
        file.create_dataset("empty", (0, 2), "f4")
        for name in ("never", "partly"):
            with pytest.raises(BadInputError, match=f"field '{name}' was not written as a whole"):
                check_storage({name: file[name]}, "a.hdf5")
        check_storage({name: file[name] for name in ("whole", "empty")}, "a.hdf5")
