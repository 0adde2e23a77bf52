import sys
from pathlib import Path

import pytest
from fake_dataset import write_fake

from astra_data.cli import app as cli


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["astra-data", *map(str, arguments)])
    with pytest.raises(SystemExit) as left:
        cli.main()
    return int(left.value.code or 0)


def test_validate_and_repair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_fake(tmp_path / "set").root
    assert run(monkeypatch, "validate", root) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"{root} is intact: 5 episodes, 55 steps\nepisodes end: ")
    (root / "meta/tasks.parquet").unlink()
    (root / "meta/stats.json").write_text("{}")
    assert run(monkeypatch, "validate", root) == 1
    told = capsys.readouterr().err
    assert told.startswith(f"error: {root} has ")
    assert "meta/tasks.parquet is missing" in told
    assert "meta/stats.json: min of observation.state is None" in told
    assert told.endswith(f"astra-data repair {root} --out DIR\n")
    assert run(monkeypatch, "repair", root, "--out", tmp_path / "saved") == 0
    assert "finished: " in capsys.readouterr().out
    assert run(monkeypatch, "repair", root, "--out", tmp_path / "saved") == 1
    assert "exists already" in capsys.readouterr().err
    assert run(monkeypatch, "validate", tmp_path / "saved") == 0


def test_repair_takes_a_name_as_other_commands_do(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_fake(home / "walks" / "data-1.0.0").root
    (root / "meta/stats.json").unlink()
    for number, name in enumerate(("walks", "walks@data-1.0.0", str(root))):
        saved = tmp_path / str(number)
        assert run(monkeypatch, "repair", name, "--out", saved) == 0
        assert capsys.readouterr().out.endswith(f"finished: {saved} (5 episodes, 55 steps)\n")
    assert run(monkeypatch, "repair", "walk", "--out", tmp_path / "saved") == 1
    assert "no dataset 'walk'" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["validate", "repair"])
def test_a_folder_of_versions_is_told_with_their_names(
    command: str, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for version in ("data-1.0.0", "data-1.1.0"):
        write_fake(home / "walks" / version)
    out = ("--out", home / "saved") if command == "repair" else ()
    assert run(monkeypatch, command, home / "walks", *out) == 1
    told = capsys.readouterr().err
    assert told.endswith("walks contains versions of a dataset: name one of data-1.0.0, data-1.1.0.\n")


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ("{", "meta/info.json is no JSON object"),
        ("{}", "fps is None"),
        ('{"fps": 10, "features": {}}', "data_path is None"),
    ],
)
def test_repair_is_not_advised_where_it_cannot_help(
    content: str,
    fault: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    root = write_fake(tmp_path / "set").root
    (root / "meta/info.json").write_text(content)
    assert run(monkeypatch, "validate", root) == 1
    told = capsys.readouterr().err
    assert fault in told and "astra-data repair" not in told
    assert run(monkeypatch, "repair", root, "--out", tmp_path / "saved") == 1


def test_validate_counts_all_faults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_fake(tmp_path / "set").root
    (root / "data/0.txt").touch()
    run(monkeypatch, "validate", root)
    assert "has 1 error:" in capsys.readouterr().err
    for number in range(30):
        (root / f"data/{number}.txt").touch()
    run(monkeypatch, "validate", root)
    assert "has 30 errors:" in capsys.readouterr().err
