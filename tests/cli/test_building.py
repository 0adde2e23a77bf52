from pathlib import Path

import pytest
from command_line import call

from astra_data.core.errors import AstraDataError
from astra_data.dataset.columns import Episode
from astra_data.dataset.reader import Dataset
from astra_data.dataset.staging import StagedWriter
from astra_data.dataset.versions import open_dataset

pytestmark = pytest.mark.usefixtures("home")

SMALL = ["--episodes", "2", "--max-steps", "3"]


def test_a_dataset_is_collected_and_paired_without_a_recipe(home: Path) -> None:
    collected = call("collect", "antmaze-umaze", *SMALL, "--seed", "3")
    folder = home / "antmaze-umaze-random-seed3/data-1.0.0"
    assert collected.output.splitlines()[-1] == f"finished: {folder}"
    assert "target steps/s" in collected.output
    dataset = Dataset.open(folder)
    assert (len(dataset), dataset.lengths.tolist()) == (2, [3, 3])
    paired = call("pair", "antmaze-umaze-random-seed3", "--simulator", "antmaze-umaze")
    assert paired.output.splitlines()[-1] == f"finished: {folder.with_name('data-2.0.0')}"
    newest = open_dataset("antmaze-umaze-random-seed3")
    assert newest.description["parents"] == [dataset.identity]


def test_an_option_of_0_is_given(home: Path) -> None:
    call("collect", "antmaze-umaze", *SMALL, "--name", "walks")
    call("pair", "walks", "--simulator", "antmaze-umaze", "--reset-tolerance", "0")
    assert open_dataset("walks").description["config"]["reset_tolerance"] == 0.0


def test_commands_may_be_held_for_no_time(home: Path) -> None:
    call("collect", "antmaze-umaze", *SMALL, "--hold-s", "0", "0", "--name", "restless")
    call("collect", "antmaze-umaze", *SMALL, "--hold-s", "9", "9", "--name", "patient")
    counts = [
        len({tuple(row) for row in open_dataset(name).columns(["action"], [0])["action"].tolist()})
        for name in ("restless", "patient")
    ]
    assert counts == [3, 1]


def test_folder_and_name_can_be_chosen(tmp_path: Path) -> None:
    assert (
        call("collect", "antmaze-long", *SMALL, "--out", str(tmp_path / "a"), "--name", "walks").exit_code
        == 0
    )
    assert Dataset.open(tmp_path / "a").reference == "walks@data-1.0.0"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["collect", "recipe.toml", "--episodes", "3"], r"\[collect\] sets this: leave out --episodes"),
        (["collect", "recipe.toml", "--resume"], r"leave out --resume"),
        (["collect", "antmaze-umaze", "--seed", "1", "--seed", "2"], r"give at most one --seed"),
        (["collect", "antmaze-umaze", "--behavior", "wild"], r"behavior: expected 'random', .*got 'wild'"),
        (
            ["collect", "antmaze-umaze", "--random-share", "0.5"],
            r"random_share: expected the behavior of a pol",
        ),
        (["collect", "antmaze-umaze", "--max-steps", "-1"], r"max_steps: expected greater than"),
        (
            ["collect", "humanoid-walker2d", "--clearance-m", "0.5", "--start", "task"],
            r"expected a task in a maze",
        ),
        (["collect", "antmaze-umase"], r"did you mean 'antmaze-umaze'"),
        (
            ["pair", "recipe.toml", "--simulator", "antmaze-umaze"],
            r"\[pair\] sets this: leave out --simulator",
        ),
        (["pair", "walks", "--jobs", "2", "--simulator", "antmaze-umaze"], r"leave out --seed and --jobs"),
        (["pair", "walks"], r"expected --simulator"),
        (["pair", "walks", "--simulator", "antmaze-umaze"], r"no dataset 'walks'"),
    ],
)
def test_what_does_not_fit_is_told(home: Path, arguments: list[str], told: str) -> None:
    error = call(*arguments).exception
    assert isinstance(error, AstraDataError)
    with pytest.raises(AstraDataError, match=told):
        raise error
    assert not home.exists()


def test_datasets_at_home_are_listed(home: Path) -> None:
    call("collect", "antmaze-umaze", *SMALL, "--name", "walks")
    call("pair", "walks", "--simulator", "antmaze-umaze", "--name", "pairs")
    told = call("list").output
    assert [line.split()[1] for line in told.splitlines() if "@" in line] == [
        "pairs@data-1.0.0",
        "walks@data-1.0.0",
    ]


def test_stopping_a_recording_says_how_to_go_on(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add = StagedWriter.add

    def stop(writer: StagedWriter, episode: Episode, position: int | None = None) -> None:
        add(writer, episode, position)
        raise KeyboardInterrupt

    monkeypatch.setattr(StagedWriter, "add", stop)
    stopped = call("collect", "antmaze-umaze", *SMALL)
    assert stopped.exit_code == 130
    assert stopped.output.splitlines()[-1] == "stopped: run the same command with --resume to continue"
    monkeypatch.setattr(StagedWriter, "add", add)
    assert "resume it" in str(call("collect", "antmaze-umaze", *SMALL).exception)
    assert call("collect", "antmaze-umaze", *SMALL, "--resume").exit_code == 0
