import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import pytest
from command_line import call
from fake_dataset import COLUMNS, DESCRIPTION, fake_episodes, write_fake, writer
from toy_logs import Columns, toy_columns, write_logs

from astra_data.cli import app as cli
from astra_data.core.errors import AstraDataError
from astra_data.dataset.columns import Episode


def test_a_dataset_is_shown_and_drawn(tmp_path: Path) -> None:
    write_fake(tmp_path / "fake")
    result = call("inspect", str(tmp_path / "fake"), "--plot", str(tmp_path / "plots"))
    assert "fake@data-1.0.0: 5 episodes" in result.output
    assert result.output.splitlines()[-1] == f"written: {tmp_path / 'plots/position_coverage.png'}"
    # Its roles tell positions but no velocities.
    (picture,) = (tmp_path / "plots").iterdir()
    assert matplotlib.image.imread(picture).std() > 0.05


def test_findings_are_shown_and_written(tmp_path: Path) -> None:
    def copied(uid: int, columns: Columns) -> Columns | None:
        return toy_columns(2) if uid > 20 else None

    logs = tmp_path / "my logs"
    write_logs(logs, copied)
    result = call("inspect", str(logs), "--json", str(tmp_path / "found.json"))
    assert result.exit_code == 0
    lines = result.output.splitlines()
    found = json.loads((tmp_path / "found.json").read_text())
    (finding,) = found["findings"]
    assert finding["episodes"] == [*range(21, 30)]
    assert f"astra-data filter '{logs}' --without 21" in finding["advice"]
    shown = "warning: " + finding["what"] + " (episodes 21, 22, 23, 24, 25 and 4 more): " + finding["advice"]
    assert lines[-5:] == ["check-up", *found["summary"], shown, f"written: {tmp_path / 'found.json'}"][-5:]


def test_what_does_not_fit_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    write_fake(tmp_path / "fake")
    write_fake(tmp_path / "mute", columns=[replace(column, astra=None) for column in COLUMNS])
    for arguments, told in (
        ([str(tmp_path / "none")], "no such folder"),
        (
            [str(tmp_path / "mute"), "--plot", str(tmp_path / "plots")],
            "expected a state with the role position or vector",
        ),
        ([str(tmp_path / "fake"), "--plot", str(tmp_path / "file")], "cannot be written: a file is where"),
    ):
        error = call("inspect", *arguments).exception
        assert isinstance(error, AstraDataError)
        with pytest.raises(AstraDataError, match=told):
            raise error


def test_what_killed_commands_left_is_removed_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    dead, other = tmp_path / "home/ant/.data-1.0.0.tmp-7", tmp_path / "runs/.recipe.json.tmp-7"
    staged = tmp_path / "home/.walks.staged"
    for folder in (dead, other, staged):
        folder.mkdir(parents=True)
    assert call("list", "--clean").output.splitlines() == [
        f"kept: {staged}: the interrupted command can continue from it; otherwise delete it",
        f"removed: {dead}",
    ]
    assert not dead.exists() and other.exists()
    assert f"removed: {other}" in call("list", "--clean", str(tmp_path / "runs")).output
    staged.rmdir()
    assert call("list", "--clean").output == "found no leftovers of killed commands\n"
    assert "folders are for --clean" in str(call("list", str(tmp_path / "runs")).exception)


def test_a_damaged_dataset_hides_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path))
    for name in ("broken", "whole"):
        write_fake(tmp_path / name / "data-1.0.0")
    (tmp_path / "broken/data-1.0.0/meta/info.json").write_text("{")
    result = call("list")
    assert isinstance(result.exception, AstraDataError)
    assert "broken/data-1.0.0 is incomplete or was altered" in str(result.exception)
    assert result.output.count("@data-1.0.0") == 2 and "damaged" in result.output
    (tmp_path / "empty/data-1.0.0").mkdir(parents=True)
    result = call("list")
    assert isinstance(result.exception, AstraDataError)
    assert "empty/data-1.0.0" in str(result.exception) and "broken/data-1.0.0" in str(result.exception)
    assert result.output.count("@data-1.0.0") == 3


def test_a_folder_to_clean_that_is_not_there_is_told(tmp_path: Path) -> None:
    result = call("list", "--clean", str(tmp_path / "nowhere"))
    assert str(result.exception) == f"list --clean: expected folders, got {tmp_path / 'nowhere'}"


@pytest.mark.parametrize("command", [["list"], ["list", "--clean"], ["inspect", "fake"]])
def test_a_home_that_is_no_folder_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    (tmp_path / "home").touch()
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    error = call(*command).exception
    assert isinstance(error, AstraDataError)
    assert re.search("home is no folder: expected|expected folders, got .*home", str(error))


def test_no_name_controls_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of columns, values, units, tasks, settings and folders; in what is shown, noted and refused."""
    bad = "a\x1b]0;title\x07\nb\x9b31m"
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / bad))
    column = replace(COLUMNS[1], name=f"x{bad}", names=(f"x{bad}", "y"), astra={"unit": [bad, "m"]})
    description: dict[str, object] = {**DESCRIPTION, "config": {bad: bad}, "stage": f"s{bad}"}
    root = tmp_path / bad / "fake/data-1.0.0"
    with writer(root, columns=[*COLUMNS, column], task=bad, description=description) as open_writer:
        for episode in fake_episodes():
            columns = {**episode.columns, column.name: episode.columns["action"]}
            open_writer.add(Episode(episode.uid, columns, {bad: 1.0}))
    (root / "meta" / bad).touch()
    for command in ("list", "inspect", "log", "validate"):
        monkeypatch.setattr(sys, "argv", ["astra-data", command, *(["fake"] if command != "list" else [])])
        with pytest.raises(SystemExit):
            cli.main()
        shown = capsys.readouterr()
        assert not {"\x1b", "\x07", "\x9b"} & {*shown.out, *shown.err}, command
        assert not re.search("^b", shown.out + shown.err, re.MULTILINE)
    monkeypatch.setattr(sys, "argv", ["astra-data", "inspect", str(tmp_path / f"none{bad}")])
    with pytest.raises(SystemExit):
        cli.main()
    assert capsys.readouterr().err.count("\n  b") == 1
