import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from toy_walks import actions, log, states, write_archive

from astra_data.core.errors import BadInputError
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import import_dataset
from astra_data.studies.joints import JointsConfig
from astra_data.studies.recordings import place_name, read_recordings
from astra_data.studies.walking import WalkingConfig

MAPPING = Path(__file__).parents[2] / "recipes/imports/nao_guda.toml"
CONFIG = WalkingConfig()


def test_archives_and_loose_logs_are_recordings(tmp_path: Path) -> None:
    folder, home = tmp_path / "logs", tmp_path / "home"
    folder.mkdir()
    write_archive(folder / "b.tar.gz", 400, seed=1)
    write_archive(folder / "a.tar.gz", 300, seed=0)
    (folder / "LICENSE").write_text("text")
    found = read_recordings(folder, MAPPING, home, CONFIG)
    assert [(recording.name, recording.rows) for recording in found] == [("a", 299), ("b", 399)]
    (path,) = (path for path in home.iterdir() if path.name.startswith("a-"))
    assert read_recordings(path, MAPPING, home, CONFIG)[0].content_hash == found[0].content_hash
    (tmp_path / "loose").mkdir()
    (tmp_path / "loose/run_2.log").write_text(json.dumps(log(200, 3)))
    (tmp_path / "loose/run_10.log").write_text(json.dumps(log(100, 3)))
    (one,) = read_recordings(tmp_path / "loose", MAPPING, home, CONFIG)
    assert one.name == "loose"
    np.testing.assert_allclose(one.pieces[0].state[:200], states(actions(200, 3))[:-1], atol=1e-5)


def test_a_dataset_at_home_is_a_recording_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "datasets"))
    archive = write_archive(tmp_path / "a.tar.gz", 200, seed=0)
    root = import_dataset([archive], MAPPING).root
    name = root.parent.name
    expected = Dataset.open(root).content_hash
    for called in (name, f"{name}@{root.name}"):
        (one,) = read_recordings(Path(called), MAPPING, tmp_path / "home", CONFIG)
        assert one.content_hash == expected and one.name == f"{name}-1.0.0" == place_name(Path(called))
    with pytest.raises(BadInputError, match=rf"walls does not exist.*no dataset 'walls'.*{name}"):
        read_recordings(Path("walls"), MAPPING, tmp_path / "home", CONFIG)
    with pytest.raises(BadInputError, match="does not exist: expected a dataset, or logs"):
        read_recordings(Path("w" * 400), MAPPING, tmp_path / "home", CONFIG)


def test_long_episodes_become_pieces_that_share_a_state(tmp_path: Path) -> None:
    archive = write_archive(tmp_path / "a.tar.gz", 500, seed=0)
    config = WalkingConfig(piece_s=3.0)
    pieces = read_recordings(archive, MAPPING, tmp_path / "home", config)[0].pieces
    assert [len(piece) for piece in pieces] == [180, 180, 139]
    np.testing.assert_array_equal(pieces[0].state[-1], pieces[1].state[0])


@pytest.mark.parametrize("terminal", ["drop", "stand_still"])
def test_only_a_next_state_that_was_made_up_is_no_step(tmp_path: Path, terminal: str) -> None:
    mapping, recorded = tmp_path / "m.toml", tmp_path / "run.log"
    ends = '\n[columns."next.terminated"]\nfields = ["fell"]\n'
    mapping.write_text(f'terminal = "{terminal}"\n{MAPPING.read_text()}{ends}')
    walk = log(200, 3)
    recorded.write_text(json.dumps({**walk, "fell": [[row == 199] for row in range(200)]}))
    (one,) = read_recordings(recorded, mapping, tmp_path / "home", CONFIG)
    assert one.rows == 199
    np.testing.assert_allclose(one.pieces[0].state[-1, :2] * 1000, walk["observations"][-1][:2], rtol=1e-5)


