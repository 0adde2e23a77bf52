from pathlib import Path

import numpy as np
import pytest
from fake_dataset import COLUMNS, LENGTHS, fake_columns, writer
from fake_transitions import NEXT, write_transitions

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Episode
from astra_data.dataset.reader import Dataset
from astra_data.io.exporters import export
from astra_data.io.exporters.minari import _attributes
from astra_data.io.importing import import_dataset


@pytest.mark.parametrize("has_goal", [True, False])
def test_minari_loads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_goal: bool) -> None:
    import minari  # noqa: PLC0415 - slow

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    dataset = write_transitions(tmp_path / "set", has_goal=has_goal)
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
    told = list(loaded.storage.get_episode_metadata(range(5)))
    assert [metadata["total_steps"] for metadata in told] == list(LENGTHS)
    assert [metadata.get("seed") for metadata in told[:2]] == [None, 3]


def test_a_dataset_without_columns_of_its_own_comes_back(tmp_path: Path) -> None:
    """Minari keeps these as infos."""
    kept = (STATE, NEXT_STATE, ACTION, REWARD, TERMINATED, TRUNCATED)
    whole = write_transitions(tmp_path / "set")
    with writer(tmp_path / "few", columns=whole.specs(kept)) as few:
        for episode in whole.episodes(kept):
            few.add(episode)
    export(Dataset.open(tmp_path / "few"), tmp_path / "few-v0", format="minari")
    import_dataset([tmp_path / "few-v0"], out=tmp_path / "back")
    assert Dataset.open(tmp_path / "back").content_hash == Dataset.open(tmp_path / "few").content_hash


def test_a_seed_of_zero_is_one() -> None:
    assert _attributes(2, Episode(9, {STATE: np.zeros(4, np.float32)}, {"seed": 0})) == {
        "id": 2,
        "total_steps": 4,
        "astra_data/episode_uid": 9,
        "astra_data/seed": 0,
        "seed": 0,
    }


def test_minari_refuses_next_states_that_do_not_follow(tmp_path: Path) -> None:
    with writer(tmp_path / "set", columns=[*COLUMNS, NEXT]) as open_writer:
        columns = fake_columns(4, seed=1)
        following = np.concatenate([columns[STATE][1:], columns[STATE][:1]])
        following[-2] += 1
        open_writer.add(Episode(1, columns | {NEXT_STATE: following}))
    apart = Dataset.open(tmp_path / "set")
    with pytest.raises(BadInputError, match="a next state is not the state of the next step"):
        export(apart, tmp_path / "random-v0", format="minari")
    with pytest.raises(BadInputError, match="not a Minari id"):
        export(apart, tmp_path / "no id!", format="minari")
    with pytest.raises(BadInputError, match="not a Minari id; end --out with a name and a version"):
        export(apart, tmp_path / "without-version", format="minari")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
