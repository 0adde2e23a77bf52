import re
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import pytest
from command_line import call, output_of
from fake_dataset import COLUMNS, DESCRIPTION, fake_episodes, write_fake
from rich.table import Table
from toy_logs import Columns, toy_columns, write_logs

from astra_data.cli import app as cli
from astra_data.cli.arguments import show_table
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.dataset.columns import Episode
from astra_data.dataset.edit import filter_episodes, subset
from astra_data.dataset.versions import open_dataset, versions_at_home


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path))
    write_fake(tmp_path / "fake/data-1.0.0", subset_seed=3)
    return "fake@data-1.0.0"


def test_every_edit_is_the_next_version_at_home(fake: str, tmp_path: Path) -> None:
    assert "(fake@data-1.1.0, 2 episodes, " in output_of("subset", fake, "--percent", "40")
    assert "(fake@data-1.2.0, 3 episodes, " in output_of("filter", fake, "--without", "13", "--without", "0")
    assert "(fake@data-1.3.0, 2 episodes, " in output_of("filter", fake, "--success")
    assert "(fake@data-1.4.0, 3 episodes, " in output_of("filter", fake, "--no-success")
    merged = output_of("merge", "fake@data-1.3.0", "fake@data-1.4.0", "--out", str(tmp_path / "here"))
    assert "(fake@data-1.4.0, 5 episodes, 55 " in merged
    assert open_dataset(tmp_path / "here").verify() == [] and len(versions_at_home("fake")) == 5


def test_an_edit_tells_what_the_name_means_from_now_on(fake: str, tmp_path: Path) -> None:
    note = "note: fake now means this version, no longer data-1.0.0; --name keeps both apart\n"
    assert output_of("subset", fake, "--percent", "40").endswith(note)
    for apart in (("--name", "part"), ("--out", str(tmp_path / "here"))):
        assert "note" not in output_of("subset", fake, "--percent", "40", *apart)
    write_fake(tmp_path / "fake/data-2.0.0", description={**DESCRIPTION, "version": "2.0.0"})
    # Of an older version, it is not the newest.
    assert "(fake@data-1.2.0, 2 episodes, " in (output := output_of("subset", fake, "--percent", "40"))
    assert "note" not in output


def test_episodes_are_those_between_the_bounds_and_of_the_stored_order(fake: str, tmp_path: Path) -> None:
    def uids(*arguments: str) -> list[int]:
        out = tmp_path / "-".join(arguments)
        output_of(*arguments[:1], fake, *arguments[1:], "--out", str(out))
        return [int(uid) for uid in open_dataset(out).uids]

    # Returns are half the uids; lengths are 7, 1, 12, 30 and 5.
    assert uids("filter", "--min-return", "2", "--max-return", "3") == [4, 6]
    assert uids("filter", "--min-length", "5", "--max-length", "12") == [13, 2**53 + 1, 0]
    stored = subset(open_dataset(fake), episodes=3, out=tmp_path / "stored")
    taken = uids("subset", "--episodes", "3")
    assert taken == open_dataset(stored).uids.tolist() and taken != uids("subset", "--episodes", "3", "--seed", "0")


def test_a_refused_edit_writes_nothing(fake: str) -> None:
    result = call("filter", fake, "--without", "1")
    assert isinstance(result.exception, BadInputError) and len(versions_at_home("fake")) == 1


def test_a_recipe_says_its_sizes_itself() -> None:
    result = call("subset", "r.toml", "--percent", "50")
    assert str(result.exception) == "subset: the recipe's [sweep] sets this: leave out --percent"
    for option in (("--seed", "0", "--seed", "1"), ("--jobs", "1"), ("--root", "elsewhere")):
        result = call("subset", "fake", "--percent", "50", *option)
        assert "at most one --seed, no --jobs and no --root" in str(result.exception)


def test_a_dataset_is_shown_and_drawn(tmp_path: Path) -> None:
    write_fake(tmp_path / "fake")
    result = call("inspect", str(tmp_path / "fake"), "--plot", str(tmp_path / "plots"))
    assert "fake@data-1.0.0: 5 episodes" in result.output
    assert result.output.splitlines()[-1] == f"written: {tmp_path / 'plots/position_coverage.png'}"
    (picture,) = (tmp_path / "plots").iterdir()  # its roles tell positions but no velocities
    assert matplotlib.image.imread(picture).std() > 0.05