def test_recordings_of_one_name_are_told_apart(tmp_path: Path) -> None:
    for seed, day in enumerate(("day1", "day2")):
        (tmp_path / "logs" / day).mkdir(parents=True)
        write_archive(tmp_path / "logs" / day / "walk.tar.gz", 300, seed=seed)
    write_archive(tmp_path / "logs/alone.tar.gz", 300, seed=5)
    found = read_recordings(tmp_path / "logs", MAPPING, tmp_path / "home", CONFIG)
    alone, *walks = found
    assert alone.name == "alone"
    assert [one.name for one in walks] == [f"walk-{one.content_hash[:8]}" for one in walks]
    assert len({one.name for one in found}) == 3
    assert all(piece.recording == one.name for one in found for piece in one.pieces)


def test_a_recording_that_is_there_twice_would_be_predicted_from_itself(tmp_path: Path) -> None:
    first = write_archive(tmp_path / "walk.tar.gz", 300, seed=0)
    (tmp_path / "day").mkdir()
    for copy in ("copy.tar.gz", "day/walk.tar.gz"):
        shutil.copy(first, tmp_path / copy)
    write_archive(tmp_path / "other.tar.gz", 300, seed=1)
    told = r"copy.tar.gz and .*day/walk.tar.gz and .*/walk.tar.gz hold the same rows: move all but one aside"
    with pytest.raises(BadInputError, match=told):
        read_recordings(tmp_path, MAPPING, tmp_path / "home", CONFIG)


def test_a_recording_without_a_step_is_none(tmp_path: Path) -> None:
    mapping, recorded = tmp_path / "m.toml", tmp_path / "run.json"
    columns = "".join(
        f'[columns."{column}"]\nfields = ["{field}"]\n'
        for column, field in (("observation.state", "knee"), ("next.terminated", "broke"))
    )
    mapping.write_text(f'name = "toy"\ntask = "t"\nfps = 10\nterminal = "stand_still"\n{columns}')
    recorded.write_text(json.dumps({"knee": [0.5], "broke": [True]}))
    with pytest.raises(BadInputError, match=r"found none: .*run.json has no step: expected an episode"):
        read_recordings(recorded, mapping, tmp_path / "home", JointsConfig())


def test_a_piece_has_a_row_at_least(tmp_path: Path) -> None:
    write_archive(tmp_path / "walk.tar.gz", 80, seed=0)
    short = CONFIG.model_copy(update={"piece_s": 0.001})
    [found] = read_recordings(tmp_path / "walk.tar.gz", MAPPING, tmp_path / "home", short)
    assert [len(piece) for piece in found.pieces] == [1] * 79


def test_at_one_row_a_second_carrying_is_told_too() -> None:
    state = np.zeros((6, 5))
    state[:, 0] = np.arange(6) * 0.05
    assert not CONFIG.broken(state, 1).any()


def test_jumps_and_carried_stretches_are_no_walking() -> None:
    state = np.zeros((301, 5))
    state[:, 0] = np.arange(301) * 0.004  # 0.24 m/s
    state[100:, 1] += 0.08
    state[150:, 2] += 2 * np.pi  # the same heading
    state[160:, 2] += 0.2
    broken = CONFIG.broken(state, 60)
    assert np.flatnonzero(broken).tolist() == [99, 159]
    state[200:231, 0] += np.arange(31) * 0.01  # carried, 0.84 m/s
    state[231:, 0] += 0.3
    assert CONFIG.broken(state, 60)[200:230].all()


def test_nothing_usable_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="does not exist: expected a dataset, or logs"):
        read_recordings(tmp_path / "none", MAPPING, tmp_path, CONFIG)
    (tmp_path / "notes.txt").write_text("no log")
    with pytest.raises(BadInputError, match=r"found none: it has no datasets, no archives"):
        read_recordings(tmp_path, MAPPING, tmp_path / "home", CONFIG)
    (tmp_path / "other.json").write_text('{"speed": [1, 2]}')
    with pytest.raises(BadInputError, match="no fields 'observations', 'actions'; known: speed"):
        read_recordings(tmp_path, MAPPING, tmp_path / "home", CONFIG)