def test_findings_are_shown_with_their_remedies(tmp_path: Path) -> None:
    def copied(uid: int, columns: Columns) -> Columns | None:
        return toy_columns(2) if uid > 20 else None

    logs = tmp_path / "my logs"
    write_logs(logs, copied)
    result = call("inspect", str(logs))
    lines = result.output.splitlines()
    assert result.exit_code == 0 and lines[-1].startswith("warning: ") and "check-up" in lines
    assert " (episodes 21, 22, 23, 24, 25 and 4 more): " in lines[-1]
    assert f"astra-data filter '{logs}' --without 21" in lines[-1]


def test_what_does_not_fit_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    write_fake(tmp_path / "fake")
    write_fake(tmp_path / "mute", columns=[replace(column, astra=None) for column in COLUMNS])
    for name, plot, told in (
        ("none", "plots", "no such folder"),
        ("mute", "plots", "expected a state with the role position or vector"),
        ("fake", "file", "cannot be written: "),
    ):
        error = call("inspect", str(tmp_path / name), "--plot", str(tmp_path / plot)).exception
        assert isinstance(error, AstraDataError) and told in str(error)


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


def test_a_home_that_is_no_folder_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "home").touch()
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    for error in (call("list").exception, call("inspect", "fake").exception):
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
    given = {one.uid: {**one.columns, column.name: one.columns["action"]} for one in fake_episodes()}
    episodes = (Episode(uid, columns, {bad: 1.0}) for uid, columns in given.items())
    write_fake(root, episodes, columns=[*COLUMNS, column], task=bad, description=description)
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


def called(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["astra-data", *map(str, arguments)])
    with pytest.raises(SystemExit) as left:
        cli.main()
    return int(left.value.code or 0)


def test_validate_and_repair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_fake(tmp_path / "a set").root
    assert called(monkeypatch, "validate", root) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"{root} is intact: 5 episodes, 55 steps\nepisodes end: ")
    (root / "meta/tasks.parquet").unlink()
    (root / "meta/stats.json").write_text("{}")
    assert called(monkeypatch, "validate", root) == 1
    told = capsys.readouterr().err
    assert told.startswith(f"error: {root} has ") and "meta/tasks.parquet is missing" in told
    assert "meta/stats.json was altered" in told and told.endswith(f"astra-data repair '{root}' --out DIR\n")
    assert f"LeRobot's tools edited it: astra-data repair '{root}' --like ORIGINAL --out DIR\n" in told
    assert called(monkeypatch, "repair", root, "--out", tmp_path / "saved") == 0
    assert "finished: " in capsys.readouterr().out
    assert called(monkeypatch, "repair", root, "--out", tmp_path / "saved") == 1
    assert "exists already" in capsys.readouterr().err and called(monkeypatch, "validate", tmp_path / "saved") == 0


def test_lineage_and_differences_are_shown(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "first")
    made = filter_episodes(first, without=[13], out=tmp_path / "made")
    assert output_of("log", str(made)).splitlines()[1].startswith("└── fake@data-1.0.0  ")
    told = output_of("log", str(first.root), str(made)).splitlines()
    both, only = (
        ["1.0.0: 5 episodes, 55 steps", "1.1.0: 4 episodes, 48 steps"],
        "1 episodes only in fake@data-1.0.0: 13",
    )
    assert told[:3] == [*(f"fake@data-{one}" for one in both), only] and "stage: 'collect', then 'filter'" in told
    assert output_of("log", str(made), str(first.root)).splitlines()[2] == only


def test_values_are_told_from_metadata(tmp_path: Path) -> None:
    episodes = (replace(one, metadata={**one.metadata, "source": "log.csv"}) for one in fake_episodes())
    first, second = write_fake(tmp_path / "first"), write_fake(tmp_path / "second", episodes)
    told = output_of("log", str(first.root), str(second.root)).splitlines()
    metadata = "5 episodes differ in metadata: source (0, 4, 6, 13, 9007199254740993)"
    assert told[2:] == ["0 episodes differ in values", metadata]
    other = write_fake(tmp_path / "other")
    assert output_of("log", str(first.root), str(other.root)).splitlines()[2:] == []


def test_cells_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("field")
    cells = ("x[m]", "rate[/s]", "pose:x:raw")
    for cell in cells:
        table.add_row(cell)
    show_table(table)
    assert all(cell in shown for shown in [capsys.readouterr().out] for cell in cells)
